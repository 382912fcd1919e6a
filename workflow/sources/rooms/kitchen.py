"""The kitchen: fitted furniture and lamps here, walls in `kitchen_shell`, loose things in `kitchen_things` and `kitchen_decor`.

Plan (x east, y north, z up, metres; the room is 5 x 4 x 2.7):

    north wall   fridge | drawers, doors, oven with hob and hood, doors | corner; open shelves on the right
    east wall    worktop with a ceramic sink under the window
    south wall   sideboard under a shelf of books, door
    west wall    picture, clock
    middle       table with four chairs on a rug, under a hanging lamp

Parts that touch keep a gap of 1 to 2 mm or pass through each other: no two surfaces lie in one plane.
"""

from __future__ import annotations

import numpy as np

from workflow.sources.rooms import kitchen_things
from workflow.sources.rooms.kitchen_shell import SIZE, door, shell, window
from workflow.sources.rooms.palette import (
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
    paint,
    plain,
    tiles,
    wood,
)
from workflow.sources.rooms.patterns import Material
from workflow.sources.rooms.room import Room, RoomBuilder
from workflow.sources.rooms.shapes import Shape, arc, box, cylinder, lathe, mm, move, ring, sheet, sphere, tub, tube, wedge

LAMP = (1.75, 1.75)


def build() -> Room:
    """A closed, furnished kitchen of 5 x 4 x 2.7 m."""
    room = RoomBuilder("kitchen", SIZE)
    shell(room)
    window(room)
    door(room)
    _fitted(room)
    _cooker(room)
    _sink(room)
    _seating(room)
    _lamps(room)
    kitchen_things.furnish(room)
    return room.finish(SHOTS)


def _front(low: tuple[float, float], high: tuple[float, float], wall: str) -> Shape:
    """A door or drawer front in the plane of its run: (along, z) corners."""
    if wall == "north":
        return box((low[0] + 0.003, 3.416, low[1] + 0.003), (high[0] - 0.003, 3.437, high[1] - 0.003), 0.004)
    if wall == "upper":
        return box((low[0] + 0.003, 3.636, low[1] + 0.003), (high[0] - 0.003, 3.657, high[1] - 0.003), 0.004)
    return box((4.416, low[0] + 0.003, low[1] + 0.003), (4.437, high[0] - 0.003, high[1] - 0.003), 0.004)


def _bow(a: tuple[float, float, float], b: tuple[float, float, float], out: tuple[float, float, float]) -> Shape:
    """A bar handle from a to b that stands off by `out`."""
    a, b, out = np.array(a), np.array(b), np.array(out)
    return tube([a, a + out, b + out, b], 0.006, 10)


