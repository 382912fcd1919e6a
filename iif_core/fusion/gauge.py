"""Levels that the predictions leave open (METHOD 7c, gauge freedoms G1 and G2).

A shift of the texture and the opposite shift of every correction cancel. Segments are tied to one another only through
the cells that they share: a *part* is a set of segments and cells that hang together, and each part has a level of its
own. `anchor_shifts` holds each part at the level of its predictions. Where an object falls into several parts (two sides
of a cupboard that no photograph shows together), their levels differ by the error of the predictions, and an edge runs
through the object that no correction per object can undo: `seam_shifts` closes it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

SEAM_RIDGE = 5.0
"""Pull of an object's parts to their own level, in seam pairs: an object's texture changes from cell to cell, so few
pairs say little about the levels of two parts."""

PLAUSIBLE = 2.0
"""Largest jump at a seam that is taken for a difference of levels, in standard deviations of the predictions' levels."""


@dataclass(frozen=True)
class Parts:
    """Connected parts of the graph of segments and cells.

    Attributes:
        of_segment: (S,) int32; of_cell: (n_cells,) int32, -1 for cells that no segment shows; count: number of parts.
    """

    of_segment: NDArray
    of_cell: NDArray
    count: int


def covisible_parts(n_segments: int, n_cells: int, pairs: list[tuple[NDArray, NDArray]]) -> Parts:
    """Parts of the graph that (segment, cell) `pairs` of used pixels make: connected components (union-find)."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    keys = [np.unique(segment.astype(np.int64) * n_cells + cell) for segment, cell in pairs]
    segment, cell = np.divmod(np.concatenate([np.zeros(0, np.int64), *keys]), max(n_cells, 1))
    size = n_segments + n_cells
    graph = coo_matrix((np.ones(len(cell), np.int8), (segment, n_segments + cell)), (size, size))
    _, label = connected_components(graph, directed=False)
    of_segment, of_cell = label[:n_segments], label[n_segments:]
    seen = np.zeros(n_cells, bool)
    seen[cell] = True
    used, compact = np.unique(np.concatenate([of_segment, of_cell[seen]]), return_inverse=True)
    cells = np.full(n_cells, -1, np.int32)
    cells[seen] = compact[n_segments:]
    return Parts(compact[:n_segments].astype(np.int32), cells, len(used))


def anchor_shifts(parts: Parts, level: NDArray, texture: NDArray, weight: NDArray) -> NDArray:
    """(parts, 5) shifts that give the texture the mean that `level` has over every part.

    Args:
        level, texture: (n_cells, 5); weight: (n_cells,) pixel weight of each cell.
    """
    seen = parts.of_cell >= 0
    of_cell, weight = parts.of_cell[seen], weight[seen]
    total = np.bincount(of_cell, weight, parts.count)
    missing = level[seen] - texture[seen]
    sums = np.stack([np.bincount(of_cell, weight * missing[:, c], parts.count) for c in range(5)], 1)
    return sums / np.where(total > 0, total, np.inf)[:, None]


def seam_shifts(
    parts: Parts, texture: NDArray, weight: NDArray, neighbours: NDArray, spread: NDArray, ridge: float = SEAM_RIDGE
) -> tuple[NDArray, NDArray]:
    """Shifts (parts, 5) that close the seams between parts, and the number of seam pairs of each part (parts,).

    Minimises, channel by channel and over each set of parts that touch,

        sum over seam pairs (x, y) of (mu_x + s_part(x) - mu_y - s_part(y))^2 + sum over parts of ridge q_p s_p^2,

    with q_p the share of the part in the pixels of its set: the small part moves, the large one stays. A seam between two
    parts is left alone in a property whose mean jump is more than `PLAUSIBLE` times the spread of the predictions' levels
    in both parts: predictions that agree on their level mean the edge that they show.

    Args:
        texture: (n_cells, 5); weight: (n_cells,); neighbours: (m, 2) pairs of neighbouring cells of one object.
        spread: (parts, 5) standard deviation over the predictions of the part's mean.
    """
    shift, count = np.zeros((parts.count, 5)), np.zeros(parts.count, np.int64)
    if parts.count == 0 or len(neighbours) == 0:
        return shift, count
    a, b = parts.of_cell[neighbours[:, 0]], parts.of_cell[neighbours[:, 1]]
    seam = (a >= 0) & (b >= 0) & (a != b)
    if not seam.any():
        return shift, count
    turned = a[seam] > b[seam]
    pairs = np.where(turned[:, None], neighbours[seam][:, ::-1], neighbours[seam])
    a, b = parts.of_cell[pairs[:, 0]].astype(np.int64), parts.of_cell[pairs[:, 1]].astype(np.int64)
    jump = texture[pairs[:, 1]].astype(np.float64) - texture[pairs[:, 0]]
    seams, of_pair, length = np.unique(a * parts.count + b, return_inverse=True, return_counts=True)
    mean = np.stack([np.bincount(of_pair, jump[:, c]) for c in range(5)], 1) / length[:, None]
    limit = PLAUSIBLE * np.hypot(spread[seams // parts.count], spread[seams % parts.count])
    plausible = np.abs(mean) <= limit + 1e-6
    plausible[:, :3] = plausible[:, :3].all(1, keepdims=True)  # a colour moves as a whole
    for channels in (slice(0, 3), slice(3, 4), slice(4, 5)):
        used = plausible[of_pair, channels.start]
        if used.any():
            shift[:, channels], touched = _closed(parts, a[used], b[used], jump[used, channels], weight, ridge)
            count = np.maximum(count, touched)
    return shift, count


def _closed(parts: Parts, a: NDArray, b: NDArray, jump: NDArray, weight: NDArray, ridge: float) -> tuple[NDArray, NDArray]:
    """Shifts (parts, C) for seam pairs between parts a and b with jumps (m, C); pairs of each part."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.sparse.linalg import splu

    n, ones = parts.count, np.ones(len(a))
    count = np.bincount(a, minlength=n) + np.bincount(b, minlength=n)
    _, group = connected_components(coo_matrix((ones, (a, b)), (n, n)), directed=False)
    seen = parts.of_cell >= 0
    size = np.bincount(parts.of_cell[seen], weight[seen], n)
    share = size / np.maximum(np.bincount(group, size)[group], 1e-30)
    matrix = coo_matrix((np.concatenate([-ones, -ones]), (np.r_[a, b], np.r_[b, a])), (n, n)).tocsc()
    solver = splu(matrix + coo_matrix((count + ridge * share + 1e-9, (np.arange(n),) * 2)).tocsc())
    right = [np.bincount(a, jump[:, c], n) - np.bincount(b, jump[:, c], n) for c in range(jump.shape[1])]
    shift = np.stack([solver.solve(r) for r in right], 1)
    shift[count == 0] = 0
    return shift, count
