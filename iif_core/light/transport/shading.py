"""Cached shading: diffuse and split specular lobes of points, all from ONE set of paths."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from iif_core.errors import InputError
from iif_core.light.transport.arrays import batches, rows_of
from iif_core.light.transport.cache import RadianceCache
from iif_core.light.transport.emitters import Emitters
from iif_core.light.transport.geometry import Geometry, offset_from
from iif_core.light.transport.kernels import RadianceCollector, World, incoming, power_weight, sample_light, sample_lobe, uniform
from iif_core.light.transport.render import check_counts
from iif_core.numerics.xp import DRJIT
from iif_core.reflectance import brdf
from iif_core.reflectance.brdf import R_MIN

Array = np.ndarray


class _Levels:
    """Roughness levels and the sampling lobes: the cosine twice, and GGX lobes from the sharpest level up to
    0.5."""

    def __init__(self, levels: Array):
        self.levels = [float(level) for level in levels]
        wanted = np.geomspace(min(levels.min(), 0.5), 0.5, 4) if len(levels) else []
        nearest = [int(np.argmin(np.abs(np.log(levels / value)))) for value in wanted]
        self.lobes = [self.levels[index] for index in dict.fromkeys(nearest)]
        self.cosine_lobes = 2
        self.count = self.cosine_lobes + len(self.lobes)

    def lobe_roughness(self, lobe: Any) -> Any:
        roughness = mi.Float(1)
        for number, level in enumerate(self.lobes):
            roughness = dr.select(lobe == self.cosine_lobes + number, level, roughness)
        return roughness

    def pdf(self, angles: tuple[Any, ...]) -> Any:
        """Density of the mixture of all lobes, each chosen equally often."""
        NoL, _, NoH, VoH, sin2_h = angles
        total = self.cosine_lobes * NoL * dr.inv_pi
        for level in self.lobes:
            total += brdf.specular_pdf(DRJIT, NoH, VoH, sin2_h, level)
        return total / self.count

    def accumulate(self, sums: list[Any], angles: tuple[Any, ...], radiance: Any) -> list[Any]:
        """Adds the lobes of one direction times its radiance / pdf to [diffuse, s0 ..., s1 ...]."""
        count = len(self.levels)
        NoL, NoV, NoH, VoH, sin2_h = angles
        result = list(sums)
        for number, level in enumerate(self.levels):
            _, spec, fc = brdf.lobes(DRJIT, NoL, NoV, NoH, VoH, sin2_h, level)
            result[1 + number] += radiance * (spec * (1 - fc))
            result[1 + count + number] += radiance * (spec * fc)
        result[0] += radiance * (NoL * dr.inv_pi)
        return result

    def light(self, world: World, rng: Any, point: Any, normal: Any, wo: Any, sums: list[Any]) -> list[Any]:
        """Next-event estimation for all lobes at once."""
        if not world.emitters.can_be_sampled:
            return sums
        light = sample_light(world, rng, point, normal, mi.Bool(True))
        angles = brdf.half_angles(DRJIT, normal, light.wi, wo)
        share = dr.select(light.valid, power_weight(light.pdf, self.pdf(angles)) / light.pdf, 0)
        return self.accumulate(sums, angles, light.radiance * share)


@dr.syntax
def _lobe_sums(
    world: World,
    levels: _Levels,
    rng: Any,
    point: Any,
    normal: Any,
    wo: Any,
    samples: Any,
    sample: Any,
    end: Any,
    max_bounces: Any,
) -> Any:
    sums = [mi.Color3f(0) for _ in range(1 + 2 * len(levels.levels))]
    origin = offset_from(point, normal)
    while sample < end:
        sums = levels.light(world, rng, origin, normal, wo, sums)
        # Stratified choice: over all samples every lobe is drawn equally often in expectation.
        position = (mi.Float(sample) + uniform(rng)) / mi.Float(samples)
        lobe = dr.minimum(mi.UInt32(position * levels.count), levels.count - 1)
        u1 = uniform(rng)
        u2 = uniform(rng)
        wi = sample_lobe(lobe >= levels.cosine_lobes, u1, u2, wo, normal, levels.lobe_roughness(lobe))
        angles = brdf.half_angles(DRJIT, normal, wi, wo)
        pdf = levels.pdf(angles)
        useful = (dr.dot(normal, wi) > 0) & (dr.dot(normal, wo) > 0) & (pdf > 0)
        radiance, rng = incoming(world, rng, origin, wi, pdf, 1, max_bounces, useful)
        sums = levels.accumulate(sums, angles, dr.select(useful, radiance / pdf, 0))
        sample += 1
    return sums


def unit_rows(vectors_: Array, name: str) -> Array:
    """Rows scaled to unit length; raises InputError for zero rows."""
    length = np.linalg.norm(vectors_, axis=1, keepdims=True)
    if not (length > 0).all():
        raise InputError(f"{name} contains a zero vector")
    return vectors_ / length


def surface_points(points: ArrayLike, normals: ArrayLike, wo: ArrayLike) -> tuple[Array, Array, Array]:
    """Checked (points, unit normals on the viewer's side, unit wo), each (n, 3) float32."""
    points = np.asarray(points, np.float32)
    count = len(points)
    points = rows_of(points, count, 3, "points")
    normals = unit_rows(rows_of(normals, count, 3, "normals"), "normals")
    wo = unit_rows(rows_of(wo, count, 3, "wo"), "wo")
    away = np.einsum("ij,ij->i", normals, wo) < 0
    return points, np.where(away[:, None], -normals, normals), wo


def shading_caches(
    geometry: Geometry,
    material: Any,
    emitters: Emitters,
    points: ArrayLike,
    normals: ArrayLike,
    wo: ArrayLike,
    levels: ArrayLike,
    samples: int,
    max_bounces: int,
    seed: int,
    cache: RadianceCache | None = None,
    chunk: int | None = None,
) -> tuple[Array, Array, Array]:
    """(diffuse (n, 3), s0 (n, J, 3), s1 (n, J, 3)) float32 of points (n, 3) seen along wo (n, 3).

        diffuse = 1/pi int L cos,  s0(r) = int spec_r (1 - F_c) L,  s1(r) = int spec_r F_c L,

    with L the incident radiance under the given materials elsewhere, so that `brdf.compose(k_d, k_s, diffuse,
    s0(r), s1(r))` is the radiance reflected at the point for ANY material of roughness r there. normals are
    flipped to the viewer. levels (J,) roughness in [0.02, 1], increasing (may be empty). max_bounces counts
    surface interactions including the point itself. All lobes share one path per sample, drawn from a mixture
    of the cosine and a few GGX lobes and weighted with that mixture's density (balance heuristic). chunk:
    lanes on the device at once, a lane being up to 8 samples of a point (default: 2^18, fewer when the lobes
    would take more than 256 MiB). Source: METHOD 2.7; COMPUTE 5.
    """
    check_counts(samples, max_bounces)
    levels = np.asarray(levels, np.float64).reshape(-1)
    if levels.size and not (levels.min() >= R_MIN - 1e-6 and levels.max() <= 1 + 1e-6 and (np.diff(levels) > 0).all()):
        raise InputError(f"roughness levels {levels.tolist()}: must increase within [{R_MIN}, 1]")
    points, normals, wo = surface_points(points, normals, wo)
    count = len(levels)
    diffuse = np.zeros((len(points), 3), np.float32)
    s0, s1 = np.zeros((len(points), count, 3), np.float32), np.zeros((len(points), count, 3), np.float32)
    if max_bounces == 0:
        return diffuse, s0, s1
    world, lobes = World(geometry, material, emitters, cache, RadianceCollector()), _Levels(levels)
    for batch in batches(len(points), samples, 3 * (1 + 2 * count), chunk):
        sums = _lobe_sums(
            world,
            lobes,
            batch.streams(seed),
            batch.spread(mi.Point3f, points),
            batch.spread(mi.Vector3f, normals),
            batch.spread(mi.Vector3f, wo),
            dr.opaque(mi.UInt32, samples),
            *batch.samples(samples),
            dr.opaque(mi.UInt32, max_bounces),
        )
        dr.eval(sums)
        diffuse[batch.part] = batch.collect(sums[0])
        for number in range(count):
            s0[batch.part, number] = batch.collect(sums[1 + number])
            s1[batch.part, number] = batch.collect(sums[1 + count + number])
    for result in (diffuse, s0, s1):
        result /= samples
    return diffuse, s0, s1