def _fitted(room: RoomBuilder) -> None:
    green = plain("#5c7d70", 0.40, "#557669", grain=2.0)
    cream = plain("#e9e0cc", 0.40, "#e2d8c2", grain=2.0)
    room.add(
        "north cabinets",
        box((0.78, 3.44, 0.10), (2.585, 3.975, 0.858)),
        box((3.215, 3.44, 0.10), (4.37, 3.975, 0.858)),
        material=green,
    )
    fronts = [_front((0.78, z0), (1.38, z1), "north") for z0, z1 in ((0.11, 0.38), (0.38, 0.63), (0.63, 0.85))]
    fronts += [_front((x0, 0.11), (x1, 0.85), "north") for x0, x1 in ((1.38, 1.98), (1.98, 2.585))]
    fronts += [_front((3.215, z0), (3.82, z1), "north") for z0, z1 in ((0.11, 0.48), (0.48, 0.85))]
    fronts += [_front((3.82, 0.11), (4.37, 0.85), "north")]
    room.add("north fronts", *fronts, material=green)
    out = (0, -0.035, 0)
    bows = [_bow((0.98, 3.418, z), (1.18, 3.418, z), out) for z in (0.32, 0.57, 0.79)]
    bows += [_bow((x, 3.418, 0.62), (x, 3.418, 0.78), out) for x in (1.92, 2.04, 3.88)]
    bows += [_bow((3.42, 3.418, z), (3.62, 3.418, z), out) for z in (0.42, 0.79)]
    room.add("north handles", *bows, material=BRASS)

    room.add(
        "east cabinets",
        box((4.44, 1.50, 0.10), (4.975, 1.925, 0.858)),
        box((4.44, 2.575, 0.10), (4.975, 3.41, 0.858)),
        box((4.44, 1.930, 0.10), (4.975, 2.570, 0.615)),
        material=green,
    )
    fronts = [
        _front((1.50, 0.11), (1.925, 0.85), "east"),
        _front((1.93, 0.11), (2.25, 0.61), "east"),
        _front((2.25, 0.11), (2.57, 0.61), "east"),
    ]
    fronts += [_front((2.575, z0), (3.385, z1), "east") for z0, z1 in ((0.11, 0.38), (0.38, 0.63), (0.63, 0.85))]
    room.add("east fronts", *fronts, material=green)
    out = (-0.035, 0, 0)
    bows = [
        _bow((4.418, y, z0), (4.418, y, z1), out) for y, z0, z1 in ((1.87, 0.62, 0.78), (2.20, 0.42, 0.56), (2.30, 0.42, 0.56))
    ]
    bows += [_bow((4.418, 2.88, z), (4.418, 3.08, z), out) for z in (0.32, 0.57, 0.79)]
    room.add("east handles", *bows, material=BRASS)
    room.add(
        "plinths",
        box((0.80, 3.50, 0.002), (4.42, 3.96, 0.099)),
        box((4.50, 1.52, 0.002), (4.96, 3.49, 0.099)),
        material=plain("#3c4743", 0.6),
    )

    room.add(
        "worktop",
        box((0.75, 3.392, 0.861), (4.992, 3.988, 0.901), 0.005),
        box((4.388, 1.465, 0.861), (4.992, 1.928, 0.901), 0.005),
        box((4.388, 2.572, 0.861), (4.992, 3.390, 0.901), 0.005),
        box((4.872, 1.930, 0.861), (4.992, 2.570, 0.901), 0.005),
        material=MARBLE,
    )
    room.add(
        "north tiles",
        box((0.75, 3.984, 0.903), (4.980, 3.997, 1.446)),
        material=tiles("y", "#dfe6df", "#a9c0b6", (0.75, 3.98, 0.906)),
    )
    room.add(
        "east tiles",
        box((4.984, 1.47, 0.903), (4.997, 3.982, 1.012)),
        material=tiles("x", "#dfe6df", "#a9c0b6", (4.98, 1.47, 0.906)),
    )

    room.add("wall cabinets", box((0.82, 3.66, 1.45), (2.50, 3.985, 2.15)), material=cream)
    room.add(
        "wall cabinet fronts",
        *(_front((x, 1.45), (x + 0.56, 2.15), "upper") for x in (0.82, 1.38, 1.94)),
        material=cream,
    )
    room.add(
        "wall cabinet knobs",
        *(sphere((x, 3.622, 1.53), 0.014, 12) for x in (1.33, 1.43, 2.45)),
        material=BRASS,
    )
    room.add("cornice", box((0.79, 3.615, 2.152), (2.53, 3.99, 2.19), 0.01), material=cream)
    plank = wood(BIRCH, BIRCH_DARK, EAST, NORTH, 0.40, origin=(0, 0, 0.3))
    room.add(
        "north shelves",
        *(box((3.30, 3.73, z), (4.90, 3.992, z + 0.03), 0.004) for z in (1.46, 1.86)),
        material=plank,
    )
    room.add(
        "shelf brackets",
        *(tube([(x, 3.985, z - 0.10), (x, 3.78, z - 0.010)], 0.007, 8) for x in (3.45, 4.08, 4.72) for z in (1.46, 1.86)),
        material=IRON,
    )

    room.add("fridge", box((0.06, 3.34, 0.03), (0.70, 3.96, 1.92), 0.012), material=STEEL)
    room.add(
        "fridge doors",
        box((0.063, 3.295, 0.05), (0.697, 3.337, 0.70), 0.010),
        box((0.063, 3.295, 0.71), (0.697, 3.337, 1.915), 0.010),
        material=STEEL,
    )
    room.add(
        "fridge handles",
        _bow((0.64, 3.297, 0.42), (0.64, 3.297, 0.66), (0, -0.05, 0)),
        _bow((0.64, 3.297, 0.78), (0.64, 3.297, 1.20), (0, -0.05, 0)),
        material=CHROME,
    )

    walnut = wood(WALNUT, WALNUT_DARK, EAST, UP, 0.38)
    room.add(
        "sideboard",
        box((1.25, 0.03, 0.14), (2.95, 0.43, 0.80)),
        box((1.22, 0.028, 0.802), (2.98, 0.465, 0.832), 0.006),
        *(tube([(x, y, 0.15), (x, y, 0.003)], (0.026, 0.016)) for x in (1.32, 2.88) for y in (0.09, 0.37)),
        material=walnut,
    )
    room.add(
        "sideboard doors",
        *(box((x + 0.003, 0.432, 0.155), (x + 0.562, 0.450, 0.790), 0.004) for x in (1.253, 1.817, 2.382)),
        material=wood(OAK, OAK_DARK, UP, EAST, 0.38, origin=(0.3, 0.1, 0)),
    )
    room.add("sideboard knobs", *(sphere((x, 0.462, 0.50), 0.016, 12) for x in (1.77, 1.87, 2.43)), material=BRASS)
    room.add(
        "book shelves",
        *(box((1.45, 0.006, z), (2.85, 0.235, z + 0.028), 0.004) for z in (1.36, 1.76)),
        *(box((x, 0.008, 1.39), (x + 0.024, 0.225, 1.758)) for x in (1.52, 2.756)),
        material=plank,
    )


