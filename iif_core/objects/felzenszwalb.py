"""Objects from shape alone: the graph segmentation of Felzenszwalb and Huttenlocher (IJCV 59(2), 2004) on the faces of a mesh.

Edges of the graph are shared edges of the mesh (Eq. O.5), taken from the lightest on (Eq. O.6). In all functions `pairs` is
(e, 2) int, the result of `face_adjacency`, and m is the number of faces.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from iif_core.errors import InputError
from iif_core.numerics.arrays import numbered_by_first
from iif_core.numerics.compiled import njit
from iif_core.surface.segments import face_adjacency
from iif_core.surface.triangles import face_geometry

Array = np.ndarray

FILTER_WIDTH = 0.35
"""Bend |n_a - n_b|, about radians, above which the filter of the normals keeps a crease: 20 degrees."""

FILTER_ROUNDS = 5

ISLAND_GAP = 3.0
"""Distance, in mean edge lengths, up to which a small island joins the nearest large region."""


def filtered_normals(normal: ArrayLike, area: ArrayLike, pairs: ArrayLike, rounds: int = FILTER_ROUNDS) -> Array:
    """Smooth face normals with a bilateral filter that keeps creases (Eq. O.4).

    Args:
        normal: (m, 3) unit normals; 0 where a face has none.
        area: (m,) areas, in any unit.
        pairs: faces that share an edge.
        rounds: number of passes.

    Returns:
        (m, 3) float64 unit normals; 0 where no normal is known.
    """
    normal, area, pairs = np.asarray(normal, np.float64), np.asarray(area, np.float64), np.asarray(pairs)
    a, b = pairs[:, 0], pairs[:, 1]
    for _ in range(rounds):
        # (e,) likeness of the two normals of a pair, small across a crease (Eq. O.4).
        near = np.exp(-((normal[a] - normal[b]) ** 2).sum(1) / (2 * FILTER_WIDTH**2))
        # A face without a normal adds 0 and takes the mean of its neighbours.
        total = normal * area[:, None]
        for c in range(3):
            total[:, c] += np.bincount(a, near * area[b] * normal[b, c], len(normal))
            total[:, c] += np.bincount(b, near * area[a] * normal[a, c], len(normal))
        length = np.linalg.norm(total, axis=1, keepdims=True)
        normal = np.where(length > 0, total / np.where(length > 0, length, 1), 0)
    return normal


def edge_weights(
    normal: ArrayLike,
    centre: ArrayLike,
    pairs: ArrayLike,
    colour: ArrayLike | None = None,
    colour_weight: float = 0.0,
) -> Array:
    """Compute how different the two faces of every pair look (Eq. O.5).

    w = 1 - n_a . n_b, squared where the surface is convex, n_b . (c_b - c_a) > 0, plus `colour_weight` times the largest
    difference of a colour channel. The bend of a face without normal is 0.

    Args:
        normal, centre: (m, 3) unit normals (0 = none) and centres of the faces.
        pairs: faces that share an edge.
        colour: (m, 3) in [0, 1]; NaN = not known, which adds nothing.
        colour_weight: weight of the colour term.

    Returns:
        (e,) float64 >= 0.
    """
    normal, centre = np.asarray(normal, np.float64), np.asarray(centre, np.float64)
    a, b = np.asarray(pairs).T
    known = normal.any(1)
    bend = np.where(known[a] & known[b], 1 - np.clip((normal[a] * normal[b]).sum(1), -1, 1), 0)
    convex = (normal[b] * (centre[b] - centre[a])).sum(1) > 0
    weight = np.where(convex, np.minimum(bend, bend * bend), bend)  # beyond 90 degrees the square would be the larger one
    if colour is not None and colour_weight > 0:
        colour = np.asarray(colour, np.float64)
        weight = weight + colour_weight * np.nan_to_num(np.abs(colour[a] - colour[b]).max(1), nan=0.0)
    return weight


def smooth_over_faces(values: ArrayLike, weight: ArrayLike, pairs: ArrayLike, rounds: int) -> Array:
    """Average values over each face and its neighbours, repeatedly; this also fills faces that nobody saw.

    Args:
        values: (m, c).
        weight: (m,) >= 0; 0 = not known.
        pairs: faces that share an edge.
        rounds: number of passes.

    Returns:
        (m, c) float64; NaN for faces that no known value reached.
    """
    from scipy.sparse import coo_matrix, identity

    values, weight, pairs = np.asarray(values, np.float64), np.asarray(weight, np.float64), np.asarray(pairs)
    count = len(values)
    ends = np.concatenate([pairs, pairs[:, ::-1]])
    # Row f of the matrix sums face f and its neighbours.
    graph = (coo_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), (count, count)) + identity(count)).tocsr()
    total = np.where(weight[:, None] > 0, values, 0) * weight[:, None]
    # Weighted sums and weights spread alike; the one division at the end keeps every value weighted by its pixels.
    for _ in range(rounds):
        total, weight = graph @ total, graph @ weight
    return np.where(weight[:, None] > 0, total / np.where(weight > 0, weight, 1)[:, None], np.nan)


def merge_regions(
    count: int, pairs: ArrayLike, weights: ArrayLike, scale: float, min_size: int, fill: ArrayLike | None = None
) -> Array:
    """Merge the nodes of a graph to regions (Eq. O.6).

    Args:
        count: number of nodes.
        pairs, weights: (e, 2) int and (e,) finite; edges of equal weight are taken in the order of `pairs`.
        scale: k; larger values give larger regions.
        min_size: a region with fewer nodes joins a neighbour, if it has one.
        fill: (count,) share of a region that is large enough which each node makes up; regions whose nodes together reach 1 stay,
            however few they are. None = 0.

    Returns:
        (count,) int32 regions, numbered by their lowest node.

    Raises:
        InputError: a weight that is not finite, or a non-positive scale.
    """
    pairs, weights = np.asarray(pairs), np.asarray(weights, np.float64)
    if not scale > 0:
        raise InputError(f"segmentation scale is {scale}; it must be positive")
    if not np.isfinite(weights).all():
        raise InputError(f"{int((~np.isfinite(weights)).sum())} edge weights are not finite; the mesh has NaN vertices")
    order = np.argsort(weights, kind="stable")
    ends = pairs[order].astype(np.int64).reshape(-1, 2)
    filled = np.zeros(count) if fill is None else np.array(fill, np.float64)
    parent = _merged(count, ends[:, 0].copy(), ends[:, 1].copy(), weights[order], float(scale), int(min_size), filled)
    return numbered_by_first(parent)


@njit()
def _merged(count, first, second, weight, scale, min_size, fill):
    """Find the root of every node: union-find with path halving over the sorted edges, and a second pass for small regions.
    `fill` is overwritten."""
    # limit = Int(C) + k / |C| at the root of each region C; a single node has no inner edge, so Int is 0.
    parent, size, limit = np.arange(count), np.ones(count, np.int64), np.full(count, scale)
    # -------- first pass: Eq. O.6; second pass: small regions join across their lightest edge --------
    for last in (False, True):
        for edge in range(len(first)):
            a, b = first[edge], second[edge]
            while parent[a] != a:
                parent[a] = parent[parent[a]]  # path halving keeps trees flat
                a = parent[a]
            while parent[b] != b:
                parent[b] = parent[parent[b]]
                b = parent[b]
            if a == b:
                continue
            if last:
                if (size[a] >= min_size or fill[a] >= 1.0) and (size[b] >= min_size or fill[b] >= 1.0):
                    continue
            elif weight[edge] > limit[a] or weight[edge] > limit[b]:
                continue
            if size[a] < size[b]:  # the smaller tree hangs below the larger
                a, b = b, a
            parent[b] = a
            size[a] += size[b]
            fill[a] += fill[b]
            if not last:
                limit[a] = weight[edge] + scale / size[a]  # edges come in order: this one is the heaviest inside
    for node in range(count):
        root = node
        while parent[root] != root:
            root = parent[root]
        parent[node] = root
    return parent


def segment_mesh(
    vertices: ArrayLike,
    faces: ArrayLike,
    scale: float = 0.05,
    min_faces: int = 100,
    colour: ArrayLike | None = None,
    colour_weight: float = 0.0,
    pairs: ArrayLike | None = None,
    min_area: float = 0.01,
) -> Array:
    """Segment a mesh into regions.

    Vertices at one position count as one. A region is small if it has fewer than `min_faces` faces and less than `min_area`:
    furniture that somebody modelled may have very few. Small islands without neighbours join the region of the nearest face of
    a larger region, up to ISLAND_GAP mean edge lengths away, and stay alone otherwise.

    Args:
        vertices, faces: (n, 3) in metres and (m, 3) int.
        scale, min_faces: `scale` and `min_size` of `merge_regions`.
        colour, colour_weight: see `edge_weights`.
        pairs: `face_adjacency(faces, vertices)`, if it is known already.
        min_area: m^2, about the area of a hundred faces of a scan; infinite = the number of faces alone counts.

    Returns:
        (m,) int32 regions from 0 without gaps, in the order of their lowest face; deterministic.
    """
    vertices, faces = np.asarray(vertices), np.asarray(faces)
    if len(faces) == 0:
        return np.zeros(0, np.int32)
    pairs = face_adjacency(faces, vertices) if pairs is None else np.asarray(pairs)
    normal, area = face_geometry(vertices, faces)
    normal = filtered_normals(normal, area, pairs)
    weights = edge_weights(normal, vertices.astype(np.float64)[faces].mean(1), pairs, colour, colour_weight)
    # Infinite `min_area` gives 0, so the number of faces alone counts; with 0 a single face fills a region.
    fill = area / max(min_area, 1e-300)
    labels = merge_regions(len(faces), pairs, weights, scale, min_faces, fill)
    return _join_islands(vertices, faces, labels, (np.bincount(labels) < min_faces) & (np.bincount(labels, fill) < 1.0))


def _join_islands(vertices: Array, faces: Array, labels: Array, is_small: Array) -> Array:
    """Let regions that are small, (regions,) bool, join the nearest one that is not."""
    from scipy.spatial import cKDTree

    small = is_small[labels]
    if small.all() or not small.any():
        return labels
    corners = np.asarray(vertices, np.float64)[faces]
    centre = corners.mean(1)
    edge = float(np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1).mean())
    # What is small after both passes has no edge to anything else, so only distance can find it a region.
    large = np.flatnonzero(~small)
    island = np.flatnonzero(small)
    distance, nearest = cKDTree(centre[large]).query(centre[island])
    # The face of an island that lies nearest decides for the island; of equal distances the lowest face.
    order = np.lexsort((island, distance, labels[island]))
    pieces, first = np.unique(labels[island][order], return_index=True)
    chosen = order[first]
    target = np.where(distance[chosen] <= ISLAND_GAP * edge, labels[large[nearest[chosen]]], pieces)  # else it keeps its label
    out = labels.copy()
    out[island] = target[np.searchsorted(pieces, labels[island])]
    return numbered_by_first(out)
