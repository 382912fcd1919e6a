"""Objects from shape alone: Felzenszwalb and Huttenlocher's graph segmentation on the faces of a mesh.

Faces that share an edge are joined by a graph edge whose weight says how much they look like different things (bend,
concave more than convex; difference of colour). Edges are taken from the lightest on; the two regions at its ends
merge when

    w <= min(Int(A) + k / |A|, Int(B) + k / |B|)

with Int the heaviest edge merged so far inside a region and |.| its number of faces (IJCV 59(2), 2004, Eq. 4 and 5).
Small regions then join the neighbour across their lightest edge. Over-segmentation is the safe side: a piece of an
object can still be corrected by its own affine, two objects in one cannot.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import ArrayLike

from iif_core.errors import InputError
from iif_core.surface.segments import face_adjacency

Array = np.ndarray

FILTER_WIDTH = 0.35
"""Bends (as |n_a - n_b|, about radians) above this count as creases when normals are filtered: 20 degrees."""

FILTER_ROUNDS = 5

ISLAND_GAP = 3.0
"""A small island joins the nearest large region when it is within this many mean edge lengths."""


def face_normals(vertices: ArrayLike, faces: ArrayLike) -> Array:
    """(m, 3) float64 unit right-hand normals; zero where a face has no area."""
    corners = np.asarray(vertices, np.float64)[np.asarray(faces)]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    return np.where(length > 0, normal / np.where(length > 0, length, 1), 0)


def filtered_normals(normal: ArrayLike, area: ArrayLike, pairs: ArrayLike, rounds: int = FILTER_ROUNDS) -> Array:
    """Bilateral filter on face normals: calms the noise of a scan and keeps creases.

    n_a <- sum over a and its neighbours b of area_b exp(-|n_a - n_b|^2 / (2 FILTER_WIDTH^2)) n_b, normalised; repeated.
    normal (m, 3) unit or zero, area (m,) -> (m, 3) float64, zero where no normal is known.
    """
    normal, area, pairs = np.asarray(normal, np.float64), np.asarray(area, np.float64), np.asarray(pairs)
    a, b = pairs[:, 0], pairs[:, 1]
    for _ in range(rounds):
        near = np.exp(-((normal[a] - normal[b]) ** 2).sum(1) / (2 * FILTER_WIDTH**2))
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
    """How different the two faces of every pair are, (e,) float64 >= 0.

    w = 1 - n_a . n_b, squared where the surface is convex, n_b . (c_b - c_a) > 0 (a convex bend is rarely a
    border), plus colour_weight times the largest channel difference. A face without area has no normal and
    bends nowhere.

    Args:
        normal, centre: (m, 3) unit normals (zero = none) and centres of the faces.
        pairs: (e, 2) int, from `face_adjacency`.
        colour: (m, 3) in [0, 1], NaN = not known, which costs nothing.
    """
    normal, centre = np.asarray(normal, np.float64), np.asarray(centre, np.float64)
    a, b = np.asarray(pairs).T
    known = normal.any(1)
    bend = np.where(known[a] & known[b], 1 - np.clip((normal[a] * normal[b]).sum(1), -1, 1), 0)
    convex = (normal[b] * (centre[b] - centre[a])).sum(1) > 0
    weight = np.where(convex, np.minimum(bend, bend * bend), bend)
    if colour is not None and colour_weight > 0:
        colour = np.asarray(colour, np.float64)
        weight = weight + colour_weight * np.nan_to_num(np.abs(colour[a] - colour[b]).max(1), nan=0.0)
    return weight


def smooth_over_faces(values: ArrayLike, weight: ArrayLike, pairs: ArrayLike, rounds: int) -> Array:
    """Mean of each face and its neighbours, weighted and repeated: fills faces that nobody saw, calms noise.

    values (m, c), weight (m,) >= 0 (0 = unknown) -> (m, c) float64, NaN where no weight came within `rounds` steps.
    """
    from scipy.sparse import coo_matrix, identity

    values, weight, pairs = np.asarray(values, np.float64), np.asarray(weight, np.float64), np.asarray(pairs)
    count = len(values)
    ends = np.concatenate([pairs, pairs[:, ::-1]])
    graph = (coo_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), (count, count)) + identity(count)).tocsr()
    total = np.where(weight[:, None] > 0, values, 0) * weight[:, None]
    for _ in range(rounds):
        total, weight = graph @ total, graph @ weight
    return np.where(weight[:, None] > 0, total / np.where(weight > 0, weight, 1)[:, None], np.nan)


def merge_regions(count: int, pairs: ArrayLike, weights: ArrayLike, scale: float, min_size: int) -> Array:
    """Regions of a graph of `count` nodes, (count,) int32, numbered by their lowest node.

    Args:
        pairs, weights: (e, 2) int and (e,) finite; the order of equal weights is that of `pairs`.
        scale: k; larger gives larger regions.
        min_size: a region with fewer nodes joins a neighbour, if it has one.

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
    parent = _merged(count, ends[:, 0].copy(), ends[:, 1].copy(), weights[order], float(scale), int(min_size))
    return _numbered(parent)


