"""Light that keeps the room as bright when a gauge divides all albedos (docs/method/fitting.md#level-of-all-albedos)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from iif_core.fitting.gauge import kept_brightness
from iif_core.fitting.problem import FitResult
from iif_core.light.base_scene import BaseScene, Light
from iif_core.reflectance.material import apply_affines
from workflow.fitting.fit_input import FitInputs
from workflow.runtime import device
from workflow.runtime.job import Job
from workflow.scene.base_scene import read_lit_scene
from workflow.scene.cached_light import ends_in_cache, has_lobes
from workflow.scene.normal_form import CaptureReader

RAYS, PATHS, MAX_BOUNCES = 6144, 64, 16
_SEEDS = 0x67617567  # keeps the random streams apart from those of other traces


def interreflection(job: Job, inputs: FitInputs, before: FitResult, after: FitResult) -> float:
    """Return the factor on all light, beyond that of the gauge, with which the room is as bright as before (Eq. M.42).

    Args:
        job, inputs: of the stage.
        before, after: the fit without and with the gauge.

    Returns:
        1.0 where the gauge changes nothing, where the radiance of a lamp is known, and where photographed radiance stands for
        reflected light.
    """
    whole_paths = has_lobes(job) or not ends_in_cache(job.read("shading"))
    if after.light_scale == before.light_scale or inputs.gauge.kind == "lamp" or not whole_paths:
        return 1.0
    scene, light = read_lit_scene(job)
    origins, rays = _camera_rays(inputs.capture, scene, light, job.seed)
    if not len(rays):
        return 1.0
    shown = []
    device.mitsuba()
    from iif_core.light.transport.render import render
    from iif_core.light.transport.scene import PathOptions, Scene

    for fit in (before, after):
        scale = np.float32(fit.light_scale)
        lit = replace(light, radiance=light.radiance * scale, environment=light.environment * scale)
        geometry, material = _painted(scene, inputs, fit).traceable(light.emits)
        # The same paths both times, so that their noise has next to no part in the ratio.
        paths = PathOptions(PATHS, MAX_BOUNCES, (job.seed << 32) | _SEEDS)
        shown.append(render(Scene(geometry, material, lit.emitters(geometry)), origins, rays, paths))
    return kept_brightness(*shown)


def _painted(scene: BaseScene, inputs: FitInputs, fit: FitResult) -> BaseScene:
    """Return the scene with the materials of a fit."""
    cells = apply_affines(fit.affine, scene.cell_object.astype(np.int64), scene.cell_values)
    if inputs.textures is not None:
        cells[:, :3] = inputs.textures.albedo(fit)
    objects = scene.object_values
    if scene.n_objects:
        objects = apply_affines(fit.affine, np.arange(scene.n_objects), objects)
    return replace(scene, cell_values=cells.astype(np.float32), object_values=objects.astype(np.float32))


def _camera_rays(capture: CaptureReader, scene: BaseScene, light: Light, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return origins and directions (n, 3) of about RAYS pixels that show surface that does not shine, evenly over the views."""
    rng = np.random.default_rng([seed, _SEEDS])
    each = -(-RAYS // max(len(capture.used), 1))
    reflects = np.append(~(light.emits | scene.is_sheer), False)  # the last for pixels without surface, -1
    origins, rays = [np.zeros((0, 3))], [np.zeros((0, 3), np.float32)]
    for view in capture.used:
        index = np.flatnonzero(reflects[capture.gbuffer(view)[1].ravel()])
        index = rng.choice(index, min(each, len(index)), replace=False)
        rays.append(view.directions().reshape(-1, 3)[index])
        origins.append(np.tile(view.world_from_camera[:3, 3], (len(index), 1)))
    return np.concatenate(origins), np.concatenate(rays)
