"""The kitchen's walls, floor and ceiling, its window and its door."""

from __future__ import annotations

import numpy as np

from lab.rooms.palette import BRASS, FLOOR, MARBLE, WHITE_PAINT, plain
from lab.rooms.room import RoomBuilder
from lab.rooms.shapes import box, grid_sheet, sheet, tube

SIZE = (5.0, 4.0, 2.7)
WINDOW = (1.55, 2.95, 1.03, 2.17)  # y0, y1, z0, z1 of the opening in the east wall, metres
_OVERLAP = 0.02  # metres by which walls reach past their corners, so that no ray slips through
_REVEAL = 0.15  # depth of the window opening, metres


def shell(room: RoomBuilder) -> None:
    """Add floor, ceiling, walls and skirting."""
    x, y, z = SIZE
    o, step = _OVERLAP, 0.25
    wall = plain("#e6dccb", 0.85, "#ddd1bd", grain=1.6, vary=0.08)
    ceiling, west = plain("#eeeae2", 0.9, "#e8e3d9", grain=1.2), plain("#8fa393", 0.82, "#849a8a", grain=1.8, vary=0.08)
    across, along, up = (x + 2 * o, 0, 0), (0, y + 2 * o, 0), (0, 0, z + 2 * o)
    room.add("floor", FLOOR, sheet((-o, -o, 0), across, along, step), is_part=False)
    room.add("ceiling", ceiling, sheet((-o, y + o, z), across, (0, -y - 2 * o, 0), step), is_part=False)
    room.add("north wall", wall, sheet((-o, y, -o), across, up, step), is_part=False)
    room.add("south wall", wall, sheet((x + o, 0, -o), (-x - 2 * o, 0, 0), up, step), is_part=False)
    room.add("west wall", west, sheet((0, -o, -o), along, up, step), is_part=False)
    y0, y1, z0, z1 = WINDOW
    u = [(y + o - edge) / (y + 2 * o) for edge in (y + o, y1, y0, -o)]
    v = [(edge + o) / (z + 2 * o) for edge in (-o, z0, z1, z + o)]
    hole = (u[1], u[2], v[1], v[2])
    room.add(
        "east wall",
        wall,
        grid_sheet((x, y + o, -o), (0, -y - 2 * o, 0), up, _refined(u, 0.06), _refined(v, 0.09), hole),
        sheet((x, y1, z0), (0, y0 - y1, 0), (_REVEAL, 0, 0)),
        sheet((x, y0, z1), (0, y1 - y0, 0), (_REVEAL, 0, 0)),
        sheet((x, y0, z0), (0, 0, z1 - z0), (_REVEAL, 0, 0)),
        sheet((x, y1, z1), (0, 0, z0 - z1), (_REVEAL, 0, 0)),
        is_part=False,
    )
    d, h = 0.018, 0.09
    room.add(
        "skirting",
        WHITE_PAINT,
        box((0.004, 0.004, 0.002), (0.004 + d, 3.26, h), 0.004),
        box((0.024, 0.004, 0.002), (3.36, 0.004 + d, h), 0.004),
        box((4.39, 0.004, 0.002), (4.975, 0.004 + d, h), 0.004),
        box((4.978, 0.004, 0.002), (4.996, 1.46, h), 0.004),
        is_part=False,
    )


def _refined(edges: list[float], step: float) -> np.ndarray:
    """Return grid lines that hold all `edges` and lie about `step` apart."""
    pieces = [np.linspace(a, b, max(2, round((b - a) / step) + 1))[:-1] for a, b in zip(edges[:-1], edges[1:], strict=True)]
    return np.concatenate([*pieces, edges[-1:]])


def window(room: RoomBuilder) -> None:
    """Add frame, sill and luminous panes of the window in the east wall."""
    x = SIZE[0]
    y0, y1, z0, z1 = WINDOW
    side, front = 0.07, x - 0.022
    top = (front + 0.003, y0 - side + 0.005, z1 - 0.01), (x + 0.018, y1 + side - 0.005, z1 + side - 0.003)
    parts = [
        box((front, y0 - side, z0 + 0.03), (x + 0.02, y0 + 0.01, z1 + side), 0.004),
        box((front, y1 - 0.01, z0 + 0.03), (x + 0.02, y1 + side, z1 + side), 0.004),
        box(*top, 0.004),
    ]
    half, near, far = 0.045 / 2, x + 0.07, x + 0.115
    ys = (y0 + 0.012, (2 * y0 + y1) / 3, (y0 + 2 * y1) / 3, y1 - 0.012)
    zs = (z0 + 0.045, z0 + 0.70, z1 - 0.012)
    parts += [box((near, y - half, z0 - 0.01), (far, y + half, z1 + 0.01), 0.006) for y in ys]
    parts += [box((near + 0.006, y0 - 0.01, z - half), (far - 0.006, y1 + 0.01, z + half), 0.006) for z in zs]
    room.add("window frame", plain("#4f6d61", 0.42, "#4a675c", grain=2.0), *parts)
    room.add("window sill", MARBLE, box((x - 0.13, y0 - 0.11, z0 - 0.012), (x + 0.10, y1 + 0.11, z0 + 0.022), 0.006))
    # Sky above, garden below: three rows of panes, each with its own radiance, facing west.
    rows = (
        (z0 - 0.01, z0 + 0.40, (3.6, 4.0, 3.4)),
        (z0 + 0.40, z0 + 0.78, (5.0, 5.4, 5.5)),
        (z0 + 0.78, z1 + 0.01, (5.6, 6.3, 7.3)),
    )
    width, pane = y1 - y0 + 0.02, x + 0.13
    panes = [sheet((pane, y1 + 0.01, low), (0, -width, 0), (0, 0, high - low), 0.48) for low, high, _ in rows]
    room.add_emitter("window panes", *panes, radiance=[radiance for *_, radiance in rows])


def door(room: RoomBuilder) -> None:
    """Add the door in the south wall."""
    x0, x1, top = 3.45, 4.30, 2.05
    room.add(
        "door frame",
        WHITE_PAINT,
        box((x0 - 0.09, 0.004, 0.002), (x0, 0.045, top + 0.09), 0.006),
        box((x1, 0.004, 0.002), (x1 + 0.09, 0.045, top + 0.09), 0.006),
        box((x0 - 0.004, 0.006, top), (x1 + 0.004, 0.042, top + 0.085), 0.006),
    )
    places = [(*u, *v) for u in ((0.10, 0.39), (0.46, 0.75)) for v in ((0.22, 0.92), (1.08, 1.92))]
    panels = [box((x0 + a, 0.024, b), (x0 + c, 0.034, d), 0.008) for a, c, b, d in places]
    leaf = box((x0 + 0.004, 0.006, 0.006), (x1 - 0.004, 0.026, top - 0.004))
    room.add("door", plain("#6f8fa3", 0.38, "#678699"), leaf, *panels)
    bar = [(x0 + out, y, 1.03) for out, y in ((0.065, 0.030), (0.065, 0.075), (0.09, 0.085), (0.18, 0.085))]
    plate = box((x0 + 0.045, 0.027, 0.93), (x0 + 0.085, 0.033, 1.10), 0.002)
    room.add("door handle", BRASS, plate, tube(bar, 0.009))
