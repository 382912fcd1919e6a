"""The transport matrix: radiance that points reflect per unit radiance of every emitter group, by lobe, from one set of paths
(docs/method/light.md#transport-matrix)."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from iif_core.errors import InputError
from iif_core.light.environment import solid_angles
from iif_core.light.transport.arrays import batches, checked_points, on_device, rows_of
from iif_core.light.transport.emitters import Emitters, share_of_environment
from iif_core.light.transport.geometry import Geometry, offset_from
from iif_core.light.transport.kernels import Vertex, World, incoming, light_by_lobe, scatter_by_lobe
from iif_core.light.transport.scene import EmitterColumns, PathOptions, Scene, ShadingPoints
from iif_core.reflectance import brdf

Array = np.ndarray


class _ColumnCollector:
    """Adds path weights to the row of the lane and the column of the emitter's group: all diffuse columns of the lane come
    first, then all specular ones. `specular` (Color3f) is the share of the specular lobe at the first vertex of the path.

    Only cached light is returned. A lane writes to its own row alone, so plain (non-atomic) additions are safe and their order
    is fixed.
    """

    def __init__(self, rows: Any, lane: Any, groups: int, group_of_face: Any, group_of_texel: Any):
        self.rows, self.lane, self.groups = rows, lane, dr.opaque(mi.UInt32, groups)
        self.group_of_face, self.group_of_texel = group_of_face, group_of_texel
        self.specular: Any = None

    def emitter(self, face: Any, radiance: Any, weight: Any, active: Any) -> Any:
        # Radiance is the unknown of the system, so the weight is added by itself and `radiance`, which is 0, is not used.
        group = dr.gather(mi.Int32, self.group_of_face, face, active)
        return self._deposit(mi.UInt32(group), weight, active & (group >= 0))

    def environment(self, texel: Any, radiance: Any, weight: Any, active: Any) -> Any:
        if self.group_of_texel is None:
            return mi.Color3f(0)
        group = dr.gather(mi.Int32, self.group_of_texel, texel, active)
        return self._deposit(mi.UInt32(group), weight, active & (group >= 0))

    def _deposit(self, group: Any, weight: Any, active: Any) -> Any:
        # rho of Eq. L.14: the share of either lobe in the first factor of the throughput splits the weight of the whole path.
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
def _deposit_paths(world: World, rng: Any, vertex: Vertex, sample: Any, end: Any, max_bounces: Any) -> Any:
    # Each lane follows its samples one after the other. The collector holds A; what is returned is h, from the radiance cache.
    diffuse_cached = mi.Color3f(0)
    specular_cached = mi.Color3f(0)
    # The normal is on the viewer's side already, so this leaves out points that are seen edge-on.
    visible = dr.dot(vertex.normal, vertex.wo) > 0
    while sample < end:
        # -------- next-event estimation at the point itself --------
        if world.emitters.can_be_sampled:
            light, diffuse, specular = light_by_lobe(world, rng, vertex, visible)
            world.collector.specular = _share(specular, diffuse)
            light.gain(world, diffuse + specular)

        # -------- path that continues from the point --------
        goes_on, wi, diffuse, specular, pdf = scatter_by_lobe(rng, vertex, visible)
        share = _share(specular, diffuse)
        world.collector.specular = share
        # The point is the first interaction. The throughput holds both lobes; `share` takes them apart at every deposit.
        gain, rng = incoming(world, rng, vertex.point, wi, pdf, 1, max_bounces, goes_on, diffuse + specular)
        diffuse_cached += gain * (1 - share)
        specular_cached += gain * share
        sample += 1
    return diffuse_cached, specular_cached


def _share(part: Any, rest: Any) -> Any:
    """part / (part + rest) for each channel, in [0, 1], 0 where both are 0 (docs/method/numerics.md#arithmetic-of-a-gpu)."""
    whole = part + rest
    return dr.select(whole > 0, dr.minimum(part / whole, 1), 0)


def transport_matrix(
    scene: Scene,
    points: ShadingPoints,
    columns: EmitterColumns,
    paths: PathOptions,
    texel_weight: ArrayLike | None = None,
    number: Array | None = None,
) -> tuple[Array, Array]:
    """Trace the transport matrix (Eq. L.14): a point reflects A @ E + h by each lobe, for emitter radiances E (G, 3).

    Emission that a point sees directly is not included.

    Args:
        scene: geometry, materials of everything that paths meet after the points, and cache; its emitters are not used.
        points: the points, n of them, with their own materials.
        columns: which faces and texels share an unknown radiance. A map of one texel is found by directions of the BRDF alone.
        paths: bounces include the point.
        texel_weight: (H, W) how often texels are drawn, None = by solid angle.
        number: (n,) uint32, by which the points draw their random numbers; None = by their order.

    Returns:
        A (n, 2, G, 3) float32 by the diffuse (0) and the specular (1) lobe, and h (n, 2, 3) float32, the radiance that paths
        take from the cache (0 without one).

    Raises:
        InputError: wrong shapes, non-finite numbers, column numbers out of range.
        TransportError: light that is not finite.
    """
    # -------- inputs, with materials moved into their range --------
    position, normals, wo = checked_points(points.points, points.normals, points.wo)
    count, n_groups = len(position), columns.count
    base_color = np.clip(rows_of(points.base_color, count, 3, "base_color"), 0, 1)
    roughness = np.clip(rows_of(points.roughness, count, None, "roughness"), brdf.R_MIN, 1)
    metallic = np.clip(rows_of(points.metallic, count, None, "metallic"), 0, 1)
    groups, texels = _checked_columns(columns, len(scene.geometry.faces))
    matrix, cached = np.zeros((count, 2, n_groups, 3), np.float32), np.zeros((count, 2, 3), np.float32)
    if paths.max_bounces == 0 or n_groups == 0 and scene.cache is None:
        return matrix, cached

    # -------- emitters of unknown radiance --------
    weight = columns.sampling_weight
    if weight is None:
        weight = _group_weights(scene.geometry.areas, groups, n_groups)
    columns = columns._replace(of_texel=texels, sampling_weight=weight)
    scene = scene._replace(emitters=_unit_emitters(scene.geometry, groups, columns, texel_weight))
    group_of_face, group_of_texel = on_device(groups, mi.Int32), None if texels is None else on_device(texels, mi.Int32)

    # -------- trace, batch by batch --------
    kd, ks = brdf.kd_ks(base_color, metallic[:, None])
    width = 6 * n_groups  # floats of a row: 2 lobes x G groups x 3 channels
    for batch in batches(count, paths.samples, width, paths.chunk):
        rows = dr.zeros(mi.Float, batch.lanes * max(width, 1))
        lane = dr.arange(mi.UInt32, batch.lanes)
        world = World(scene, _ColumnCollector(rows, lane, n_groups, group_of_face, group_of_texel))
        random, start = batch.streams(paths.seed, number), batch.spread(mi.Point3f, position)
        normal, towards = batch.spread(mi.Vector3f, normals), batch.spread(mi.Vector3f, wo)
        material = batch.spread(mi.Color3f, kd), batch.spread(mi.Color3f, ks), batch.spread(mi.Float, roughness)
        vertex = Vertex(offset_from(start, normal), normal, towards, *material)
        gains = _deposit_paths(world, random, vertex, *batch.samples(paths.samples), dr.opaque(mi.UInt32, paths.max_bounces))
        dr.eval(gains, rows)
        for lobe, gain in enumerate(gains):
            cached[batch.part, lobe] = batch.collect(gain) / paths.samples
        if n_groups:
            matrix[batch.part] = batch.collect_rows(rows, 2, n_groups, 3) / paths.samples
    return matrix, cached


def _checked_columns(columns: EmitterColumns, faces: int) -> tuple[Array, Array | None]:
    """Column of every face and of every texel as int32."""
    groups = np.ascontiguousarray(columns.of_face, np.int32)
    if groups.shape != (faces,) or groups.min() < -1 or groups.max() >= columns.count:
        raise InputError(
            f"emitter_of_face has shape {groups.shape} and values up to {groups.max(initial=-1)}; expected "
            f"({faces},) in -1 ... {columns.count - 1}"
        )
    texels = None if columns.of_texel is None else np.ascontiguousarray(columns.of_texel, np.int32)
    if texels is not None and (texels.ndim != 2 or not texels.size or texels.min() < -1 or texels.max() >= columns.count):
        raise InputError(
            f"environment_columns has shape {texels.shape} and values up to {texels.max(initial=-1)}; expected "
            f"(height, width) in -1 ... {columns.count - 1}"
        )
    return groups, texels


def _unit_emitters(geometry: Geometry, groups: Array, columns: EmitterColumns, texel_weight: ArrayLike | None) -> Emitters:
    """Emitters of radiance 0, drawn as if all groups had the same radiance; `columns` with arrays, or None, for texels."""
    dark, texels = np.zeros((len(groups), 3)), columns.of_texel
    if texels is None or texels.size == 1:
        return Emitters(geometry, dark, columns.side, sampling_weight=columns.sampling_weight)
    solid = solid_angles(*texels.shape)
    # Both kinds count with radiance 1 wherever they may emit: area of the faces, share of the sphere.
    share = share_of_environment(geometry, geometry.areas[groups >= 0].sum(), (solid * (texels >= 0)).sum() / (4 * np.pi))
    drawn = (solid if texel_weight is None else np.asarray(texel_weight)) * (texels >= 0)
    return Emitters(geometry, dark, columns.side, np.zeros((*texels.shape, 3)), columns.sampling_weight, drawn, share)


def _group_weights(areas: Array, groups: Array, n_groups: int) -> Array:
    """How often faces are drawn: half by area, half the same for every group with area, so that small emitters get samples."""
    member = groups >= 0
    area = np.where(member, areas, 0.0)
    total = np.bincount(groups[member], area[member], minlength=n_groups)
    filled = np.count_nonzero(total)
    if not filled:
        return np.zeros(len(areas))
    # 1 / area of every group: area x share adds up to 1 over its faces.
    share = np.divide(1.0, total, out=np.zeros(n_groups), where=total > 0)
    return 0.5 * area / total.sum() + 0.5 * area * np.where(member, share[groups], 0.0) / filled
