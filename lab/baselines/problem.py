"""The loss of a free material in every surface cell, reduced to sums over the pixels of the cell (Eq. M.1, M.50).

A cell is 15 J + 3 numbers, whatever the number of photographs. Between levels the loss, not the shading, is interpolated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from iif_core.camera.response import Response
from iif_core.errors import InputError
from iif_core.fitting.cell_pixels import BOUND_WEIGHT, PixelRows

SUMS = 5
"""SS, SD, SZ, DZ, ZZ of a level."""
_PIECE = 1 << 15


@dataclass(frozen=True)
class CellProblem:
    """The loss of all cells, as `CellSums` collects it; C cells, J levels.

    Attributes:
        object_id: (C,) int in [0, n_objects).
        levels: (J,) roughness of the levels, increasing.
        pixels: (C,) summed pixel weight; 0 = the cell was not seen.
        dd: (C, 3); lobes: (C, J, 5, 3) SS, SD, SZ, DZ, ZZ.
        specular: (C, J, 2) sums of S0 and S1, mean over the channels.
    """

    object_id: np.ndarray
    n_objects: int
    levels: np.ndarray
    pixels: np.ndarray
    dd: np.ndarray
    lobes: np.ndarray
    specular: np.ndarray

    @property
    def known(self) -> np.ndarray:
        """Cells that light reached in every channel of some pixel, (C,) bool."""
        return (self.pixels > 0) & (self.dd > 0).all(1)

    def take(self, choice: np.ndarray) -> CellProblem:
        """Return some of the cells."""
        return CellProblem(
            self.object_id[choice],
            self.n_objects,
            self.levels,
            self.pixels[choice],
            self.dd[choice],
            self.lobes[choice],
            self.specular[choice],
        )


class CellSums:
    """Collects a `CellProblem` from pixels in any number of pieces; memory grows with the number of cells alone."""

    def __init__(self, object_id: np.ndarray, n_objects: int, levels: np.ndarray):
        levels = np.asarray(levels, np.float64)
        if len(levels) < 2 or np.any(np.diff(levels) <= 0):
            raise InputError("cells: needs at least two increasing roughness levels")
        object_id = np.asarray(object_id, np.int64)
        if object_id.size and not 0 <= object_id.min() <= object_id.max() < n_objects:
            found = f"{object_id.min()} ... {object_id.max()}"
            raise InputError(f"cells: object ids {found}; allowed are 0 ... {n_objects - 1}")
        self.object_id, self.n_objects, self.levels = object_id, n_objects, levels
        cells, count = len(object_id), len(levels)
        self._pixels, self._dd = np.zeros(cells), np.zeros((cells, 3), np.float32)
        self._lobes = np.zeros((cells, count, SUMS, 3), np.float32)
        self._specular = np.zeros((cells, count, 2), np.float32)

    def add(self, rows: PixelRows, response: Response, dark: float = 0.0) -> None:
        """Add the usable pixels (`PixelRows.usable`), seen through `response`."""
        rows = rows.take(np.flatnonzero(rows.usable(dark)))
        rows = rows.take(np.argsort(rows.cell, kind="stable"))
        for start in range(0, len(rows.cell), _PIECE):
            self._add_piece(rows.take(np.arange(start, min(start + _PIECE, len(rows.cell)))), response)

    def _add_piece(self, rows: PixelRows, response: Response) -> None:
        starts = np.flatnonzero(np.r_[True, np.diff(rows.cell) != 0])
        cell = rows.cell[starts]
        y, slope = rows.radiance(response)
        slope = slope * rows.weight[:, None] * np.where(rows.saturated, BOUND_WEIGHT, 1.0)
        d = rows.diffuse.astype(np.float64)
        self._pixels[cell] += np.add.reduceat(rows.weight.astype(np.float64), starts)
        self._dd[cell] += np.add.reduceat(slope * d * d, starts)
        for j in range(len(self.levels)):
            s0, s1 = rows.s0[:, j].astype(np.float64), rows.s1[:, j].astype(np.float64)
            z = y - s1
            for number, (left, right) in enumerate(((s0, s0), (s0, d), (s0, z), (d, z), (z, z))):
                self._lobes[cell, j, number] += np.add.reduceat(slope * left * right, starts)
            means = np.stack([s0.mean(1), s1.mean(1)], 1) * rows.weight[:, None]
            self._specular[cell, j] += np.add.reduceat(means, starts)

    def problem(self) -> CellProblem:
        """Return the sums collected so far."""
        return CellProblem(self.object_id, self.n_objects, self.levels, self._pixels, self._dd, self._lobes, self._specular)
