"""Light transport as the published method has it: one bounce, then the radiance cache (lab/docs/published.md).

A path ends at the second surface that it meets: at an emitter, in the cache, or in the dark. Emitters reflect, too.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from iif_core.errors import InputError
from iif_core.light.transport.arrays import Batch, batches, checked_points, on_device, rows_of, to_numpy
from iif_core.light.transport.geometry import nearest_hit, offset_from
from iif_core.light.transport.kernels import (
    RadianceCollector,
    Vertex,
    World,
    light_by_lobe,
    power_weight,
    sample_lobe,
    scatter_by_lobe,
    uniform,
)
from iif_core.light.transport.scene import PathOptions, Scene
from iif_core.numerics.xp import DRJIT
from iif_core.reflectance import brdf

Array = np.ndarray

LOBE_CHANCE = 0.5
"""Probability with which a path continues in the GGX lobe, whatever the material, as published."""


class BouncePaths(NamedTuple):
    """What the paths of n rays collect: R contributions of emitters, and the light of the cache.

    ray (R,) int64 number of the ray; emitter (R,) int64 number of the emitter; weight (R, 3) float32 radiance along the ray for
    each unit of the radiance of that emitter; cached (n, 3) float32 radiance that paths take from the cache.
    """

    ray: Array
    emitter: Array
    weight: Array
    cached: Array

    def radiance(self, emission: Array) -> Array:
        """Return the radiance along the rays (n, 3) float64, for emitters of radiance `emission` (G, 3)."""
        light = self.weight * emission[self.emitter]
        return self.cached + np.stack([np.bincount(self.ray, light[:, c], len(self.cached)) for c in range(3)], 1)

    def gradient(self, by_ray: Array, emitters: int) -> Array:
        """Return the derivative by the radiance of the emitters (G, 3), from that by the radiance along the rays (n, 3)."""
        light = self.weight * by_ray[self.ray]
        return np.stack([np.bincount(self.emitter, light[:, c], emitters) for c in range(3)], 1)


def trace_bounce(
    scene: Scene,
    emitter_of_face: ArrayLike,
    origins: ArrayLike,
    directions: ArrayLike,
    jitter: tuple[ArrayLike, ArrayLike],
    paths: PathOptions,
    mixed_measures: bool = False,
) -> BouncePaths:
    """Trace camera rays, one light sample and one direction of the BRDF each (Eq. T.3).

    Args:
        scene: its emitters say how often faces are drawn, by their sampling weight; their radiance is not used.
        emitter_of_face: (m,) int number of the emitter that a face belongs to, -1 = none.
        origins: (n, 3) metres.
        directions: (n, 3); jitter: (n, 3) each, change of the direction to the next pixel on the right and below.
        paths: how many for each ray; bounces are not used.
        mixed_measures: weight directions that meet an emitter by densities of different measures, as published (Eq. T.4).

    Returns:
        The contributions, divided by the number of paths.
    """
    faces = np.ascontiguousarray(emitter_of_face, np.int32)
    if faces.shape != (len(scene.geometry.faces),):
        raise InputError(f"emitter_of_face has shape {faces.shape}, expected ({len(scene.geometry.faces)},)")
    count = len(np.asarray(directions))
    rows = [rows_of(value, count, 3, "camera rays") for value in (origins, directions, *jitter)]
    device = on_device(faces, mi.Int32)
    cached = np.zeros((count, 3), np.float32)
    found: list[tuple[Array, Array, Array]] = []
    world = World(scene, RadianceCollector())
    # A lane traces one path, so that its contributions need no sums.
    for batch in batches(count * paths.samples, 1, 16, paths.chunk):
        lanes = np.arange(batch.part.start, batch.part.stop)
        ray = lanes // paths.samples
        first = int(ray[0])
        kinds = (mi.Point3f, mi.Vector3f, mi.Vector3f, mi.Vector3f)
        some = (_spread(kind, part[first : ray[-1] + 1], ray - first) for kind, part in zip(kinds, rows, strict=True))
        emitters, weights, gain = _one_bounce(world, device, batch.streams(paths.seed), *some, mixed_measures)
        dr.eval(emitters, weights, gain)
        light = to_numpy(gain)
        cached += np.stack([np.bincount(ray, light[:, c], count) for c in range(3)], 1).astype(np.float32)
        for emitter, weight in zip(emitters, weights, strict=True):
            number = to_numpy(emitter)
            hit = np.flatnonzero(number >= 0)
            found.append((ray[hit], number[hit].astype(np.int64), to_numpy(weight)[hit] / np.float32(paths.samples)))
    joined = [np.concatenate(part) for part in zip(*found, strict=True)] if found else [np.zeros(0, np.int64)] * 2
    weight = joined[2] if found else np.zeros((0, 3), np.float32)
    return BouncePaths(joined[0], joined[1], weight, cached / np.float32(paths.samples))


def _spread(kind: Any, rows: Array, of: Array) -> Any:
    """Device vectors of the `rows` (k, 3), one for each lane: `of` (lanes,) is the row of a lane."""
    index = on_device(of.astype(np.uint32), mi.UInt32)
    return kind(*(dr.gather(mi.Float, on_device(rows[:, axis]), index) for axis in range(3)))


def _one_bounce(
    world: World, emitter_of_face: Any, rng: Any, origin: Any, direction: Any, right: Any, down: Any, mixed_measures: bool
) -> tuple[list[Any], list[Any], Any]:
    """Emitters (-1 = none) and weights of what is seen, drawn and met, and what is taken from the cache."""

    def emitter(face: Any, active: Any) -> Any:
        return dr.select(active, dr.gather(mi.Int32, emitter_of_face, face, active), -1)

    du, dv = uniform(rng) - 0.5, uniform(rng) - 0.5
    toward = dr.normalize(direction + du * right + dv * down)
    hit = nearest_hit(world.geometry, origin, toward, mi.Bool(True), None)
    cos_front = -dr.dot(hit.normal, toward)
    lit = hit.valid & (cos_front != 0)
    normal = dr.select(cos_front < 0, -hit.normal, hit.normal)
    base_color, roughness, metallic = world.material(hit.point, hit.face, hit.object_id, lit)
    vertex = Vertex(offset_from(hit.point, normal), normal, -toward, *brdf.kd_ks(base_color, metallic), roughness, LOBE_CHANCE)
    emitters, weights = [emitter(hit.face, hit.valid)], [mi.Color3f(dr.select(hit.valid, 1.0, 0.0))]
    if world.emitters.can_be_sampled:
        light, diffuse, specular = light_by_lobe(world, rng, vertex, lit)
        emitters.append(emitter(light.face, light.valid))
        weights.append(diffuse + specular)
    goes_on, wi, diffuse, specular, pdf = scatter_by_lobe(rng, vertex, lit)
    throughput = diffuse + specular
    met = nearest_hit(world.geometry, vertex.point, wi, goes_on, None)
    cosine = dr.abs(dr.dot(met.normal, wi))
    _, pdf_area, _, _ = world.emitters.surface(met.face, cosine, met.valid)
    other = pdf_area if mixed_measures else pdf_area * met.t * met.t / cosine
    number = emitter(met.face, met.valid)
    emitters.append(number)
    weights.append(throughput * power_weight(pdf, other))
    stored, radiance = world.cache.radiance(met.point, met.valid & (number < 0))
    return emitters, weights, dr.select(stored, throughput * radiance, 0)


@dr.syntax
def _lobe_sum(
    world: World, rng: Any, point: Any, normal: Any, wo: Any, roughness: Any, specular: Any, sample: Any, end: Any
) -> Any:
    plain, fresnel = mi.Color3f(0), mi.Color3f(0)
    origin = offset_from(point, normal)
    while sample < end:
        u1 = uniform(rng)
        u2 = uniform(rng)
        wi = sample_lobe(specular, u1, u2, wo, normal, roughness)
        NoL, NoV, NoH, VoH, sin2_h = brdf.half_angles(DRJIT, normal, wi, wo)
        _, lobe, fc = brdf.lobes(DRJIT, NoL, NoV, NoH, VoH, sin2_h, roughness)
        pdf = brdf.specular_pdf(DRJIT, NoH, VoH, sin2_h, roughness)
        above = (dr.dot(normal, wi) > 0) & (dr.dot(normal, wo) > 0)
        weight = dr.select(specular, dr.select(pdf > 0, lobe / pdf, 0), 1)
        met = nearest_hit(world.geometry, origin, wi, above, None)
        radiance, _, emits, is_emitter = world.emitters.surface(met.face, -dr.dot(met.normal, wi), met.valid)
        stored, cached = world.cache.radiance(met.point, met.valid & ~is_emitter)
        light = dr.select(emits, radiance, dr.select(stored, cached, 0)) * dr.select(above, weight, 0)
        fresnel += light * dr.select(specular, fc, 0)
        plain += light * dr.select(specular, 1 - fc, 1)
        sample += 1
    return plain, fresnel


def shade_lobe(
    scene: Scene, points: ArrayLike, normals: ArrayLike, wo: ArrayLike, roughness: float | None, paths: PathOptions
) -> tuple[Array, Array]:
    """Integrate the light that arrives at points over one lobe, by directions of that lobe alone (Eq. T.5).

    Args:
        scene: geometry, emitters and cache; materials are not used, because paths end at the first surface.
        points, normals, wo: (n, 3) metres; normals, flipped to the viewer; towards the viewer.
        roughness: of the GGX lobe; None = the diffuse lobe.
        paths: how many; bounces are not used.

    Returns:
        S0 and S1 (n, 3) float32; of the diffuse lobe D and zeros.
    """
    points, normals, wo = checked_points(points, normals, wo)
    plain, fresnel = np.zeros((len(points), 3), np.float32), np.zeros((len(points), 3), np.float32)
    world = World(scene, RadianceCollector())
    specular, level = dr.opaque(mi.Bool, roughness is not None), dr.opaque(mi.Float, float(roughness or 1.0))
    for batch in batches(len(points), paths.samples, 6, paths.chunk):
        sums = _lobe_sum(
            world,
            batch.streams(paths.seed),
            *_surface(batch, points, normals, wo),
            level,
            specular,
            *batch.samples(paths.samples),
        )
        dr.eval(sums)
        plain[batch.part], fresnel[batch.part] = (batch.collect(part) for part in sums)
    return plain / np.float32(paths.samples), fresnel / np.float32(paths.samples)


def _surface(batch: Batch, points: Array, normals: Array, wo: Array) -> tuple[Any, ...]:
    return tuple(batch.spread(kind, rows) for kind, rows in ((mi.Point3f, points), (mi.Vector3f, normals), (mi.Vector3f, wo)))
