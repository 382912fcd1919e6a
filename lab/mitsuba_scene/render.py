"""Photographs of the original scene by Mitsuba's own path tracer, along the rays of the capture's cameras.

The samples of a pixel (a box filter) are summed in order, so that the image does not depend on the number of threads.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from iif_core.camera.pinhole import direction_derivatives
from iif_core.light.transport.arrays import on_device, vectors
from lab.mitsuba_scene.flatten import texture_at
from lab.mitsuba_scene.scene import children
from workflow.scene.normal_form import View

Array = np.ndarray

PATHS_AT_ONCE = 1 << 19  # bounds the memory


def path_integrator(max_bounces: int) -> Any:
    """Return Mitsuba's `path` with that many surface interactions; its `max_depth` also counts the camera's segment."""
    return mi.load_dict({"type": "path", "max_depth": max_bounces + 1})


def balance_lights(scene: Any, shapes: list[Any]) -> None:
    """Make the path tracer choose area lights by power (nine parts in ten) and uniformly (one part), which only affects noise.

    Lights without area keep their share.
    """
    lights = [(shape, shape.emitter()) for shape in shapes if shape.emitter() is not None]
    power = np.array([_power(shape, light) for shape, light in lights])
    if len(lights) < 2 or not power.sum() > 0:
        return
    weight = 0.1 + 0.9 * len(lights) * power / power.sum()
    parameters = mi.traverse(scene)
    keys = {f"{shape.id()}.emitter.sampling_weight": float(w) for (shape, _), w in zip(lights, weight, strict=True)}
    for key, value in keys.items():
        if key in parameters:
            parameters[key] = value
    parameters.update()


def _power(shape: Any, light: Any) -> float:
    """Return area times mean radiance over a coarse grid of the texture, which is accurate enough for a sampling weight."""
    texture = children(light).get("radiance")
    if texture is None:
        return 0.0
    u, v = np.meshgrid((np.arange(8) + 0.5) / 8, (np.arange(8) + 0.5) / 8)
    mean = texture_at(texture, np.column_stack([u.ravel(), v.ravel()])).mean()
    return float(np.array(shape.surface_area()).ravel()[0] * mean)


def render_view(scene: Any, integrator: Any, view: View, samples: int, seed: int) -> tuple[Array, Array, int]:
    """Render a view; the result depends on the arguments alone.

    Args:
        scene: Mitsuba scene.
        integrator: of `path_integrator`.
        view: the camera.
        samples: paths per pixel.
        seed: of the random numbers.

    Returns:
        Radiance (H, W, 3) float32, valid (H, W) bool, and the number of samples that were not finite. Those are left out of the
        means; a pixel without finite samples has radiance 0 and is not valid.
    """
    directions = view.directions().reshape(-1, 3)
    d_du, d_dv = direction_derivatives(view.fx, view.fy, view.world_from_camera)
    origin = mi.Point3f(*view.world_from_camera[:3, 3].tolist())
    right, down = mi.Vector3f(*d_du.tolist()), mi.Vector3f(*d_dv.tolist())
    dr.make_opaque(origin, right, down)  # the kernel, which takes long to compile, is the same for all views
    radiance = np.zeros((len(directions), 3), np.float64)
    finite = np.zeros(len(directions), np.int64)
    for first in range(0, len(directions), PATHS_AT_ONCE):
        rows = slice(first, min(first + PATHS_AT_ONCE, len(directions)))
        count = rows.stop - rows.start
        device = [on_device(directions[rows, axis]) for axis in range(3)]
        done = 0
        while done < samples:
            repeat = min(max(1, PATHS_AT_ONCE // count), samples - done)
            sampler = mi.load_dict({"type": "independent"})
            key = np.random.SeedSequence([seed, view.view_id, first, done]).generate_state(1)[0]
            sampler.seed(int(key), count * repeat)
            toward = mi.Vector3f(*(dr.repeat(axis, repeat) for axis in device))
            du, dv = sampler.next_1d() - 0.5, sampler.next_1d() - 0.5
            toward = dr.normalize(toward + du * right + dv * down)
            value, _, _ = integrator.sample(scene, sampler, mi.RayDifferential3f(mi.Ray3f(origin, toward)))
            good = dr.all(dr.isfinite(value))
            value = dr.select(good, value, 0)
            good = dr.select(good, mi.UInt32(1), 0)
            dr.eval(value, good)
            radiance[rows] += np.array(value, np.float64).T.reshape(count, repeat, 3).sum(1)
            finite[rows] += np.array(good).reshape(count, repeat).sum(1, dtype=np.int64)
            done += repeat
    valid = finite > 0
    radiance[valid] /= finite[valid, None]
    shape = (view.height, view.width)
    image = np.maximum(radiance, 0).astype(np.float32).reshape(*shape, 3)
    return image, valid.reshape(shape), int(len(finite) * samples - finite.sum())


def original_distance(scene: Any, origin: Array, directions: Array) -> Array:
    """Return t (n,) of the first surface of the original scene along rays, inf = none; the mesh may lack that surface."""
    if not len(directions):  # an empty launch aborts the process
        return np.zeros(0, np.float32)
    start = mi.Point3f(*np.asarray(origin, np.float32).tolist())
    dr.make_opaque(start)
    ray = mi.Ray3f(start, vectors(mi.Vector3f, np.asarray(directions)))
    found = scene.ray_intersect_preliminary(ray)
    return np.array(dr.select(found.is_valid(), found.t, dr.inf))
