"""report: one page to judge the result by, and the plan of the scene."""

from __future__ import annotations

from typing import Any

import numpy as np

from iif_core.numerics import color
from workflow.artifacts.store import ids_from_disk, material_maps, prediction_numbers, rgb
from workflow.decisions import numerics
from workflow.decisions.expected import whole, with_expectation
from workflow.decisions.plan import GAINS, with_override
from workflow.decisions.record import FORCED, PROVISIONAL, SETTLED, plan_text
from workflow.report import pictures as pic
from workflow.report.page import Page, Picture, Strip, Table, ViewRows, render_page, score_table
from workflow.runtime.job import Job
from workflow.runtime.timings import read_timings
from workflow.scene.normal_form import CaptureReader, View
from workflow.scene.recovered import Recovered, read_recovered, response_samples

PLAN_KEYS = (
    "component",
    "included",
    "status",
    "measure",
    "value",
    "threshold",
    "gain_nats",
    "error_nats",
    "rows",
    "reason",
    "override",
)
ERROR_RANGE = 0.25
COVERAGE_RANGE = 4.0
UNCERTAINTY_RANGE = 0.2
CHANNEL_COLOURS = ("#c33", "#292", "#34c")


NUMERICS = ("base", "emission", "shading", "affines")
"""Stages that say where their arithmetic came close to its end."""


def run(job: Job) -> None:
    """Write report.html and plan.yaml."""
    capture = CaptureReader(job.read("capture"))
    recovered = read_recovered(job)
    summary = job.read("metrics").json("summary.json")
    cost = whole(job.scene, job.quality)
    plan = [with_expectation(item, cost) for item in collect_plan(job)]
    job.writer.bytes("plan.yaml", plan_text(job.scene, job.quality, plan).encode())
    response_svg, response_note = _response(job, capture)
    emission = _document(job, "emission", "emission.json")
    page = Page(
        scene=job.scene,
        credit=job.settings.report.credit or str(capture.facts.get("credit", "")),
        headline=_headline(summary, capture, recovered),
        facts=_facts(job, capture, recovered),
        notes=[str(note) for note in capture.facts.get("notes", [])] + [str(n) for n in emission.get("notes", [])],
        warnings=numerics.warnings((stage, _document(job, stage, f"{stage}.json")) for stage in NUMERICS),
        plan=plan,
        tables=_tables(summary),
        views=_views(job, capture, recovered),
        emitters=_emitters(job, recovered),
        emitter_note=_emitter_note(capture, recovered),
        response_svg=response_svg,
        response_note=response_note,
        timings=read_timings(job.scene),
        versions=sorted(job.read("export").manifest.get("versions", {}).items()),
    )
    job.writer.bytes("report.html", render_page(page).encode())


# ---------------------------------------------------------------------------------------------------------------- plan


def collect_plan(job: Job) -> list[dict[str, Any]]:
    """Return the plan items in the JSON documents of the stages (key `plan`), with the name of the rule, in the order in which
    their components are first named. What a later stage found replaces what was planned; of gains that no stage had a reason to
    try there are none."""
    items: dict[str, dict[str, Any]] = {}
    for stage in job.stage.upstream:
        reader = job.read(stage)
        for name in reader.names():
            if "/" in name or not name.endswith(".json"):
                continue
            document = reader.json(name)
            found = document.get("plan", []) if isinstance(document, dict) else []
            for item in found if isinstance(found, list) else []:
                kept = {key: item[key] for key in PLAN_KEYS if key in item}
                earlier = items.get(item["component"], {})
                forced = {"status": FORCED} if earlier.get("status") == FORCED else {}
                found_here = {**kept, "included": bool(item.get("included")), **forced, "rule": stage}
                items[item["component"]] = {"status": SETTLED, **found_here}
    untried = {"included": False, "status": SETTLED, "reason": "no stage had a reason to try it"}
    settled = ({**i, **untried} if i["status"] == PROVISIONAL and i["component"] in GAINS else i for i in items.values())
    return [with_override(item) for item in settled]


# ---------------------------------------------------------------------------------------------------------------- text


