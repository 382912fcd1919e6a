"""Diffuse light of every lamp on the surface that rays from the points of a light map meet
(docs/method/light.md#light-of-what-is-met)."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from iif_core.light.transport.arrays import on_device
from iif_core.light.transport.cache import VoxelRows
from iif_core.numerics.frames import AXIS_WEIGHTS, dominant_side
from iif_core.surface.cells import grid_origin, pack_keys, voxel_indices

Array = np.ndarray

LEAST = 4
"""Places in a cell at which light is known, at least; those of a cell with fewer are put together with what is around."""
COARSER = 4
"""Edges of a voxel along an edge of the cells for that."""
NEAR = 1.0
"""Edges of a voxel: from nearer surface the light is not taken, because it may differ within a cell."""
MOST_OBJECTS = 10_000
"""Objects beyond are counted from 0 again, because the table has 16 bits for an object and the side that surface faces."""


class LampCache:
    """Mean light of every lamp in cells of the surface: voxels x objects x the side of a cube to which the surface faces.

    Args:
        edge: of a voxel, metres.
        points, normals: (n, 3) places where light is known: metres; unit vectors on the side from which it arrives.
        object_id: (n,) of the surface, -1 = none.
        light: (n, lamps, 3) D_l of Eq. L.59, before the colours of the lamps.
    """

    def __init__(self, edge: float, points: ArrayLike, normals: ArrayLike, object_id: ArrayLike, light: Array):
        points, light = np.asarray(points, np.float32), np.asarray(light)
        kind = _kind(np.asarray(object_id), dominant_side(normals))
        fine, sparse, mean = _cells(edge, points, kind, light, LEAST)
        # Places in sparse cells are put together in larger voxels, where a single place is enough.
        coarse, _, rest = _cells(COARSER * edge, points[sparse], kind[sparse], light[sparse], 1)
        self.light = np.concatenate([mean, rest])
        # Rows of the coarse cells follow the fine ones in `light`.
        self._tables = [
            (table, dr.opaque(mi.UInt32, first)) for table, first in ((fine, 0), (coarse, len(mean))) if table is not None
        ]
        self._near, self._lamps = dr.opaque(mi.Float, NEAR * edge), dr.opaque(mi.UInt32, light.shape[1])
        self._light = on_device(self.light.ravel())

    def find(self, point: Any, normal: Any, object_id: Any, distance: Any, active: Any) -> tuple[Any, Any]:
        """Return (found, row) of the cell of surface that a ray met after `distance` metres, on the side `normal`."""
        # `frames.dominant_side` on the device, with the same weights of the axes.
        x, y, z = (dr.abs(part) * weight for part, weight in zip(normal, AXIS_WEIGHTS, strict=True))
        axis = dr.select((x >= y) & (x >= z), 0, dr.select(y >= z, 1, 2))
        along = dr.select(axis == 0, normal.x, dr.select(axis == 1, normal.y, normal.z))
        side = mi.Int32(2 * axis) + dr.select(along < 0, 1, 0)
        kind, active = _kind(mi.Int32(object_id), side), active & (distance > self._near)
        found, row = mi.Bool(False), mi.UInt32(0)
        # The fine table first; the coarse one is asked only where it has no cell.
        for table, first in self._tables:
            here, own = table.find(point, kind, active & ~found)
            row = dr.select(here, first + own, row)
            found |= here
        return found, row

    @dr.syntax
    def add(self, collector: Any, row: Any, weight: Any, active: Any) -> Any:
        """Add the light of all lamps times `weight` (Color3f) to the rows of a `lamps.LampCollector`; return the gain, 0."""
        gain, lamp = mi.Color3f(0), mi.UInt32(0)
        # A loop on the device: one kernel serves any number of lamps.
        while lamp < self._lamps:
            light = dr.gather(mi.Color3f, self._light, row * self._lamps + lamp, active)
            gain += collector.add(lamp, weight * light, active)
            lamp += 1
        return gain


def _cells(edge: float, points: Array, kind: Array, light: Array, least: int) -> tuple[VoxelRows | None, Array, Array]:
    """Group places by voxel and kind: the table of the groups of at least `least` (None = there is none), the rows (k,) of the
    places that are in none of them, and the mean light (c, lamps, 3) of each."""
    if not len(points):
        return None, np.zeros(0, np.int64), np.zeros((0, *light.shape[1:]))
    origin = grid_origin(points, edge)
    ijk = voxel_indices(points, edge, origin)
    _, first, of, count = np.unique(pack_keys(ijk, kind), return_index=True, return_inverse=True, return_counts=True)
    of = of.ravel()
    order = np.argsort(of, kind="stable")
    # `order` lines up the places of each cell, so a cell is one run of rows.
    mean = np.add.reduceat(light[order].astype(np.float64), np.cumsum(count) - count) / count[:, None, None]
    enough = count >= least
    own = first[enough]
    rows = VoxelRows(edge, origin, ijk[own], kind[own]) if len(own) else None
    return rows, np.flatnonzero(~enough[of]), mean[enough]


def _kind(object_id: Any, side: Any) -> Any:
    """One number below 2^16 for an object and a side, for arrays of the host and of the device."""
    return (object_id + 1) % MOST_OBJECTS * 6 + side
