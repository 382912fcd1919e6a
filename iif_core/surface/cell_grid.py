"""The grid of surface cells that pixels fall into, and the values of cells at any surface point.

A cell is a voxel together with an object (cells.py), so values never leak from one object to another.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from iif_core.surface.cells import (
    COARSE_SHIFT,
    INDEX_LIMIT,
    coarse_cells,
    grid_origin,
    pack_keys,
    unpack_keys,
    voxel_indices,
)


@dataclass(frozen=True)
class CellGrid:
    """A voxel grid and the cells that some pixel fell into, in the order of their keys.

    Attributes:
        edge: of a voxel, m; origin: (3,) float32 lower corner, world coordinates in m.
        keys: (n,) uint64, sorted; centre: (n, 3) float32 mean surface point of the pixels of each cell.
    """

    edge: float
    origin: NDArray
    keys: NDArray
    centre: NDArray

    def __len__(self) -> int:
        return len(self.keys)

    @cached_property
    def object_id(self) -> NDArray:
        """(n,) int32."""
        return unpack_keys(self.keys)[1]


def median_footprint(depths: Iterable[tuple[NDArray, float]]) -> float | None:
    """Return the median over views of the median size of a pixel on the surface (Eq. F.18), or None without surface.

    `depths`: for each view the z-depths (m,) of the pixels that see surface, in m, and the focal length in pixels.
    """
    footprints = [float(np.median(depth)) / focal for depth, focal in depths if len(depth)]
    return float(np.median(footprints)) if footprints else None


def smallest_edge(corners: NDArray) -> float:
    """Return the smallest edge (m) with which voxel indices around the points `corners` (n, 3) fit into a key."""
    # The origin lies more than an edge below the mesh; 8 voxels of margin cover it and rounding.
    return float(np.ptp(corners, axis=0).max()) / (INDEX_LIMIT - 8)


def build_cell_grid(views: Iterable[tuple[NDArray, NDArray]], corners: NDArray, edge: float) -> tuple[CellGrid, list[NDArray]]:
    """Find the cells of edge `edge` (m) that the pixels of all views fill; `corners` (n, 3) are the vertices of the mesh.

    A view is surface points (m, 3) and object ids (m,). Returns the grid, which is empty if no view has pixels, and the cells of
    the pixels of each view.

    Raises:
        InputError: an edge that is not positive or too small, points that are not finite.
    """
    # -------- keys, counts and summed points of the cells of each view --------
    origin = grid_origin(corners, edge)
    found = []
    for points, objects in views:
        keys = pack_keys(voxel_indices(points, edge, origin), objects)
        unique, inverse, count = np.unique(keys, return_inverse=True, return_counts=True)
        sums = np.stack([np.bincount(inverse, points[:, a], len(unique)) for a in range(3)], 1)
        found.append((unique, inverse.astype(np.int32), count, sums))
    # -------- cells of all views, sorted by key; sums and rows of each view in turn --------
    keys = np.unique(np.concatenate([unique for unique, *_ in found])) if found else np.zeros(0, np.uint64)
    total, summed = np.zeros(len(keys)), np.zeros((len(keys), 3))
    cell_of_pixel = []
    while found:
        unique, inverse, count, sums = found.pop(0)  # what was used is freed
        rows = np.searchsorted(keys, unique).astype(np.int32)
        total[rows] += count  # keys of one view are distinct, so no row comes twice
        summed[rows] += sums
        cell_of_pixel.append(rows[inverse])
    return CellGrid(edge, origin, keys, (summed / total[:, None]).astype(np.float32)), cell_of_pixel


class CellValues:
    """Values of the cells of a grid, (n, c), read at surface points."""

    def __init__(self, grid: CellGrid, values: NDArray):
        self.grid, self.values = grid, values
        ijk, objects, self._coarse = coarse_cells(*unpack_keys(grid.keys), values)
        self._coarse_keys = pack_keys(ijk, objects)

    def at(self, points: NDArray, objects: NDArray, fallback: NDArray) -> tuple[NDArray, NDArray]:
        """Read values (m, c) and cells (m,) int64 at surface points (m, 3); -1 for points in no cell.

        A point in no cell takes the mean of the cells of its object in the block of 4 x 4 x 4 voxels around, or its row of
        `fallback`, which is overwritten.
        """
        ijk = voxel_indices(points, self.grid.edge, self.grid.origin)
        row, known = _rows_of(self.grid.keys, pack_keys(ijk, objects))
        if not known.all():
            near, around = _rows_of(self._coarse_keys, pack_keys(ijk >> COARSE_SHIFT, objects))
            fallback[around] = self._coarse[near[around]]
        fallback[known] = self.values[row[known]]  # last, since the finer value counts
        return fallback, np.where(known, row, -1)


def _rows_of(keys: NDArray, wanted: NDArray) -> tuple[NDArray, NDArray]:
    """Row of each wanted key in the sorted `keys` (any row where it is missing), and whether it is there."""
    row = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    return row, keys[row] == wanted
