"""Stage relit_scores: the recovered scene under new light, scored against its source under the same light
(lab/docs/evaluation.md#relighting)."""

from __future__ import annotations

import time
from collections import defaultdict
from typing import Any

import numpy as np

from iif_core.camera.pinhole import direction_derivatives
from iif_core.errors import InputError
from iif_core.evaluation.metrics import Score
from lab.relit.lamps import match_faces
from lab.relit.measures import METRICS, RelitTarget
from lab.relit.new_light import NewLight, relit_world, source_lamps
from workflow.artifacts.store import rgb, split_rgb
from workflow.models.denoise import denoise, require_denoiser
from workflow.runtime.job import Job
from workflow.scene.normal_form import CaptureReader, View
from workflow.scene.recovered import Recovered, read_recovered
from workflow.scoring.scores import UNITS, ScoreRows, perceptual_networks

_SEEDS = 0x726C7363  # keeps the random streams of this stage apart from those of others
NOISE = "noise"
"""Variant of the rows that compare two renderings of the source. They differ by twice the variance of one; a result is compared
with the mean of both and has three quarters of that, so their score is a bound on what noise takes from it."""


def run(job: Job) -> None:
    """Write scores.parquet (every light and view), scores.json (lamps and their matches, means) and <light>/<view>.exr.

    Raises:
        InputError: the pictures of the source are of another mesh.
    """
    capture, truth, scene = CaptureReader(job.read("capture")), job.read("relit_truth"), read_recovered(job)
    facts, wanted = truth.json("lights.json"), job.settings.relit
    if wanted.denoise:
        require_denoiser()
    lamps = source_lamps(capture)
    where = match_faces(lamps, scene.surface.vertices, scene.surface.faces, scene.light.emits)
    lamp_of_face = np.where(where >= 0, np.array([lamp.lamp for lamp in lamps] or [-1])[where], -1)
    networks = {"alex": perceptual_networks()["alex"]}
    views = {view.name: view for view in capture.views}
    rows, extra, done = ScoreRows(), defaultdict(list), 0
    count = len(facts["lights"]) * len(facts["views"])
    for number, document in enumerate(facts["lights"]):
        light = NewLight.of(document)
        found = light.lamp < 0 or bool((lamp_of_face == light.lamp).any())
        world = relit_world(scene, light, lamp_of_face)
        for name in facts["views"]:
            job.progress(done, count, "pictures under new light")
            done += 1
            started = time.monotonic()
            channels = truth.exr(f"{light.name}/{name}.exr")
            seed = ((((job.seed << 32) | _SEEDS) << 16 | number) << 32) | views[name].view_id
            radiance = _picture(world, views[name], wanted, seed)
            if not np.isfinite(radiance).all():
                raise InputError(f"{light.name}, view {name}: radiance is not finite; please report it with the scene")
            seconds = time.monotonic() - started
            job.writer.exr(f"{light.name}/{name}.exr", split_rgb(radiance), "relative")
            first, second, mask = rgb(channels), rgb(channels, "again"), channels["valid"] > 0.5
            for variant, image, source in (("result", radiance, (first + second) / 2), (NOISE, second, first)):
                target = RelitTarget(source, mask, document["exposure"], networks if variant != NOISE else None)
                metrics = METRICS if variant != NOISE else ("l2", "psnr", "ssim")
                _add(rows, extra, variant, name, light, found, seconds, list(target.scores(image, metrics)))
    job.progress(done, count, "pictures under new light")
    table = rows.table(job.scene)
    table |= {column: np.array(values, object) for column, values in extra.items() if column == "light"}
    table["found"] = np.array(extra["found"], bool)
    table["seconds"] = np.array(extra["seconds"], np.float64)
    job.writer.table("scores.parquet", table, UNITS)
    job.writer.json("scores.json", {"means": rows.means(), "not_scored": rows.missing, **_matches(scene, lamps, where, facts)})


def _add(
    rows: ScoreRows,
    extra: dict[str, list[Any]],
    variant: str,
    view: str,
    light: NewLight,
    found: bool,
    seconds: float,
    scores: list[Score],
) -> None:
    """Add the scores of one picture, and for each row its light, whether the recovery has it, and the seconds of rendering."""
    before = len(rows.columns["value"])
    rows.add(variant, view, light.quantity, scores)
    added = len(rows.columns["value"]) - before
    extra["light"] += [light.name] * added
    extra["found"] += [found] * added
    extra["seconds"] += [seconds] * added


def _picture(world: Any, view: View, wanted: Any, seed: int) -> np.ndarray:
    """Return (H, W, 3) float32 radiance."""
    from iif_core.light.transport.render import first_hits, render
    from iif_core.light.transport.scene import PathOptions

    shape, eye = (view.height, view.width, 3), view.world_from_camera[:3, 3]
    rays, steps = view.directions().reshape(-1, 3), direction_derivatives(view.fx, view.fy, view.world_from_camera)
    radiance = render(world, eye, rays, PathOptions(wanted.samples, wanted.max_bounces, seed), steps).reshape(shape)
    if not wanted.denoise or not radiance.any():  # the denoiser makes a faint haze of black
        return radiance
    albedo, normals, _ = first_hits(world.geometry, world.material, eye, rays)
    return denoise(radiance, albedo.reshape(shape), normals.reshape(shape))


def _matches(scene: Recovered, lamps: list[Any], where: np.ndarray, facts: dict[str, Any]) -> dict[str, Any]:
    """Say of each lamp of the source which surface was taken for it, and what the recovery has that belongs to none."""
    areas, power = scene.surface.areas, scene.surface.areas * scene.light.radiance.mean(1)
    out = []
    for number, lamp in enumerate(lamps):
        own = where == number
        shared = np.zeros(len(where), bool)
        shared[lamp.faces] = True
        out.append(
            {
                "lamp": lamp.lamp,
                "name": lamp.name,
                "share_of_power": next(f["share_of_power"] for f in facts["lamps"] if f["lamp"] == lamp.lamp),
                "found": bool(own.any()),
                "overlap": float(areas[own & shared].sum() / max(lamp.area, 1e-12)),
                "power_ratio": float(power[own].sum() / max(lamp.power, 1e-12)),
                "emitters": sorted({int(e) for e in scene.emitter_id[own] if e >= 0}),
            }
        )
    nowhere = scene.light.emits & (where < 0)
    total = float(power[scene.light.emits].sum())
    return {
        "lamps": out,
        "left_out": facts["left_out"],
        "unmatched_emitters": sorted({int(e) for e in scene.emitter_id[nowhere] if e >= 0}),
        "unmatched_share": float(power[nowhere].sum()) / total if total > 0 else 0.0,
    }
