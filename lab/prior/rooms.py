"""Random rooms: geometry, materials and light from a seed. The product's own rooms are never built here."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lab.prior.assets import Assets
from lab.prior.building import Building, Part
from lab.prior.doors import build_next_room, open_door
from lab.prior.furniture import furnish
from lab.prior.lamps import light_up
from lab.prior.materials import Materials
from lab.prior.palette import Palette
from lab.prior.shell import build_shell, light_from_outside, open_windows

VERSION = 4
"""Version of the generator, written into every room's file: 1 was the prototype, 2 had no matte surface, 3 no doors. Raise it
when rooms of a seed change."""
_STREAM, _DOORS = 0x726F6F6D, 0x646F6F72


@dataclass(frozen=True)
class Room:
    """A room as it is rendered.

    Attributes:
        size: (3,) metres, x and y along the walls, z up.
        parts: its objects, in the order of their ids.
        materials: one for each part.
        obstacles: (k, 2, 3) boxes that cameras must not stand in.
        sky: (64, 128, 3) float32 radiance from outside.
        outside: `sky`, `sun`, `dusk` or `panes`: what is seen through windows, if there are any.
    """

    size: np.ndarray
    parts: tuple[Part, ...]
    materials: Materials
    obstacles: np.ndarray
    sky: np.ndarray
    outside: str

    def mesh(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return vertices (n, 3) float32, faces (m, 3) int32 and the part (m,) int32 of each face."""
        counts = np.cumsum([0] + [len(part.shape[0]) for part in self.parts])
        vertices = np.concatenate([part.shape[0] for part in self.parts])
        faces = np.concatenate([part.shape[1] + first for part, first in zip(self.parts, counts[:-1], strict=True)])
        own = np.repeat(np.arange(len(self.parts)), [len(part.shape[1]) for part in self.parts])
        return vertices.astype(np.float32), faces.astype(np.int32), own.astype(np.int32)

    def emission(self) -> np.ndarray:
        """Return the radiance (parts, 3) float32 of each part."""
        return np.stack([part.radiance for part in self.parts]).astype(np.float32)


def build(seed: int, assets: Assets | None = None) -> Room:
    """Build the room of a seed.

    Args:
        seed: any integer >= 0.
        assets: textures and light from outside; without them, or with others, the room of a seed is another one.

    Returns:
        The room.
    """
    rng = np.random.default_rng([seed, _STREAM])
    assets = assets or Assets()
    size = np.round(rng.uniform((2.4, 2.4, 2.2), (7.5, 6.0, 3.6)), 2)
    building = Building(rng, size, Palette(rng, assets))
    open_windows(building)
    doors = np.random.default_rng([seed, _DOORS])
    open_door(building, doors)
    build_shell(building)
    build_next_room(building, doors)
    light_from_outside(building, assets)
    furnish(building)
    light_up(building)
    rows = Materials([part.material for part in building.parts], building.palette.layers)
    return Room(size, tuple(building.parts), rows, np.array(building.obstacles).reshape(-1, 2, 3), building.sky, building.outside)
