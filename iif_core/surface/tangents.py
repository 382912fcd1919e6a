"""Tangent frames of textured meshes, and normals in them: what a normal map stores.

The frame of glTF: the tangent t points to +u, the bitangent b to -v (upwards in the picture, v grows downwards), n is the normal.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray


def vertex_tangents(vertices: ArrayLike, faces: ArrayLike, uv: ArrayLike, normals: ArrayLike) -> NDArray:
    """Compute the tangents of vertices: the mean over their faces of the direction of +u, weighted by area, made perpendicular to
    the normal.

    Args:
        vertices: (n, 3) metres; faces: (m, 3); uv: (n, 2), v downwards; normals: (n, 3), of unit length.

    Returns:
        (n, 4) float64: unit tangent t, and the sign w with which b = w n x t. Where the texture has no direction, as on faces of
        one texel, some perpendicular of the normal.
    """
    vertices, uv, normals = (np.asarray(a, np.float64) for a in (vertices, uv, normals))
    faces = np.asarray(faces)
    e1, e2 = (vertices[faces[:, i]] - vertices[faces[:, 0]] for i in (1, 2))
    d1, d2 = (uv[faces[:, i]] - uv[faces[:, 0]] for i in (1, 2))
    # With the edges e_i = d_i,u t + d_i,v b, Cramer's rule gives t and b. Only directions matter, so the sign of the determinant
    # stands for a division by it.
    determinant = d1[:, 0] * d2[:, 1] - d2[:, 0] * d1[:, 1]
    sign = np.sign(determinant)[:, None]
    along = (d2[:, 1:] * e1 - d1[:, 1:] * e2) * sign  # +u, of a length that goes with area
    down = (d1[:, :1] * e2 - d2[:, :1] * e1) * sign  # +v
    length = [np.maximum(np.linalg.norm(a, axis=1, keepdims=True), 1e-300) for a in (along, down)]
    weight = np.linalg.norm(np.cross(e1, e2), axis=1, keepdims=True)
    total = np.zeros((2, len(vertices), 3))
    for i in range(3):
        for axis, (direction, size) in enumerate(zip((along, down), length, strict=True)):
            np.add.at(total[axis], faces[:, i], weight * direction / size)
    tangent = total[0] - normals * np.einsum("ij,ij->i", total[0], normals)[:, None]
    norm = np.linalg.norm(tangent, axis=1, keepdims=True)
    smallest = np.eye(3)[np.abs(normals).argmin(1)]
    some = np.cross(normals, smallest)  # the axis farthest from the normal makes a stable perpendicular
    some /= np.maximum(np.linalg.norm(some, axis=1, keepdims=True), 1e-300)
    tangent = np.where(
        # Below this, what is left of the sum is rounding.
        norm > 1e-9 * np.maximum(np.linalg.norm(total[0], axis=1, keepdims=True), 1e-300),
        tangent / np.maximum(norm, 1e-300),
        some,
    )
    handed = np.einsum("ij,ij->i", np.cross(normals, tangent), -total[1])
    return np.concatenate([tangent, np.where(handed < 0, -1.0, 1.0)[:, None]], 1)


def in_tangent_frame(directions: ArrayLike, normals: ArrayLike, tangents: ArrayLike) -> NDArray:
    """Return the components (n, 3) of unit `directions` (n, 3) along t, b and n.

    Args:
        normals: (n, 3) of any length above 0, as interpolated over a face.
        tangents: (n, 4), interpolated too, with w = +-1.
    """
    directions, normals, tangents = (np.asarray(a, np.float64) for a in (directions, normals, tangents))
    n = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    # Interpolation leaves the frame neither orthogonal nor of unit length.
    t = tangents[:, :3] - n * np.einsum("ij,ij->i", tangents[:, :3], n)[:, None]
    t /= np.maximum(np.linalg.norm(t, axis=1, keepdims=True), 1e-300)
    b = np.cross(n, t) * np.where(tangents[:, 3:] < 0, -1.0, 1.0)
    return np.stack([np.einsum("ij,ij->i", directions, axis) for axis in (t, b, n)], 1)
