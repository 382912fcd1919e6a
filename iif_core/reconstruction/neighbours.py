"""Which photographs are compared with which: those that show the same points from directions that differ, but not by much."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_matrix

BEST_ANGLE = 8.0
"""Degrees between two lines of sight at which depth is exact enough, and the pictures are still alike."""
_BELOW, _ABOVE = 3.0, 8.0  # widths in degrees of the preference on either side


def neighbours(point: ArrayLike, view: ArrayLike, points: ArrayLike, centres: ArrayLike, most: int = 6) -> list[NDArray]:
    """Return the views to compare each view with, best first.

    The score of a pair is the sum over the points that both show of exp(-(a - 8)^2 / 2 w^2), where a is the angle in degrees
    between their lines of sight, and w is 3 below 8 and 8 above (after Yao et al., MVSNet, 2018, with another best angle).

    Args:
        point, view: (n,) observations: number of the point and of the view that shows it.
        points: (p, 3) in the world.
        centres: (v, 3) of the cameras.
        most: views for each.

    Returns:
        v arrays of at most `most` numbers of views; those that share nothing with a view are not among its neighbours.
    """
    point, view = np.asarray(point, np.int64), np.asarray(view, np.int64)
    points, centres = np.asarray(points, np.float64), np.asarray(centres, np.float64)
    count = len(centres)
    shows = csr_matrix((np.ones(len(point), bool), (view, point)), (count, len(points)))
    out = []
    for i in range(count):
        own = shows[i].indices
        also = shows[:, own].toarray()
        sight = points[own][None] - centres[:, None]
        sight /= np.maximum(np.linalg.norm(sight, axis=-1, keepdims=True), 1e-12)
        angle = np.degrees(np.arccos(np.clip(np.einsum("vpc,pc->vp", sight, sight[i]), -1, 1)))
        width = np.where(angle < BEST_ANGLE, _BELOW, _ABOVE)
        score = (np.exp(-0.5 * ((angle - BEST_ANGLE) / width) ** 2) * also).sum(1)
        score[i] = 0
        order = np.argsort(-score, kind="stable")[:most]
        out.append(order[score[order] > 0])
    return out
