"""How much of a room's visible surface a set of cameras sees."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from iif_core.camera.pinhole import project

if TYPE_CHECKING:
    from iif_core.light.transport.geometry import Geometry
    from workflow.sources.rooms.room import Room

_SAME = 2e-3
"""Relative difference of distance up to which a ray has reached its point."""


def surface_points(room: Room, count: int, seed: int = 0) -> np.ndarray:
    """(count, 3) points, uniform over the area of all faces; always the same for one seed."""
    rng = np.random.default_rng(seed)
    corner = room.vertices[room.faces].astype(np.float64)
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    chosen = corner[rng.choice(len(area), count, p=area / area.sum())]
    root, v = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
    return chosen[:, 0] * (1 - root) + chosen[:, 1] * (root * (1 - v)) + chosen[:, 2] * (root * v)


def seen_from(geometry: Geometry, points: np.ndarray, field_of_view: float, aspect: float, pose: np.ndarray) -> np.ndarray:
    """(n,) bool: the points a camera sees. `field_of_view` horizontal, degrees; `aspect` height / width."""
    from iif_core.light.transport.geometry import trace

    focal = 0.5 / np.tan(np.radians(field_of_view / 2))
    u, v, z = project(points, focal, focal, 0.5, 0.5 * aspect, pose)
    inside = (z > 0) & (u > 0) & (u < 1) & (v > 0) & (v < aspect)
    seen = np.zeros(len(points), bool)
    _, t = trace(geometry, pose[:3, 3], points[inside] - pose[:3, 3])
    seen[inside] = np.abs(t - 1) < _SAME
    return seen
