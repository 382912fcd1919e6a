"""Fewer triangles for the same surface: quadric error decimation after Garland and Heckbert (1997), by Open3D."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iif_core.errors import InputError
from iif_core.surface.triangles import face_geometry

MIN_AREA = 1e-12
"""Smallest area of a face, m^2; smaller ones have no normal."""
BOUNDARY_WEIGHT = 30.0
"""Weight of the quadrics that hold open boundaries in place; parts of one surface meet at such boundaries."""
_COLOURS = 1 << 12  # part numbers are split into two digits of this size, which colours hold without loss


def clean(faces: NDArray, vertices: NDArray) -> NDArray:
    """Return which faces (m,) bool have an area above `MIN_AREA` and are not the copy of an earlier one, turned or not."""
    keep = face_geometry(vertices, faces)[1] > MIN_AREA
    rows = np.flatnonzero(keep)
    # Sorted corners are alike for copies and turned copies.
    _, first = np.unique(np.sort(faces[rows], 1), axis=0, return_index=True)
    out = np.zeros(len(faces), bool)
    out[rows[first]] = True
    return out


def simplify(vertices: ArrayLike, faces: ArrayLike, part: ArrayLike, target: int) -> tuple[NDArray, NDArray, NDArray]:
    """Collapse the edges that change the surface least until at most about `target` faces are left.

    Parts stay separate and keep their boundaries. All are simplified together, so that flat ones give up faces first.

    Args:
        vertices, faces: (n, 3) metres and (m, 3), welded within each part; no vertex is shared by two parts.
        part: (m,) number >= 0 of the part of each face.
        target: number of faces.

    Returns:
        vertices (n', 3) float64, faces (m', 3) int64 and part (m',) int64; the input where it is small enough. A part that is
        much smaller than the error allowed may have no face left.

    Raises:
        InputError: a vertex that two parts share, or a target below 1.
    """
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    part = np.asarray(part, np.int64)
    if target < 1:
        raise InputError(f"simplification to {target} faces: at least 1 is needed")
    if len(faces) <= target:
        return vertices, faces, part
    owner = np.zeros(len(vertices), np.int64)
    owner[faces.ravel()] = np.repeat(part, 3)
    if not np.array_equal(owner[faces], np.repeat(part[:, None], 3, 1)):
        raise InputError("simplify: a vertex is shared by two parts; give each its own")
    import open3d as o3d

    mesh = o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(vertices), o3d.utility.Vector3iVector(faces.astype(np.int32)))
    # Open3D carries colours along, and an edge joins vertices of one part, so that the mean of two equal numbers is exact.
    digits = np.stack([owner % _COLOURS, owner // _COLOURS, np.zeros(len(owner))], 1)
    mesh.vertex_colors = o3d.utility.Vector3dVector(digits.astype(np.float64))
    mesh = mesh.simplify_quadric_decimation(int(target), boundary_weight=BOUNDARY_WEIGHT)
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.triangles).astype(np.int64)
    digits = np.rint(np.asarray(mesh.vertex_colors)).astype(np.int64)
    return vertices, faces, (digits[:, 0] + _COLOURS * digits[:, 1])[faces[:, 0]]
