"""A room in the making: its parts, what stands where, and the surfaces that small things may stand on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from iif_core.light.environment import direction_in
from iif_core.numerics.xp import NUMPY
from lab.prior import materials
from lab.prior.assets import SKY
from lab.prior.palette import Palette
from lab.rooms import shapes
from lab.rooms.shapes import Shape

WALLS = ("north", "south", "west", "east")


@dataclass(frozen=True)
class Part:
    """An object of a room.

    Attributes:
        name: for people.
        shape: vertices (n, 3) metres and faces (m, 3), as it is rendered.
        material: row (materials.WIDTH,).
        radiance: (3,) of the front side, linear, relative.
        delivered: the shape that a scan would deliver in its place; None = the same.
    """

    name: str
    shape: Shape
    material: np.ndarray
    radiance: np.ndarray
    delivered: Shape | None = None


@dataclass(frozen=True)
class Top:
    """A horizontal surface that things may stand on: x and y from `low` (2,) to `high` (2,), at height z, metres."""

    low: np.ndarray
    high: np.ndarray
    z: float


@dataclass(frozen=True)
class Hole:
    """An opening in a wall, for a window or a door: `start` to `stop` along it, `low` to `high` above the floor, metres."""

    wall: str
    start: float
    stop: float
    low: float
    high: float


@dataclass
class Building:
    """What the steps of a room's making share. The room spans x, y, z from 0 to `size`.

    Attributes:
        rng: of the room.
        size: (3,) metres.
        palette: its materials.
        parts: objects so far.
        obstacles: (low, high) (2, 3) of what cameras must not stand in.
        taken: footprints (x0, y0, x1, y1) of furniture.
        tops: surfaces for small things.
        holes: window openings; doors: openings of doors that are ajar.
        sky: (H, W, 3) radiance from outside; outside: `sky`, `sun`, `dusk` or `panes`.
    """

    rng: np.random.Generator
    size: np.ndarray
    palette: Palette
    parts: list[Part] = field(default_factory=list)
    obstacles: list[np.ndarray] = field(default_factory=list)
    taken: list[tuple[float, float, float, float]] = field(default_factory=list)
    tops: list[Top] = field(default_factory=list)
    holes: list[Hole] = field(default_factory=list)
    doors: list[Hole] = field(default_factory=list)
    sky: np.ndarray = field(default_factory=lambda: np.full((*SKY, 3), 1e-5, np.float32))
    outside: str = ""

    def chance(self, share: float) -> bool:
        """Draw True with a probability."""
        return bool(self.rng.random() < share)

    def between(self, low: float, high: float) -> float:
        """Draw a number between two."""
        return float(self.rng.uniform(low, high))

    def material(self, place: str = "thing", face: str | None = None) -> np.ndarray:
        """Draw a material (`Palette.material`)."""
        return self.palette.material(place, face)

    def add(
        self, name: str, material: np.ndarray, *pieces: Shape, obstacle: bool = True, delivered: Sequence[Shape] | None = None
    ) -> None:
        """Add an object of one material."""
        other = None if delivered is None else shapes.merge(*delivered)
        self.parts.append(Part(name, shapes.merge(*pieces), material, np.zeros(3), other))
        if obstacle:
            self.obstacles += [np.stack([v.min(0), v.max(0)]) for v, _ in pieces]

    def shine(self, name: str, *pieces: Shape, radiance: Sequence[float]) -> None:
        """Add a lamp: a black body whose front side has a radiance."""
        black = materials.row((0.0, 0.0, 0.0), rough=(1.0, 0, 0))
        self.parts.append(Part(name, shapes.merge(*pieces), black, np.asarray(radiance, float)))
        self.obstacles += [np.stack([v.min(0), v.max(0)]) for v, _ in pieces]

    def on_wall(self, wall: str, along: float, up: float, out: float = 0.0) -> np.ndarray:
        """Return the point (3,) at `along` and `up` on a wall, `out` metres behind it (negative: in the room)."""
        x, y, _ = self.size
        foot = {"north": (along, y + out), "south": (along, -out), "west": (-out, along), "east": (x + out, along)}[wall]
        return np.array([*foot, up])

    def plate(self, wall: str, along: Sequence[float], up: Sequence[float], out: Sequence[float]) -> Shape:
        """Return a box in front of a wall, between two values each of `along`, `up` and `out` as `on_wall` takes them."""
        return box(self.on_wall(wall, along[0], up[0], out[0]), self.on_wall(wall, along[1], up[1], out[1]))

    def length(self, wall: str) -> float:
        """Return the length of a wall in metres."""
        return float(self.size[0] if wall in ("north", "south") else self.size[1])

    def free_of_windows(self, wall: str, start: float, stop: float) -> bool:
        """Tell whether a stretch of a wall has no window and no door."""
        holes = *self.holes, *self.doors
        return all(hole.wall != wall or stop < hole.start - 0.1 or start > hole.stop + 0.1 for hole in holes)

    def place(self, width: float, depth: float, at_wall: bool = False) -> Placed | None:
        """Find a free place on the floor for furniture of width x depth; None where there is none.

        Furniture with its back to a wall is square to it; other furniture may be turned a little.
        """
        turn = int(self.rng.integers(4))
        a, b = (width, depth) if turn % 2 == 0 else (depth, width)
        room = self.size[:2] - (a, b) - 0.1
        if (room < 0.05).any():
            return None
        for _ in range(30):
            x, y = self.rng.uniform(0.03, np.maximum(room, 0.06))
            if at_wall:
                x, y = [(x, self.size[1] - b - 0.02), (0.02, y), (x, 0.02), (self.size[0] - a - 0.02, y)][turn]
            if all(x > p1 + 0.05 or x + a < p0 - 0.05 or y > q1 + 0.05 or y + b < q0 - 0.05 for p0, q0, p1, q1 in self.taken):
                self.taken.append((x, y, x + a, y + b))
                askew = 0.0 if at_wall or self.chance(0.5) else float(self.rng.normal(0, 4))
                return Placed(self, (x + a / 2, y + b / 2), 90.0 * turn + askew, width, depth)
        return None


@dataclass(frozen=True)
class Placed:
    """A place that was found: shapes in [0, width] x [0, depth], with the front at y = 0, move there."""

    building: Building
    centre: tuple[float, float]
    turn: float
    width: float
    depth: float

    def moved(self, shape: Shape) -> Shape:
        """Return a shape in the room."""
        return shapes.move((shape[0] - (self.width / 2, self.depth / 2, 0), shape[1]), (*self.centre, 0), self.turn)

    def add(self, name: str, material: np.ndarray, *pieces: Shape) -> None:
        """Add an object that is given in the frame of the furniture."""
        self.building.add(name, material, *[self.moved(piece) for piece in pieces])

    def top(self, low: Sequence[float], high: Sequence[float], z: float) -> None:
        """Remember a surface from `low` (2,) to `high` (2,), in the frame of the furniture, that things may stand on."""
        corners = self.moved((np.array([[*low, z], [*high, z]], float), np.zeros((0, 3), int)))[0][:, :2]
        self.building.tops.append(Top(corners.min(0) + 0.03, corners.max(0) - 0.03, float(z)))


def box(low: Sequence[float], high: Sequence[float], bevel: float = 0.0) -> Shape:
    """Make a box between two corners in any order; every side is at least 1 mm. Only bevelled ones need the slower `hull`."""
    a, b = np.asarray(low, float), np.asarray(high, float)
    low, high = np.minimum(a, b), np.maximum(a, b)
    high = np.maximum(high, low + 1e-3)
    if bevel > 0:
        return shapes.box(low, high, bevel)
    corners = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)], float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([[(a, b, c), (a, c, d)] for a, b, c, d in quads]).reshape(-1, 3)
    return low + corners * (high - low), faces


def bounds(shape: Shape) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and the highest coordinates (3,) of a shape."""
    return shape[0].min(0), shape[0].max(0)


def sky_of(horizon: np.ndarray, zenith: np.ndarray, ground: np.ndarray, sun: tuple[float, float, float] | None) -> np.ndarray:
    """Return a map of sky, ground and sun.

    Args:
        horizon, zenith, ground: (3,) radiance, linear.
        sun: elevation and azimuth in degrees, and the radiance of one texel; None = no sun.

    Returns:
        (64, 128, 3) float32.
    """
    row, column = np.indices(SKY).astype(float)
    towards = np.stack(direction_in(NUMPY, row, column, 0.5, 0.5, *SKY), -1)
    up = towards[..., 2:]
    out = np.where(up > 0, horizon + (zenith - horizon) * np.maximum(up, 0), ground)
    if sun is not None:
        elevation, azimuth = np.radians(sun[:2])
        way = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
        out[np.unravel_index((towards @ way).argmax(), SKY)] = sun[2] * np.array([1.0, 0.93, 0.82])
    return out.astype(np.float32)
