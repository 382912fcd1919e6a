"""The nearest points on a triangle mesh, and what it hides, by Open3D."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

CHUNK = 1 << 20
"""Points that are looked up at a time."""


class Closest(NamedTuple):
    """The nearest point of a mesh: `points` (n, 3) float32 metres, its face (n,) int64 and barycentric coordinates (n, 3)."""

    points: NDArray
    face: NDArray
    barycentric: NDArray


def closest_points(vertices: ArrayLike, faces: ArrayLike, points: ArrayLike) -> Closest:
    """Find the point of a mesh that is nearest to each of `points` (n, 3), metres.

    Args:
        vertices, faces: (v, 3) and (m, 3), m >= 1.
    """
    import open3d as o3d

    points, scene = np.ascontiguousarray(points, np.float32).reshape(-1, 3), _scene(vertices, faces)
    out = Closest(np.empty_like(points), np.empty(len(points), np.int64), np.empty((len(points), 3), np.float32))
    for first in range(0, len(points), CHUNK):
        here = slice(first, first + CHUNK)
        found = scene.compute_closest_points(o3d.core.Tensor(points[here]))
        second = found["primitive_uvs"].numpy()
        out.points[here], out.face[here] = found["points"].numpy(), found["primitive_ids"].numpy()
        # Open3D gives the weights of the second and third corner.
        out.barycentric[here] = np.stack([1 - second.sum(1), second[:, 0], second[:, 1]], 1)
    return out


def hidden_from(vertices: ArrayLike, faces: ArrayLike, eye: ArrayLike, points: ArrayLike) -> NDArray:
    """Return (n,) bool: the mesh lies between `eye` (3,) and each of `points` (n, 3), metres.

    Args:
        vertices, faces: (v, 3) and (m, 3), m >= 1.
    """
    import open3d as o3d

    points, scene = np.asarray(points, np.float64).reshape(-1, 3), _scene(vertices, faces)
    rays = np.concatenate([np.broadcast_to(eye, points.shape), points - np.asarray(eye, np.float64)], 1).astype(np.float32)
    out = np.zeros(len(points), bool)
    for first in range(0, len(points), CHUNK):
        here = slice(first, first + CHUNK)
        out[here] = scene.test_occlusions(o3d.core.Tensor(rays[here]), tnear=0.0, tfar=1.0).numpy()
    return out


def _scene(vertices: ArrayLike, faces: ArrayLike) -> Any:
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    corners = np.ascontiguousarray(vertices, np.float32), np.ascontiguousarray(faces, np.uint32)
    scene.add_triangles(*(o3d.core.Tensor(array) for array in corners))
    return scene