def _document(job: Job, stage: str, name: str) -> dict[str, Any]:
    reader = job.read(stage)
    return reader.json(name) if reader.has(name) else {}


def _headline(summary: dict[str, Any], capture: CaptureReader, recovered: Recovered) -> str:
    means = summary["means"].get("result", {})
    psnr = means.get("rgb", {}).get("raw", {}).get("psnr", {}).get("mean")
    text = f"Re-rendered views match the photographs with {psnr:.1f} dB PSNR (sensor values)." if psnr is not None else ""
    held_out = means.get("rgb_held_out", {}).get("raw", {}).get("psnr")
    if held_out is not None:
        text += f" The {held_out['views']} held-out photographs: {held_out['mean']:.1f} dB."
    gains = summary.get("gain_over_raw_predictions", {})
    gain = gains.get("albedo", {}).get("scaled", {}).get("psnr_db")
    if gain is not None:
        raw = means.get("albedo", {}).get("raw", {}).get("psnr", {}).get("mean")
        uncorrected = f"albedo has {raw:.1f} dB without correction; " if raw is not None else ""
        text += f" Against ground truth, {uncorrected}up to scale it gains {gain:+.1f} dB over the raw predictions of the prior."
        plain = summary["means"].get("object_mean", {}).get("albedo", {}).get("scaled", {}).get("psnr", {}).get("mean")
        own = means.get("albedo", {}).get("scaled", {}).get("psnr", {}).get("mean")
        if plain is not None and own is not None:
            text += f" Scaled albedo: {own:.1f} dB; the mean prediction of each object, as one flat colour, has {plain:.1f} dB."
    if not np.any(recovered.light.emits):
        text += " No lamp was found, so relighting has none to switch off."
    if gain is None and not capture.has_truth:
        text += " There is no ground truth for this scene: materials are judged by re-rendering alone."
    return text.strip()


def _fit_fact(facts: dict[str, Any]) -> str:
    history = facts["history"]
    if facts["converged"]:
        return f"converged in {len(history) - 1} steps"
    last = (history[-2] - history[-1]) / max(abs(history[-1]), 1e-12) if len(history) > 1 else 0.0
    return f"stopped after {len(history) - 1} steps, the last of which lowered the objective by {100 * last:.2g} %"


def _facts(job: Job, capture: CaptureReader, recovered: Recovered) -> list[tuple[str, str]]:
    first = capture.views[0]
    sizes = sorted({(v.width, v.height) for v in capture.views})
    exposures = capture.exposures()
    stops = np.log2(exposures.max() / exposures.min()) if exposures.min() > 0 else 0.0
    held_out = sum(v.split == "test" for v in capture.views)
    extent = np.ptp(recovered.surface.vertices, axis=0)
    prior = job.read("prior").manifest.get("settings", {}).get("prior", {})
    size = f"{first.width} x {first.height}" if len(sizes) == 1 else f"{len(sizes)} sizes, first {first.width} x {first.height}"
    facts = [
        ("quality", job.quality),
        ("source", str(capture.facts.get("source", ""))),
        ("photographs", f"{len(capture.views)} of {size} pixels, {capture.facts['dynamic_range'].upper()}"),
        ("exposures", f"{stops:.1f} stops apart" if stops > 0.01 else "all equal"),
        ("mesh", f"{len(recovered.surface.faces)} faces, {' x '.join(f'{v:.2f}' for v in extent)} m"),
        ("objects", _objects_fact(job, len(recovered.object_names))),
        ("material fit", _fit_fact(job.read("affines").json("affines.json"))),
        (
            "surface cells",
            f"{len(recovered.surface.cell_ijk)} of {1000 * recovered.surface.cell_edge:.1f} mm,"
            f" {100 * job.read('base').json('base.json')['seen_once_share']:.0f} % in one photograph only",
        ),
        ("prior", f"{prior.get('kind', 'unknown')}, {prior.get('samples', '?')} predictions a photograph"),
    ]
    if held_out:
        facts.insert(3, ("held out", f"{held_out} photographs were not used"))
    return facts


