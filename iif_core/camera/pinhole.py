"""Pinhole cameras with OpenCV axes: x right, y down, z forward (docs/method/camera.md#axes-and-pixels).

Pixel (column, row) has its centre at (u, v) = (column + 0.5, row + 0.5). Focal lengths and principal point are in pixels.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from iif_core.errors import InputError

Array = np.ndarray


def _pose(world_from_camera: ArrayLike) -> Array:
    pose = np.asarray(world_from_camera, np.float64)
    if pose.shape not in ((4, 4), (3, 4)) or not np.isfinite(pose).all():
        raise InputError(f"world_from_camera has shape {pose.shape} or non-finite entries; give a finite 4x4 matrix")
    return pose


def pixel_directions(fx: float, fy: float, cx: float, cy: float, width: int, height: int, world_from_camera: ArrayLike) -> Array:
    """Compute the world direction of every pixel centre, not normalised: point = origin + depth * direction (Eq. C.1).

    d = R ((u - cx) / fx, (v - cy) / fy, 1).

    Args:
        fx, fy, cx, cy: focal lengths and principal point in pixels.
        width, height: size in pixels.
        world_from_camera: (4, 4) or (3, 4).

    Returns:
        (height, width, 3) float32.

    Raises:
        InputError: sizes or focal lengths that are not positive, or an unusable pose.
    """
    if width < 1 or height < 1 or not (fx > 0 and fy > 0):
        raise InputError(f"camera of {width}x{height} pixels with fx={fx}, fy={fy}: all must be positive")
    rotation = _pose(world_from_camera)[:3, :3]
    x = (np.arange(width) + 0.5 - cx) / fx
    y = (np.arange(height) + 0.5 - cy) / fy
    directions = x[None, :, None] * rotation[:, 0] + y[:, None, None] * rotation[:, 1] + rotation[:, 2]
    return directions.astype(np.float32)


def direction_derivatives(fx: float, fy: float, world_from_camera: ArrayLike) -> tuple[Array, Array]:
    """Compute the change of `pixel_directions` per pixel to the right and down, (3,) float32 each (Eq. C.3)."""
    rotation = _pose(world_from_camera)[:3, :3]
    return (rotation[:, 0] / fx).astype(np.float32), (rotation[:, 1] / fy).astype(np.float32)


def project(
    points: ArrayLike, fx: float, fy: float, cx: float, cy: float, world_from_camera: ArrayLike
) -> tuple[Array, Array, Array]:
    """Project world points to pixel coordinates (Eq. C.2).

    Args:
        points: (..., 3).
        fx, fy, cx, cy: focal lengths and principal point in pixels.
        world_from_camera: (4, 4) or (3, 4), with an orthonormal rotation.

    Returns:
        u, v and z-depth, (...) float64; u and v are NaN behind the camera.

    Example:
        >>> u, v, z = project([0, 0, 2], 100, 100, 32, 24, np.eye(4))
        >>> float(u), float(v), float(z)
        (32.0, 24.0, 2.0)
    """
    pose = _pose(world_from_camera)
    local = (np.asarray(points, np.float64) - pose[:3, 3]) @ pose[:3, :3]
    z = local[..., 2]
    ahead = np.where(z > 0, z, np.nan)
    return fx * local[..., 0] / ahead + cx, fy * local[..., 1] / ahead + cy, z


def look_at(origin: ArrayLike, target: ArrayLike, up: ArrayLike) -> Array:
    """Compute the pose (4, 4) float64 of a camera at `origin` that sees `target` in its centre, with `up` upwards.

    z = target - origin, x = z x up, y = z x x, all normalised. If `up` is parallel to the view, the world axis that is least
    along the view replaces it.

    Raises:
        InputError: origin and target coincide.
    """
    origin, target, up = (np.asarray(value, np.float64) for value in (origin, target, up))
    forward = target - origin
    length = np.linalg.norm(forward)
    if not length > 0:
        raise InputError(f"look_at: origin and target are both {origin.tolist()}; give two different points")
    forward = forward / length
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-9 * max(np.linalg.norm(up), 1e-300):
        right = np.cross(forward, np.eye(3)[np.argmin(np.abs(forward))])
    right = right / np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3] = right, np.cross(forward, right), forward, origin
    return pose


def up_axis(world_from_camera: ArrayLike) -> Array:
    """Return the world axis (3,) nearest to the mean upward direction of the cameras (V, 4, 4); z if they cancel out."""
    mean = -np.asarray(world_from_camera, np.float64)[:, :3, 1].sum(0)
    axis = np.zeros(3)
    strongest = int(np.argmax(np.abs(mean)))
    if abs(mean[strongest]) < 1e-6:
        strongest, mean = 2, np.ones(3)
    axis[strongest] = np.sign(mean[strongest])
    return axis
