"""Parts of objects that no view ties together, and their levels (METHOD 7c, gauge freedom G2)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .problem import BaseProblem


def covisible_parts(problem: BaseProblem) -> NDArray:
    """Part of every segment, (S,) int32: segments are in one part when they share cells, directly or through others.

    An object in n > 1 parts has n independent gauges that only the pull to identity ties together (METHOD 7c, G2):
    its parts may differ in tone.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    pairs = [np.zeros(0, np.int64)]
    for cell, segment in zip(problem.cell_of_pixel, problem.segment_of_pixel, strict=True):
        cell, segment = np.ravel(cell), np.ravel(segment)
        known = (cell >= 0) & (segment >= 0)
        pairs.append(np.unique(segment[known].astype(np.int64) * problem.n_cells + cell[known]))
    segment, cell = np.divmod(np.concatenate(pairs), max(problem.n_cells, 1))
    size = problem.n_segments + problem.n_cells
    graph = coo_matrix((np.ones(len(cell), np.int8), (segment, problem.n_segments + cell)), (size, size))
    _, label = connected_components(graph, directed=False)
    return np.unique(label[: problem.n_segments], return_inverse=True)[1].astype(np.int32)
