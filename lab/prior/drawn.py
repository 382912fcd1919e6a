"""Rooms of the generator that makes the training rooms of the learned prior, from seeds that it never trained on."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from lab.rooms.room import Room

if TYPE_CHECKING:
    from lab.prior import rooms

PREFIX = "drawn-"
FIRST = 700_000_000
"""Seeds from here on are of drawn rooms, with the remainder that training keeps back (`lab/prior/shards.py`)."""
COUNT, REPORTED = 200, 80
"""Number of rooms of the bed, and of those, the last, that only report: nothing is chosen by them."""
SHOTS = 48
_STREAM = 0x73686F74


def generated(number: int) -> rooms.Room:
    """Return a drawn room as the generator makes it, without pictures from files."""
    from lab.prior import rooms
    from lab.prior.shards import HELD_OUT

    every, remainder = HELD_OUT
    return rooms.build(FIRST + every * number + remainder)


def build(number: int) -> Room:
    """Build a drawn room with its poses and its camera."""
    from lab.prior import cameras
    from lab.prior.sensor import draw_response

    drawn = generated(number)
    rng = np.random.default_rng([number, _STREAM])
    poses = cameras.poses(drawn, SHOTS, rng)
    shots = np.stack([poses[:, :3, 3], poses[:, :3, 3] + poses[:, :3, 2]], 1)
    vertices, faces, own = drawn.mesh()
    names = tuple(f"{part.name} {i}" for i, part in enumerate(drawn.parts))
    scanned = {i: part.delivered for i, part in enumerate(drawn.parts) if part.delivered is not None}
    return Room(
        f"{PREFIX}{number}",
        vertices,
        faces,
        own,
        names,
        drawn.materials,
        drawn.emission()[own],
        drawn.size,
        drawn.obstacles,
        shots,
        float(rng.uniform(50, 85)),
        drawn.sky,
        scanned,
        response=draw_response(rng),
    )
