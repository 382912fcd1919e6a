"""Light that keeps the room as bright when a gauge divides all albedos (docs/method/fitting.md#level-of-all-albedos)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from iif_core.fitting.gauge import is_divided, kept_brightness
from iif_core.fitting.problem import FitResult
from iif_core.light.base_scene import BaseScene
from iif_core.reflectance.material import apply_affines, unclamped_material
from workflow.fitting.fit_input import FitInputs
from workflow.runtime import device
from workflow.runtime.job import Job
from workflow.scene.base_scene import base_maps, read_lit_scene
from workflow.scene.cached_light import ends_in_cache, has_lobes

RAYS, PATHS, MAX_BOUNCES = 6144, 64, 16
_SEEDS = 0x67617567  # keeps the random streams apart from those of other traces


def interreflection(job: Job, inputs: FitInputs, before: FitResult, after: FitResult) -> float:
    """Return the factor on all light, beyond that of the gauge, with which the room is as bright as before.

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
    counts = ~(light.emits | scene.is_sheer) & np.append(is_divided(before), False)[scene.object_id]  # the last for -1
    origins, rays = camera_rays(job, inputs, before, scene, counts)
    if not len(rays):
        return 1.0
    device.mitsuba()
    from iif_core.light.transport.render import render
    from iif_core.light.transport.scene import PathOptions, Scene

    first = _painted(scene, inputs, before)
    geometry, material = first.traceable(light.emits)
    shown = []
    for fit in (before, after):
        scale = np.float32(fit.light_scale)
        lit = replace(light, radiance=light.radiance * scale, environment=light.environment * scale)
        paint = material if fit is before else _painted(scene, inputs, after).repainted(material)
        # The same random numbers both times: most of the noise cancels in the ratio.
        paths = PathOptions(PATHS, MAX_BOUNCES, (job.seed << 32) | _SEEDS)
        shown.append(render(Scene(geometry, paint, lit.emitters(geometry)), origins, rays, paths))
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


def camera_rays(
    job: Job, inputs: FitInputs, before: FitResult, scene: BaseScene, counts: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return origins and directions (n, 3) of about `RAYS` pixels, evenly over the used views.

    They show faces that count, (m,) bool, with an albedo that was at most 1: a larger one is limited when it is rendered, so
    that such surface was brighter in the fit than it can be shown.
    """
    used, rng = inputs.capture.used, np.random.default_rng([job.seed, _SEEDS])
    origins, rays = [np.zeros((0, 3))], [np.zeros((0, 3), np.float32)]
    for view in used:
        face = inputs.capture.gbuffer(view)[1].ravel()
        index = np.flatnonzero((face >= 0) & counts[face])
        albedo = unclamped_material(before.affine[scene.object_id[face[index]]], base_maps(job, view)[index])[:, :3]
        index = index[(albedo <= 1.0).all(1)]
        index = rng.choice(index, min(-(-RAYS // len(used)), len(index)), replace=False)
        rays.append(view.directions().reshape(-1, 3)[index])
        origins.append(np.tile(view.world_from_camera[:3, 3], (len(index), 1)))
    return np.concatenate(origins), np.concatenate(rays)
