"""Connected components of a graph given by its edges."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray


def component_labels(n_nodes: int, first: ArrayLike, second: ArrayLike) -> NDArray:
    """Label the connected components of an undirected graph with edges (first, second), which may repeat.

    Returns (n_nodes,) int32 labels 0, 1, ..., numbered by the lowest node of each component.

    Example:
        >>> component_labels(5, [0, 3], [2, 4]).tolist()
        [0, 1, 0, 2, 2]
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    graph = coo_matrix((np.ones(len(first), np.int8), (first, second)), (n_nodes, n_nodes))
    return connected_components(graph, directed=False)[1]
