"""Groups of pixels that share errors: neighbours on the surface, in whichever view (docs/method/fitting.md#uncertainty)."""

from __future__ import annotations

import numpy as np

_PIXELS_OF_PATCH = 48
_FEWEST_PATCHES, _MOST_PATCHES = 12, 200
"""Of an object."""


def patches(object_id: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Number the patches of each object and return the patch of every pixel, (n,) int32.

    The pixels of an object are ordered along a Z-curve through its bounding box and cut into equal runs of about 48 pixels, 12 to
    200 for each object. Positions (n, 3) may have any unit.
    """
    object_id = np.asarray(object_id)
    if not len(object_id):
        return np.zeros(0, np.int32)
    groups, owner = np.unique(object_id, return_inverse=True)
    position = np.asarray(position, np.float64)
    low, high = np.full((len(groups), 3), np.inf), np.full((len(groups), 3), -np.inf)
    np.minimum.at(low, owner, position)
    np.maximum.at(high, owner, position)
    extent = np.maximum((high - low).max(1), 1e-12)
    grid = np.clip((position - low[owner]) / extent[owner, None] * 1023.0, 0, 1023).astype(np.int64)
    order = np.lexsort((_interleaved(grid), owner))
    count = np.bincount(owner)
    place = np.empty(len(owner), np.int64)
    place[order] = np.arange(len(owner)) - np.repeat(np.r_[0, np.cumsum(count)[:-1]], count)
    runs = np.minimum(np.clip(count // _PIXELS_OF_PATCH, _FEWEST_PATCHES, _MOST_PATCHES), np.maximum(count, 1))
    return (place * runs[owner] // count[owner]).astype(np.int32)


def _interleaved(grid: np.ndarray) -> np.ndarray:
    """Return the Morton code of (n, 3) integers below 1024."""
    code = np.zeros(len(grid), np.int64)
    for bit in range(10):
        for axis in range(3):
            code |= ((grid[:, axis] >> bit) & 1) << (3 * bit + axis)
    return code
