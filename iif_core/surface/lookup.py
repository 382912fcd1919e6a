"""Values of surface cells at points, on the host: what `iif_core.light.transport.materials.CellMaterials` reads on the device."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from iif_core.errors import InputError
from iif_core.surface.cells import COARSE, CellTable, coarse_cells, pack_keys, voxel_indices

Array = np.ndarray


def values_at(
    points: ArrayLike,
    object_id: ArrayLike,
    edge: float,
    origin: ArrayLike,
    ijk: ArrayLike,
    cell_object: ArrayLike,
    values: ArrayLike,
    object_values: ArrayLike,
) -> tuple[Array, Array]:
    """Read the values of the surface at points (docs/method/numerics.md#surface-that-nobody-saw).

    A point takes the value of its cell. Where no cell was observed, it takes the mean of the coarse cell around it, otherwise the
    mean of its object, and without an object the mean over all objects.

    Args:
        points: (n, 3) metres.
        object_id: (n,) of the surface there, -1 = none.
        edge, origin: grid of the cells, metres (`iif_core.surface.cells.voxel_indices`).
        ijk, cell_object: (c, 3) and (c,) of the cells, which are distinct.
        values: (c, C) of the cells.
        object_values: (objects, C), at least one row.

    Returns:
        (n, C) float32, and (n,) int64 the cell at each point, -1 where none was observed.

    Raises:
        InputError: points that are not finite, or no row of `object_values`.
    """
    values, object_values = np.asarray(values, np.float32), np.asarray(object_values, np.float32)
    if not len(object_values):
        raise InputError("values_at needs at least one row of object_values: the values of surface nobody saw")
    points, object_id = np.asarray(points, np.float32).reshape(-1, 3), np.asarray(object_id, np.int64).reshape(-1)
    # -------- the mean of the object, or of all objects; each finer grid then overwrites it where it has a cell --------
    known = (object_id >= 0) & (object_id < len(object_values))
    out = np.where(known[:, None], object_values[np.where(known, object_id, 0)], object_values.mean(axis=0))
    row = np.full(len(points), -1, np.int64)
    if not len(values):
        return out, row
    around_ijk, around_object, around = coarse_cells(ijk, cell_object, values)
    grids = (
        (COARSE * edge, around_ijk, around_object, around),
        (edge, np.asarray(ijk).reshape(-1, 3), np.asarray(cell_object), values),
    )
    # Scaling by 4 is exact in binary, so a point has the coarse voxel that its fine voxel was averaged into.
    for size, own_ijk, own_object, own in grids:
        table = CellTable.build(pack_keys(own_ijk, own_object))
        row = _rows(table, voxel_indices(points, size, origin), object_id).astype(np.int64)
        out = np.where((row >= 0)[:, None], own[row], out)
    # `row` is what the last, fine grid found.
    return out, row


def _rows(table: CellTable, ijk: Array, object_id: Array) -> Array:
    """Look up voxels of objects; -1 for those that the table lacks, and for indices that no key can hold."""
    # `pack_keys` refuses what does not fit.
    inside = ((ijk >= 0) & (ijk < 1 << 16)).all(1) & (object_id >= -1) & (object_id < (1 << 16) - 1)
    row = np.full(len(ijk), -1, np.int32)
    row[inside] = table.lookup(pack_keys(ijk[inside], object_id[inside]))
    return row
