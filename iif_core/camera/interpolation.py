"""What a held-out photograph would show by the other photographs alone, without any model of light
(docs/method/evaluation.md#rivals)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from iif_core.camera.view import View

NEAREST = 4
"""Photographs that an interpolated view is blended of."""
DEPTH_TOLERANCE = 0.02
"""Two views see the same point if their z-depths differ by less than this share."""
_LEAST_ANGLE = 1e-6  # radians; the photograph from the same place has all of the weight


@dataclass(frozen=True)
class Shown:
    """What one photograph shows.

    Attributes:
        camera: of the photograph.
        radiance: (H, W, 3) linear, with exposure, white balance and vignetting divided out.
        usable: (H, W) bool; bound: (H, W) bool, a channel is saturated.
        depth: (H, W) z-depth in metres, 0 = no surface.
    """

    camera: View
    radiance: NDArray
    usable: NDArray
    bound: NDArray
    depth: NDArray

    def at(self, points: NDArray, normals: NDArray) -> tuple[NDArray, NDArray, NDArray]:
        """Look surface up that another view sees, bilinearly among the pixels that show the same depth.

        Args:
            points, normals: (n, 3) metres, and towards the viewer.

        Returns:
            Whether the photograph shows the point (n,), its radiance (n, 3), and whether that is saturated (n,).
        """
        view, pose = self.camera, self.camera.world_from_camera
        eye = pose[:3, 3] - points
        x, y, z = -(eye @ pose[:3, :3]).T
        front = np.flatnonzero((z > 0) & ((normals * eye).sum(1) > 0))
        u, v = view.fx * x[front] / z[front] + view.cx - 0.5, view.fy * y[front] / z[front] + view.cy - 0.5
        inside = (u > -0.5) & (u < view.width - 0.5) & (v > -0.5) & (v < view.height - 0.5)
        found, u, v = front[inside], u[inside], v[inside]
        near = z[found]
        left, top = np.floor(u).astype(np.int64), np.floor(v).astype(np.int64)
        total, value, saturated = np.zeros(len(found)), np.zeros((len(found), 3)), np.zeros(len(found), bool)
        for right in (0, 1):
            for low in (0, 1):
                column, row = np.clip(left + right, 0, view.width - 1), np.clip(top + low, 0, view.height - 1)
                weight = np.abs(1 - right - (u - left)) * np.abs(1 - low - (v - top))
                weight *= self.usable[row, column] & (np.abs(self.depth[row, column] - near) < DEPTH_TOLERANCE * near)
                total += weight
                value += weight[:, None] * self.radiance[row, column]
                saturated |= (weight > 0) & self.bound[row, column]
        some = total > 0.5
        seen, radiance, bound = np.zeros(len(points), bool), np.zeros((len(points), 3), np.float32), np.zeros(len(points), bool)
        rows = found[some]
        seen[rows], radiance[rows], bound[rows] = True, value[some] / total[some, None], saturated[some]
        return seen, radiance, bound


def by_others(
    points: NDArray, normals: NDArray, eye: NDArray, others: Sequence[Shown], nearest: int = NEAREST
) -> tuple[NDArray, NDArray, NDArray]:
    """Predict the radiance of surface points from what other photographs show of them (Eq. E.21, E.22).

    Args:
        points, normals: (n, 3) metres, and towards the viewer.
        eye: (3,) of the view that is predicted.
        others: the photographs, at least one, without that view.
        nearest: photographs that are blended.

    Returns:
        The mean (n, 3); the blend of the nearest views (n, 3), with the weights of the unstructured lumigraph; and whether any
        photograph shows the point (n,). Radiance is 0 where none does. Saturated values count only where there are no others.
    """
    seen, clean = np.zeros((2, len(others), len(points)), bool)
    value, angle = np.zeros((len(others), len(points), 3), np.float32), np.zeros((len(others), len(points)))
    towards = unit(eye - points)
    for i, other in enumerate(others):
        seen[i], value[i], bound = other.at(points, normals)
        clean[i] = seen[i] & ~bound
        angle[i] = angles_between(unit(other.camera.world_from_camera[:3, 3] - points), towards)
    counted = np.where(clean.any(0), clean, seen)
    mean = (counted[..., None] * value).sum(0) / np.maximum(counted.sum(0), 1)[:, None]
    limit = np.full(len(points), np.inf)
    if len(others) > nearest:
        limit = np.partition(np.where(counted, angle, np.inf), nearest, axis=0)[nearest]
    limit = np.where(np.isfinite(limit), limit, np.pi)  # too few photographs show the point to leave one out
    weight = counted * blend_weights(angle, limit)
    total = weight.sum(0)
    blend = (weight[..., None] * value).sum(0) / np.where(total > 0, total, 1)[:, None]
    return mean, np.where((total > 0)[:, None], blend, mean), seen.any(0)


def blend_weights(angle: NDArray, limit: NDArray) -> NDArray:
    """Weights of the unstructured lumigraph (Eq. E.22) for angles, and the angle from which on a photograph counts nothing."""
    return np.maximum(1 - angle / np.maximum(limit, _LEAST_ANGLE), 0) / np.maximum(angle, _LEAST_ANGLE)


def angles_between(a: NDArray, b: NDArray) -> NDArray:
    """Angles (n,) in radians between unit vectors (n, 3), exact for small ones."""
    return 2 * np.arcsin(np.minimum(np.linalg.norm(a - b, axis=1) / 2, 1))


def unit(vectors: NDArray) -> NDArray:
    """Vectors (..., 3) of length 1; 0 stays 0."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)
