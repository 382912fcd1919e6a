"""Radiance along rays by path tracing."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from iif_core.errors import InputError
from iif_core.light.transport.arrays import batches, chunks, rows_of, to_numpy, vectors
from iif_core.light.transport.geometry import Geometry, nearest_hit
from iif_core.light.transport.kernels import RadianceCollector, World, incoming, uniform
from iif_core.light.transport.scene import Material, PathOptions, Scene

Array = np.ndarray


@dr.syntax
def radiance_sum(
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
    """Sum over the paths of every lane of what its ray gains; a collector that keeps the light itself lets it gain 0."""
    total = mi.Color3f(0)
    while sample < end:
        du = uniform(rng) - 0.5
        dv = uniform(rng) - 0.5
        # Jitter after normalisation would widen the footprint away from the centre of the picture (Eq. S.20).
        toward = dr.normalize(direction + du * d_du + dv * d_dv)
        # Nothing else finds what a camera ray meets; an infinite density gives it weight 1.
        radiance, rng = incoming(world, rng, origin, toward, dr.inf, 0, max_bounces, True)
        total += radiance
        sample += 1
    return total


def render(
    scene: Scene,
    origins: ArrayLike,
    directions: ArrayLike,
    paths: PathOptions,
    jitter: tuple[ArrayLike, ArrayLike] | None = None,
) -> Array:
    """Estimate the radiance that arrives along rays, the mean over `paths.samples` paths.

    Unbiased except for the offset of new rays along the normal, the limit of bounces and the radiance cache
    (docs/method/shading.md#paths).

    Args:
        scene: what paths meet. The first hit is always shaded with its material and never taken from the cache.
        origins: (n, 3) or (3,) metres.
        directions: (n, 3) of any length above 0.
        paths: 0 bounces = visible emission, 1 = direct light.
        jitter: (d_du, d_dv), each (n, 3) or (3,): the direction becomes d + xi_1 d_du + xi_2 d_dv with xi uniform in
            [-1/2, 1/2) before it is normalised, a box filter over the pixel. None = none.

    Returns:
        (n, 3) float32 radiance, linear.

    Raises:
        InputError: wrong shapes, non-finite numbers, a zero direction.
        TransportError: light that is not finite.
    """
    directions = np.asarray(directions, np.float32)
    directions = rows_of(directions, len(directions), 3, "directions")
    if not (np.abs(directions).max(axis=1, initial=0) > 0).all():
        raise InputError("directions contain a zero vector")
    origins = rows_of(np.broadcast_to(np.asarray(origins, np.float32), directions.shape), len(directions), 3, "origins")
    steps = (np.zeros(3), np.zeros(3)) if jitter is None else jitter
    d_du, d_dv = (
        rows_of(np.broadcast_to(np.asarray(step, np.float32), directions.shape), len(directions), 3, "jitter") for step in steps
    )
    world = World(scene, RadianceCollector())
    result = np.zeros(directions.shape, np.float32)
    for batch in batches(len(directions), paths.samples, 3, paths.chunk):
        total = radiance_sum(
            world,
            batch.streams(paths.seed),
            batch.spread(mi.Point3f, origins),
            batch.spread(mi.Vector3f, directions),
            batch.spread(mi.Vector3f, d_du),
            batch.spread(mi.Vector3f, d_dv),
            *batch.samples(paths.samples),
            dr.opaque(mi.UInt32, paths.max_bounces),
        )
        dr.eval(total)
        result[batch.part] = batch.collect(total) / paths.samples
    return result


def first_hits(
    geometry: Geometry, material: Material, origins: ArrayLike, directions: ArrayLike, chunk: int = 1 << 20
) -> tuple[Array, Array, Array]:
    """Look up base colour, normal and face where rays first meet the mesh: the noise-free guides of a denoiser.

    Args:
        geometry, material: as in `Scene`.
        origins, directions: as in `render`.
        chunk: rays on the device at once.

    Returns:
        Base colour (n, 3) float32 linear, unit normal towards the viewer (n, 3) float32, face (n,) int32. A ray that meets
        nothing gives 0, 0 and -1.
    """
    directions = np.asarray(directions, np.float32).reshape(-1, 3)
    origins = np.broadcast_to(np.asarray(origins, np.float32), directions.shape)
    colour, normal = np.zeros((2, *directions.shape), np.float32)
    face = np.full(len(directions), -1, np.int32)
    for part in chunks(len(directions), chunk):
        way = vectors(mi.Vector3f, directions[part])
        # No salt: guides show a sheet that lets light through, not what lies behind it.
        hit = nearest_hit(geometry, vectors(mi.Point3f, origins[part]), way, mi.Bool(True), salt=None)
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
