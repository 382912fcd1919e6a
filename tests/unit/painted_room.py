"""A room whose photographs are computed exactly: a box with painted walls and a block in it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from iif_core.camera.alignment import Photo

BOXES = (((-2.0, -2.0, -1.2), (2.0, 2.0, 1.2)), ((-0.5, -0.3, -1.2), (0.4, 0.4, -0.1)))
WIDTH, HEIGHT, FOCAL = 128, 96, 100.0


def paint(point: np.ndarray) -> np.ndarray:
    """A smooth texture of space, (..., 3) -> (...)."""
    rng = np.random.default_rng(3)
    out = np.zeros(point.shape[:-1])
    for _ in range(24):
        out += np.sin(point @ rng.normal(0, 18.0, 3) + rng.uniform(0, 7))
    return np.exp(0.18 * out) * (0.25 + 0.1 * (np.abs(point[..., 2]) > 1.15))


def look(pose: np.ndarray, principal: tuple[float, float], oversample: int = 1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Grey image, z-depth and normals of the room."""
    v, u = (np.mgrid[: HEIGHT * oversample, : WIDTH * oversample] + 0.5) / oversample
    local = np.stack([(u - principal[0]) / FOCAL, (v - principal[1]) / FOCAL, np.ones_like(u)], -1)
    ray, eye = local @ pose[:3, :3].T, pose[:3, 3]
    depth, normal = np.full(u.shape, np.inf), np.zeros((*u.shape, 3))
    for number, (low, high) in enumerate(BOXES):
        t = (np.stack([np.array(low), np.array(high)])[:, None, None] - eye) / ray
        near, far = t.min(0), t.max(0)
        axis = far.argmin(-1) if number == 0 else near.argmax(-1)
        hit = far.min(-1) if number == 0 else np.where(near.max(-1) < far.min(-1), near.max(-1), np.inf)
        closer = (hit < depth) & (hit > 0)
        depth = np.where(closer, hit, depth)
        facing = np.eye(3)[axis] * -np.sign(np.take_along_axis(ray, axis[..., None], -1))
        normal = np.where(closer[..., None], facing, normal)
    image = paint(eye + depth[..., None] * ray) * (0.6 + 0.4 * np.abs(normal[..., 2:] @ np.ones(1)))
    return image, depth, normal


def room(views: int = 10) -> list[Photo]:
    """Cameras around the block, looking at it and at the walls."""
    photos, principal = [], (WIDTH / 2, HEIGHT / 2)
    for k in range(views):
        turn = 2 * np.pi * k / views
        eye = np.array([1.5 * np.cos(turn), 1.5 * np.sin(turn) * 0.9, 0.2 * np.sin(3 * turn)])
        forward = np.array([0.1 * np.sin(5 * k), 0.4 + 0.2 * np.cos(2 * k), -0.3]) - eye
        z = forward / np.linalg.norm(forward)
        x = np.cross(z, [0, 0, 1.0])
        x /= np.linalg.norm(x)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = np.stack([x, np.cross(z, x), z], 1), eye
        grey, depth, normal = look(pose, principal)
        image = np.repeat(grey[..., None], 3, -1)
        photos.append(Photo(image, np.ones(depth.shape, bool), depth, normal, (FOCAL, FOCAL), principal, pose))
    return photos


def posed(photos: list[Photo], poses: list[np.ndarray]) -> list[Photo]:
    """The same photographs, believed to come from other poses."""
    out = []
    for photo, pose in zip(photos, poses, strict=True):
        _, depth, normal = look(pose, photo.principal)
        out.append(replace(photo, pose=pose, depth=depth, normal=normal))
    return out


def twisted(pose: np.ndarray, rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = Rotation.from_rotvec(rotation).as_matrix(), translation
    return pose @ out


def off(poses: np.ndarray, photos: list[Photo]) -> np.ndarray:
    """(V,) median distance in pixels between where a pose and the true one show the surface."""
    out = []
    for pose, photo in zip(poses, photos, strict=True):
        v, u = np.mgrid[4:HEIGHT:9, 4:WIDTH:9]
        local = np.stack([(u + 0.5 - WIDTH / 2) / FOCAL, (v + 0.5 - HEIGHT / 2) / FOCAL, np.ones(u.shape)], -1)
        point = photo.pose[:3, 3] + photo.depth[v, u][..., None] * (local @ photo.pose[:3, :3].T)
        seen = (point - pose[:3, 3]) @ pose[:3, :3]
        gap = FOCAL * (seen[..., :2] / seen[..., 2:]) - FOCAL * local[..., :2]
        out.append(np.median(np.hypot(*np.moveaxis(gap, -1, 0))))
    return np.array(out)
