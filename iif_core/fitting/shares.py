"""How many pixels of each object a fit takes."""

from __future__ import annotations

import numpy as np


def fair_shares(counts: np.ndarray, budget: int) -> np.ndarray:
    """Return the share of each object's pixels to keep, (O,), so that about `budget` remain.

    Objects keep the same number of pixels; those that have fewer keep all.

    Example:
        >>> fair_shares(np.array([2, 10, 100]), 22).tolist()
        [1.0, 1.0, 0.1]
    """
    counts = np.asarray(counts, np.float64)
    if counts.sum() <= budget:
        return np.ones(len(counts))
    # With the objects sorted by size, candidate k keeps the k smallest whole and shares the rest of the budget equally. The first
    # candidate that is not larger than the next object is the common number.
    order = np.sort(counts)
    below = np.r_[0.0, np.cumsum(order)[:-1]]
    limits = (budget - below) / np.arange(len(order), 0, -1)
    limit = limits[np.argmax(limits <= order)]
    return np.minimum(1.0, limit / np.maximum(counts, 1.0))
