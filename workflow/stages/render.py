"""render: re-renders every view from the recovered materials and emitters, by path tracing
(docs/method/shading.md#re-rendering)."""

from __future__ import annotations

from typing import Any

import numpy as np

from iif_core.camera.pixels import pixel_gains, pixel_steps
from iif_core.camera.response import SATURATION
from iif_core.evaluation.consistency import held_out_gain
from iif_core.evaluation.light import dark_where_saturated
from workflow.artifacts.store import rgb, split_rgb
from workflow.decisions import light as decisions
from workflow.decisions.plan import ESCAPE_OPEN
from workflow.models.denoise import denoise, require_denoiser
from workflow.runtime import device
from workflow.runtime.job import Job
from workflow.scene.base_scene import read_gains, read_radiance_cache
from workflow.scene.cached_light import ends_in_cache, has_lobes
from workflow.scene.fitted_maps import fitted_maps, without_emitters
from workflow.scene.normal_form import CaptureReader
from workflow.scene.picture_facts import view_attributes
from workflow.scene.recovered import read_recovered, read_response
from workflow.scene.unexplained import Unexplained

MAX_BOUNCES = 16  # of a path
WORST = 3
"""Photographs that are named where light is missing."""
_SEEDS = 0x72656E  # keeps the random streams of this stage apart from those of others


def run(job: Job) -> None:
    """Write maps/<view>.exr, which is published: the re-rendering, its sensor value, emission and the fitted maps; and
    unexplained/<view>.exr, held_out.parquet.

    The sensor value is the re-rendering through the gains of the view and the fitted response, clipped to [0, 1]. A held-out
    photograph of unknown exposure gets the gain with which its own re-rendering is nearest to it, one for each channel where
    the white balance of the camera was found to change. Nothing else is taken from its colours.
    """
    capture, scene = CaptureReader(job.read("capture")), read_recovered(job)
    curve, gains = read_response(job.read("affines")), read_gains(job)
    device.mitsuba()
    geometry, material = scene.surface.traceable(scene.light.emits)
    from iif_core.light.transport.render import render
    from iif_core.light.transport.scene import PathOptions, Scene

    if job.settings.render.denoise:
        require_denoiser()
    emitters = scene.light.emitters(geometry)
    if not (emitters.can_be_sampled or scene.light.environment.any()):
        job.log.warning("no emitter and no environment: the re-renderings are black (see emission.json)")
    # What matte surface shows of other surface is a mean over many directions, for which photographed radiance is good enough.
    cache = None if has_lobes(job) or not ends_in_cache(job.read("shading")) else read_radiance_cache(job, scene.light_scale)
    how = "whole paths" if cache is None else "paths that end where radiance was photographed"
    job.log.info("views are re-rendered by %s", how)
    world = Scene(geometry, material, emitters, cache)
    found: dict[int, np.ndarray] = {}
    bright: list[tuple[str, int, int, int]] = []
    unexplained = Unexplained(job, capture, scene, curve)
    through_holes = job.read("emission").json("emission.json")["escape_share"]["secondary"] > ESCAPE_OPEN
    white_balance = bool((gains.gain != gains.gain[:, :1]).any())
    for done, view in enumerate(capture.views):
        job.progress(done, len(capture.views), "views re-rendered")
        eye = view.world_from_camera[:3, 3]
        _, face_id = capture.gbuffer(view)
        seed = ((job.seed << 32) | _SEEDS) << 32 | view.view_id
        fitted = fitted_maps(job.read("affines"), job.read("segmentation"), view)
        paths = PathOptions(job.settings.render.samples, MAX_BOUNCES, seed)
        jitter = pixel_steps(view, face_id, through_holes)
        radiance = render(world, eye, view.directions().reshape(-1, 3), paths, jitter).reshape(view.height, view.width, 3)
        if job.settings.render.denoise:
            albedo = rgb(fitted, "albedo") if "albedo.R" in fitted else np.zeros_like(radiance)
            radiance = denoise(radiance, albedo, scene.surface.seen_normals(face_id, eye))
        factor = pixel_gains(gains, done, view, np.arange(view.height * view.width)).reshape(radiance.shape)
        if view.split == "test" and capture.facts.get("exposure_estimated"):
            photo, valid = capture.photo(view, held_out=True)
            found[view.view_id] = held_out_gain(factor * radiance, photo, valid & (face_id >= 0), curve, white_balance)
            factor = factor * found[view.view_id]
        sensor = curve(np.clip(factor * radiance, 0, 1))
        channels = {**split_rgb(radiance), **split_rgb(np.clip(sensor, 0, 1), "ldr")}
        emission = scene.emission_map(face_id, eye)
        channels |= split_rgb(emission, "emission") | without_emitters(fitted, emission.any(-1))
        unexplained.add(view, radiance, factor, emission.any(-1))
        if not capture.is_hdr and view.split != "test":
            photo, valid = capture.photo(view)
            own = valid & (face_id >= 0)
            bright.append((view.name, int(own.sum()), *dark_where_saturated(photo, sensor, own, curve.inverse, SATURATION)))
        attributes = view_attributes(view, float(factor.mean()))
        job.writer.exr(f"maps/{view.name}.exr", channels, "relative", attributes=attributes)
    if found:
        rows = np.array(list(found.values()))
        columns = {"view_id": np.array(list(found), np.int32), **{f"gain_{c}": rows[:, i] for i, c in enumerate("rgb")}}
        job.writer.table("held_out.parquet", columns)
    job.progress(len(capture.views), len(capture.views), "views re-rendered")
    strength, decision = unexplained.write()
    job.log.info("unexplained light: %s", decision["reason"])
    facts = {"beta": strength.beta.tolist(), "share": strength.share, "share_error": strength.error}
    plan = [decisions.denoiser(job.settings.render.denoise), decision]
    job.writer.json("render.json", {"paths": how, "unexplained": facts, "saturated": _saturated(bright), "plan": plan})


def _saturated(views: list[tuple[str, int, int, int]]) -> dict[str, Any]:
    """Return what render.json says of saturated pixels; of each view: its name, pixels, those that are saturated, and of these
    those that are re-rendered dark."""
    pixels, saturated, dark = (sum(view[i] for view in views) for i in (1, 2, 3))
    worst = sorted((view for view in views if view[3]), key=lambda view: -view[3])[:WORST]
    return {
        "share": saturated / pixels if pixels else 0.0,
        "dark_share": dark / saturated if saturated else 0.0,
        "worst": [view[0] for view in worst],
    }
