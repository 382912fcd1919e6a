"""Small operations on arrays."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray


def numbered_by_first(labels: ArrayLike) -> NDArray:
    """Renumber labels from 0 in the order of their first occurrence; int32.

    Example:
        >>> numbered_by_first([7, 2, 7, 5]).tolist()
        [0, 1, 0, 2]
    """
    _, first, inverse = np.unique(labels, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int32)
    rank[np.argsort(first)] = np.arange(len(first), dtype=np.int32)
    return rank[inverse.ravel()]