def _cooker(room: RoomBuilder) -> None:
    room.add(
        "oven",
        box((2.600, 3.425, 0.105), (3.200, 3.96, 0.857), 0.004),
        box((2.602, 3.404, 0.715), (3.198, 3.424, 0.850), 0.004),
        material=STEEL,
    )
    room.add("oven door", box((2.606, 3.400, 0.135), (3.194, 3.424, 0.700), 0.006), material=BLACK_GLASS)
    room.add("oven handle", _bow((2.66, 3.402, 0.655), (3.14, 3.402, 0.655), (0, -0.045, 0)), material=CHROME)
    knobs = []
    for x in (2.70, 2.80, 2.90, 3.00, 3.10):
        knobs.append(tube([(x, 3.405, 0.783), (x, 3.380, 0.783)], (0.022, 0.019), 16))
    room.add("oven knobs", *knobs, material=plain("#22242a", 0.35))
    room.add("hob", box((2.615, 3.47, 0.903), (3.185, 3.93, 0.911), 0.003), material=BLACK_GLASS)
    burners = [(2.76, 3.58), (3.04, 3.58), (2.76, 3.81), (3.04, 3.81)]
    grates = []
    for x, y in burners:
        grates.append(ring((x, y, 0.938), 0.085, 0.006, EAST, NORTH, 20))
        grates += [
            box((x - 0.10, y - 0.005, 0.934), (x - 0.03, y + 0.005, 0.945)),
            box((x + 0.03, y - 0.005, 0.934), (x + 0.10, y + 0.005, 0.945)),
            box((x - 0.005, y - 0.10, 0.9335), (x + 0.005, y - 0.03, 0.9445)),
            box((x - 0.005, y + 0.03, 0.9335), (x + 0.005, y + 0.10, 0.9445)),
        ]
        grates += [
            cylinder((x + dx, y + dy, 0.912), 0.006, 0.027, segments=8)
            for dx, dy in ((0.085, 0), (-0.085, 0), (0, 0.085), (0, -0.085))
        ]
    room.add("grates", *grates, material=IRON)
    room.add(
        "burners",
        *(lathe(mm("0,0 35,0 30,12 0,14"), (x, y, 0.912)) for x, y in burners),
        material=plain("#2b2b2e", 0.6),
    )
    room.add(
        "hood",
        box((2.57, 3.44, 1.55), (3.23, 3.985, 1.602), 0.005),
        wedge((2.585, 3.455, 1.601), (3.215, 3.983, 1.601), (2.77, 3.68, 1.86), (3.03, 3.981, 1.86)),
        box((2.775, 3.685, 1.85), (3.025, 3.979, 2.715)),
        material=STEEL,
    )


