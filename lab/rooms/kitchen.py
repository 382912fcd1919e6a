"""The kitchen: fitted furniture and lamps here, walls in `kitchen_shell`, loose things in `kitchen_things` and `kitchen_decor`.

Plan (x east, y north, z up, metres; the room is 5 x 4 x 2.7): units and cooker along the north wall, worktop and sink under the
window in the east, sideboard and door in the south, pictures in the west, a table with four chairs in the middle. Parts that
touch keep a gap of 1 to 2 mm or pass through each other, so that no two surfaces lie in one plane.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lab.rooms import kitchen_decor, kitchen_things
from lab.rooms.kitchen_shell import SIZE, door, shell, window
from lab.rooms.palette import (
    BIRCH,
    BIRCH_DARK,
    BLACK_GLASS,
    BRASS,
    CHROME,
    EAST,
    IRON,
    MARBLE,
    NORTH,
    OAK,
    OAK_DARK,
    STEEL,
    UP,
    WALNUT,
    WALNUT_DARK,
    WHITE_GLAZE,
    WHITE_PAINT,
    patterned,
    plain,
    tiles,
    wood,
)
from lab.rooms.patterns import MaterialTable
from lab.rooms.room import Room, RoomBuilder
from lab.rooms.shapes import Shape, box, cylinder, lathe, mm, move, ring, sheet, sphere, tub, tube, wedge

LAMP = (1.75, 1.75)
GREEN = plain("#5c7d70", 0.40, "#557669", grain=2.0)
PLANK = wood(BIRCH, BIRCH_DARK, EAST, NORTH, 0.40, origin=(0, 0, 0.3))
DRAWERS = ((0.11, 0.38), (0.38, 0.63), (0.63, 0.85))
DRAWER_HANDLES = (0.32, 0.57, 0.79)

# x y z of a camera and of its target, three cameras a line; each adds the most surface that fewer than two before it have seen.
_SHOTS = """
0.45 1.90 1.55  4.90 2.20 1.10    0.70 2.95 1.60  4.20 0.80 0.80    4.10 3.10 1.60  0.90 0.90 0.90
4.05 0.60 1.60  1.30 3.40 0.90    0.55 0.95 1.60  3.60 3.40 0.95    3.40 2.90 1.90  2.00 0.30 1.60
2.90 1.00 2.10  1.70 3.70 1.80    3.60 3.00 1.15  1.50 1.50 0.60    0.60 1.30 1.20  2.20 2.60 0.60
1.20 2.95 1.80  2.60 0.10 1.10    0.95 3.00 1.45  4.90 3.60 1.10    3.30 0.85 0.95  1.20 2.20 0.60
2.70 3.05 0.90  1.70 1.20 0.30    3.95 3.05 2.10  2.40 1.20 2.30    2.50 0.75 1.55  2.60 3.90 1.00
0.50 2.50 1.10  2.80 1.20 0.50    2.70 0.80 1.90  4.60 2.60 0.30    3.60 1.90 1.50  0.10 2.00 1.20
1.10 2.80 2.20  3.20 1.60 2.40    3.80 0.70 1.10  2.70 1.90 0.30    0.95 3.05 1.15  0.30 1.40 0.60
0.50 1.60 1.80  1.90 3.70 1.00    1.00 0.95 1.60  0.10 2.40 1.60    2.20 2.95 2.10  1.80 1.30 0.40
4.05 1.15 1.50  4.70 3.30 1.00    4.10 2.10 1.55  2.20 0.20 0.90    1.15 0.80 1.75  4.00 0.20 0.90
0.80 2.20 1.90  0.40 0.40 0.80    4.05 2.95 1.40  4.80 1.50 1.00    0.70 2.60 1.35  1.90 1.60 0.70
2.90 3.00 1.25  0.50 3.60 1.00    2.60 2.30 1.30  3.50 3.90 1.60    3.95 1.60 1.80  0.40 3.60 0.50
0.60 1.75 1.15  2.00 1.80 0.80    2.60 3.05 1.60  2.30 0.20 0.90    3.20 0.75 1.70  0.30 0.40 0.70
3.85 2.50 1.50  4.30 3.90 1.40    4.05 1.80 1.20  3.60 0.10 0.70    3.30 2.20 1.55  2.95 3.90 1.05
1.60 2.60 1.40  2.40 3.80 0.80    3.10 3.05 1.70  4.90 0.90 0.90    2.95 2.70 1.45  1.60 1.60 0.75
3.50 2.60 1.35  2.70 3.80 0.70    3.50 1.75 1.45  3.90 0.00 1.10    2.30 1.30 1.40  2.30 0.10 1.20
3.20 1.60 1.50  4.90 2.40 1.00    2.10 1.20 1.70  0.00 1.75 1.45    1.40 1.15 1.35  1.90 0.10 1.00
3.00 1.50 1.50  1.90 0.10 1.05    2.30 1.15 1.50  4.60 0.90 0.50    1.90 2.30 1.50  1.50 3.90 1.20
2.85 1.75 1.25  1.50 1.75 0.80    3.60 2.30 1.35  4.80 2.20 0.90    1.70 2.75 1.60  0.70 3.90 1.10
"""


def build() -> Room:
    """Build a closed, furnished kitchen of 5 x 4 x 2.7 m."""
    room = RoomBuilder("kitchen", SIZE)
    steps = (shell, window, door, _north_run, _east_run, _worktops, _wall_cabinets, _fridge, _sideboard, _cooker, _sink, _seating)
    for step in (*steps, _lamps, *kitchen_things.STEPS, *kitchen_decor.STEPS):
        step(room)
    return room.finish(_SHOTS)


def build_matte() -> Room:
    """Build the same kitchen in matte paint: every roughness is 0.9, and nothing is metal."""
    room = build()
    paints = (replace(finish, roughness=(0.9, 0.0, 0.0), metallic=0.0) for finish in room.materials.materials)
    return replace(room, name="matte", materials=MaterialTable(tuple(paints)))


def _front(wall: str, start: float, stop: float, low: float, high: float) -> Shape:
    """Make a door or drawer front: from `start` to `stop` along its wall, from `low` to `high`."""
    near, far = {"north": (3.416, 3.437), "upper": (3.636, 3.657), "east": (4.416, 4.437)}[wall]
    start, low, stop, high = start + 0.003, low + 0.003, stop - 0.003, high - 0.003
    if wall == "east":
        return box((near, start, low), (far, stop, high), 0.004)
    return box((start, near, low), (stop, far, high), 0.004)


def _bow(a: tuple[float, float, float], b: tuple[float, float, float], out: tuple[float, float, float]) -> Shape:
    """Make a bar handle from `a` to `b` that stands off by `out`."""
    a, b, out = np.array(a), np.array(b), np.array(out)
    return tube([a, a + out, b + out, b], 0.006, 10)


def _north_run(room: RoomBuilder) -> None:
    low = box((0.78, 3.44, 0.10), (2.585, 3.975, 0.858)), box((3.215, 3.44, 0.10), (4.37, 3.975, 0.858))
    room.add("north cabinets", GREEN, *low)
    panels = [*((0.78, 1.38, *z) for z in DRAWERS), (1.38, 1.98, 0.11, 0.85), (1.98, 2.585, 0.11, 0.85)]
    panels += [(3.215, 3.82, 0.11, 0.48), (3.215, 3.82, 0.48, 0.85), (3.82, 4.37, 0.11, 0.85)]
    room.add("north fronts", GREEN, *(_front("north", *panel) for panel in panels))
    out = (0, -0.035, 0)
    bows = [_bow((0.98, 3.418, z), (1.18, 3.418, z), out) for z in DRAWER_HANDLES]
    bows += [_bow((x, 3.418, 0.62), (x, 3.418, 0.78), out) for x in (1.92, 2.04, 3.88)]
    bows += [_bow((3.42, 3.418, z), (3.62, 3.418, z), out) for z in (0.42, 0.79)]
    room.add("north handles", BRASS, *bows)


def _east_run(room: RoomBuilder) -> None:
    sides = (1.50, 1.925, 0.858), (2.575, 3.41, 0.858), (1.930, 2.570, 0.615)
    room.add("east cabinets", GREEN, *(box((4.44, y0, 0.10), (4.975, y1, top)) for y0, y1, top in sides))
    panels = [(1.50, 1.925, 0.11, 0.85), (1.93, 2.25, 0.11, 0.61), (2.25, 2.57, 0.11, 0.61)]
    panels += [(2.575, 3.385, *z) for z in DRAWERS]
    room.add("east fronts", GREEN, *(_front("east", *panel) for panel in panels))
    out = (-0.035, 0, 0)
    upright = (1.87, 0.62, 0.78), (2.20, 0.42, 0.56), (2.30, 0.42, 0.56)
    bows = [_bow((4.418, y, z0), (4.418, y, z1), out) for y, z0, z1 in upright]
    bows += [_bow((4.418, 2.88, z), (4.418, 3.08, z), out) for z in DRAWER_HANDLES]
    room.add("east handles", BRASS, *bows)


def _worktops(room: RoomBuilder) -> None:
    plinths = box((0.80, 3.50, 0.002), (4.42, 3.96, 0.099)), box((4.50, 1.52, 0.002), (4.96, 3.49, 0.099))
    room.add("plinths", plain("#3c4743", 0.6), *plinths)
    plan = (0.75, 3.392, 3.988), (4.388, 1.465, 1.928), (4.388, 2.572, 3.390), (4.872, 1.930, 2.570)
    room.add("worktop", MARBLE, *(box((x, y0, 0.861), (4.992, y1, 0.901), 0.005) for x, y0, y1 in plan))
    north, east = (tiles(axis, "#dfe6df", "#a9c0b6", at) for axis, at in (("y", (0.75, 3.98, 0.906)), ("x", (4.98, 1.47, 0.906))))
    room.add("north tiles", north, box((0.75, 3.984, 0.903), (4.980, 3.997, 1.446)))
    room.add("east tiles", east, box((4.984, 1.47, 0.903), (4.997, 3.982, 1.012)))


def _wall_cabinets(room: RoomBuilder) -> None:
    cream = plain("#e9e0cc", 0.40, "#e2d8c2", grain=2.0)
    room.add("wall cabinets", cream, box((0.82, 3.66, 1.45), (2.50, 3.985, 2.15)))
    room.add("wall cabinet fronts", cream, *(_front("upper", x, x + 0.56, 1.45, 2.15) for x in (0.82, 1.38, 1.94)))
    room.add("wall cabinet knobs", BRASS, *(sphere((x, 3.622, 1.53), 0.014, 12) for x in (1.33, 1.43, 2.45)))
    room.add("cornice", cream, box((0.79, 3.615, 2.152), (2.53, 3.99, 2.19), 0.01))
    room.add("north shelves", PLANK, *(box((3.30, 3.73, z), (4.90, 3.992, z + 0.03), 0.004) for z in (1.46, 1.86)))
    places = [(x, z) for x in (3.45, 4.08, 4.72) for z in (1.46, 1.86)]
    room.add("shelf brackets", IRON, *(tube([(x, 3.985, z - 0.10), (x, 3.78, z - 0.010)], 0.007, 8) for x, z in places))


def _fridge(room: RoomBuilder) -> None:
    room.add("fridge", STEEL, box((0.06, 3.34, 0.03), (0.70, 3.96, 1.92), 0.012))
    room.add("fridge doors", STEEL, *(box((0.063, 3.295, a), (0.697, 3.337, b), 0.010) for a, b in ((0.05, 0.70), (0.71, 1.915))))
    ends = (0.42, 0.66), (0.78, 1.20)
    room.add("fridge handles", CHROME, *(_bow((0.64, 3.297, a), (0.64, 3.297, b), (0, -0.05, 0)) for a, b in ends))


def _sideboard(room: RoomBuilder) -> None:
    case = box((1.25, 0.03, 0.14), (2.95, 0.43, 0.80)), box((1.22, 0.028, 0.802), (2.98, 0.465, 0.832), 0.006)
    legs = [tube([(x, y, 0.15), (x, y, 0.003)], (0.026, 0.016)) for x in (1.32, 2.88) for y in (0.09, 0.37)]
    room.add("sideboard", wood(WALNUT, WALNUT_DARK, EAST, UP, 0.38), *case, *legs)
    doors = [box((x + 0.003, 0.432, 0.155), (x + 0.562, 0.450, 0.790), 0.004) for x in (1.253, 1.817, 2.382)]
    room.add("sideboard doors", wood(OAK, OAK_DARK, UP, EAST, 0.38, origin=(0.3, 0.1, 0)), *doors)
    room.add("sideboard knobs", BRASS, *(sphere((x, 0.462, 0.50), 0.016, 12) for x in (1.77, 1.87, 2.43)))
    shelves = [box((1.45, 0.006, z), (2.85, 0.235, z + 0.028), 0.004) for z in (1.36, 1.76)]
    room.add("book shelves", PLANK, *shelves, *(box((x, 0.008, 1.39), (x + 0.024, 0.225, 1.758)) for x in (1.52, 2.756)))


def _cooker(room: RoomBuilder) -> None:
    case = box((2.600, 3.425, 0.105), (3.200, 3.96, 0.857), 0.004), box((2.602, 3.404, 0.715), (3.198, 3.424, 0.850), 0.004)
    room.add("oven", STEEL, *case)
    room.add("oven door", BLACK_GLASS, box((2.606, 3.400, 0.135), (3.194, 3.424, 0.700), 0.006))
    room.add("oven handle", CHROME, _bow((2.66, 3.402, 0.655), (3.14, 3.402, 0.655), (0, -0.045, 0)))
    knobs = [tube([(x, 3.405, 0.783), (x, 3.380, 0.783)], (0.022, 0.019), 16) for x in (2.70, 2.80, 2.90, 3.00, 3.10)]
    room.add("oven knobs", plain("#22242a", 0.35), *knobs)
    room.add("hob", BLACK_GLASS, box((2.615, 3.47, 0.903), (3.185, 3.93, 0.911), 0.003))
    burners = [(2.76, 3.58), (3.04, 3.58), (2.76, 3.81), (3.04, 3.81)]
    room.add("grates", IRON, *(part for x, y in burners for part in _grate(x, y)))
    room.add("burners", plain("#2b2b2e", 0.6), *(lathe(mm("0,0 35,0 30,12 0,14"), (x, y, 0.912)) for x, y in burners))
    room.add(
        "hood",
        STEEL,
        box((2.57, 3.44, 1.55), (3.23, 3.985, 1.602), 0.005),
        wedge((2.585, 3.455, 1.601), (3.215, 3.983, 1.601), (2.77, 3.68, 1.86), (3.03, 3.981, 1.86)),
        box((2.775, 3.685, 1.85), (3.025, 3.979, 2.715)),
    )


def _grate(x: float, y: float) -> list[Shape]:
    """Make the iron ring over a burner with its four bars and four feet."""
    bars = [box((x + a, y - 0.005, 0.934), (x + b, y + 0.005, 0.945)) for a, b in ((-0.10, -0.03), (0.03, 0.10))]
    bars += [box((x - 0.005, y + a, 0.9335), (x + 0.005, y + b, 0.9445)) for a, b in ((-0.10, -0.03), (0.03, 0.10))]
    corners = ((0.085, 0), (-0.085, 0), (0, 0.085), (0, -0.085))
    feet = [cylinder((x + dx, y + dy, 0.912), 0.006, 0.027, segments=8) for dx, dy in corners]
    return [ring((x, y, 0.938), 0.085, 0.006, EAST, NORTH, 20), *bars, *feet]


def _sink(room: RoomBuilder) -> None:
    room.add("sink", WHITE_GLAZE, tub((4.372, 1.932, 0.622), (4.868, 2.568, 0.896), 0.028, 0.035))
    room.add("drain", CHROME, lathe(mm("0,0 35,0 32,4 0,3"), (4.62, 2.25, 0.658)))
    turn = np.radians(np.linspace(15, 180, 8))[:, None]
    bend = np.array([4.84, 2.25, 1.16]) + 0.09 * (np.cos(turn) * np.array(EAST, float) + np.sin(turn) * np.array(UP, float))
    spout = tube([(4.93, 2.25, 0.90), (4.93, 2.25, 1.16), *bend, (4.75, 2.25, 1.10)], 0.013)
    path = (0.02, 0.955), (0.06, 0.96), (0.075, 1.0)
    levers = [tube([(4.93, 2.25 + s * out, z) for out, z in path], 0.008) for s in (-1, 1)]
    room.add("tap", CHROME, spout, cylinder((4.93, 2.25, 0.902), 0.026, 0.03, 0.004), *levers)


def _chair(x: float, y: float, sign: float, turn: float) -> tuple[list[Shape], Shape]:
    """Make the frame of a chair and its cushion at (x, y), the back on the side `sign` of y before a turn by `turn` degrees."""
    parts = [box((-0.20, -0.20, 0.425), (0.20, 0.20, 0.452), 0.006)]
    for u in (-0.17, 0.17):
        back = [(1.08 * u, 0.20 * sign, 0.002), (u, 0.178 * sign, 0.44), (0.97 * u, 0.225 * sign, 0.86)]
        parts.append(tube([(u, -0.17 * sign, 0.432), (1.08 * u, -0.19 * sign, 0.002)], (0.019, 0.014), 10))
        parts.append(tube(back, (0.014, 0.019, 0.015), 10))
    rails = (0.192 * sign, 0.208 * sign, 0.60, 0.05), (0.205 * sign, 0.222 * sign, 0.76, 0.075)
    parts += [box((-0.168, min(a, b), z), (0.168, max(a, b), z + h), 0.004) for a, b, z, h in rails]
    front, back = (-0.185, 0.150) if sign > 0 else (-0.150, 0.185)
    cushion = box((-0.185, front, 0.4535), (0.185, back, 0.487), 0.012)
    return [move(p, (x, y, 0), turn) for p in parts], move(cushion, (x, y, 0), turn)


def _seating(room: RoomBuilder) -> None:
    x0, x1, y0, y1 = 1.02, 2.48, 1.32, 2.18
    legs = []
    for x, y in ((x, y) for x in (x0 + 0.09, x1 - 0.09) for y in (y0 + 0.09, y1 - 0.09)):
        foot = (x - 0.022, y - 0.022, 0.014), (x + 0.022, y + 0.022, 0.014)
        legs.append(wedge(*foot, (x - 0.035, y - 0.035, 0.70), (x + 0.035, y + 0.035, 0.70)))
    rails = [box((x0 + 0.09, y, 0.64), (x1 - 0.09, y + 0.02, 0.715)) for y in (y0 + 0.08, y1 - 0.10)]
    rails += [box((x, y0 + 0.09, 0.641), (x + 0.02, y1 - 0.09, 0.716)) for x in (x0 + 0.08, x1 - 0.10)]
    top = wood(WALNUT, WALNUT_DARK, EAST, NORTH, 0.33, 7.0, origin=(0, 0, 0.21))
    room.add("table", top, box((x0, y0, 0.712), (x1, y1, 0.745), 0.008), *legs, *rails)
    cloth = (("#c58b2e", "#b87f27"), ("#3f6f86", "#38667c"))
    chairs = (1.38, 1.12, -1, 4), (2.12, 1.16, -1, -7), (1.42, 2.42, 1, -5), (2.16, 2.52, 1, 12)
    for number, (x, y, sign, turn) in enumerate(chairs, 1):
        parts, cushion = _chair(x, y, sign, turn)
        room.add(f"chair {number}", wood(BIRCH, BIRCH_DARK, UP, EAST, 0.40, 9.0, origin=(x, y, 0.1 * number)), *parts)
        light, dark = cloth[number % 2]
        room.add(f"cushion {number}", plain(light, 0.93, dark, grain=28.0), cushion)
    weave = {"size": (1.14, 0.90), "origin": (1.76, 1.76, 0.5), "roughness": 0.95, "grain": 24.0}
    rug = patterned("rug", "#a5483a", "#e0d2b4", "#33505c", **weave)
    room.add("rug", rug, box((0.62, 0.86, 0.001), (2.90, 2.66, 0.0125)))


def _lamps(room: RoomBuilder) -> None:
    x, y = LAMP
    shade = mm("0,214 26,212 50,192 115,134 184,48 209,0 215,0 190,50 120,140 55,200 30,232 0,235")
    parts = lathe(shade, (x, y, 1.62), 36), cylinder((x, y, 1.85), 0.018, 0.05, segments=12)
    room.add("hanging lamp", plain("#d39a2c", 0.28, "#cc9226"), *parts)
    parts = tube([(x, y, 1.895), (x, y, 2.67)], 0.005, 8), lathe(mm("0,0 30,0 55,28 0,30"), (x, y, 2.665))
    room.add("lamp cord", plain("#2c2c2e", 0.5), *parts)
    room.add_emitter("bulb", sphere((x, y, 1.662), 0.085, 16), radiance=(10.5, 8.2, 5.6))
    room.add("bulb socket", BRASS, cylinder((x, y, 1.744), 0.018, 0.092, segments=12))
    for number, (x, y) in enumerate(((3.35, 2.55), (3.35, 0.95)), 1):
        v, u = (y - 0.30, y + 0.30), (x - 0.315, x + 0.315)
        frame = [box((x - 0.33, c - 0.015, 2.655), (x + 0.33, c + 0.015, 2.698), 0.003) for c in v]
        frame += [box((c - 0.015, y - 0.283, 2.656), (c + 0.015, y + 0.283, 2.697), 0.003) for c in u]
        room.add(f"ceiling panel frame {number}", WHITE_PAINT, *frame)
        panel = sheet((x - 0.322, y + 0.307, 2.652), (0.644, 0, 0), (0, -0.614, 0), 0.33)
        room.add_emitter(f"ceiling panel {number}", panel, radiance=(9.6, 8.7, 7.3))
    room.add("cabinet light body", WHITE_PAINT, box((0.94, 3.722, 1.4385), (2.39, 3.808, 1.449), 0.003))
    strip = sheet((0.95, 3.80, 1.438), (1.43, 0, 0), (0, -0.07, 0), 0.25)
    room.add_emitter("cabinet light", strip, radiance=(4.2, 3.5, 2.5))
