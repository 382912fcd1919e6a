"""Geometry of triangle meshes in float64: normals (right-hand rule), areas, welding, subdivision.

A mesh is `vertices` (n, 3) in metres and `faces` (m, 3) of vertex indices.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

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


def _unit(v: NDArray) -> NDArray:
    return v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-300)
