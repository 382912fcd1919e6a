"""Voxel tables on the device: the hash lookup that cell materials and the radiance cache share, and that cache."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from iif_core.errors import InputError
from iif_core.light.transport.arrays import on_device, rows_of
from iif_core.surface.cells import CellTable, hash_words, inverse_edge, pack_keys, probe_step, voxel_indices

Array = np.ndarray


class VoxelRows:
    """Device copy of a `CellTable` with its grid: maps a point (and an object id) to a row of the caller's table."""

    def __init__(self, edge: float, origin: ArrayLike, ijk: ArrayLike, object_id: ArrayLike):
        self.table = CellTable.build(pack_keys(ijk, object_id))
        self._slots = on_device(self.table.slots, mi.UInt32)
        # Opaque: kernels do not differ by scene.
        self._mask, self._probes = (dr.opaque(mi.UInt32, value) for value in (len(self.table.slots) - 1, self.table.probes))
        self._inverse_edge = dr.opaque(mi.Float, float(inverse_edge(edge)))
        self._origin = [dr.opaque(mi.Float, float(value)) for value in np.asarray(origin, np.float32).reshape(3)]

    def find(self, point: Any, object_id: Any, active: Any) -> tuple[Any, Any]:
        """(found, row) of the cell around `point`; row is 0 where nothing is found."""
        i, j, k = (mi.Int32(dr.floor((x - low) * self._inverse_edge)) for x, low in zip(point, self._origin, strict=True))
        # One unsigned test covers both ends: negative indices wrap to huge values.
        inside = (mi.UInt32(i | j | k) < 65536) & (object_id >= -1) & (object_id < 65535)
        # The two words of a key, with the object in the upper half of the second (`iif_core.surface.cells`).
        low = mi.UInt32(i) | (mi.UInt32(j) << 16)
        high = mi.UInt32(k) | (mi.UInt32(object_id + 1) << 16)
        h = hash_words(low, high)
        return _probe(self._slots, self._mask, self._probes, low, high, h, probe_step(h), active & inside)


@dr.syntax
def _probe(slots: Any, mask: Any, probes: Any, low: Any, high: Any, h: Any, step: Any, searching: Any) -> tuple[Any, Any]:
    """(found, row) of the keys (low, high) in the slots of a `CellTable`; row is 0 where nothing is found."""
    found, row, probe = mi.Bool(False), mi.UInt32(0), mi.UInt32(0)
    while searching:
        entry = dr.gather(mi.Vector4u, slots, h & mask, searching)
        match = (entry.x == low) & (entry.y == high) & (entry.z != 0xFFFFFFFF)
        row = dr.select(match, entry.z, row)
        found |= match
        h += step
        probe += 1
        # An empty slot ends the search, because no later slot can hold the key.
        searching &= ~match & (entry.z != 0xFFFFFFFF) & (probe < probes)
    return found, row


class RadianceCache:
    """Diffuse outgoing radiance on a voxel grid, with which a path ends instead of bouncing on
    (docs/method/light.md#radiance-cache).

    A voxel in the table with radiance 0 is a black surface. A voxel that is not in the table is unknown, and the path continues
    (docs/method/numerics.md#empty-voxels-of-the-radiance-cache).

    Args:
        edge: of a voxel, metres.
        origin: (3,) corner of voxel (0, 0, 0).
        ijk: (n, 3) from `cells.voxel_indices(points, edge, origin)`.
        radiance: (n, 3) linear, >= 0.

    Raises:
        InputError: wrong shapes, non-finite or negative radiance.
    """

    def __init__(self, edge: float, origin: ArrayLike, ijk: ArrayLike, radiance: ArrayLike):
        ijk = np.asarray(ijk).reshape(-1, 3)
        radiance = rows_of(radiance, len(ijk), 3, "cache radiance")
        if radiance.size and radiance.min() < 0:
            raise InputError(f"cache radiance goes down to {radiance.min()}; radiance is never negative")
        self.count = len(ijk)
        self.edge, self.origin = edge, np.asarray(origin, np.float32)
        # One radiance for a voxel, whatever objects its surface belongs to.
        self._rows = VoxelRows(edge, origin, ijk, -1)
        self._radiance = on_device(np.column_stack([radiance, np.zeros(len(ijk))])) if len(ijk) else mi.Float(0, 0, 0, 0)

    def covers(self, points: ArrayLike) -> Array:
        """(n,) bool: the voxel around each point (n, 3) is in the table."""
        return self._rows.table.lookup(pack_keys(voxel_indices(points, self.edge, self.origin))) >= 0

    def radiance(self, point: Any, active: Any) -> tuple[Any, Any]:
        """(found, radiance) at a surface point (device types)."""
        found, row = self._rows.find(point, mi.Int32(-1), active)
        value = dr.gather(mi.Vector4f, self._radiance, row, found)
        return found, mi.Color3f(value.x, value.y, value.z)
