"""Pinhole cameras with OpenCV axes (x right, y down, z forward); pixel (u, v) has its centre at (u + 0.5, v +
0.5)."""

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
    """World direction of every pixel centre, NOT normalised: its camera z is 1, so point = origin + depth *
    direction.

    d = R ((u + 0.5 - cx) / fx, (v + 0.5 - cy) / fy, 1). Focal lengths and principal point in pixels.
    Returns (height, width, 3) float32. Source: METHOD 1.4. Raises InputError for non-positive sizes or focal
    lengths.
    """
    if width < 1 or height < 1 or not (fx > 0 and fy > 0):
        raise InputError(f"camera of {width}x{height} pixels with fx={fx}, fy={fy}: all must be positive")
    rotation = _pose(world_from_camera)[:3, :3]
    x = (np.arange(width) + 0.5 - cx) / fx
    y = (np.arange(height) + 0.5 - cy) / fy
    directions = x[None, :, None] * rotation[:, 0] + y[:, None, None] * rotation[:, 1] + rotation[:, 2]
    return directions.astype(np.float32)


def direction_derivatives(fx: float, fy: float, world_from_camera: ArrayLike) -> tuple[Array, Array]:
    """(d_du, d_dv): change of the un-normalised `pixel_directions` per pixel step right and down, (3,)
    float32 each."""
    rotation = _pose(world_from_camera)[:3, :3]
    return (rotation[:, 0] / fx).astype(np.float32), (rotation[:, 1] / fy).astype(np.float32)


def project(
    points: ArrayLike, fx: float, fy: float, cx: float, cy: float, world_from_camera: ArrayLike
) -> tuple[Array, Array, Array]:
    """Pixel coordinates (u, v) and z-depth of world points (..., 3); float64.

    u = fx x/z + cx with a pixel centre at u = column + 0.5; u and v are NaN where z <= 0 (behind the camera).
    Assumes a rigid pose (orthonormal rotation).
    """
    pose = _pose(world_from_camera)
    local = (np.asarray(points, np.float64) - pose[:3, 3]) @ pose[:3, :3]
    z = local[..., 2]
    ahead = np.where(z > 0, z, np.nan)
    return fx * local[..., 0] / ahead + cx, fy * local[..., 1] / ahead + cy, z


def look_at(origin: ArrayLike, target: ArrayLike, up: ArrayLike) -> Array:
    """`world_from_camera` (4x4 float64) of a camera at `origin` that sees `target` in its centre with `up`
    upwards.

    z = target - origin, x = z x up, y = z x x, all normalised. When `up` is parallel to the view the world
    axis least along the view takes its place. Raises InputError when origin and target coincide.
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
