"""The smallest room with everything in it: texture, gloss, metal, two emitters, eight objects. For tests."""

from __future__ import annotations

from workflow.sources.rooms.palette import BRASS, EAST, OAK, OAK_DARK, UP, paint, plain, wood
from workflow.sources.rooms.patterns import Material
from workflow.sources.rooms.room import Room, RoomBuilder
from workflow.sources.rooms.shapes import box, merge, sheet, sphere

SIZE = (3.0, 2.6, 2.2)
_OVER = 0.02  # walls reach past their corners, so that no ray slips through


def build() -> Room:
    """A closed room of 3 x 2.6 x 2.2 m: shell, floor, two boxes, a metal sphere, a rug, two lamps."""
    x, y, z = SIZE
    o = _OVER
    room = RoomBuilder("tiny", SIZE)
    room.add(
        "floor",
        sheet((-o, -o, 0), (x + 2 * o, 0, 0), (0, y + 2 * o, 0)),
        is_part=False,
        material=Material(
            paint("#c9b494"),
            paint("#8d6a49"),
            roughness=(0.45, 0.1, 0.1),
            kind="checks",
            size=(0.5, 0.5),
            origin=(0.1, 0.05, 0),
        ),
    )
    room.add(
        "walls",
        merge(
            sheet((-o, y, -o), (x + 2 * o, 0, 0), (0, 0, z + 2 * o)),
            sheet((x + o, 0, -o), (-x - 2 * o, 0, 0), (0, 0, z + 2 * o)),
            sheet((0, -o, -o), (0, y + 2 * o, 0), (0, 0, z + 2 * o)),
            sheet((x, y + o, -o), (0, -y - 2 * o, 0), (0, 0, z + 2 * o)),
            sheet((-o, y + o, z), (x + 2 * o, 0, 0), (0, -y - 2 * o, 0)),
        ),
        material=plain("#dcd5c6", 0.85, "#cbbfa9", grain=2.0),
        is_part=False,
    )
    room.add("chest", box((1.9, 1.7, 0.001), (2.7, 2.4, 0.8), 0.02), material=wood(OAK, OAK_DARK, EAST, UP))
    room.add("crate", box((0.4, 1.6, 0.001), (0.95, 2.2, 0.5), 0.02), material=plain("#b5473a", 0.25, "#8f2f28"))
    room.add("ball", sphere((2.2, 2.0, 0.962), 0.16), material=BRASS)
    room.add(
        "rug",
        box((0.7, 0.5, 0.001), (2.2, 1.4, 0.012)),
        material=Material(
            paint("#3f6675"),
            paint("#d9cda9"),
            paint("#c2783f"),
            roughness=(0.95, 0, 0),
            kind="stripes",
            size=(0.15, 0.125),
            origin=(0, 0.01, 0),
        ),
    )
    room.add_emitter("ceiling lamp", box((1.2, 1.0, 2.15), (1.8, 1.6, 2.18)), radiance=(9.0, 8.0, 6.5))
    room.add_emitter("wall lamp", box((0.02, 0.6, 1.3), (0.06, 0.9, 1.7)), radiance=(4.0, 5.0, 6.5))
    return room.finish(
        [
            ((0.4, 0.3, 1.0), (2.2, 2.2, 1.4)),
            ((2.6, 0.4, 1.4), (0.5, 2.0, 0.6)),
            ((1.4, 0.5, 1.2), (1.5, 2.4, 0.9)),
            ((0.4, 2.3, 1.1), (2.4, 0.7, 1.5)),
            ((2.7, 2.4, 1.6), (0.4, 0.5, 0.7)),
            ((1.5, 0.4, 1.7), (1.3, 2.0, 0.1)),
            ((1.4, 2.3, 1.3), (1.5, 0.3, 1.2)),
            ((0.4, 1.2, 1.0), (2.6, 1.6, 1.0)),
        ]
    )
