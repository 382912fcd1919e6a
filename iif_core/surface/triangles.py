"""Geometry of triangle meshes in float64: normals (right-hand rule), areas, welding, subdivision.

A mesh is `vertices` (n, 3) in metres and `faces` (m, 3) of vertex indices.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iif_core.errors import InputError
from iif_core.numerics.arrays import unique_rows
from iif_core.numerics.graph import component_labels


def face_crosses(vertices: ArrayLike, faces: ArrayLike) -> NDArray:
    """Compute the cross product of two edges of every face, (m, 3): the normal times twice the area."""
    corner = np.asarray(vertices, np.float64)[np.asarray(faces)]
    return np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])


def face_geometry(vertices: ArrayLike, faces: ArrayLike) -> tuple[NDArray, NDArray]:
    """Compute the unit normals (m, 3) of all faces, 0 for faces without area, and their areas (m,) in square metres.

    Example:
        >>> normal, area = face_geometry([[0, 0, 0], [2, 0, 0], [0, 1, 0]], [[0, 1, 2]])
        >>> normal.tolist(), area.tolist()
        ([[0.0, 0.0, 1.0]], [1.0])
    """
    cross = face_crosses(vertices, faces)
    length = np.linalg.norm(cross, axis=-1)
    return cross / np.maximum(length, 1e-30)[:, None], 0.5 * length


def towards_viewer(normals: NDArray, towards: NDArray) -> tuple[NDArray, NDArray]:
    """Turn the normals of faces to the side from which they are seen.

    A face without area has no normal; the direction to the viewer takes its place.

    Args:
        normals: (n, 3) unit normals, 0 for faces without area.
        towards: (n, 3) unit vectors to the viewer.

    Returns:
        The normals (n, 3), and whether the front of each face is seen, (n,) bool.

    Example:
        >>> normals = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [0.0, 0.0, 0.0]])
        >>> towards_viewer(normals, np.array([[0.0, 0.6, 0.8]] * 3))[0].tolist()
        [[0.0, 0.0, 1.0], [-0.0, -0.0, 1.0], [0.0, 0.6, 0.8]]
    """
    front = np.einsum("ij,ij->i", normals, towards) >= 0
    flat = np.einsum("ij,ij->i", normals, normals) < 0.5
    return np.where(flat[:, None], towards, np.where(front[:, None], normals, -normals)), front


def vertex_normals(vertices: NDArray, faces: NDArray) -> NDArray:
    """Compute unit normals of vertices, (n, 3): the mean of the adjacent faces, weighted by their angles; +z without faces."""
    corner = vertices[faces]
    normal = face_geometry(vertices, faces)[0]
    total = np.zeros((len(vertices), 3))
    for i in range(3):
        a = _unit(corner[:, (i + 1) % 3] - corner[:, i])
        b = _unit(corner[:, (i + 2) % 3] - corner[:, i])
        # Angles do not depend on how a flat surface is cut into triangles; numbers and areas of faces do.
        angle = np.arccos(np.clip(np.einsum("ij,ij->i", a, b), -1, 1))[:, None]
        for c in range(3):
            total[:, c] += np.bincount(faces[:, i], (normal * angle)[:, c], len(vertices))
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 1e-9, total / np.maximum(length, 1e-300), [0.0, 0.0, 1.0])


def weld(vertices: NDArray, faces: NDArray) -> tuple[NDArray, NDArray]:
    """Merge vertices at equal positions and drop unused ones; returns the new vertices and faces."""
    unique, inverse = unique_rows(vertices)
    used, local = np.unique(inverse[faces], return_inverse=True)
    return unique[used], local.reshape(-1, 3)


def smooth_groups(vertices: NDArray, faces: NDArray, part: NDArray, crease_cosine: float) -> NDArray:
    """Label faces that are connected, within one part, by edges less sharp than a crease.

    Args:
        vertices, faces: welded mesh.
        part: (m,) int; faces of different parts are never connected.
        crease_cosine: cosine between the normals of two faces below which their common edge is a crease.

    Returns:
        (m,) int32 labels from 0.
    """
    normal = face_geometry(vertices, faces)[0]
    # Every edge of every face with its lower vertex first, so that both faces list it alike.
    pairs = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1)
    face = np.repeat(np.arange(len(faces)), 3)
    order = np.lexsort((pairs[:, 1], pairs[:, 0]))
    same = (pairs[order][1:] == pairs[order][:-1]).all(1)
    a, b = face[order][:-1][same], face[order][1:][same]
    smooth = (np.einsum("ij,ij->i", normal[a], normal[b]) > crease_cosine) & (part[a] == part[b])
    return component_labels(len(faces), a[smooth], b[smooth])


def subdivide(vertices: NDArray, faces: NDArray, longest: float, max_faces: int) -> tuple[NDArray, NDArray, NDArray]:
    """Halve edges until none is longer than `longest` or the next round would exceed `max_faces`.

    An edge is split for all faces that share it, so no cracks appear. Every round halves the largest length allowed, so that
    the longest edges are split first and all parts stay equally coarse when the budget is exhausted.

    Args:
        vertices, faces: welded mesh.
        longest: length of an edge in metres, > 0.
        max_faces: largest number of faces.

    Returns:
        vertices (n', 3) float64, faces (m', 3) int64, and the original face of every new one, (m',).

    Raises:
        InputError: `longest` is not positive.
    """
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    parent = np.arange(len(faces))
    if not longest > 0:
        raise InputError(f"subdivision to edges of {longest} m: must be positive")
    limit = np.inf  # longest edge allowed in a round
    while True:
        edges, edge_of = _edges(faces)
        length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
        limit = max(longest, min(limit, length.max()) / 2)
        marked = length > limit * (1 + 1e-9)  # an edge at the limit but for rounding is not split
        if not marked.any():
            if limit <= longest:
                return vertices, faces, parent
            continue
        if len(faces) + np.count_nonzero(marked[edge_of]) > max_faces:  # each split edge adds one triangle to each of its faces
            return vertices, faces, parent
        middle = np.full(len(edges), -1, np.int64)
        middle[marked] = len(vertices) + np.arange(np.count_nonzero(marked))
        vertices = np.concatenate([vertices, vertices[edges[marked]].mean(1)])
        faces, source = _split(vertices, faces, middle[edge_of])
        parent = parent[source]


def quarter(vertices: NDArray, faces: NDArray) -> tuple[NDArray, NDArray]:
    """Split every face at the midpoints of its edges, which neighbours share: vertices (n', 3) float64 and faces (4 m, 3) int64,
    those of face i at 4 i ... 4 i + 3."""
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    edges, edge_of = _edges(faces)
    split, _ = _split(vertices, faces, len(vertices) + edge_of)
    return np.concatenate([vertices, vertices[edges].mean(1)]), split


def _edges(faces: NDArray) -> tuple[NDArray, NDArray]:
    """Distinct edges (e, 2) of faces (m, 3), and which of them the edges v0v1, v1v2, v2v0 of each face are, (m, 3)."""
    edges, edge_of = unique_rows(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1))
    return edges, edge_of.reshape(-1, 3)


def _split(vertices: NDArray, faces: NDArray, middle: NDArray) -> tuple[NDArray, NDArray]:
    """Split faces at the midpoints `middle` (m, 3) of their edges (v0v1, v1v2, v2v0), -1 = not split.

    Returns the new faces and the face that each one came from.
    """
    count = (middle >= 0).sum(1)
    out, source = [faces[count == 0]], [np.flatnonzero(count == 0)]

    def add(rows: NDArray, *triangles: tuple[NDArray, NDArray, NDArray]) -> None:
        for triangle in triangles:
            out.append(np.stack(triangle, 1))
            source.append(rows)

    def rotated(rows: NDArray, first: NDArray) -> tuple[NDArray, NDArray]:
        order = (first[:, None] + np.arange(3)) % 3
        return np.take_along_axis(faces[rows], order, 1), np.take_along_axis(middle[rows], order, 1)

    # -------- one split edge: two triangles that meet at the opposite corner --------
    one = np.flatnonzero(count == 1)
    v, e = rotated(one, np.argmax(middle[one] >= 0, 1))
    add(one, (v[:, 0], e[:, 0], v[:, 2]), (e[:, 0], v[:, 1], v[:, 2]))
    # -------- two split edges: the corner between them, and a quadrilateral cut along its shorter diagonal --------
    two = np.flatnonzero(count == 2)
    v, e = rotated(two, (np.argmin(middle[two], 1) + 1) % 3)  # the edge that is not split comes last
    add(two, (e[:, 0], v[:, 1], e[:, 1]))
    down = _distance(vertices, v[:, 0], e[:, 1]) < _distance(vertices, e[:, 0], v[:, 2])
    for chosen, diagonal in ((down, True), (~down, False)):
        a, b, c, d = v[chosen, 0], e[chosen, 0], e[chosen, 1], v[chosen, 2]
        rows = two[chosen]
        add(rows, *(((a, b, c), (a, c, d)) if diagonal else ((a, b, d), (b, c, d))))
    # -------- three split edges: three corners and the triangle of the midpoints --------
    three = np.flatnonzero(count == 3)
    v, e = faces[three], middle[three]
    inner = [(e[:, 0], v[:, 1], e[:, 1]), (e[:, 2], e[:, 1], v[:, 2]), (e[:, 0], e[:, 1], e[:, 2])]
    add(three, (v[:, 0], e[:, 0], e[:, 2]), *inner)
    source_rows = np.concatenate(source)  # children in the order of their parents
    order = np.argsort(source_rows, kind="stable")
    return np.concatenate(out)[order], source_rows[order]


def _distance(vertices: NDArray, a: NDArray, b: NDArray) -> NDArray:
    return np.linalg.norm(vertices[a] - vertices[b], axis=1)


def _unit(v: NDArray) -> NDArray:
    return v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-300)
