"""How often a ray meets thin surface, such as the folds of a curtain."""

from __future__ import annotations

import mitsuba
import numpy as np

from iif_core.light.transport.arrays import to_numpy, vectors
from iif_core.light.transport.geometry import Geometry, offset_from, trace

MAX_SHEETS = 16
"""Folds of a curtain that one ray crosses, at most; light through more of them would not be seen."""


def count_sheets(geometry: Geometry, origin: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """Count how often each ray from `origin` (3,) in direction `towards` (n, 3) meets the mesh, (n,) int, up to `MAX_SHEETS`."""
    start = np.tile(origin, (len(towards), 1))
    count, going = np.zeros(len(towards), np.int64), np.arange(len(towards))
    for _ in range(MAX_SHEETS):
        face, distance = trace(geometry, start[going], towards[going])
        met = face >= 0
        going = going[met]
        if not len(going):
            break
        count[going] += 1
        at = start[going] + distance[met, None] * towards[going]
        past = offset_from(vectors(mitsuba.Point3f, at), vectors(mitsuba.Vector3f, towards[going]))
        start[going] = to_numpy(past)
    return count
