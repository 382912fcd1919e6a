"""The smallest room with everything in it: texture, gloss, metal, two emitters, eight objects. It serves the tests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

from lab.rooms.palette import BRASS, EAST, OAK, OAK_DARK, UP, paint, patterned, plain, wood
from lab.rooms.patterns import Material
from lab.rooms.room import Room, RoomBuilder
from lab.rooms.shapes import box, merge, sheet, sphere

SIZE = (3.0, 2.6, 2.2)
_OVERLAP = 0.02  # metres by which walls reach past their corners, so that no ray slips through

_SHOTS = """
0.4 0.3 1.0  2.2 2.2 1.4    2.6 0.4 1.4  0.5 2.0 0.6    1.4 0.5 1.2  1.5 2.4 0.9    0.4 2.3 1.1  2.4 0.7 1.5
2.7 2.4 1.6  0.4 0.5 0.7    1.5 0.4 1.7  1.3 2.0 0.1    1.4 2.3 1.3  1.5 0.3 1.2    0.4 1.2 1.0  2.6 1.6 1.0
"""


class Look(NamedTuple):
    """Materials of the room that an extreme replaces; `lamp`: a single square one, its edge in metres and radiance."""

    floor: Material | None = None
    walls: Material | None = None
    chest: Material | None = None
    crate: Material | None = None
    ball: Material | None = None
    rug: Material | None = None
    lamp: tuple[float, tuple[float, float, float]] | None = None


USUAL = Look()


def build(look: Look = USUAL) -> Room:
    """Build a closed room of 3 x 2.6 x 2.2 m: shell, floor, two boxes, a metal sphere, a rug, two lamps."""
    x, y, z = SIZE
    o = _OVERLAP
    room = RoomBuilder("tiny", SIZE)
    checks = {"roughness": (0.45, 0.1, 0.1), "kind": "checks", "size": (0.5, 0.5), "origin": (0.1, 0.05, 0)}
    boards = Material(paint("#c9b494"), paint("#8d6a49"), **checks)
    room.add("floor", look.floor or boards, sheet((-o, -o, 0), (x + 2 * o, 0, 0), (0, y + 2 * o, 0)), is_part=False)
    walls = merge(
        sheet((-o, y, -o), (x + 2 * o, 0, 0), (0, 0, z + 2 * o)),
        sheet((x + o, 0, -o), (-x - 2 * o, 0, 0), (0, 0, z + 2 * o)),
        sheet((0, -o, -o), (0, y + 2 * o, 0), (0, 0, z + 2 * o)),
        sheet((x, y + o, -o), (0, -y - 2 * o, 0), (0, 0, z + 2 * o)),
        sheet((-o, y + o, z), (x + 2 * o, 0, 0), (0, -y - 2 * o, 0)),
    )
    room.add("walls", look.walls or plain("#dcd5c6", 0.85, "#cbbfa9", grain=2.0), walls, is_part=False)
    room.add("chest", look.chest or wood(OAK, OAK_DARK, EAST, UP), box((1.9, 1.7, 0.001), (2.7, 2.4, 0.8), 0.02))
    room.add("crate", look.crate or plain("#b5473a", 0.25, "#8f2f28"), box((0.4, 1.6, 0.001), (0.95, 2.2, 0.5), 0.02))
    room.add("ball", look.ball or BRASS, sphere((2.2, 2.0, 0.962), 0.16))
    stripes = {"size": (0.15, 0.125), "origin": (0, 0.01, 0), "roughness": 0.95}
    rug = patterned("stripes", "#3f6675", "#d9cda9", "#c2783f", **stripes)
    room.add("rug", look.rug or rug, box((0.7, 0.5, 0.001), (2.2, 1.4, 0.012)))
    if look.lamp is not None:
        edge, radiance = look.lamp
        room.add_emitter("lamp", sheet((1.5, 1.3 + edge, 2.15), (edge, 0, 0), (0, -edge, 0)), radiance=radiance)
        return room.finish(_SHOTS)
    room.add_emitter("ceiling lamp", box((1.2, 1.0, 2.15), (1.8, 1.6, 2.18)), radiance=(9.0, 8.0, 6.5))
    room.add_emitter("wall lamp", box((0.02, 0.6, 1.3), (0.06, 0.9, 1.7)), radiance=(4.0, 5.0, 6.5))
    return room.finish(_SHOTS)


def _gloss() -> Room:
    matte, mirror, brass = plain("#a8826b", 1.0), plain("#b5473a", 0.02), plain("#d9b25f", 0.02, metallic=1)
    return build(Look(chest=matte, crate=mirror, ball=brass))


def _black_metal() -> Room:
    return build(Look(crate=plain("#000000", 0.3, metallic=1), ball=plain("#000000", 0.6, metallic=1)))


def _white() -> Room:
    paint = plain("#f9f9f9", 0.9)  # 0.95; with 0.98 and gloss a surface returns what it receives, and no light is lost
    return replace(build(Look(*6 * (paint,), lamp=(0.3, (9.0, 8.0, 6.5)))), max_bounces=400)


def _lamp() -> Room:
    return build(Look(lamp=(0.02, (1e6, 0.9e6, 0.8e6))))


EXTREMES: dict[str, Callable[[], Room]] = {
    "tiny-gloss": _gloss,
    "tiny-black-metal": _black_metal,
    "tiny-white": _white,
    "tiny-lamp": _lamp,
}
"""The room at the ends of what materials and lamps may be: perceptual roughness 0.02 and 1, metal of base colour 0, albedo 0.95
everywhere, and a lamp of 4 cm^2 with a radiance of 10^6."""
