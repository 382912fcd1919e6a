"""Levels that the predictions leave open, and how they are fixed (docs/method/fusion.md#gauge).

A *part* is a connected component of the graph of segments and cells. Each part has its own level (Eq. F.37). `anchor_shifts`
holds a part at the level of its predictions; `seam_shifts` removes the difference between the parts of an object.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from iif_core.numerics.graph import component_labels

SEAM_RIDGE_PAIRS = 5.0
"""Strength of the ridge that holds a part at its own level, in seam pairs (kappa of Eq. F.41). A texture changes from cell
to cell, so a few pairs determine the difference of two levels badly."""

MAX_LEVEL_JUMP = 2.0
"""Largest mean jump at a seam that is treated as a difference of levels, in standard deviations of the predictions' levels
(Eq. F.42)."""


@dataclass(frozen=True)
class Parts:
    """Connected components of the graph of segments and cells.

    Attributes:
        of_segment: (S,) int32 part of each segment; of_cell: (n_cells,) int32, -1 for cells that no segment shows.
        count: number of parts.
    """

    of_segment: NDArray
    of_cell: NDArray
    count: int


def covisible_parts(n_segments: int, n_cells: int, pairs: list[tuple[NDArray, NDArray]]) -> Parts:
    """Find the parts of the graph whose edges are the (segment, cell) `pairs` of used pixels."""
    # A segment meets a cell in many pixels; one edge for each pair is enough.
    keys = [np.unique(segment.astype(np.int64) * n_cells + cell) for segment, cell in pairs]
    segment, cell = np.divmod(np.concatenate([np.zeros(0, np.int64), *keys]), max(n_cells, 1))
    # Nodes 0 ... S - 1 are the segments; the cells follow.
    label = component_labels(n_segments + n_cells, segment, n_segments + cell)
    of_segment, of_cell = label[:n_segments], label[n_segments:]
    seen = np.zeros(n_cells, bool)
    seen[cell] = True
    # An unseen cell is a component by itself. It gets no number, and later systems stay as small as the parts.
    used, compact = np.unique(np.concatenate([of_segment, of_cell[seen]]), return_inverse=True)
    cells = np.full(n_cells, -1, np.int32)
    cells[seen] = compact[n_segments:]
    return Parts(compact[:n_segments].astype(np.int32), cells, len(used))


def anchor_shifts(parts: Parts, level: NDArray, texture: NDArray, weight: NDArray) -> NDArray:
    """Shift every part so that the texture has the mean that `level` has over it (Eq. F.38).

    Args:
        parts: parts of the graph of segments and cells.
        level, texture: (n_cells, 5); weight: (n_cells,) summed pixel weight of each cell.

    Returns:
        (parts, 5) shifts to add to the texture.
    """
    seen = parts.of_cell >= 0
    of_cell, weight = parts.of_cell[seen], weight[seen]
    total = np.bincount(of_cell, weight, parts.count)
    missing = level[seen] - texture[seen]
    sums = np.stack([np.bincount(of_cell, weight * missing[:, c], parts.count) for c in range(5)], 1)
    return sums / np.where(total > 0, total, np.inf)[:, None]  # a part without weight does not move


def seam_shifts(parts: Parts, texture: NDArray, weight: NDArray, neighbours: NDArray, spread: NDArray) -> tuple[NDArray, NDArray]:
    """Shift the parts of each object so that the jumps across their common seams vanish (Eqs. F.41, F.42).

    A seam between two parts is left unchanged in a property whose mean jump exceeds `MAX_LEVEL_JUMP` times the spread of
    the predictions' levels: predictions that agree on their level show a true edge.

    Args:
        parts: parts of the graph of segments and cells.
        texture: (n_cells, 5); weight: (n_cells,) summed pixel weight of each cell.
        neighbours: (m, 2) pairs of neighbouring cells of one object.
        spread: (parts, 5) standard deviation over the predictions of the part's mean.

    Returns:
        (parts, 5) shifts and (parts,) number of seam pairs of each part.
    """
    shift, count = np.zeros((parts.count, 5)), np.zeros(parts.count, np.int64)
    if parts.count == 0 or len(neighbours) == 0:
        return shift, count
    # -------- pairs of cells (x, y) at a seam, x in the part with the lower number --------
    a, b = parts.of_cell[neighbours[:, 0]], parts.of_cell[neighbours[:, 1]]
    seam = (a >= 0) & (b >= 0) & (a != b)
    if not seam.any():
        return shift, count
    # With one order of the parts, all jumps of a seam have the same sign.
    turned = a[seam] > b[seam]
    pairs = np.where(turned[:, None], neighbours[seam][:, ::-1], neighbours[seam])
    a, b = parts.of_cell[pairs[:, 0]].astype(np.int64), parts.of_cell[pairs[:, 1]].astype(np.int64)
    jump = texture[pairs[:, 1]].astype(np.float64) - texture[pairs[:, 0]]  # (m, 5), mu_y - mu_x
    # -------- which seams are plausible as an error of level (Eq. F.42), (seams, 5) --------
    seams, of_pair, length = np.unique(a * parts.count + b, return_inverse=True, return_counts=True)
    mean = np.stack([np.bincount(of_pair, jump[:, c]) for c in range(5)], 1) / length[:, None]
    limit = MAX_LEVEL_JUMP * np.hypot(spread[seams // parts.count], spread[seams % parts.count])
    # Where the predictions agree exactly the limit is 0, and the tolerance keeps rounding of the float32 texture from deciding.
    plausible = np.abs(mean) <= limit + 1e-6
    plausible[:, :3] = plausible[:, :3].all(1, keepdims=True)  # albedo is closed in all three channels or in none
    # -------- one system for each property (Eq. F.43) --------
    for channels in (slice(0, 3), slice(3, 4), slice(4, 5)):
        used = plausible[of_pair, channels.start]
        if used.any():
            shift[:, channels], touched = _solve_shifts(parts, a[used], b[used], jump[used, channels], weight)
            count = np.maximum(count, touched)
    return shift, count


def _solve_shifts(parts: Parts, a: NDArray, b: NDArray, jump: NDArray, weight: NDArray) -> tuple[NDArray, NDArray]:
    """Solve Eq. F.43: shifts (parts, C) for seam pairs between parts a and b with jumps (m, C), and pairs of each part."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.linalg import splu

    n, ones = parts.count, np.ones(len(a))
    count = np.bincount(a, minlength=n) + np.bincount(b, minlength=n)  # m_P
    # q_P is the share of a part in the weight of all parts that seams join to it, directly or through others.
    group = component_labels(n, a, b)
    seen = parts.of_cell >= 0
    size = np.bincount(parts.of_cell[seen], weight[seen], n)
    share = size / np.maximum(np.bincount(group, size)[group], 1e-30)
    # Entries at one position add up, to -m_PQ off the diagonal.
    matrix = coo_matrix((np.concatenate([-ones, -ones]), (np.r_[a, b], np.r_[b, a])), (n, n)).tocsc()
    # The matrix is symmetric and strictly diagonally dominant, hence regular: 1e-9 sees to it even where parts have no weight.
    # One sparse factorisation serves all channels of the property.
    solver = splu(matrix + coo_matrix((count + SEAM_RIDGE_PAIRS * share + 1e-9, (np.arange(n),) * 2)).tocsc())
    # A jump pulls its two parts towards each other.
    right = [np.bincount(a, jump[:, c], n) - np.bincount(b, jump[:, c], n) for c in range(jump.shape[1])]
    shift = np.stack([solver.solve(r) for r in right], 1)
    shift[count == 0] = 0
    return shift, count


def parts_per_object(object_of_cell: NDArray, part_of_cell: NDArray) -> dict[int, int]:
    """Return the number of parts of every object that falls into more than one, by object id.

    Example:
        >>> parts_per_object(np.array([0, 0, 1, 1]), np.array([0, 1, 2, -1]))
        {0: 2}
    """
    seen = part_of_cell >= 0
    pairs = np.unique(np.stack([object_of_cell[seen], part_of_cell[seen]]), axis=1)
    ids, count = np.unique(pairs[0], return_counts=True)
    return {int(i): int(n) for i, n in zip(ids, count, strict=True) if n > 1}
