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

from .problem import BaseProblem, check_ids

SEAM_RIDGE = 5.0
"""Pull of an object's parts to their own level, in seam pairs: an object's texture changes from cell to cell, so few
pairs say little about the levels of two parts."""


@dataclass(frozen=True)
class Parts:
    """Connected parts of the graph of segments and cells.

    Attributes:
        of_segment: (S,) int32; of_cell: (n_cells,) int32, -1 for cells that no segment shows; count: number of parts.
    """

    of_segment: NDArray
    of_cell: NDArray
    count: int


def covisible_parts(problem: BaseProblem) -> Parts:
    """Parts of a problem: segments are in one part when they share cells, directly or through others (union-find)."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    pairs = [np.zeros(0, np.int64)]
    for view, (cell, segment) in enumerate(zip(problem.cell_of_pixel, problem.segment_of_pixel, strict=True)):
        cell, segment = np.ravel(cell), np.ravel(segment)
        check_ids(problem, view)
        known = (cell >= 0) & (segment >= 0)
        if problem.weight is not None:
            known &= np.ravel(problem.weight[view]) > 0
        pairs.append(np.unique(segment[known].astype(np.int64) * problem.n_cells + cell[known]))
    segment, cell = np.divmod(np.concatenate(pairs), max(problem.n_cells, 1))
    size = problem.n_segments + problem.n_cells
    graph = coo_matrix((np.ones(len(cell), np.int8), (segment, problem.n_segments + cell)), (size, size))
    _, label = connected_components(graph, directed=False)
    of_segment, of_cell = label[: problem.n_segments], label[problem.n_segments :]
    seen = np.zeros(problem.n_cells, bool)
    seen[cell] = True
    used, compact = np.unique(np.concatenate([of_segment, of_cell[seen]]), return_inverse=True)
    cells = np.full(problem.n_cells, -1, np.int32)
    cells[seen] = compact[problem.n_segments :]
    return Parts(compact[: problem.n_segments].astype(np.int32), cells, len(used))


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
    parts: Parts, texture: NDArray, weight: NDArray, neighbours: NDArray, ridge: float = SEAM_RIDGE
) -> tuple[NDArray, NDArray]:
    """Shifts (parts, 5) that close the seams between parts, and the number of seam pairs of each part (parts,).

    Minimises, channel by channel and over each set of parts that touch,

        sum over seam pairs (x, y) of (mu_x + s_part(x) - mu_y - s_part(y))^2 + sum over parts of ridge q_p s_p^2,

    with q_p the share of the part in the pixels of its set: the small part moves, the large one stays.

    Args:
        texture: (n_cells, 5); weight: (n_cells,); neighbours: (m, 2) pairs of neighbouring cells of one object.
    """
    shift, count = np.zeros((parts.count, 5)), np.zeros(parts.count, np.int64)
    if parts.count == 0 or len(neighbours) == 0:
        return shift, count
    a, b = parts.of_cell[neighbours[:, 0]], parts.of_cell[neighbours[:, 1]]
    seam = (a >= 0) & (b >= 0) & (a != b)
    if not seam.any():
        return shift, count
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.sparse.linalg import splu

    a, b = a[seam], b[seam]
    jump = texture[neighbours[seam, 1]].astype(np.float64) - texture[neighbours[seam, 0]]
    count = np.bincount(a, minlength=parts.count) + np.bincount(b, minlength=parts.count)
    ones = np.ones(len(a))
    adjacency = coo_matrix((ones, (a, b)), (parts.count, parts.count))
    _, group = connected_components(adjacency, directed=False)
    seen = parts.of_cell >= 0
    size = np.bincount(parts.of_cell[seen], weight[seen], parts.count)
    share = size / np.maximum(np.bincount(group, size)[group], 1e-30)
    pull = ridge * share + 1e-9
    matrix = coo_matrix((np.concatenate([-ones, -ones]), (np.r_[a, b], np.r_[b, a])), (parts.count, parts.count)).tocsc()
    matrix = matrix + coo_matrix((count + pull, (np.arange(parts.count),) * 2)).tocsc()
    solver = splu(matrix)
    for c in range(5):
        right = np.bincount(a, jump[:, c], parts.count) - np.bincount(b, jump[:, c], parts.count)
        shift[:, c] = solver.solve(right)
    shift[count == 0] = 0
    return shift, count
