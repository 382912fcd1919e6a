"""Filling of invalid pixels."""

from __future__ import annotations

import numpy as np


def fill_from_neighbours(maps: np.ndarray) -> tuple[np.ndarray, int]:
    """Replace every pixel of (H, W, C) maps that is not finite by the nearest finite pixel; also return how many there were."""
    from scipy.ndimage import distance_transform_edt

    lost = ~np.isfinite(maps).all(-1)
    if not lost.any():
        return maps, 0
    rows, columns = distance_transform_edt(lost, return_distances=False, return_indices=True)
    return maps[rows, columns], int(lost.sum())
