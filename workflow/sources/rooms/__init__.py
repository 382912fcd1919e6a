"""Rooms that the project makes itself."""

from __future__ import annotations

from collections.abc import Callable

from iif_core.errors import InputError
from workflow.sources.rooms import bed, kitchen, tiny
from workflow.sources.rooms.room import Room

ROOMS: dict[str, Callable[[], Room]] = {"kitchen": kitchen.build, "tiny": tiny.build, **bed.ROOMS}


def build(name: str) -> Room:
    """Build the room of that name.

    Raises:
        InputError: unknown name.
    """
    if name not in ROOMS:
        raise InputError(f"source.scene: found {name!r}, allowed: {', '.join(ROOMS)}")
    return ROOMS[name]()
