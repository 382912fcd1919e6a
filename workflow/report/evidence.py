"""Collects what the stages measured, for the verdict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from iif_core.light.emission.odds import DOUBTFUL
from iif_core.light.emission.options import EmissionOptions
from workflow.decisions import numerics
from workflow.report.emitters import lamp_power
from workflow.report.reported import Reported
from workflow.report.scores import found
from workflow.report.verdict import Evidence
from workflow.report.views import psnr_of_views
from workflow.report.wording import percent

NUMERICS = ("base", "emission", "shading", "affines")
"""Stages that say where their arithmetic came close to its end."""
BRIGHT = 12.0
"""A surface that is at most so many times as bright as nine tenths of the room may reflect its light: a white ceiling around a
lamp was 3 to 11 times as bright, window panes and lamp shades 11 to 80 times (lab/notebook/verdicts.md)."""
LEAST_SATURATED = 5e-3
"""Share of the pixels that must be saturated for what the re-rendering shows there to be told."""
SHOWN = 0.2
"""A lamp that fewer pixels show than this share of what surface of its area has on average is hardly photographed."""


def evidence_of(scene: Reported) -> Evidence:
    """Return what is known about a result."""
    capture, recovered, means = scene.capture, scene.recovered, scene.summary["means"]
    emission, affines = scene.document("emission"), scene.document("affines")
    scale = affines.get("scale") or {}
    cache = [
        decision["value"]
        for decision in scene.document("shading").get("plan", [])
        if decision["component"] == "radiance_cache" and "value" in decision
    ]
    emitters = scene.readers["export"].table("emitters.parquet")
    light, pixels = scene.readers["emission"], sum(view.width * view.height for view in capture.used)
    density = min(pixels, EmissionOptions.pixels) / max(float(recovered.surface.areas.sum()), 1e-9)
    fitted = scene.readers["affines"]
    lamps = emitters["kept"].astype(bool) & (emitters["kind"] == "area")
    probability = emitters.get("probability", np.full(len(lamps), -1.0))
    unlikely, power = lamps & (probability >= 0) & (probability < DOUBTFUL), lamp_power(emitters)
    doubted = dict(zip(emitters["name"][unlikely].tolist(), probability[unlikely].tolist(), strict=True))
    alone = scene.document("reconstruction") if "reconstruction" in scene.readers else {}
    photographed = float(cache[-1]) if cache else scene.document("plan").get("probes", {}).get("photographed_share")
    scored = psnr_of_views(scene.readers["metrics"].table("metrics.parquet"))
    worst = min(scored, key=lambda view: scored[view], default="")
    aside = [scored[view.name] for view in scene.capture.views if view.split == "test" and view.name in scored]
    uncertainty = fitted.table("cells.parquet").get("uncertainty", ())

    def psnr(quantity: str) -> float | None:
        return found(means, quantity, "raw", "psnr").get("mean")

    def over_all(quantity: str) -> float | None:
        """PSNR of the mean square over the views: the mean of their PSNR is that of views which show no metal at all."""
        square = found(means, quantity, "raw", "l2").get("mean")
        return None if square is None else float(-10 * np.log10(max(square, 1e-12)))

    return Evidence(
        **of_geometry(capture.facts, len(capture.views), alone, emission.get("escape_share") or {}, photographed),
        stability=scene.document("segmentation").get("stability"),
        lamps=len(set(emitters["name"][lamps].tolist())),
        unlikely=[f"{name} ({percent(p)})" for name, p in doubted.items()],
        unlikely_power=float(power[unlikely].sum() / max(power[lamps].sum(), 1e-300)),
        environment=bool(np.any(recovered.light.environment)),
        doubtful_area=doubtful_area(light.table("emitters.parquet"), light.table("radiance_cache.parquet"), density),
        misfit=emission.get("misfit"),
        **_missed(scene.document("render").get("saturated") or {}),
        light_spread=found(means, "rgb", "raw", "light_spread").get("mean"),
        held_out=psnr("rgb_held_out"),
        others=found(means, "rgb_held_out", "raw", "psnr", "photo_mean").get("mean"),
        held_out_each=aside,
        held_out_views=int(found(means, "rgb_held_out", "raw", "psnr").get("views", 0)),
        used=psnr("rgb"),
        worst=(worst, scored[worst]) if worst else None,
        albedo=psnr("albedo"),
        roughness=over_all("roughness"),
        metallic=over_all("metallic"),
        roughness_interval=roughness_interval(scene.objects),
        has_truth=capture.has_truth,
        prior=str(scene.prior.get("kind", "")),
        uncertainty=float(np.median(uncertainty)) if len(uncertainty) else None,
        unfitted=unfitted_share(fitted.table("objects.parquet")),
        level=str(scale.get("kind", "")),
        level_error=scale.get("relative_error"),
        raised=float(np.exp(emission.get("level_raised") or 0.0)),
        light_scale=float(scale.get("factor", 1.0)),
        discrepancy=(affines.get("level_errors") or {}).get("normalised_discrepancy"),
        warnings=[(stage, says) for stage in NUMERICS for says in numerics.warnings([(stage, scene.document(stage))])],
    )


def of_geometry(
    capture: Mapping[str, Any],
    photographs: int,
    alone: Mapping[str, Any],
    escape: Mapping[str, float],
    photographed: float | None,
) -> dict[str, Any]:
    """Return the evidence on the geometry, which stage `plan` has already.

    Args:
        capture: capture.json.
        photographs: number of those that are there.
        alone: reconstruction.json of photographs alone; else empty.
        escape: shares of the rays from cameras (`primary`) and from surface (`secondary`) that leave the mesh.
        photographed: share of the surface met by rays from surface that photographs show.
    """
    alignment, registration = capture.get("alignment") or {}, capture.get("registration") or {}
    agreement = [view["agreement"] for view in registration.get("views", {}).values() if view.get("agreement")]
    left_out = [capture.get(key) or () for key in ("dropped_views", "left_out_views")] + [alone.get("left_out", ())]
    return {
        "escape": escape.get("secondary"),
        "escape_camera": escape.get("primary"),
        # The depth of photographs alone is what their mesh was made of.
        "depth": None if alone else alignment.get("depth_median_disagreement"),
        "edges": alignment.get("edge_correlation"),
        "edges_warn": any("may not be aligned" in str(note) for note in capture.get("notes", [])),
        "agreement": float(np.median(agreement)) if agreement else None,
        "confirmed": float(np.mean(alone["depth_share"])) if alone else None,
        "built": sum(float(side["added_m2"]) for side in alone.get("planes", ())),
        "photographs": photographs,
        "added": bool(capture.get("added_faces")),
        "lost": sum(map(len, left_out)),
        "photographed": photographed,
    }


def _missed(saturated: Mapping[str, Any]) -> dict[str, Any]:
    """Return `missed` and `missed_in` of the evidence, from render.json; nothing where hardly anything is saturated."""
    if saturated.get("share", 0.0) < LEAST_SATURATED:
        return {}
    return {"missed": saturated["dark_share"], "missed_in": saturated["worst"]}


def doubtful_area(emitters: Mapping[str, np.ndarray], cache: Mapping[str, np.ndarray], pixels_per_m2: float) -> float:
    """Return the area in m^2 of what was taken for lamps without clear evidence: it hardly outshines what reflects (`BRIGHT`), or
    is hardly photographed (`SHOWN`).

    Args:
        emitters, cache: columns of emitters.parquet and radiance_cache.parquet of stage emission.
        pixels_per_m2: pixels of photographs per area of the mesh.
    """
    lamps, surface = (np.mean([table[f"radiance_{c}"] for c in "rgb"], axis=0) for table in (emitters, cache))
    area, kept = emitters["area_m2"], emitters["kept"].astype(bool) & (emitters["kind"] == "area")
    bright = lamps > BRIGHT * np.quantile(surface, 0.9) if len(surface) else np.zeros(len(lamps), bool)
    shown = emitters["observations"] >= SHOWN * pixels_per_m2 * area
    return float(area[kept & ~(bright & shown)].sum())


def unfitted_share(objects: Mapping[str, np.ndarray]) -> float | None:
    """Return the share of pixels on objects that were not fitted by themselves, from objects.parquet of stage affines; None where
    it does not say."""
    if "model" not in objects or "pixels" not in objects or not objects["pixels"].sum() > 0:
        return None
    alone = np.array([not str(model).startswith(("population", "identity")) for model in objects["model"]], bool)
    return float(objects["pixels"][~alone].sum() / objects["pixels"].sum())


def roughness_interval(objects: Sequence[Mapping[str, str]]) -> float | None:
    """Return half of the 95 % interval of roughness, on its longer side, as the median over the pixels seen, from the rows of
    objects.csv; None where less than half of the pixels are on objects whose interval is narrower than 0 to 1."""
    width, pixels = [], []
    for row in objects:
        value, low, high = (float(row[f"roughness{end}"]) for end in ("", "_low", "_high"))
        width.append(max(high - value, value - low) if high - low < 1 else np.inf)
        pixels.append(float(row["pixels"] or 0))
    if not sum(pixels):
        return None
    order = np.argsort(width, kind="stable")
    share = np.cumsum(np.array(pixels)[order])
    middle = width[order[np.searchsorted(share, 0.5 * share[-1])]]
    return middle if np.isfinite(middle) else None