def _objects_fact(job: Job, count: int) -> str:
    """Return number, source and stability of the objects in words (docs/guide/segmentation.md)."""
    facts = _document(job, "segmentation", "segmentation.json")
    if not facts:
        return str(count)
    text = f"{count} ({facts['kind']}), {facts['objects_seen']} of them seen"
    if facts["stability"] is None:
        return text
    return f"{text}; stability {facts['stability']:.2f} (adjusted Rand index with {facts['perturbed']}; 1 = unmoved)"


def _scored(summary: dict[str, Any]) -> str:
    """Which views the scores are of."""
    views = summary["views"]
    return "the views" if views["scored"] == views["of"] else f"{views['scored']} of the {views['of']} views, spread evenly"


def _tables(summary: dict[str, Any]) -> list[Table]:
    means = summary["means"]
    any_held_out = "rgb_held_out" in means.get("result", {})
    materials = [("albedo", "raw", m) for m in ("l2", "psnr", "ssim", "flip")]
    materials += [("albedo", "scaled", m) for m in ("l2", "psnr", "ssim")]
    materials += [(q, "raw", m) for q in ("roughness", "metallic") for m in ("l2", "psnr", "ssim")]
    oracle = [(q, "oracle_affine", m) for q in ("albedo", "roughness", "metallic") for m in ("l2", "psnr", "ssim")]
    light = [("rgb", "raw", m) for m in ("l2", "psnr", "ssim", "flip", "log_l2", "light_spread")] + [("rgb", "scaled", "log_l2")]
    light += [("emission", "raw", m) for m in ("l2", "log_l2", "iou")] + [("emission", "scaled", m) for m in ("l2", "log_l2")]
    tables = [
        score_table(
            f"Materials against ground truth, mean over {_scored(summary)}",
            means,
            materials,
            "Linear values. Emitters, pixels without meaningful truth and (albedo) mirrors are left out, by the truth."
            " scaled = one gain per image and channel.",
        ),
        score_table(
            "Without truth",
            means,
            [("rgb_held_out", "raw", m) for m in ("l2", "psnr", "ssim", "flip")]
            + [("albedo", "raw", m) for m in ("shading_left", "shading_slope", "view_spread")],
            ("Held-out photographs: one exposure gain each where it is estimated. " if any_held_out else "")
            + "Shading left: correlation, inside objects, of log albedo with the log of the light that was found; 0 is none.",
        ),
        score_table("Light and re-rendering", means, light, "rgb: sensor values; its log L2: radiance, where known."),
        score_table(
            "With the best affine per image and object (an oracle)",
            means,
            oracle,
            "Every variant may correct each object by the truth; what remains is the error inside objects. Not a result.",
        ),
    ]
    return [table for table in tables if table]


# --------------------------------------------------------------------------------------------------------------- views


def _views(job: Job, capture: CaptureReader, recovered: Recovered) -> list[ViewRows]:
    count = min(job.settings.report.views, len(capture.views))
    chosen = np.unique(np.linspace(0, len(capture.views) - 1, count).round().astype(int))
    emission_exposure = _emission_exposure(recovered)
    exposures, rows = capture.exposures(), []
    for done, i in enumerate(chosen):
        rows.append(_view(job, capture, capture.views[i], float(exposures[i]), emission_exposure))
        job.progress(done + 1, len(chosen), "views drawn")
    return rows


def _emission_exposure(recovered: Recovered) -> float:
    """Return the factor at which emitters of median radiance, by area, appear just below white; brighter ones clip."""
    lit = np.flatnonzero(recovered.light.emits)
    peak, area = recovered.light.radiance[lit].max(-1), recovered.surface.areas[lit]
    order = np.argsort(peak, kind="stable")
    half = np.searchsorted(np.cumsum(area[order]), 0.5 * area.sum())
    return 0.8 / max(float(peak[order][min(half, len(lit) - 1)]), 1e-6) if len(lit) else 1.0


