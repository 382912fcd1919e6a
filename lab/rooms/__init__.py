"""Rooms that the project makes itself."""

from __future__ import annotations

from collections.abc import Callable

from iif_core.errors import InputError
from lab.rooms import bed, kitchen, tiny
from lab.rooms.room import Room

ROOMS: dict[str, Callable[[], Room]] = {
    "kitchen": kitchen.build,
    "matte": kitchen.build_matte,
    "tiny": tiny.build,
    **tiny.EXTREMES,
    **bed.ROOMS,
}


def build(name: str, quarterings: int = 0) -> Room:
    """Build the room of that name, with every face split into four `quarterings` times.

    Raises:
        InputError: unknown name.
    """
    if name not in ROOMS:
        raise InputError(f"source.scene: found {name!r}, allowed: {', '.join(ROOMS)}")
    room = ROOMS[name]()
    for _ in range(quarterings):
        room = room.quartered()
    return room
