"""Radiance along rays by path tracing."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from iif_core.errors import InputError
from iif_core.light.transport.arrays import batches, chunks, rows_of, to_numpy, vectors
from iif_core.light.transport.cache import RadianceCache
from iif_core.light.transport.emitters import Emitters
from iif_core.light.transport.geometry import Geometry, nearest_hit
from iif_core.light.transport.kernels import RadianceCollector, World, incoming, uniform

Array = np.ndarray


def check_counts(samples: int, max_bounces: int) -> None:
    """Raises InputError for sample and bounce counts that make no path."""
    if samples < 1 or max_bounces < 0:
        raise InputError(f"samples={samples}, max_bounces={max_bounces}: at least 1 sample and 0 bounces")


@dr.syntax
def _radiance_sum(
    world: World,
    rng: Any,
    origin: Any,
    direction: Any,
    d_du: Any,
    d_dv: Any,
    sample: Any,
    end: Any,
    max_bounces: Any,
) -> Any:
    total = mi.Color3f(0)
    while sample < end:
        du = uniform(rng) - 0.5
        dv = uniform(rng) - 0.5
        toward = dr.normalize(direction + du * d_du + dv * d_dv)
        radiance, rng = incoming(world, rng, origin, toward, dr.inf, 0, max_bounces, True)
        total += radiance
        sample += 1
    return total


def render(
    geometry: Geometry,
    material: Any,
    emitters: Emitters,
    origins: ArrayLike,
    directions: ArrayLike,
    samples: int,
    max_bounces: int,
    seed: int,
    cache: RadianceCache | None = None,
    jitter: tuple[ArrayLike, ArrayLike] | None = None,
    chunk: int | None = None,
) -> Array:
    """Mean radiance (n, 3) float32, linear, of `samples` paths along each ray.

    origins (n, 3) or (3,) metres; directions (n, 3), any length. max_bounces counts surface interactions: 0 =
    visible emission only, 1 = direct light. jitter = (d_du, d_dv), (n, 3) or (3,) each: the direction becomes
    d + xi_1 d_du + xi_2 d_dv with xi uniform in [-1/2, 1/2) BEFORE it is normalised, a box filter over the
    pixel (METHOD 1.4). The first hit is always shaded with its material; from the second on a path ends in
    `cache` where it has a voxel. chunk: lanes on the device at once, a lane being up to 8 samples of a ray
    (default 2^18). Unbiased but for the offset along the normal, the bounce limit and the cache. Source:
    METHOD 2.5, 3.
    """
    check_counts(samples, max_bounces)
    directions = np.asarray(directions, np.float32)
    directions = rows_of(directions, len(directions), 3, "directions")
    if not (np.abs(directions).max(axis=1, initial=0) > 0).all():
        raise InputError("directions contain a zero vector")
    origins = rows_of(np.broadcast_to(np.asarray(origins, np.float32), directions.shape), len(directions), 3, "origins")
    steps = (np.zeros(3), np.zeros(3)) if jitter is None else jitter
    d_du, d_dv = (
        rows_of(np.broadcast_to(np.asarray(step, np.float32), directions.shape), len(directions), 3, "jitter") for step in steps
    )
    world = World(geometry, material, emitters, cache, RadianceCollector())
    result = np.zeros(directions.shape, np.float32)
    for batch in batches(len(directions), samples, 3, chunk):
        total = _radiance_sum(
            world,
            batch.streams(seed),
            batch.spread(mi.Point3f, origins),
            batch.spread(mi.Vector3f, directions),
            batch.spread(mi.Vector3f, d_du),
            batch.spread(mi.Vector3f, d_dv),
            *batch.samples(samples),
            dr.opaque(mi.UInt32, max_bounces),
        )
        dr.eval(total)
        result[batch.part] = batch.collect(total) / samples
    return result


def first_hits(
    geometry: Geometry, material: Any, origins: ArrayLike, directions: ArrayLike, chunk: int = 1 << 20
) -> tuple[Array, Array, Array]:
    """(base colour (n, 3), normal (n, 3) towards the viewer, face (n,) int32) of what rays meet first; 0, 0, -1 for a miss.

    The noise-free guides of a denoiser. origins (n, 3) or (3,), directions (n, 3), any length.
    """
    directions = np.asarray(directions, np.float32).reshape(-1, 3)
    origins = np.broadcast_to(np.asarray(origins, np.float32), directions.shape)
    colour, normal = np.zeros((2, *directions.shape), np.float32)
    face = np.full(len(directions), -1, np.int32)
    for part in chunks(len(directions), chunk):
        way = vectors(mi.Vector3f, directions[part])
        hit = nearest_hit(geometry, vectors(mi.Point3f, origins[part]), way, mi.Bool(True))
        base_color, _, _ = material(hit.point, hit.face, hit.object_id, hit.valid)
        toward = dr.select(dr.dot(hit.normal, way) > 0, -hit.normal, hit.normal)
        results = (
            dr.select(hit.valid, base_color, 0),
            dr.select(hit.valid, toward, 0),
            dr.select(hit.valid, mi.Int32(hit.face), -1),
        )
        dr.eval(results)
        colour[part], normal[part], face[part] = (to_numpy(result) for result in results)
    return colour, normal, face
