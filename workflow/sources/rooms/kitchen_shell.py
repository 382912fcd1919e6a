"""The kitchen's walls, floor and ceiling, its window and its door."""

from __future__ import annotations

import numpy as np

from workflow.sources.rooms.palette import BRASS, FLOOR, MARBLE, WHITE_PAINT, plain
from workflow.sources.rooms.room import RoomBuilder
from workflow.sources.rooms.shapes import box, grid_sheet, sheet, tube

SIZE = (5.0, 4.0, 2.7)
WINDOW = (1.55, 2.95, 1.03, 2.17)  # y0, y1, z0, z1 of the hole in the east wall
_OVER = 0.02  # walls reach past their corners, so that no ray slips through
_REVEAL = 0.15


def shell(room: RoomBuilder) -> None:
    """Floor, ceiling, walls and skirting."""
    x, y, z = SIZE
    o, step = _OVER, 0.25
    wall = plain("#e6dccb", 0.85, "#ddd1bd", grain=1.6, vary=0.08)
    room.add("floor", sheet((-o, -o, 0), (x + 2 * o, 0, 0), (0, y + 2 * o, 0), step), material=FLOOR, is_part=False)
    room.add(
        "ceiling",
        sheet((-o, y + o, z), (x + 2 * o, 0, 0), (0, -y - 2 * o, 0), step),
        material=plain("#eeeae2", 0.9, "#e8e3d9", grain=1.2),
        is_part=False,
    )
    room.add(
        "north wall",
        sheet((-o, y, -o), (x + 2 * o, 0, 0), (0, 0, z + 2 * o), step),
        material=wall,
        is_part=False,
    )
    room.add(
        "south wall",
        sheet((x + o, 0, -o), (-x - 2 * o, 0, 0), (0, 0, z + 2 * o), step),
        material=wall,
        is_part=False,
    )
    room.add(
        "west wall",
        sheet((0, -o, -o), (0, y + 2 * o, 0), (0, 0, z + 2 * o), step),
        material=plain("#8fa393", 0.82, "#849a8a", grain=1.8, vary=0.08),
        is_part=False,
    )
    y0, y1, z0, z1 = WINDOW
    across = [(y + o - edge) / (y + 2 * o) for edge in (y + o, y1, y0, -o)]
    up = [(edge + o) / (z + 2 * o) for edge in (-o, z0, z1, z + o)]
    room.add(
        "east wall",
        grid_sheet(
            (x, y + o, -o),
            (0, -y - 2 * o, 0),
            (0, 0, z + 2 * o),
            _refined(across, 0.06),
            _refined(up, 0.09),
            (across[1], across[2], up[1], up[2]),
        ),
        sheet((x, y1, z0), (0, y0 - y1, 0), (_REVEAL, 0, 0)),
        sheet((x, y0, z1), (0, y1 - y0, 0), (_REVEAL, 0, 0)),
        sheet((x, y0, z0), (0, 0, z1 - z0), (_REVEAL, 0, 0)),
        sheet((x, y1, z1), (0, 0, z0 - z1), (_REVEAL, 0, 0)),
        material=wall,
        is_part=False,
    )
    d, h = 0.018, 0.09
    room.add(
        "skirting",
        box((0.004, 0.004, 0.002), (0.004 + d, 3.26, h), 0.004),
        box((0.024, 0.004, 0.002), (3.36, 0.004 + d, h), 0.004),
        box((4.39, 0.004, 0.002), (4.975, 0.004 + d, h), 0.004),
        box((4.978, 0.004, 0.002), (4.996, 1.46, h), 0.004),
        material=WHITE_PAINT,
        is_part=False,
    )


def _refined(edges: list[float], step: float) -> np.ndarray:
    pieces = [np.linspace(a, b, max(2, round((b - a) / step) + 1))[:-1] for a, b in zip(edges[:-1], edges[1:], strict=True)]
    return np.concatenate([*pieces, edges[-1:]])


