"""The frame of a room: which way is up, and, for photographs alone, where the floor lies and how long a metre is."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iif_core.surface.enclosure import directions, fitted_plane
from iif_core.surface.triangles import face_geometry

UPRIGHT = float(np.cos(np.radians(25.0)))
"""Cosine of the largest angle between the vertical of the surface and that of the cameras."""
LEVEL = 0.9
"""Cosine with the vertical from which a face is level."""
TURNED = 0.05
"""Second eigenvalue, of three that add up to 1, of the directions to the right of the pictures, from which on they tell the
vertical."""
BESIDE_FLOOR = 0.03
"""Share of the height of the room by which faces of the floor lie apart."""
NOISE = 0.005
"""Share of the level surface below the floor, and above the ceiling: depth that is wrong."""
LEAST = 0.005
"""Least share of the area that makes a floor or a ceiling."""
BEYOND, BEYOND_SHARE = 0.1, 0.02
"""What lies below level surface by more than this part of the height, as a share of all surface, makes it a table and no floor;
above it, a lamp or a shelf and no ceiling."""
LEANS = float(np.radians(2.0))
"""Angle between the vertical and an axis up to which the axis is the vertical: floors of scans are off by up to 0.8 degrees."""
NEAR = float(np.radians(5.0))
"""Largest angle with the vertical at which a face counts as level beside another vertical."""
CLEARLY, LEAST_LEVEL = 2.0, 0.02
"""How many times as much surface must be level by another vertical than by an axis, and which share of all surface."""
BINS = 90
"""Layers in which the height of the room is divided."""


class RoomFrame(NamedTuple):
    """Where a reconstruction lies.

    Attributes:
        turn: (3, 3) rotation to z up, x along the largest wall.
        floor, ceiling: heights along the new z, before any scaling.
        has_floor, has_ceiling: level surface lies there; else surface ends there.
    """

    turn: NDArray
    floor: float
    ceiling: float
    has_floor: bool
    has_ceiling: bool


def room_frame(vertices: ArrayLike, faces: ArrayLike, world_from_camera: ArrayLike) -> RoomFrame:
    """Find the vertical, the direction of the walls, and the heights of floor and ceiling.

    The vertical is the direction that most surface faces of those near the vertical of the cameras; without one, it is that of
    the cameras. Floor and ceiling are the heights where most of the level surface lies near the ends.

    Args:
        vertices, faces: (n, 3) and (m, 3), in any unit.
        world_from_camera: (v, 3 or 4, 4) poses, OpenCV axes.
    """
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    normal, area = face_geometry(vertices, faces)
    middle, found = vertices[faces].mean(1), directions(normal, area)
    up = _vertical(middle, normal, area, found, world_from_camera)

    # -------- walls: the largest direction that is square to it --------
    across = found[np.abs(found @ up) < np.sqrt(1 - UPRIGHT**2)]
    along = across[0] if len(across) else np.eye(3)[np.abs(up).argmin()]
    along = along - (along @ up) * up
    along /= np.linalg.norm(along)
    ends = _ends(middle @ up, area, np.abs(normal @ up) > LEVEL, BEYOND_SHARE)
    return RoomFrame(np.stack([along, np.cross(up, along), up]), *ends)


def upward(vertices: ArrayLike, faces: ArrayLike, world_from_camera: ArrayLike, axis: NDArray) -> NDArray:
    """Return what is up (3,) in a capture whose coordinates may lean, as those of COLMAP and of depth cameras do: the axis
    nearest to the vertical of the cameras, unless the surface says otherwise.

    It does if its vertical (as in `room_frame`) is more than `LEANS` away from that axis, and `CLEARLY` as much surface is level
    by it as by the axis; level is what is nearer to the one than to the other.

    Args:
        vertices, faces: (n, 3) and (m, 3), in any unit.
        world_from_camera: (v, 3 or 4, 4) poses, OpenCV axes.
        axis: (3,) the axis of the coordinates that is nearest to the vertical of the cameras.
    """
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    normal, area = face_geometry(vertices, faces)
    up = _vertical(vertices[faces].mean(1), normal, area, directions(normal, area), world_from_camera)
    angle = float(np.arccos(np.clip(axis @ up, -1.0, 1.0)))
    if angle <= LEANS:
        return axis
    by_up, by_axis = (float(area[np.abs(normal @ one) >= np.cos(min(angle / 2, NEAR))].sum()) for one in (up, axis))
    return up if by_up >= max(CLEARLY * by_axis, LEAST_LEVEL * float(area.sum())) else axis


def _vertical(middle: NDArray, normal: NDArray, area: NDArray, found: NDArray, world_from_camera: ArrayLike) -> NDArray:
    """Return the direction (3,) that most surface faces of those near the vertical of the cameras; without one, the cameras' own.

    Args:
        middle, normal, area: (m, 3), (m, 3) and (m,) of the faces.
        found: (k, 3) directions of surface, the largest first.
    """
    up = upright(world_from_camera)
    level = found[np.abs(found @ up) >= UPRIGHT]
    if len(level):  # the largest
        up = level[0] * np.sign(level[0] @ up)
    # The floor tells the vertical best.
    is_level = np.abs(normal @ up) > LEVEL
    beside = BESIDE_FLOOR * float(np.ptp(middle @ up))
    floor = _ends(middle @ up, area, is_level)[0]
    up, _ = fitted_plane(up, is_level & (np.abs(middle @ up - floor) <= beside), middle, normal, area, beside)
    return up


def upright(world_from_camera: ArrayLike) -> NDArray:
    """Return the vertical (3,) of cameras that nobody rolls: square to what lies to the right in their pictures, also where all
    of them look down; of cameras that all look the same way, the mean of what is up in their pictures.

    world_from_camera: (v, 3 or 4, 4) poses, OpenCV axes.
    """
    poses = np.asarray(world_from_camera, np.float64)
    up, right = -poses[:, :3, 1].mean(0), poses[:, :3, 0]
    share, axes = np.linalg.eigh(right.T @ right / len(right))
    if share[1] >= TURNED:
        up = axes[:, 0] * (1.0 if axes[:, 0] @ up >= 0 else -1.0)
    return up / max(float(np.linalg.norm(up)), 1e-12)


def _ends(height: NDArray, area: NDArray, level: NDArray, most_beyond: float = 1.0) -> tuple[float, float, bool, bool]:
    """Return where most level surface lies in the lowest and in the highest third of the room, else where all surface ends; and
    whether there is such surface.

    Args:
        height, area: (m,) of the faces.
        level: (m,) bool.
        most_beyond: share of all surface that may lie further out than such surface by `BEYOND` of the height.
    """
    order = np.argsort(height)
    share = np.cumsum(area[order]) / area.sum()
    low, high = (float(height[order][min(np.searchsorted(share, s), len(order) - 1)]) for s in (NOISE, 1 - NOISE))
    step = max((high - low) / BINS, 1e-12)
    place = np.clip(((height - low) / step).astype(np.int64), 0, BINS - 1)
    filled = np.convolve(np.bincount(place, area * level, BINS), np.ones(3), "same")
    third = BINS // 3
    out, there = [], []
    for first, end, outward in ((0, low, -1), (BINS - third, high, 1)):
        peak = first + int(filled[first : first + third].argmax())
        own = (np.abs(place - peak) <= 1) & level
        found = float(np.average(height[own], weights=area[own])) if area[own].sum() >= LEAST * area.sum() else None
        if found is not None and area[outward * (height - found) > BEYOND * (high - low)].sum() > most_beyond * area.sum():
            found = None
        there.append(found is not None)
        out.append(end if found is None else found)
    return out[0], out[1], there[0], there[1]
