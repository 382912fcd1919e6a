"""The test bed: small furnished rooms that differ in how light enters them. Plan, furniture and paints are drawn from a seed.

What a scan of such a room delivers may differ from the room: half-transparent curtains and half-open blinds are strips with
gaps between them in the room and closed sheets in the mesh.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from iif_core.light.environment import direction_in
from iif_core.numerics.xp import NUMPY
from lab.rooms.palette import (
    BIRCH,
    BIRCH_DARK,
    BRASS,
    CHROME,
    EAST,
    NORTH,
    OAK,
    OAK_DARK,
    STEEL,
    UP,
    WALNUT,
    WALNUT_DARK,
    WHITE_PAINT,
    patterned,
    plain,
    tiles,
    wood,
)
from lab.rooms.patterns import Material
from lab.rooms.room import Room, RoomBuilder
from lab.rooms.shapes import Shape, box, cylinder, grid_sheet, hull, lathe, mm, sheet, sphere, tube

_OVERLAP = 0.02  # metres by which walls reach past their corners, so that no ray slips through
_REVEAL = 0.18  # depth of a window opening, metres
_SHOTS = 48
_PAINTS = ("#b5473a", "#3f6f86", "#5c7d70", "#c58b2e", "#7a5a86", "#86794f", "#49566b", "#a8826b", "#d8cfa8", "#2f3a36")
_WALLS = ("#e6dccb", "#d9dee0", "#cfd8c6", "#e0cfc0", "#8fa393", "#c9b59a", "#a9b7c6")
_FLOORS = ("wood", "tiles", "checks", "carpet")


@dataclass(frozen=True)
class Light:
    """How light enters a room of the test bed.

    Attributes:
        windows: number of window openings, in the east wall and then in the north wall.
        sky: radiance of the sky at the horizon and at the zenith, and of the ground; None = no light from outside.
        sun: (elevation, azimuth) in degrees, and radiance of its disc; None = no sun.
        cover: what hangs before the windows: None, "curtains" or "blinds".
        panes: radiance of luminous panes in the window openings; None = openings.
        lamps: luminous things in the room: "ceiling", "bulb", "shade", "recess" (which no camera sees).
        door: the room is lit from the next room, through a door that is ajar.
    """

    windows: int = 1
    sky: tuple[Sequence[float], Sequence[float], Sequence[float]] | None = None
    sun: tuple[float, float, float] | None = None
    cover: str | None = None
    panes: Sequence[float] | None = None
    lamps: tuple[str, ...] = ()
    door: bool = False


@dataclass(frozen=True)
class Look:
    """What is not drawn of the look of a room: `floor` material, colour of the `walls`, a mirror, one object for everything."""

    floor: Material | None = None
    walls: str | None = None
    mirror: bool = False
    single: bool = False


OVERCAST = ((3.2, 3.5, 3.8), (9.0, 9.8, 10.5), (1.1, 1.0, 0.8))
CLEAR = ((5.5, 6.2, 7.0), (1.6, 2.6, 4.4), (1.6, 1.5, 1.2))
KINDS: dict[str, tuple[int, Light, Look]] = {
    "sky": (1, Light(windows=2, sky=OVERCAST), Look()),
    "sun": (2, Light(windows=2, sky=CLEAR, sun=(38.0, 25.0, 900.0)), Look()),
    "blinds": (3, Light(windows=1, sky=OVERCAST, cover="blinds", lamps=("ceiling",)), Look()),
    "curtains": (4, Light(windows=2, sky=OVERCAST, cover="curtains"), Look()),
    "door": (5, Light(windows=0, door=True), Look()),
    "lamps": (6, Light(windows=0, lamps=("bulb", "shade", "recess")), Look()),
    "gloss": (7, Light(windows=1, panes=(7.0, 7.6, 8.4), lamps=("ceiling",)), Look(plain("#1d1a19", 0.16), mirror=True)),
    "white": (8, Light(windows=2, panes=(6.0, 6.3, 6.6)), Look(plain("#d9d7d2", 0.35), walls="#f2f0ec")),
    "single": (9, Light(windows=1, sky=CLEAR, lamps=("ceiling",)), Look(single=True)),
    "evening": (
        10,
        Light(windows=1, sky=((0.5, 0.45, 0.6), (0.15, 0.2, 0.45), (0.1, 0.1, 0.1)), lamps=("ceiling", "shade")),
        Look(),
    ),
}
"""Name -> (seed, light, look)."""


def build(name: str) -> Room:
    """Build the room `name` of `KINDS`."""
    seed, light, look = KINDS[name]
    return _Bed(name, np.random.default_rng(seed), light, look).build()


def environment(light: Light, height: int = 64, width: int = 128) -> np.ndarray | None:
    """Return the map (H, W, 3) float32 of what surrounds a room: sky from horizon to zenith, ground, sun; None = dark."""
    if light.sky is None:
        return None
    horizon, zenith, ground = (np.asarray(c, float) for c in light.sky)
    row, column = np.indices((height, width)).astype(float)
    towards = np.stack(direction_in(NUMPY, row, column, 0.5, 0.5, height, width), -1)
    up = np.maximum(towards[..., 2:], 0.0)
    out = np.where(towards[..., 2:] > 0, horizon + (zenith - horizon) * up, ground)
    if light.sun is not None:
        elevation, azimuth = np.radians(light.sun[:2])
        sun = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
        out[np.unravel_index((towards @ sun).argmax(), (height, width))] = light.sun[2] * np.array([1.0, 0.93, 0.82])
    return out.astype(np.float32)


@dataclass
class _Bed:
    """A room in the making."""

    name: str
    rng: np.random.Generator
    light: Light
    look: Look
    taken: list[tuple[float, float, float, float]] = field(default_factory=list)

    def build(self) -> Room:
        self.size = np.round(self.rng.uniform((4.0, 3.4, 2.4), (5.6, 4.6, 2.9)), 2)
        self.room = RoomBuilder(self.name, self.size)
        self.paints = list(self.rng.permutation(_PAINTS))
        self.holes = self._windows()
        self._shell()
        for number, hole in enumerate(self.holes):
            self._window(number, *hole)
        if self.light.door:
            self._door()
        self._furniture()
        self._lamps()
        shots = "\n".join(" ".join(f"{value:.2f}" for value in shot) for shot in self._shots())
        room = self.room.finish(shots)
        return replace(room, environment=environment(self.light), one_object=self.look.single)

    def _paint(self) -> str:
        self.paints.append(self.paints.pop(0))
        return self.paints[-1]

    # ------------------------------------------------------------------------------------------------------- the shell

    def _windows(self) -> list[tuple[str, float, float, float, float]]:
        """(wall, start, stop, low, high) of every window opening."""
        out = []
        for wall in ("east", "north")[: self.light.windows]:
            length = self.size[1] if wall == "east" else self.size[0]
            width = self.rng.uniform(1.2, min(2.0, length - 1.2))
            start = self.rng.uniform(0.5, length - width - 0.5)
            out.append((wall, *np.round((start, start + width, 0.85, self.size[2] - 0.35), 2)))
        return out

    def _wall(self, wall: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(origin, edge along, outward normal) of a wall seen from inside, so that along x up faces the room."""
        x, y, _ = self.size
        o = _OVERLAP
        return {
            "north": (np.array([-o, y, -o]), np.array([x + 2 * o, 0, 0]), np.array([0, 1.0, 0])),
            "south": (np.array([x + o, 0, -o]), np.array([-x - 2 * o, 0, 0]), np.array([0, -1.0, 0])),
            "west": (np.array([0, -o, -o]), np.array([0, y + 2 * o, 0]), np.array([-1.0, 0, 0])),
            "east": (np.array([x, y + o, -o]), np.array([0, -y - 2 * o, 0]), np.array([1.0, 0, 0])),
        }[wall]

    def _place(self, wall: str, along: float, up: float, out: float = 0.0) -> np.ndarray:
        """Point at `along` metres from the origin of x or y on a wall, `up` from the floor, `out` beyond the wall."""
        x, y, _ = self.size
        foot = {"north": (along, y, up), "south": (along, 0, up), "west": (0, along, up), "east": (x, along, up)}[wall]
        return np.array(foot, float) + out * self._wall(wall)[2]

    def _shell(self) -> None:
        x, y, z = self.size
        o = _OVERLAP
        floors = {
            "wood": wood(OAK, OAK_DARK, EAST, NORTH, 0.38),
            "tiles": tiles("z", "#d8d2c4", "#b9b2a2", (0, 0, 0), (0.30, 0.30)),
            "checks": patterned("checks", "#c9b494", "#8d6a49", size=(0.5, 0.5), roughness=0.4),
            "carpet": plain("#7d8791", 0.95, "#6d7781", grain=5.0),
        }
        floor = self.look.floor or floors[self.rng.choice(_FLOORS)]
        self.room.add("floor", floor, sheet((-o, -o, 0), (x + 2 * o, 0, 0), (0, y + 2 * o, 0), 0.3), is_part=False)
        ceiling = plain("#eeeae2", 0.9, "#e8e3d9", grain=1.2)
        self.room.add("ceiling", ceiling, sheet((-o, y + o, z), (x + 2 * o, 0, 0), (0, -y - 2 * o, 0), 0.3), is_part=False)
        shade = self.look.walls or self.rng.choice(_WALLS)
        accent = self.look.walls or self.rng.choice(_WALLS)
        door = [("south", 0.6, 1.5, 0.02, 2.05)] if self.light.door else []
        for wall in ("north", "south", "west", "east"):
            colour = accent if wall == "west" else shade
            holes = [hole[1:] for hole in (*self.holes, *door) if hole[0] == wall]
            depth = _REVEAL if wall != "south" else 0.08
            shapes = self._wall_with(wall, holes[0] if holes else None, depth)
            self.room.add(f"{wall} wall", plain(colour, 0.85, grain=1.6), *shapes, is_part=False)

    def _wall_with(self, wall: str, hole: Sequence[float] | None, depth: float) -> list[Shape]:
        origin, along, out = self._wall(wall)
        up = np.array([0, 0, self.size[2] + 2 * _OVERLAP])
        if hole is None:
            return [sheet(origin, along, up, 0.3)]
        length = np.linalg.norm(along)
        axis = np.abs(along).argmax()
        sides = sorted((self._place(wall, edge, 0)[axis] - origin[axis]) / along[axis] for edge in hole[:2])
        levels = [(edge + _OVERLAP) / up[2] for edge in hole[2:]]
        u, v = _lines([0, *sides, 1], 0.25 / length), _lines([0, *levels, 1], 0.25 / up[2])
        a, b = (origin + s * along for s in sides)
        low, high = (np.array([0, 0, edge + _OVERLAP]) for edge in hole[2:])
        back, rise = depth * out, high - low
        return [
            grid_sheet(origin, along, up, u, v, (*sides, *levels)),
            sheet(a + low, b - a, back),
            sheet(b + high, a - b, back),
            sheet(b + low, rise, back),
            sheet(a + high, -rise, back),
        ]

    # --------------------------------------------------------------------------------------------------------- openings

    def _window(self, number: int, wall: str, start: float, stop: float, low: float, high: float) -> None:
        frame, half = [], 0.025
        for along in (start + half, 0.5 * (start + stop), stop - half):
            frame.append(self._bar(wall, (along - half, along + half), (low, high), (0.08, 0.13)))
        for level in (low + half, high - half):
            frame.append(self._bar(wall, (start, stop), (level - half, level + half), (0.085, 0.125)))
        self.room.add(f"window frame {number + 1}", plain(self.rng.choice(("#ece8de", "#4f6d61", "#5b3a26")), 0.42), *frame)
        if self.light.panes is not None:
            corner = [self._place(wall, along, low, 0.15) for along in (start, stop)]
            across = corner[1] - corner[0]
            first = corner[0]
            if np.cross(across, UP) @ self._wall(wall)[2] > 0:  # the pane shines into the room
                first, across = corner[1], -across
            pane = sheet(first, across, (0, 0, high - low), 0.4)
            self.room.add_emitter(f"window pane {number + 1}", pane, radiance=self.light.panes)
        if self.light.cover == "curtains":
            self._curtain(number, wall, start - 0.25, stop + 0.25, 0.04, high + 0.12)
        if self.light.cover == "blinds":
            self._blinds(number, wall, start, stop, low, high)

    def _bar(self, wall: str, along: Sequence[float], up: Sequence[float], out: Sequence[float]) -> Shape:
        a, b = self._place(wall, along[0], up[0], out[0]), self._place(wall, along[1], up[1], out[1])
        return box(np.minimum(a, b), np.maximum(a, b), 0.004)

    def _curtain(self, number: int, wall: str, start: float, stop: float, low: float, high: float) -> None:
        """Folded cloth of which every second strip of 1 cm is a gap; the mesh that is delivered is closed."""

        def cloth(columns: int, strips: bool) -> Shape:
            along = np.linspace(start, stop, columns + 1)
            out = -0.14 + 0.035 * np.sin(2 * np.pi * (along - start) / 0.22)
            foot = np.array([self._place(wall, a, low, o) for a, o in zip(along, out, strict=True)])
            vertices = np.concatenate([foot, foot + (0, 0, high - low)])
            i = np.arange(columns)[:: 2 if strips else 1]
            n = columns + 1
            faces = np.concatenate([np.stack([i, i + 1, i + 1 + n], 1), np.stack([i, i + 1 + n, i + n], 1)])
            used, faces = np.unique(faces, return_inverse=True)
            return vertices[used], faces.reshape(-1, 3)

        fine = 2 * round((stop - start) / 0.02)
        material = plain("#e9e4d8", 0.92, "#ded8ca", grain=3.0)
        self.room.add(f"curtain {number + 1}", material, cloth(fine, True), scanned=[cloth(fine // 2, False)])

    def _blinds(self, number: int, wall: str, start: float, stop: float, low: float, high: float) -> None:
        """Tilted slats in the opening; the mesh that is delivered has one sheet in their place."""
        across = self._place(wall, stop, 0) - self._place(wall, start, 0)
        tilt = 0.045 * (np.cos(0.7) * self._wall(wall)[2] + np.sin(0.7) * np.array(UP))
        slats = [sheet(self._place(wall, start, level, 0.02), across, tilt, 5.0) for level in np.arange(low, high - 0.03, 0.045)]
        plane = sheet(self._place(wall, start, low, 0.04), across, (0, 0, high - low), 0.2)
        self.room.add(f"blinds {number + 1}", plain("#d9d4c8", 0.5), *slats, scanned=[plane])

    def _door(self) -> None:
        """A bright room behind the south wall; its door, hinged at one side of the opening, is ajar."""
        z = self.size[2]
        low, high = np.array([-0.6, -2.4, 0.0]), np.array([3.0, -0.085, z])
        dx, dy, dz = np.diag(high - low)
        beside = [sheet(low, dx, dy), sheet(low + dz, dy, dx), sheet(low, dz, dx), sheet(low, dy, dz), sheet(low + dx, dz, dy)]
        front = grid_sheet(
            high - dz,
            -dx,
            dz,
            *(np.array(v) for v in (_hole_lines(high, low), [0, 0.02 / z, 2.05 / z, 1])),
            hole=_door_hole(high, low, z),
        )
        self.room.add("other room", plain("#e4dfd2", 0.85), *beside, front, is_part=False)
        panel = sheet((0.2, -0.9, z - 0.03), (1.6, 0, 0), (0, -0.9, 0), 0.5)
        self.room.add_emitter("other lamp", panel, radiance=(60.0, 56.0, 50.0))
        angle = np.radians(38)
        leaf = np.array([np.cos(angle), np.sin(angle), 0]) * 0.88
        side = np.array([-np.sin(angle), np.cos(angle), 0]) * 0.04
        corner = np.array([0.62, 0.02, 0.02])
        points = [corner + i * leaf + j * side + (0, 0, k) for i in (0, 1) for j in (0, 1) for k in (0, 2.0)]
        self.room.add("door", plain("#6f8fa3", 0.4), hull(np.array(points)))

    # -------------------------------------------------------------------------------------------------------- furniture

    def _spot(self, width: float, depth: float, gap: float = 0.12) -> tuple[float, float] | None:
        """A free place (x, y of the lower corner) for something of width x depth; None where there is none."""
        for _ in range(200):
            x, y = self.rng.uniform((0.25, 0.25), np.maximum(self.size[:2] - (width, depth) - 0.25, 0.26))
            if all(x > c + gap or x + width < a - gap or y > d + gap or y + depth < b - gap for a, b, c, d in self.taken):
                self.taken.append((x, y, x + width, y + depth))
                return float(x), float(y)
        return None

    def _furniture(self) -> None:
        if self.light.door:
            self.taken.append((0.5, 0.0, 1.7, 0.9))
        for step in (self._table, self._sofa, self._cabinet, self._shelf, self._crate, self._stool, self._stool, self._column):
            step(len(self.taken))
        x, y, _ = self.size
        rug = patterned("stripes", self._paint(), "#d9cda9", self._paint(), size=(0.15, 0.12), roughness=0.95)
        self.room.add("rug", rug, box((0.3 * x, 0.3 * y, 0.001), (0.62 * x, 0.66 * y, 0.012)), is_part=False)
        painting = patterned("checks", self._paint(), self._paint(), size=(0.2, 0.2), axes=((0, 1, 0), (0, 0, 1)), roughness=0.6)
        self.room.add("painting", painting, box((0.005, 0.35 * y, 1.2), (0.03, 0.35 * y + 0.8, 1.8), 0.003))
        if self.look.mirror:
            mirror = plain("#d6d8da", 0.06, metallic=1.0)
            self.room.add("mirror", mirror, box((0.005, 0.75 * y, 0.9), (0.02, 0.75 * y + 0.6, 1.9)))

    def _table(self, _: int) -> None:
        if (at := self._spot(1.3, 0.8)) is None:
            return
        x, y = at
        legs = [box((x + a, y + b, 0.002), (x + a + 0.06, y + b + 0.06, 0.70)) for a in (0.03, 1.21) for b in (0.03, 0.71)]
        self.room.add(
            "table", wood(WALNUT, WALNUT_DARK, EAST, NORTH, 0.33), box((x, y, 0.70), (x + 1.3, y + 0.8, 0.74), 0.006), *legs
        )
        self.room.add(
            "bowl", plain(self._paint(), 0.2), lathe(mm("0,0 60,0 140,70 150,90 140,90 60,12 0,12"), (x + 0.4, y + 0.4, 0.741))
        )
        vase = lathe(mm("0,0 50,0 80,90 40,200 50,240 0,230"), (x + 0.95, y + 0.35, 0.741))
        self.room.add("vase", self.rng.choice((BRASS, CHROME, STEEL)), vase)

    def _sofa(self, _: int) -> None:
        if (at := self._spot(1.7, 0.8)) is None:
            return
        x, y = at
        cloth = plain(self._paint(), 0.95, grain=20.0)
        seat = box((x, y, 0.05), (x + 1.7, y + 0.8, 0.42), 0.03)
        back = box((x + 0.001, y + 0.58, 0.42), (x + 1.699, y + 0.799, 0.82), 0.03)
        self.room.add("sofa", cloth, seat, back)
        pillow = patterned("stripes", self._paint(), "#d9cda9", size=(0.08, 0.06), roughness=0.95)
        self.room.add("pillow", pillow, box((x + 0.2, y + 0.40, 0.43), (x + 0.62, y + 0.56, 0.78), 0.04))

    def _cabinet(self, _: int) -> None:
        if (at := self._spot(1.0, 0.45)) is None:
            return
        x, y = at
        self.room.add("cabinet", plain(self._paint(), 0.4), box((x, y, 0.05), (x + 1.0, y + 0.45, 0.95), 0.008))
        knobs = [sphere((x + a, y - 0.015, 0.6), 0.02, 12) for a in (0.45, 0.55)]
        self.room.add("knobs", BRASS, *knobs)
        self.room.add("box", wood(BIRCH, BIRCH_DARK, EAST, UP), box((x + 0.1, y + 0.1, 0.952), (x + 0.4, y + 0.35, 1.12), 0.005))

    def _shelf(self, _: int) -> None:
        if (at := self._spot(0.9, 0.32)) is None:
            return
        x, y = at
        boards = [box((x, y, z), (x + 0.9, y + 0.32, z + 0.025)) for z in (0.06, 0.45, 0.85, 1.25, 1.65)]
        sides = [box((x + a, y + 0.001, 0.002), (x + a + 0.025, y + 0.319, 1.7)) for a in (-0.026, 0.901)]
        self.room.add("shelf", wood(BIRCH, BIRCH_DARK, EAST, NORTH, 0.45), *boards, *sides)
        spines = {"size": (0.04, 0.15), "axes": ((1, 0, 0), (0, 0, 1)), "origin": (x, y, 0.48)}
        books = patterned("spines", self._paint(), self._paint(), self._paint(), roughness=0.6, **spines)
        self.room.add("books", books, box((x + 0.03, y + 0.05, 0.477), (x + 0.7, y + 0.27, 0.74)))

    def _crate(self, _: int) -> None:
        if (at := self._spot(0.5, 0.5)) is None:
            return
        x, y = at
        self.room.add("crate", plain(self._paint(), 0.25), box((x, y, 0.001), (x + 0.5, y + 0.5, 0.5), 0.02))
        self.room.add("ball", self.rng.choice((BRASS, STEEL)), sphere((x + 0.25, y + 0.25, 0.662), 0.16))

    def _stool(self, number: int) -> None:
        if (at := self._spot(0.36, 0.36)) is None:
            return
        base = (at[0] + 0.18, at[1] + 0.18, 0.002)
        self.room.add(
            f"stool {number}", plain(self._paint(), float(self.rng.uniform(0.15, 0.8))), cylinder(base, 0.17, 0.45, 0.01)
        )

    def _column(self, _: int) -> None:
        if (at := self._spot(0.3, 0.3)) is None:
            return
        x, y = at
        self.room.add(
            "cupboard", plain(self._paint(), 0.5, self._paint(), grain=3.0), box((x, y, 0.002), (x + 0.3, y + 0.3, 1.6), 0.01)
        )

    # ------------------------------------------------------------------------------------------------------------ lamps

    def _lamps(self) -> None:
        x, y, z = self.size
        for lamp in self.light.lamps:
            if lamp == "ceiling":
                a, b = 0.45 * x, 0.45 * y
                panel = box((a, b, z - 0.06), (a + 0.6, b + 0.6, z - 0.03))
                self.room.add_emitter("ceiling lamp", panel, radiance=(9.0, 8.2, 6.8))
            elif lamp == "bulb":
                self.room.add(
                    "cord", plain("#2c2c2e", 0.5), tube([(0.4 * x, 0.5 * y, z - 0.6), (0.4 * x, 0.5 * y, z - 0.01)], 0.005, 8)
                )
                self.room.add_emitter("bulb", sphere((0.4 * x, 0.5 * y, z - 0.68), 0.09, 16), radiance=(16.0, 12.5, 8.5))
            elif lamp == "shade" and (at := self._spot(0.4, 0.4)) is not None:
                middle = np.array([at[0] + 0.2, at[1] + 0.2, 0.0])
                stand = (
                    cylinder(middle + (0, 0, 0.002), 0.14, 0.02),
                    tube([middle + (0, 0, 0.02), middle + (0, 0, 1.35)], 0.012, 8),
                )
                self.room.add("lamp stand", STEEL, *stand)
                shade = lathe([(0, 0), (0.18, 0), (0.13, 0.26), (0, 0.26)], middle + (0, 0, 1.3), 28)
                self.room.add_emitter("lamp shade", shade, radiance=(4.6, 3.7, 2.6))
            elif lamp == "recess":
                ledge = (
                    box((0.004, 0.3, z - 0.34), (0.22, y - 0.3, z - 0.31), 0.003),
                    box((0.20, 0.3, z - 0.312), (0.22, y - 0.3, z - 0.22)),
                )
                self.room.add("ledge", WHITE_PAINT, *ledge)
                strip = sheet((0.05, 0.4, z - 0.30), (0.1, 0, 0), (0, y - 0.8, 0), 0.5)
                self.room.add_emitter("strip", strip, radiance=(24.0, 21.0, 17.0))

    # ---------------------------------------------------------------------------------------------------------- cameras

    def _shots(self) -> list[tuple[float, ...]]:
        """Eye points near the walls and targets across the room, of which each is far from those before it."""
        boxes = np.array(self.room.parts).reshape(-1, 2, 3)
        free, out = [], []
        while len(free) < 40 * _SHOTS:
            eye = self.rng.uniform((0.35, 0.35, 0.9), (*(self.size[:2] - 0.35), min(2.1, self.size[2] - 0.35)))
            if not ((eye > boxes[:, 0] - 0.15) & (eye < boxes[:, 1] + 0.15)).all(1).any():
                free.append(eye)
        middle = self.size / 2
        for i in range(_SHOTS):
            pool = np.array(free[40 * i : 40 * i + 40])
            far = np.linalg.norm((pool - middle)[:, :2], axis=1)
            if out:
                eyes = np.array(out)[:, :3]
                far = far + np.linalg.norm(pool[:, None] - eyes[None], axis=2).min(1)
            eye = pool[far.argmax()]
            ahead = (middle - eye) * (1, 1, 0)
            turn = self.rng.uniform(-0.7, 0.7)
            ahead = np.array(
                [np.cos(turn) * ahead[0] - np.sin(turn) * ahead[1], np.sin(turn) * ahead[0] + np.cos(turn) * ahead[1], 0.0]
            )
            ahead /= max(np.linalg.norm(ahead), 1e-6)
            target = eye + 2.0 * ahead + (0, 0, self.rng.uniform(-1.1, 0.5))
            out.append((*eye, *target))
        return out


def _lines(edges: Sequence[float], step: float) -> np.ndarray:
    """Grid lines that hold all `edges` and lie about `step` apart."""
    pieces = [np.linspace(a, b, max(2, round((b - a) / step) + 1))[:-1] for a, b in zip(edges[:-1], edges[1:], strict=True)]
    return np.concatenate([*pieces, edges[-1:]])


def _hole_lines(high: np.ndarray, low: np.ndarray) -> list[float]:
    """Grid lines along -x of the wall between two rooms, with those of the door at x = 0.6 and 1.5."""
    length = high[0] - low[0]
    return [0, (high[0] - 1.5) / length, (high[0] - 0.6) / length, 1]


def _door_hole(high: np.ndarray, low: np.ndarray, z: float) -> tuple[float, ...]:
    lines = _hole_lines(high, low)
    return lines[1], lines[2], 0.02 / z, 2.05 / z


ROOMS: dict[str, Callable[[], Room]] = {name: (lambda name=name: build(name)) for name in KINDS}