def _sink(room: RoomBuilder) -> None:
    room.add("sink", tub((4.372, 1.932, 0.622), (4.868, 2.568, 0.896), 0.028, 0.035), material=WHITE_GLAZE)
    room.add("drain", lathe(mm("0,0 35,0 32,4 0,3"), (4.62, 2.25, 0.658)), material=CHROME)
    spout = [
        (4.93, 2.25, 0.90),
        (4.93, 2.25, 1.16),
        *arc((4.84, 2.25, 1.16), 0.09, 15, 180, EAST, UP),
        (4.75, 2.25, 1.10),
    ]
    room.add(
        "tap",
        tube(spout, 0.013),
        cylinder((4.93, 2.25, 0.902), 0.026, 0.03, 0.004),
        *(
            tube(
                [
                    (4.93, 2.25 + s * 0.02, 0.955),
                    (4.93, 2.25 + s * 0.06, 0.96),
                    (4.93, 2.25 + s * 0.075, 1.0),
                ],
                0.008,
            )
            for s in (-1, 1)
        ),
        material=CHROME,
    )


def _chair(x: float, y: float, sign: float, turn: float) -> tuple[list[Shape], Shape]:
    """Chair parts and its cushion; the back is on the side `sign` of y."""
    parts = [box((-0.20, -0.20, 0.425), (0.20, 0.20, 0.452), 0.006)]
    for u in (-0.17, 0.17):
        parts.append(tube([(u, -0.17 * sign, 0.432), (1.08 * u, -0.19 * sign, 0.002)], (0.019, 0.014), 10))
        parts.append(
            tube(
                [(1.08 * u, 0.20 * sign, 0.002), (u, 0.178 * sign, 0.44), (0.97 * u, 0.225 * sign, 0.86)],
                (0.014, 0.019, 0.015),
                10,
            )
        )
    parts += [
        box((-0.168, min(a, b), z), (0.168, max(a, b), z + h), 0.004)
        for a, b, z, h in (
            (0.192 * sign, 0.208 * sign, 0.60, 0.05),
            (0.205 * sign, 0.222 * sign, 0.76, 0.075),
        )
    ]
    front, back = (-0.185, 0.150) if sign > 0 else (-0.150, 0.185)
    cushion = box((-0.185, front, 0.4535), (0.185, back, 0.487), 0.012)
    return [move(p, (x, y, 0), turn) for p in parts], move(cushion, (x, y, 0), turn)


def _seating(room: RoomBuilder) -> None:
    x0, x1, y0, y1 = 1.02, 2.48, 1.32, 2.18
    top = wood(WALNUT, WALNUT_DARK, EAST, NORTH, 0.33, 7.0, origin=(0, 0, 0.21))
    legs = [
        wedge(
            (x - 0.022, y - 0.022, 0.014),
            (x + 0.022, y + 0.022, 0.014),
            (x - 0.035, y - 0.035, 0.70),
            (x + 0.035, y + 0.035, 0.70),
        )
        for x in (x0 + 0.09, x1 - 0.09)
        for y in (y0 + 0.09, y1 - 0.09)
    ]
    rails = [box((x0 + 0.09, y, 0.64), (x1 - 0.09, y + 0.02, 0.715)) for y in (y0 + 0.08, y1 - 0.10)]
    rails += [box((x, y0 + 0.09, 0.641), (x + 0.02, y1 - 0.09, 0.716)) for x in (x0 + 0.08, x1 - 0.10)]
    room.add("table", box((x0, y0, 0.712), (x1, y1, 0.745), 0.008), *legs, *rails, material=top)
    cloth = (("#c58b2e", "#b87f27"), ("#3f6f86", "#38667c"))
    for number, (x, y, sign, turn) in enumerate(
        ((1.38, 1.12, -1, 4), (2.12, 1.16, -1, -7), (1.42, 2.42, 1, -5), (2.16, 2.52, 1, 12)), 1
    ):
        parts, cushion = _chair(x, y, sign, turn)
        room.add(
            f"chair {number}",
            *parts,
            material=wood(BIRCH, BIRCH_DARK, UP, EAST, 0.40, 9.0, origin=(x, y, 0.1 * number)),
        )
        light, dark = cloth[number % 2]
        room.add(
            f"cushion {number}",
            cushion,
            material=Material(paint(light), paint(dark), roughness=(0.93, 0, 0), grain=(28.0, 28.0, 28.0)),
        )
    room.add(
        "rug",
        box((0.62, 0.86, 0.001), (2.90, 2.66, 0.0125)),
        material=Material(
            paint("#a5483a"),
            paint("#e0d2b4"),
            paint("#33505c"),
            roughness=(0.95, 0, 0),
            kind="rug",
            size=(1.14, 0.90),
            origin=(1.76, 1.76, 0.5),
            grain=(24.0, 24.0, 24.0),
        ),
    )