def _view(job: Job, capture: CaptureReader, view: View, exposure: float, emission_exposure: float) -> ViewRows:
    file = f"maps/{view.name}.exr"
    photo, valid = capture.photo(view, held_out=True)
    depth, face_id = capture.gbuffer(view)
    counted = valid & (face_id >= 0)
    rendered = job.read("render").exr(file)
    sensor = np.clip(exposure * photo, 0, 1) if capture.is_hdr else photo
    show = pic.linear if capture.is_hdr else pic.encoded
    result = material_maps(rendered) if "albedo.R" in rendered else None
    strips = [
        Strip(
            "result",
            [
                _tile("re-rendering", show(rgb(rendered, "ldr"))),
                *(_materials(result) if result else [None, None, None]),
                _tile("emission", pic.linear(rgb(rendered, "emission"), emission_exposure)),
                _tile(
                    "re-rendering error",
                    pic.difference(rgb(rendered, "ldr"), sensor, counted),
                    f"0 (dark) to {ERROR_RANGE} in sensor units",
                ),
            ],
        )
    ]
    photograph = _tile("photograph", show(sensor))
    if capture.has_truth:
        strips.append(_truth(capture, view, photograph, result, face_id >= 0, emission_exposure))
    predictions = job.read("prior").exr(file) if job.read("prior").has(file) else {}
    if prediction_numbers(predictions):
        strips.append(_prediction(predictions, None if capture.has_truth else photograph))
    elif not capture.has_truth:
        strips.append(Strip("photograph", [photograph]))
    strips.append(Strip("checks", _checks(job, file, sensor, depth, counted)))
    captions = [f"{view.width} x {view.height}", f"exposure {exposure:.3g}"]
    if view.split == "test":
        captions.append("held out: not used in the reconstruction")
    return ViewRows(view.name, ", ".join(captions), strips)


def _tile(title: str, image: np.ndarray, note: str = "", lossless: bool = False) -> Picture:
    return Picture(title, pic.data_uri(image, lossless), note)


def _materials(maps: dict[str, np.ndarray]) -> list[Picture | None]:
    return [
        _tile("albedo", pic.linear(maps["albedo"])),
        _tile("roughness", pic.grey(maps["roughness"])),
        _tile("metallic", pic.grey(maps["metallic"])),
    ]


def _truth(
    capture: CaptureReader,
    view: View,
    photograph: Picture,
    result: dict[str, np.ndarray] | None,
    hit: np.ndarray,
    emission_exposure: float,
) -> Strip:
    truth = capture.truth(view)
    maps = {"albedo": truth.albedo, "roughness": truth.roughness, "metallic": truth.metallic}
    emission = _tile("emission", pic.linear(truth.emission, emission_exposure), "same exposure as the result's")
    error = None
    if result:
        picture = pic.difference(result["albedo"], truth.albedo, truth.valid & hit & ~(truth.emission > 0).any(-1))
        error = _tile("albedo error", picture, f"0 to {ERROR_RANGE}, linear")
    return Strip("truth", [photograph, *_materials(maps), emission, error])


def _prediction(channels: dict[str, np.ndarray], photograph: Picture | None) -> Strip:
    """Show the first prediction, and the spread of the predictions."""
    numbers = prediction_numbers(channels)
    first = _materials(material_maps(channels, f"prior.{numbers[0]:03d}."))
    spread = np.std([rgb(channels, f"prior.{k:03d}.albedo") for k in numbers], axis=0).mean(-1)
    apart = _tile("disagreement", pic.scalar(spread, 0, UNCERTAINTY_RANGE), "albedo, over the predictions")
    return Strip("raw prediction", [photograph, *first, apart])