def window(room: RoomBuilder) -> None:
    """Frame, panes and sill of the window in the east wall."""
    x = SIZE[0]
    y0, y1, z0, z1 = WINDOW
    side, front = 0.07, x - 0.022
    casing = [
        box((front, y0 - side, z0 + 0.03), (x + 0.02, y0 + 0.01, z1 + side), 0.004),
        box((front, y1 - 0.01, z0 + 0.03), (x + 0.02, y1 + side, z1 + side), 0.004),
        box(
            (front + 0.003, y0 - side + 0.005, z1 - 0.01),
            (x + 0.018, y1 + side - 0.005, z1 + side - 0.003),
            0.004,
        ),
    ]
    bar, deep = 0.045, (x + 0.07, x + 0.115)
    ys = (y0 + 0.012, (2 * y0 + y1) / 3, (y0 + 2 * y1) / 3, y1 - 0.012)
    bars = [box((deep[0], yc - bar / 2, z0 - 0.01), (deep[1], yc + bar / 2, z1 + 0.01), 0.006) for yc in ys]
    bars += [
        box((deep[0] + 0.006, y0 - 0.01, zc - bar / 2), (deep[1] - 0.006, y1 + 0.01, zc + bar / 2), 0.006)
        for zc in (z0 + 0.045, z0 + 0.70, z1 - 0.012)
    ]
    room.add("window frame", *casing, *bars, material=plain("#4f6d61", 0.42, "#4a675c", grain=2.0))
    room.add(
        "window sill",
        box((x - 0.13, y0 - 0.11, z0 - 0.012), (x + 0.10, y1 + 0.11, z0 + 0.022), 0.006),
        material=MARBLE,
    )
    # Sky above, garden below: three rows of panes, each with its own radiance, facing west.
    rows = (
        (z0 - 0.01, z0 + 0.40, (3.6, 4.0, 3.4)),
        (z0 + 0.40, z0 + 0.78, (5.0, 5.4, 5.5)),
        (z0 + 0.78, z1 + 0.01, (5.6, 6.3, 7.3)),
    )
    width, pane = y1 - y0 + 0.02, x + 0.13
    room.add_emitter(
        "window panes",
        *(sheet((pane, y1 + 0.01, low), (0, -width, 0), (0, 0, high - low), 0.48) for low, high, _ in rows),
        radiance=[radiance for *_, radiance in rows],
    )


def door(room: RoomBuilder) -> None:
    """The door in the south wall."""
    x0, x1, top = 3.45, 4.30, 2.05
    room.add(
        "door frame",
        box((x0 - 0.09, 0.004, 0.002), (x0, 0.045, top + 0.09), 0.006),
        box((x1, 0.004, 0.002), (x1 + 0.09, 0.045, top + 0.09), 0.006),
        box((x0 - 0.004, 0.006, top), (x1 + 0.004, 0.042, top + 0.085), 0.006),
        material=WHITE_PAINT,
    )
    blue = plain("#6f8fa3", 0.38, "#678699")
    panels = [
        box((x0 + a, 0.024, b), (x0 + c, 0.034, d), 0.008)
        for a, c in ((0.10, 0.39), (0.46, 0.75))
        for b, d in ((0.22, 0.92), (1.08, 1.92))
    ]
    room.add("door", box((x0 + 0.004, 0.006, 0.006), (x1 - 0.004, 0.026, top - 0.004)), *panels, material=blue)
    room.add(
        "door handle",
        box((x0 + 0.045, 0.027, 0.93), (x0 + 0.085, 0.033, 1.10), 0.002),
        tube(
            [
                (x0 + 0.065, 0.030, 1.03),
                (x0 + 0.065, 0.075, 1.03),
                (x0 + 0.09, 0.085, 1.03),
                (x0 + 0.18, 0.085, 1.03),
            ],
            0.009,
        ),
        material=BRASS,
    )
