"""The transport matrix: reflected radiance per unit radiance of every emitter group, from one path set, by the lobe of the
point that reflects it."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from iif_core.errors import InputError
from iif_core.light.environment import solid_angles
from iif_core.light.transport.arrays import batches, rows_of, to_numpy
from iif_core.light.transport.cache import RadianceCache
from iif_core.light.transport.emitters import Emitters, share_of_environment
from iif_core.light.transport.geometry import Geometry, offset_from
from iif_core.light.transport.kernels import World, incoming, light_by_lobe, scatter_by_lobe
from iif_core.light.transport.render import check_counts
from iif_core.light.transport.shading import surface_points
from iif_core.reflectance import brdf

Array = np.ndarray


class _ColumnCollector:
    """Deposits path weights in the row of the lane and the column of the emitter's group: first all diffuse columns of the
    lane, then all specular ones. `specular` (Color3f) is the share of the specular lobe at the first vertex of the path.

    Only cached light is returned. A lane writes to its own row alone, so plain (non-atomic) additions are
    safe and their order is fixed.
    """

    def __init__(self, rows: Any, lane: Any, groups: int, group_of_face: Any, group_of_texel: Any):
        self.rows, self.lane, self.groups = rows, lane, groups
        self.group_of_face, self.group_of_texel = group_of_face, group_of_texel
        self.specular: Any = None

    def emitter(self, face: Any, radiance: Any, weight: Any, active: Any) -> Any:
        group = dr.gather(mi.Int32, self.group_of_face, face, active)
        return self._deposit(mi.UInt32(group), weight, active & (group >= 0))

    def environment(self, texel: Any, radiance: Any, weight: Any, active: Any) -> Any:
        if self.group_of_texel is None:
            return mi.Color3f(0)
        group = dr.gather(mi.Int32, self.group_of_texel, texel, active)
        return self._deposit(mi.UInt32(group), weight, active & (group >= 0))

    def _deposit(self, group: Any, weight: Any, active: Any) -> Any:
        for lobe, share in enumerate((1 - self.specular, self.specular)):
            entry = ((self.lane * 2 + lobe) * self.groups + group) * 3
            for channel in range(3):
                dr.scatter_reduce(
                    dr.ReduceOp.Add,
                    self.rows,
                    weight[channel] * share[channel],
                    entry + channel,
                    active,
                    mode=dr.ReduceMode.NoConflicts,
                )
        return mi.Color3f(0)


@dr.syntax
def _deposit_paths(
    world: World,
    rng: Any,
    point: Any,
    normal: Any,
    wo: Any,
    kd: Any,
    ks: Any,
    roughness: Any,
    sample: Any,
    end: Any,
    max_bounces: Any,
) -> Any:
    diffuse_cached = mi.Color3f(0)
    specular_cached = mi.Color3f(0)
    origin = offset_from(point, normal)
    visible = dr.dot(normal, wo) > 0
    while sample < end:
        if world.emitters.can_be_sampled:
            light, diffuse, specular = light_by_lobe(world, rng, origin, normal, wo, kd, ks, roughness, visible)
            world.collector.specular = _share(specular, diffuse)
            light.gain(world, diffuse + specular)
        goes_on, wi, diffuse, specular, pdf = scatter_by_lobe(rng, normal, wo, kd, ks, roughness, visible)
        share = _share(specular, diffuse)
        world.collector.specular = share
        gain, rng = incoming(world, rng, origin, wi, pdf, 1, max_bounces, goes_on, diffuse + specular)
        diffuse_cached += gain * (1 - share)
        specular_cached += gain * share
        sample += 1
    return diffuse_cached, specular_cached


def _share(part: Any, rest: Any) -> Any:
    """part / (part + rest) a channel, 0 where both are 0."""
    whole = part + rest
    return dr.select(whole > 0, part / whole, 0)


def transport_matrix(
    geometry: Geometry,
    material: Any,
    points: ArrayLike,
    normals: ArrayLike,
    wo: ArrayLike,
    base_color: ArrayLike,
    roughness: ArrayLike,
    metallic: ArrayLike,
    emitter_of_face: ArrayLike,
    n_groups: int,
    side: ArrayLike | None,
    samples: int,
    max_bounces: int,
    seed: int,
    cache: RadianceCache | None = None,
    environment_columns: ArrayLike | None = None,
    sampling_weight: ArrayLike | None = None,
    chunk: int | None = None,
) -> tuple[Array, Array]:
    """(A (n, 2, G, 3), h (n, 2, 3)) float32: radiance that each point reflects by its diffuse lobe (0) and by its specular lobe
    (1) is A @ E + h for emitter radiances E (G, 3). A.sum(1), h.sum(1): all that it reflects.

    points, normals, wo (n, 3), base_color (n, 3), roughness (n,), metallic (n,): the points and their own
    materials; `material` shades everything further on. emitter_of_face (m,) int32 in [-1, G); side (m,) as in
    `Emitters`; faces of a group emit its unknown radiance. h is what paths take from `cache` (0 without).
    environment_columns (H, W) int32: the column in which paths that escape into a texel of the environment
    (`iif_core.light.environment`) are deposited, -1 = dark; texels of a column share its unknown radiance. The point's
    own, directly visible emission is not included. sampling_weight (m,) overrides the default, half by area and
    half the same for every group; texels are drawn by solid angle, a map of one texel by directions of the BRDF
    alone. max_bounces counts surface interactions including the point. chunk: lanes on the device at once, a lane
    being up to 8 samples of a point and a row of A (default: 2^18, fewer when their rows would take more than 256
    MiB). Source: METHOD 7a (multi-bounce, or one bounce and the cache), 2.6; COMPUTE 4.
    """
    check_counts(samples, max_bounces)
    points, normals, wo = surface_points(points, normals, wo)
    count = len(points)
    base_color = np.clip(rows_of(base_color, count, 3, "base_color"), 0, 1)
    roughness = np.clip(rows_of(roughness, count, None, "roughness"), brdf.R_MIN, 1)
    metallic = np.clip(rows_of(metallic, count, None, "metallic"), 0, 1)
    groups = np.ascontiguousarray(emitter_of_face, np.int32)
    if groups.shape != (len(geometry.faces),) or groups.min() < -1 or groups.max() >= n_groups:
        raise InputError(
            f"emitter_of_face has shape {groups.shape} and values up to {groups.max(initial=-1)}; expected "
            f"({len(geometry.faces)},) in -1 ... {n_groups - 1}"
        )
    columns = None if environment_columns is None else np.ascontiguousarray(environment_columns, np.int32)
    if columns is not None and (columns.ndim != 2 or not columns.size or columns.min() < -1 or columns.max() >= n_groups):
        raise InputError(
            f"environment_columns has shape {columns.shape} and values up to {columns.max(initial=-1)}; expected "
            f"(height, width) in -1 ... {n_groups - 1}"
        )
    matrix, cached = np.zeros((count, 2, n_groups, 3), np.float32), np.zeros((count, 2, 3), np.float32)
    if max_bounces == 0 or n_groups == 0 and cache is None:
        return matrix, cached
    if sampling_weight is None:
        sampling_weight = _group_weights(geometry.areas, groups, n_groups)
    emitters = _unit_emitters(geometry, groups, side, sampling_weight, columns)
    group_of_face = mi.Int32(groups)
    group_of_texel = None if columns is None else mi.Int32(columns.ravel())
    kd, ks = brdf.kd_ks(base_color, metallic[:, None])
    width = 6 * n_groups
    for batch in batches(count, samples, width, chunk):
        rows = dr.zeros(mi.Float, batch.lanes * max(width, 1))
        collector = _ColumnCollector(rows, dr.arange(mi.UInt32, batch.lanes), n_groups, group_of_face, group_of_texel)
        gains = _deposit_paths(
            World(geometry, material, emitters, cache, collector),
            batch.streams(seed),
            batch.spread(mi.Point3f, points),
            batch.spread(mi.Vector3f, normals),
            batch.spread(mi.Vector3f, wo),
            batch.spread(mi.Color3f, kd),
            batch.spread(mi.Color3f, ks),
            batch.spread(mi.Float, roughness),
            *batch.samples(samples),
            dr.opaque(mi.UInt32, max_bounces),
        )
        dr.eval(gains, rows)
        for lobe, gain in enumerate(gains):
            cached[batch.part, lobe] = batch.collect(gain) / samples
        if n_groups:
            matrix[batch.part] = to_numpy(rows).reshape(-1, batch.split, 2, n_groups, 3).sum(axis=1) / samples
    return matrix, cached


def _unit_emitters(
    geometry: Geometry, groups: Array, side: ArrayLike | None, weight: ArrayLike, columns: Array | None
) -> Emitters:
    """Emitters that are drawn as if all groups had the same radiance; what they radiate is the unknown."""
    dark = np.zeros((len(groups), 3))
    if columns is None or columns.size == 1:
        return Emitters(geometry, dark, side, sampling_weight=weight)
    sky = solid_angles(*columns.shape) * (columns >= 0)
    share = share_of_environment(geometry, geometry.areas[groups >= 0].sum(), sky.sum() / (4 * np.pi))
    return Emitters(geometry, dark, side, np.zeros((*columns.shape, 3)), weight, sky, share)


def _group_weights(areas: Array, groups: Array, n_groups: int) -> Array:
    """Half by area, half the same for every group with area: small emitters are not starved by large ones."""
    member = groups >= 0
    area = np.where(member, areas, 0.0)
    total = np.bincount(groups[member], area[member], minlength=n_groups)
    filled = np.count_nonzero(total)
    if not filled:
        return np.zeros(len(areas))
    share = np.divide(1.0, total, out=np.zeros(n_groups), where=total > 0)
    return 0.5 * area / total.sum() + 0.5 * area * np.where(member, share[groups], 0.0) / filled