def _lamps(room: RoomBuilder) -> None:
    lx, ly = LAMP
    shade = [
        (0, 0.235),
        (0.03, 0.232),
        (0.055, 0.20),
        (0.12, 0.14),
        (0.19, 0.05),
        (0.215, 0.0),
        (0.209, 0.0),
        (0.184, 0.048),
        (0.115, 0.134),
        (0.05, 0.192),
        (0.026, 0.212),
        (0, 0.214),
    ]
    outward = [(r, z) for r, z in reversed(shade)]
    room.add(
        "hanging lamp",
        lathe(outward, (lx, ly, 1.62), 36),
        cylinder((lx, ly, 1.85), 0.018, 0.05, segments=12),
        material=plain("#d39a2c", 0.28, "#cc9226"),
    )
    room.add(
        "lamp cord",
        tube([(lx, ly, 1.895), (lx, ly, 2.67)], 0.005, 8),
        lathe(mm("0,0 30,0 55,28 0,30"), (lx, ly, 2.665)),
        material=plain("#2c2c2e", 0.5),
    )
    room.add_emitter("bulb", sphere((lx, ly, 1.662), 0.085, 16), radiance=(10.5, 8.2, 5.6))
    room.add("bulb socket", cylinder((lx, ly, 1.744), 0.018, 0.092, segments=12), material=BRASS)
    for number, (x, y) in enumerate(((3.35, 2.55), (3.35, 0.95)), 1):
        frame = [box((x - 0.33, y + s * 0.30 - 0.015, 2.655), (x + 0.33, y + s * 0.30 + 0.015, 2.698), 0.003) for s in (-1, 1)]
        frame += [
            box((x + s * 0.315 - 0.015, y - 0.283, 2.656), (x + s * 0.315 + 0.015, y + 0.283, 2.697), 0.003) for s in (-1, 1)
        ]
        room.add(f"ceiling panel frame {number}", *frame, material=WHITE_PAINT)
        room.add_emitter(
            f"ceiling panel {number}",
            sheet((x - 0.322, y + 0.307, 2.652), (0.644, 0, 0), (0, -0.614, 0), 0.33),
            radiance=(9.6, 8.7, 7.3),
        )
    room.add("cabinet light body", box((0.94, 3.722, 1.4385), (2.39, 3.808, 1.449), 0.003), material=WHITE_PAINT)
    room.add_emitter(
        "cabinet light",
        sheet((0.95, 3.80, 1.438), (1.43, 0, 0), (0, -0.07, 0), 0.25),
        radiance=(4.2, 3.5, 2.5),
    )


# (position, target), ordered so that each view adds the most surface that fewer than two views have seen.


