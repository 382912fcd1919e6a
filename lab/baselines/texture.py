"""Albedo of surface cells, once roughness and metallic are known for blocks of cells, which share their light (Eq. M.54)."""

from __future__ import annotations

import numpy as np

from iif_core.fitting.cell_pixels import AlbedoSums
from iif_core.surface.cells import pack_keys

BLOCK_WEIGHT = 0.5
"""Weight of the albedo of its block in a cell, in pixels of average sensitivity."""


def blocks_of(ijk: np.ndarray, object_id: np.ndarray, edge: int) -> tuple[np.ndarray, np.ndarray]:
    """Group the cells of each object into cubes of `edge` cells; return the block of each cell (C,) and its object (B,)."""
    keys = pack_keys(np.asarray(ijk, np.int64) // edge, object_id)
    _, first, block = np.unique(keys, return_index=True, return_inverse=True)
    return block.reshape(-1), np.asarray(object_id)[first]


def cell_albedo(
    sums: AlbedoSums, block: np.ndarray, prior: np.ndarray | None = None, weight: float = 0.0, shrink: float = BLOCK_WEIGHT
) -> np.ndarray:
    """Return the albedo that minimises sum w^2 (a G + h - y)^2 + shrink g (a - block)^2 + weight n (a - prior)^2.

    Args:
        sums: of the pixels of each cell; block: (C, 3) albedo of each cell's block, which cells without pixels keep.
        prior: (C, 3) albedo; weight: of the prior for each pixel.
        shrink: weight of the block in pixels of average sensitivity g, the mean of w^2 G^2.

    Returns:
        (C, 3) in [0, 1].
    """
    square, cross, pixels = sums.sums
    average = square.sum(0) / max(float(pixels.sum()), 1e-300)
    square, cross = square + shrink * average, cross + shrink * average * block
    if weight and prior is not None:
        prior_weight = weight * pixels[:, None]
        square, cross = square + prior_weight, cross + prior_weight * prior
    known = (pixels[:, None] > 0) & (square > 0)
    return np.clip(np.where(known, cross / np.where(known, square, 1.0), block), 0.0, 1.0)
