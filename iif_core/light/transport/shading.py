"""Cached shading: the diffuse integral and the split specular integrals of points, all from one set of paths
(docs/method/shading.md#shared-paths)."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from iif_core.errors import InputError
from iif_core.light.transport.arrays import batches, checked_points
from iif_core.light.transport.geometry import offset_from
from iif_core.light.transport.kernels import RadianceCollector, World, incoming, power_weight, sample_light, sample_lobe, uniform
from iif_core.light.transport.scene import PathOptions, Scene
from iif_core.numerics.xp import DRJIT
from iif_core.reflectance import brdf
from iif_core.reflectance.brdf import R_MIN

Array = np.ndarray


class _Levels:
    """Roughness levels, and the lobes from which directions are drawn: the cosine twice, and GGX lobes from the sharpest level
    up to 0.5."""

    def __init__(self, levels: Array):
        self.levels = [float(level) for level in levels]
        # Lambda of Eq. S.8: the levels nearest to four values in geometric progression. `dict.fromkeys` drops a level that is
        # nearest to two.
        wanted = np.geomspace(min(levels.min(), 0.5), 0.5, 4) if len(levels) else []
        nearest = [int(np.argmin(np.abs(np.log(levels / value)))) for value in wanted]
        self.lobes = [self.levels[index] for index in dict.fromkeys(nearest)]
        self.cosine_lobes = 2
        self.count = self.cosine_lobes + len(self.lobes)

    def lobe_roughness(self, lobe: Any) -> Any:
        roughness = mi.Float(1)
        # Python unrolls the loop: the kernel gets one select for each lobe.
        for number, level in enumerate(self.lobes):
            roughness = dr.select(lobe == self.cosine_lobes + number, level, roughness)
        return roughness

    def pdf(self, angles: tuple[Any, ...]) -> Any:
        """Density of the mixture of all lobes, each chosen equally often (Eq. S.8)."""
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
    # D, then S0 and S1 at every level.
    sums = [mi.Color3f(0) for _ in range(1 + 2 * len(levels.levels))]
    origin = offset_from(point, normal)
    while sample < end:
        # -------- next-event estimation, first term of Eq. S.9 --------
        sums = levels.light(world, rng, origin, normal, wo, sums)

        # -------- direction from the mixture of lobes (Eq. S.8) --------
        # Stratified choice: every lobe is drawn equally often in expectation over all samples.
        position = (mi.Float(sample) + uniform(rng)) / mi.Float(samples)
        lobe = dr.minimum(mi.UInt32(position * levels.count), levels.count - 1)
        u1 = uniform(rng)
        u2 = uniform(rng)
        wi = sample_lobe(lobe >= levels.cosine_lobes, u1, u2, wo, normal, levels.lobe_roughness(lobe))
        angles = brdf.half_angles(DRJIT, normal, wi, wo)
        # Density of the whole mixture, whichever lobe drew the direction: the balance heuristic.
        pdf = levels.pdf(angles)
        useful = (dr.dot(normal, wi) > 0) & (dr.dot(normal, wo) > 0) & (pdf > 0)

        # -------- light that arrives along it, second term of Eq. S.9 --------
        # The point itself is the first interaction.
        radiance, rng = incoming(world, rng, origin, wi, pdf, 1, max_bounces, useful)
        sums = levels.accumulate(sums, angles, dr.select(useful, radiance / pdf, 0))
        sample += 1
    return sums


def shading_caches(
    scene: Scene,
    points: ArrayLike,
    normals: ArrayLike,
    wo: ArrayLike,
    levels: ArrayLike,
    paths: PathOptions,
    number: Array | None = None,
) -> tuple[Array, Array, Array]:
    """Integrate the light that arrives at points over the lobes of the BRDF (Eq. S.3).

    `brdf.compose(k_d, k_s, diffuse, s0(r), s1(r))` is then the radiance that the point reflects for any material of roughness r
    there. All lobes share one path per sample; its first direction is drawn from a mixture of the cosine and a few GGX lobes
    and weighted with the density of that mixture (balance heuristic, Eq. S.9).

    Args:
        scene: what paths meet; its materials apply everywhere but at the points.
        points, normals, wo: (n, 3) metres; normals, flipped to the viewer; towards the viewer.
        levels: (J,) roughness in [0.02, 1], increasing; may be empty.
        paths: bounces include the point.
        number: (n,) uint32, by which the points draw their random numbers; None = by their order.

    Returns:
        diffuse (n, 3), s0 (n, J, 3), s1 (n, J, 3), float32 radiance, linear.

    Raises:
        InputError: wrong shapes, non-finite numbers, levels that do not increase or lie outside the range.
        TransportError: light that is not finite.
    """
    levels = np.asarray(levels, np.float64).reshape(-1)
    if levels.size and not (levels.min() >= R_MIN - 1e-6 and levels.max() <= 1 + 1e-6 and (np.diff(levels) > 0).all()):
        raise InputError(f"roughness levels {levels.tolist()}: must increase within [{R_MIN}, 1]")
    points, normals, wo = checked_points(points, normals, wo)
    count = len(levels)
    diffuse = np.zeros((len(points), 3), np.float32)
    s0, s1 = np.zeros((len(points), count, 3), np.float32), np.zeros((len(points), count, 3), np.float32)
    if paths.max_bounces == 0:
        return diffuse, s0, s1
    world, lobes = World(scene, RadianceCollector()), _Levels(levels)
    for batch in batches(len(points), paths.samples, 3 * (1 + 2 * count), paths.chunk):
        sums = _lobe_sums(
            world,
            lobes,
            batch.streams(paths.seed, number),
            *(batch.spread(kind, rows) for kind, rows in ((mi.Point3f, points), (mi.Vector3f, normals), (mi.Vector3f, wo))),
            dr.opaque(mi.UInt32, paths.samples),
            *batch.samples(paths.samples),
            dr.opaque(mi.UInt32, paths.max_bounces),
        )
        dr.eval(sums)
        diffuse[batch.part] = batch.collect(sums[0])
        for level in range(count):
            s0[batch.part, level] = batch.collect(sums[1 + level])
            s1[batch.part, level] = batch.collect(sums[1 + count + level])
    for result in (diffuse, s0, s1):
        result /= paths.samples
    return diffuse, s0, s1