SHOTS = (
    ((0.45, 1.90, 1.55), (4.90, 2.20, 1.10)),
    ((0.70, 2.95, 1.60), (4.20, 0.80, 0.80)),
    ((4.10, 3.10, 1.60), (0.90, 0.90, 0.90)),
    ((4.05, 0.60, 1.60), (1.30, 3.40, 0.90)),
    ((0.55, 0.95, 1.60), (3.60, 3.40, 0.95)),
    ((3.40, 2.90, 1.90), (2.00, 0.30, 1.60)),
    ((2.90, 1.00, 2.10), (1.70, 3.70, 1.80)),
    ((3.60, 3.00, 1.15), (1.50, 1.50, 0.60)),
    ((0.60, 1.30, 1.20), (2.20, 2.60, 0.60)),
    ((1.20, 2.95, 1.80), (2.60, 0.10, 1.10)),
    ((0.95, 3.00, 1.45), (4.90, 3.60, 1.10)),
    ((3.30, 0.85, 0.95), (1.20, 2.20, 0.60)),
    ((2.70, 3.05, 0.90), (1.70, 1.20, 0.30)),
    ((3.95, 3.05, 2.10), (2.40, 1.20, 2.30)),
    ((2.50, 0.75, 1.55), (2.60, 3.90, 1.00)),
    ((0.50, 2.50, 1.10), (2.80, 1.20, 0.50)),
    ((2.70, 0.80, 1.90), (4.60, 2.60, 0.30)),
    ((3.60, 1.90, 1.50), (0.10, 2.00, 1.20)),
    ((1.10, 2.80, 2.20), (3.20, 1.60, 2.40)),
    ((3.80, 0.70, 1.10), (2.70, 1.90, 0.30)),
    ((0.95, 3.05, 1.15), (0.30, 1.40, 0.60)),
    ((0.50, 1.60, 1.80), (1.90, 3.70, 1.00)),
    ((1.00, 0.95, 1.60), (0.10, 2.40, 1.60)),
    ((2.20, 2.95, 2.10), (1.80, 1.30, 0.40)),
    ((4.05, 1.15, 1.50), (4.70, 3.30, 1.00)),
    ((4.10, 2.10, 1.55), (2.20, 0.20, 0.90)),
    ((1.15, 0.80, 1.75), (4.00, 0.20, 0.90)),
    ((0.80, 2.20, 1.90), (0.40, 0.40, 0.80)),
    ((4.05, 2.95, 1.40), (4.80, 1.50, 1.00)),
    ((0.70, 2.60, 1.35), (1.90, 1.60, 0.70)),
    ((2.90, 3.00, 1.25), (0.50, 3.60, 1.00)),
    ((2.60, 2.30, 1.30), (3.50, 3.90, 1.60)),
    ((3.95, 1.60, 1.80), (0.40, 3.60, 0.50)),
    ((0.60, 1.75, 1.15), (2.00, 1.80, 0.80)),
    ((2.60, 3.05, 1.60), (2.30, 0.20, 0.90)),
    ((3.20, 0.75, 1.70), (0.30, 0.40, 0.70)),
    ((3.85, 2.50, 1.50), (4.30, 3.90, 1.40)),
    ((4.05, 1.80, 1.20), (3.60, 0.10, 0.70)),
    ((3.30, 2.20, 1.55), (2.95, 3.90, 1.05)),
    ((1.60, 2.60, 1.40), (2.40, 3.80, 0.80)),
    ((3.10, 3.05, 1.70), (4.90, 0.90, 0.90)),
    ((2.95, 2.70, 1.45), (1.60, 1.60, 0.75)),
    ((3.50, 2.60, 1.35), (2.70, 3.80, 0.70)),
    ((3.50, 1.75, 1.45), (3.90, 0.00, 1.10)),
    ((2.30, 1.30, 1.40), (2.30, 0.10, 1.20)),
    ((3.20, 1.60, 1.50), (4.90, 2.40, 1.00)),
    ((2.10, 1.20, 1.70), (0.00, 1.75, 1.45)),
    ((1.40, 1.15, 1.35), (1.90, 0.10, 1.00)),
    ((3.00, 1.50, 1.50), (1.90, 0.10, 1.05)),
    ((2.30, 1.15, 1.50), (4.60, 0.90, 0.50)),
    ((1.90, 2.30, 1.50), (1.50, 3.90, 1.20)),
    ((2.85, 1.75, 1.25), (1.50, 1.75, 0.80)),
    ((3.60, 2.30, 1.35), (4.80, 2.20, 0.90)),
    ((1.70, 2.75, 1.60), (0.70, 3.90, 1.10)),
)
