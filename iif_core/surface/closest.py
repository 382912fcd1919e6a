"""The nearest points on a triangle mesh, by Open3D."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

CHUNK = 1 << 20
"""Points that are looked up at a time."""


def closest_points(vertices: ArrayLike, faces: ArrayLike, points: ArrayLike) -> NDArray:
    """Return the point of a mesh that is nearest to each of `points` (n, 3), metres; (n, 3) float32.

    Args:
        vertices, faces: (v, 3) and (m, 3), m >= 1.
    """
    import open3d as o3d

    points = np.ascontiguousarray(points, np.float32).reshape(-1, 3)
    scene = o3d.t.geometry.RaycastingScene()
    corners = np.ascontiguousarray(vertices, np.float32), np.ascontiguousarray(faces, np.uint32)
    scene.add_triangles(*(o3d.core.Tensor(array) for array in corners))
    out = np.empty_like(points)
    for first in range(0, len(points), CHUNK):
        here = slice(first, first + CHUNK)
        out[here] = scene.compute_closest_points(o3d.core.Tensor(points[here]))["points"].numpy()
    return out