def _checks(job: Job, file: str, sensor: np.ndarray, depth: np.ndarray, counted: np.ndarray) -> list[Picture | None]:
    """Show alignment, objects, selected prediction, uncertainty and base texture of a view, as far as they exist."""
    out: list[Picture | None] = []
    if job.read("segmentation").has(file):
        channels = job.read("segmentation").exr(file)
        object_id, segment_id = ids_from_disk(channels["object.id"]), ids_from_disk(channels["segment.id"])
        out.append(_tile("alignment", pic.alignment(sensor, object_id, depth), lossless=True))
        out.append(_tile("objects", pic.overlay(sensor, object_id), "one colour for each object, over the photograph"))
        table = job.read("base").table("selection.parquet")
        if len(table["k"]):
            k = pic.selected_prediction(segment_id, table["segment_id"], table["k"], table["weight_albedo"])
            out.append(_tile("selected prediction", pic.ids(k), "one colour for each number k", lossless=True))
    if job.read("affines").has(file):
        uncertainty = job.read("affines").exr(file)["uncertainty"].astype(np.float32)
        note = f"claimed for the albedo, 0 to {UNCERTAINTY_RANGE}; errors that all predictions share are not in it"
        out.append(_tile("uncertainty", pic.scalar(uncertainty, 0, UNCERTAINTY_RANGE, mask=counted), note))
    if job.read("base").has(file):
        base = job.read("base").exr(file)
        out.append(_tile("base albedo", pic.linear(rgb(base, "albedo")), "before the fit"))
        note = f"weighted pixels of the surface cell, 0 (filled in) to {COVERAGE_RANGE:g}"
        out.append(_tile("coverage", pic.scalar(base["coverage"], 0, COVERAGE_RANGE, mask=counted), note))
    return out


# ----------------------------------------------------------------------------------------------- emitters and response


def _emitters(job: Job, recovered: Recovered) -> list[dict[str, Any]]:
    table = job.read("export").table("emitters.parquet")
    radiance = np.stack([table[f"radiance_{c}"] for c in "rgb"], 1).astype(np.float64)
    error = np.stack([table[f"error_{c}"] for c in "rgb"], 1).astype(np.float64)
    kept = table["kept"].astype(bool)
    sides = np.where(table["side"] == 0, 2.0, 1.0)
    area = table["kind"] == "area"
    power = np.where(kept & area, table["area_m2"] * sides, 0) * radiance.sum(1)
    rows = []
    for i in np.argsort(-power, kind="stable"):
        peak = radiance[i].max()
        swatch = color.to_uint8(color.srgb_from_linear(radiance[i] / peak if peak > 0 else radiance[i]))
        share = f"{100 * power[i] / power.sum():.1f} %" if area[i] and power.sum() > 0 else "–"
        rows.append(
            {
                "id": int(table["emitter_id"][i]),
                "kind": str(table["kind"][i]),
                "faces": int(table["faces"][i]),
                "area": float(table["area_m2"][i]),
                "radiance": ", ".join(f"{v:.3g}" for v in radiance[i]),
                "error": ", ".join(f"{v:.2g}" for v in error[i]),
                "swatch": "#{:02x}{:02x}{:02x}".format(*swatch),
                "share": share,
                "observations": int(table["observations"][i]),
                "kept": bool(kept[i]),
                "reason": str(table["reason"][i]),
            }
        )
    return rows


def _emitter_note(capture: CaptureReader, recovered: Recovered) -> str:
    text = "Radiance in the units of the photographs' exposure."
    if not capture.is_hdr:
        text += " With LDR photographs the factor between light and albedo is `affines.scale`."
    if recovered.light_scale != 1:
        text += f" Light was multiplied by {recovered.light_scale:.3g} for that."
    return text


def _response(job: Job, capture: CaptureReader) -> tuple[str, str]:
    reader = job.read("affines")
    if capture.is_hdr or not reader.has("camera_response.parquet"):
        return "", ""
    x, curves = response_samples(reader.table("camera_response.parquet"))
    if not len(x):
        return "", ""
    drawn = [(x, curve, colour, False) for curve, colour in zip(curves, CHANNEL_COLOURS, strict=True)]
    note = "Sensor value over exposed radiance, red, green and blue, as fitted."
    truth = capture.facts.get("response_truth")
    if truth is not None:
        truth = np.asarray(truth, np.float64)
        grid = np.linspace(0, 1, truth.shape[1])
        drawn += [(grid, curve, colour, True) for curve, colour in zip(truth, CHANNEL_COLOURS, strict=True)]
        fitted = np.stack([np.interp(grid, x, curve) for curve in curves])
        rms = float(np.sqrt(np.mean((fitted - truth) ** 2)))
        note += f" Dashed: what the camera did; difference {rms:.4f} (root mean square, sensor units)."
    return pic.curves_svg(drawn), note
