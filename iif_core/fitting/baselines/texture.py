"""Albedo of surface cells, once roughness and metallic are known for blocks of cells, which share their light (Eq. M.54)."""

from __future__ import annotations

import numpy as np

from iif_core.camera.response import Response
from iif_core.fitting.baselines.loss import F0
from iif_core.fitting.baselines.problem import BOUND_WEIGHT, PixelRows
from iif_core.fitting.levels import interpolate_levels
from iif_core.surface.cells import pack_keys

BLOCK_WEIGHT = 0.5
"""Weight of the albedo of its block in a cell, in pixels of average sensitivity."""


def blocks_of(ijk: np.ndarray, object_id: np.ndarray, edge: int) -> tuple[np.ndarray, np.ndarray]:
    """Group the cells of each object into cubes of `edge` cells; return the block of each cell (C,) and its object (B,)."""
    keys = pack_keys(np.asarray(ijk, np.int64) // edge, object_id)
    _, first, block = np.unique(keys, return_index=True, return_inverse=True)
    return block.reshape(-1), np.asarray(object_id)[first]


class BlockLight:
    """Mean diffuse light of blocks over their pixels; it does not depend on the view, so its noise averages out."""

    def __init__(self, blocks: int):
        self._sums, self._count = np.zeros((blocks, 3)), np.zeros(blocks)

    def add(self, block: np.ndarray, diffuse: np.ndarray) -> None:
        """Add pixels: block (n,) int, -1 = none, diffuse (n, 3); values that are not finite are left out."""
        use = np.isfinite(diffuse).all(1) & (block >= 0)
        for c in range(3):
            self._sums[:, c] += np.bincount(block[use], diffuse[use, c], len(self._sums))
        self._count += np.bincount(block[use], minlength=len(self._count))

    def mean(self) -> np.ndarray:
        """Return the means, (B, 3) float32; 0 for blocks without pixels."""
        return (self._sums / np.maximum(self._count, 1)[:, None]).astype(np.float32)


class AlbedoSums:
    """Collects the sums of Eq. M.54 from pixels in any number of pieces; 7 numbers for each cell."""

    def __init__(self, cells: int):
        self._square, self._cross, self._pixels = np.zeros((cells, 3)), np.zeros((cells, 3)), np.zeros(cells)

    def add(
        self, rows: PixelRows, levels: np.ndarray, roughness: np.ndarray, metallic: np.ndarray, curve: Response, dark: float = 0.0
    ) -> None:
        """Add pixels.

        Args:
            rows: pixels, with the cell of each; levels: (J,) roughness of the cached levels.
            roughness, metallic: (n,) of each pixel's block; curve: camera response; dark: see `PixelRows.usable`.
        """
        use = np.flatnonzero(rows.usable(dark))
        rows, m = rows.take(use), metallic[use, None]
        y, slope = rows.radiance(curve)
        slope = slope * rows.weight[:, None] * np.where(rows.saturated, BOUND_WEIGHT, 1.0)
        s0, s1 = (interpolate_levels(s, levels, roughness[use])[0] for s in (rows.s0, rows.s1))
        gain = (1.0 - m) * rows.diffuse + m * s0
        rest = y - F0 * (1.0 - m) * s0 - s1
        for c in range(3):
            self._square[:, c] += np.bincount(rows.cell, slope[:, c] * gain[:, c] ** 2, len(self._square))
            self._cross[:, c] += np.bincount(rows.cell, slope[:, c] * gain[:, c] * rest[:, c], len(self._cross))
        self._pixels += np.bincount(rows.cell, rows.weight, len(self._pixels))

    @property
    def sums(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Sums of w G^2 (C, 3), of w G (y - h) (C, 3) and of the pixels' weights (C,), for L = a G + h."""
        return self._square, self._cross, self._pixels

    def albedo(
        self, block: np.ndarray, prior: np.ndarray | None = None, weight: float = 0.0, shrink: float = BLOCK_WEIGHT
    ) -> np.ndarray:
        """Return the albedo that minimises sum w^2 (a G + h - y)^2 + shrink g (a - block)^2 + weight n (a - prior)^2.

        Args:
            block: (C, 3) albedo of each cell's block, which cells without pixels keep.
            prior: (C, 3) albedo; weight: of the prior for each pixel.
            shrink: weight of the block in pixels of average sensitivity g, the mean of w^2 G^2.

        Returns:
            (C, 3) in [0, 1].
        """
        average = self._square.sum(0) / max(float(self._pixels.sum()), 1e-300)
        square, cross = self._square + shrink * average, self._cross + shrink * average * block
        if weight and prior is not None:
            prior_weight = weight * self._pixels[:, None]
            square, cross = square + prior_weight, cross + prior_weight * prior
        known = (self._pixels[:, None] > 0) & (square > 0)
        return np.clip(np.where(known, cross / np.where(known, square, 1.0), block), 0.0, 1.0)
