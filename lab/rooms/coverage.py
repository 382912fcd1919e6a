"""How much of a room's visible surface a set of cameras sees."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from iif_core.camera.pinhole import project
from iif_core.surface.triangles import face_geometry

if TYPE_CHECKING:
    from iif_core.light.transport.geometry import Geometry
    from lab.rooms.room import Room

_SAME_DISTANCE = 2e-3  # relative difference of distance up to which a ray has reached its point


def surface_points(room: Room, count: int, seed: int = 0) -> np.ndarray:
    """Return (count, 3) points, uniform over the area of all faces; a function of room, count and seed alone."""
    rng = np.random.default_rng(seed)
    corner = room.vertices[room.faces].astype(np.float64)
    area = face_geometry(room.vertices, room.faces)[1]
    chosen = corner[rng.choice(len(area), count, p=area / area.sum())]
    root, v = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
    return chosen[:, 0] * (1 - root) + chosen[:, 1] * (root * (1 - v)) + chosen[:, 2] * (root * v)


def seen_from(geometry: Geometry, points: np.ndarray, field_of_view: float, aspect: float, pose: np.ndarray) -> np.ndarray:
    """Return which points a camera sees.

    Args:
        geometry: the room, built for tracing.
        points: (n, 3) surface points, metres.
        field_of_view: horizontal, degrees.
        aspect: height / width of the picture.
        pose: (4, 4) `world_from_camera`, OpenCV axes.

    Returns:
        (n,) bool: in the picture, in front of the camera and not hidden.
    """
    from iif_core.light.transport.geometry import trace

    focal = 0.5 / np.tan(np.radians(field_of_view / 2))
    u, v, z = project(points, focal, focal, 0.5, 0.5 * aspect, pose)
    inside = (z > 0) & (u > 0) & (u < 1) & (v > 0) & (v < aspect)
    seen = np.zeros(len(points), bool)
    _, t = trace(geometry, pose[:3, 3], points[inside] - pose[:3, 3])
    seen[inside] = np.abs(t - 1) < _SAME_DISTANCE
    return seen
