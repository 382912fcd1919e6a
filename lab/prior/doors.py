"""A door that is ajar, and the lit room behind it."""

from __future__ import annotations

import numpy as np

from lab.prior.building import Building, Hole, box
from lab.prior.shell import REVEAL, warm
from lab.rooms.shapes import Shape

SHARE = 0.15
"""Share of the rooms with a door that is ajar."""
_NEAR = {"south": slice(6, 8), "west": slice(2, 4)}
"""The two faces of `building.box` that are nearest to the room, of a box behind a wall."""


def open_door(building: Building, rng: np.random.Generator) -> None:
    """Choose an opening for a door in the south or the west wall, which have no windows.

    Args:
        building: the room in the making.
        rng: of doors alone, so that rooms without one are what they were before there were doors.
    """
    if rng.random() >= SHARE:
        return
    wall = ("south", "west")[rng.integers(2)]
    length, width, high = building.length(wall), rng.uniform(0.7, 0.95), rng.uniform(1.9, 2.1)
    first, last = 0.45 * length, length - width - 0.2  # a corner near the origin may be built in
    if first < last:
        start = rng.uniform(first, last)
        building.doors.append(Hole(wall, start, start + width, 0.01, min(high, building.size[2] - 0.12)))
        before = (start, 0.0, start + width, 0.7) if wall == "south" else (0.0, start, 0.7, start + width)
        building.taken.append(before)


def build_next_room(building: Building, rng: np.random.Generator) -> None:
    """Add, behind each opening for a door, a closed room with a lamp, and the leaf of the door, which opens into it."""
    for door in building.doors:
        high, deep = float(building.size[2]), REVEAL + rng.uniform(1.0, 2.6)
        along = max(door.start - rng.uniform(0.1, 1.0), 0), min(door.stop + rng.uniform(0.1, 1.0), building.length(door.wall))
        room = box(building.on_wall(door.wall, along[0], 0.0, 0.0), building.on_wall(door.wall, along[1], high, deep))
        # Seen from inside, and open towards the wall, whose back closes it.
        inside = room[0], np.delete(room[1], _NEAR[door.wall], axis=0)[:, ::-1]
        building.add("next room", building.palette.material("wall"), inside, obstacle=False)
        middle, half = rng.uniform(along[0] + 0.3, along[1] - 0.3), rng.uniform(0.1, 0.25)
        lamp = building.plate(
            door.wall, (middle - half, middle + half), (high - 0.05, high - 0.01), (0.4 * deep, 0.4 * deep + 0.3)
        )
        building.shine("next lamp", lamp, radiance=10 ** rng.uniform(1.0, 2.2) * warm(rng, -0.3, 0.8))
        building.add("door", building.material(), _leaf(building, door, np.radians(rng.uniform(15, 80))), obstacle=False)


def _leaf(building: Building, door: Hole, angle: float) -> Shape:
    """The leaf, hinged at the start of the opening, behind its reveal."""
    hinge = building.on_wall(door.wall, door.start, door.low, REVEAL)
    across = building.on_wall(door.wall, door.stop, door.low, REVEAL) - hinge
    out = building.on_wall(door.wall, door.start, door.low, REVEAL + 1) - hinge
    width = np.linalg.norm(across)
    way = np.cos(angle) * across / width + np.sin(angle) * out
    side = np.cos(angle) * out - np.sin(angle) * across / width
    corners, faces = box((0, 0, 0), (width, 0.04, door.high - door.low))
    leaf = hinge + corners[:, :1] * way + corners[:, 1:2] * side + corners[:, 2:] * (0, 0, 1)
    mirrored = np.cross(way, side)[2] < 0
    return leaf, faces[:, ::-1] if mirrored else faces