@numba.njit(nogil=True, cache=True)
def _merged(count, first, second, weight, scale, min_size):
    """Root of every node: a union-find with halved paths over sorted edges, then once more for the small regions."""
    parent, size, limit = np.arange(count), np.ones(count, np.int64), np.full(count, scale)
    for last in (False, True):
        for edge in range(len(first)):
            a, b = first[edge], second[edge]
            while parent[a] != a:
                parent[a] = parent[parent[a]]
                a = parent[a]
            while parent[b] != b:
                parent[b] = parent[parent[b]]
                b = parent[b]
            if a == b:
                continue
            if last:
                if size[a] >= min_size and size[b] >= min_size:
                    continue
            elif weight[edge] > limit[a] or weight[edge] > limit[b]:
                continue
            if size[a] < size[b]:
                a, b = b, a
            parent[b] = a
            size[a] += size[b]
            if not last:
                limit[a] = weight[edge] + scale / size[a]
    for node in range(count):
        root = node
        while parent[root] != root:
            root = parent[root]
        parent[node] = root
    return parent


def _numbered(labels: Array) -> Array:
    """Labels counted from 0 in order of their first face."""
    _, first, inverse = np.unique(labels, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int32)
    rank[np.argsort(first, kind="stable")] = np.arange(len(first), dtype=np.int32)
    return rank[inverse.ravel()].astype(np.int32)


def segment_mesh(
    vertices: ArrayLike,
    faces: ArrayLike,
    scale: float = 0.05,
    min_faces: int = 100,
    colour: ArrayLike | None = None,
    colour_weight: float = 0.0,
    pairs: ArrayLike | None = None,
) -> Array:
    """Region of every face, (m,) int32 from 0 without gaps, in order of their lowest face; deterministic.

    Corners at one position count as joined. Islands with fewer than `min_faces` faces that no edge ties to anything
    (scans are full of them) join the region of the nearest face of a larger one if that is ISLAND_GAP mean edges away
    or less, and stay on their own otherwise.

    Args:
        vertices, faces: (n, 3) metres and (m, 3) int.
        scale, min_faces: see `merge_regions`.
        colour, colour_weight: see `edge_weights`.
        pairs: `face_adjacency(faces, vertices)` if it is known already.
    """
    vertices, faces = np.asarray(vertices), np.asarray(faces)
    if len(faces) == 0:
        return np.zeros(0, np.int32)
    pairs = face_adjacency(faces, vertices) if pairs is None else np.asarray(pairs)
    corners = vertices.astype(np.float64)[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    normal = filtered_normals(face_normals(vertices, faces), area, pairs)
    weights = edge_weights(normal, corners.mean(1), pairs, colour, colour_weight)
    labels = merge_regions(len(faces), pairs, weights, scale, min_faces)
    return _join_islands(vertices, faces, labels, min_faces)


def _join_islands(vertices: Array, faces: Array, labels: Array, min_faces: int) -> Array:
    from scipy.spatial import cKDTree

    small = np.bincount(labels)[labels] < min_faces
    if small.all() or not small.any():
        return labels
    corners = np.asarray(vertices, np.float64)[faces]
    centre = corners.mean(1)
    edge = float(np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1).mean())
    large = np.flatnonzero(~small)
    island = np.flatnonzero(small)
    distance, nearest = cKDTree(centre[large]).query(centre[island])
    # One answer for a whole island: its face that lies nearest, lowest face first.
    order = np.lexsort((island, distance, labels[island]))
    pieces, first = np.unique(labels[island][order], return_index=True)
    chosen = order[first]
    target = np.where(distance[chosen] <= ISLAND_GAP * edge, labels[large[nearest[chosen]]], pieces)
    out = labels.copy()
    out[island] = target[np.searchsorted(pieces, labels[island])]
    return _numbered(out)
