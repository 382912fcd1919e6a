"""Materials: callables (point, face, object id, active) -> (base colour, roughness, metallic) on device types.

Rows of tables are (base colour R, G, B, roughness, metallic), linear; roughness is clamped to [0.02, 1], the others to [0, 1].
"""

from __future__ import annotations

import copy
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from iif_core.errors import InputError
from iif_core.light.transport.arrays import on_device, rows_of
from iif_core.light.transport.cache import VoxelRows
from iif_core.reflectance.brdf import R_MIN
from iif_core.reflectance.material import LOWEST
from iif_core.surface.cells import COARSE, coarse_cells


class _Rows:
    """Device table of material rows, padded to 8 floats so that two aligned reads fetch a row."""

    def __init__(self, values: ArrayLike, name: str):
        values = np.asarray(values, np.float32)
        values = rows_of(values, len(values), 5, name)
        self.count = len(values)
        padded = np.zeros((max(self.count, 1), 8), np.float32)
        np.clip(values, LOWEST, 1, out=padded[: self.count, :5])
        self._table = on_device(padded)

    def read(self, row: Any, active: Any) -> tuple[Any, Any, Any]:
        first = dr.gather(mi.Vector4f, self._table, row * 2, active)
        metallic = dr.gather(mi.Float, self._table, row * 8 + 4, active)
        # A masked read gives 0, which is no valid roughness.
        return mi.Color3f(first.x, first.y, first.z), dr.maximum(first.w, R_MIN), metallic


class CellMaterials:
    """One material for each surface cell (voxel x object). Where the cell was not observed it is the mean of the coarse cell
    around, and where that is empty too the mean of the object; without an object, the mean over all objects
    (docs/method/numerics.md#surface-that-nobody-saw).

    Args:
        edge: of a voxel, metres.
        origin: (3,) corner of voxel (0, 0, 0).
        ijk: (n, 3) from `cells.voxel_indices(points, edge, origin)`.
        object_id: (n,), -1 = none.
        values: (n, 5) rows of the cells.
        object_values: (n_objects, 5), at least one.

    Raises:
        InputError: wrong shapes, non-finite numbers, no object.
    """

    def __init__(
        self,
        edge: float,
        origin: ArrayLike,
        ijk: ArrayLike,
        object_id: ArrayLike,
        values: ArrayLike,
        object_values: ArrayLike,
    ):
        self._ijk, self._object_id = np.asarray(ijk).reshape(-1, 3), object_id
        self._cells = VoxelRows(edge, origin, self._ijk, object_id)
        self._grid, self._coarse = (edge, origin), None
        self._paint(values, object_values)

    def _paint(self, values: ArrayLike, object_values: ArrayLike) -> None:
        values = rows_of(np.asarray(values, np.float32).reshape(-1, 5), len(self._ijk), 5, "cell values")
        object_values = np.asarray(object_values, np.float32)
        object_values = rows_of(object_values, len(object_values), 5, "object values")
        if not len(object_values):
            raise InputError("CellMaterials needs at least one row of object_values: the material of surface nobody saw")
        coarse_ijk, coarse_object, coarse = coarse_cells(self._ijk, self._object_id, values)
        # Which coarse cells there are does not depend on their values, so a repainted copy keeps the table.
        if self._coarse is None:
            edge, origin = self._grid
            self._coarse = VoxelRows(COARSE * edge, origin, coarse_ijk, coarse_object)
        self._objects = dr.opaque(mi.Int32, len(object_values))
        self._first_coarse, self._first_object = (dr.opaque(mi.UInt32, row) for row in (len(values), len(values) + len(coarse)))
        # One table of cells, coarse cells, objects and the overall mean: a miss only changes which row is read.
        parts = [values, coarse, object_values, object_values.mean(axis=0, keepdims=True)]
        self._rows = _Rows(np.concatenate(parts), "values")

    def repainted(self, values: ArrayLike, object_values: ArrayLike) -> CellMaterials:
        """Return a copy with other materials of the same cells, `values` (n, 5) and `object_values`; cells are not hashed anew.

        Raises:
            InputError: as the constructor.
        """
        other = copy.copy(self)
        other._paint(values, object_values)
        return other

    def __call__(self, point: Any, face: Any, object_id: Any, active: Any) -> tuple[Any, Any, Any]:
        # From the finest to the coarsest: cell, coarse cell, object. The row after the objects holds the mean of all.
        found, row = self._cells.find(point, object_id, active)
        near, around = self._coarse.find(point, object_id, active & ~found)
        known = (object_id >= 0) & (object_id < self._objects)
        fallback = self._first_object + dr.select(known, mi.UInt32(object_id), mi.UInt32(self._objects))
        row = dr.select(found, row, dr.select(near, self._first_coarse + around, fallback))
        return self._rows.read(row, active)
