"""The loose things of the kitchen: on table, worktops, sideboard, shelves, walls and floor."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from workflow.sources.rooms.palette import (
    BIRCH,
    BIRCH_DARK,
    BRASS,
    COPPER,
    EAST,
    IRON,
    NORTH,
    OAK,
    OAK_DARK,
    STEEL,
    TERRAZZO,
    UP,
    WALNUT,
    WALNUT_DARK,
    WHITE_GLAZE,
    patterned,
    plain,
    recoloured,
    wood,
)
from workflow.sources.rooms.room import RoomBuilder
from workflow.sources.rooms.shapes import Shape, box, cylinder, lathe, mm, move, ring, sphere, stretch, tube

TABLE, WORKTOP, SIDEBOARD, SHELF_LOW, SHELF_HIGH = 0.746, 0.902, 0.833, 1.491, 1.891
SILL, BOOKS_LOW, BOOKS_HIGH, FLOOR = 1.053, 1.389, 1.789, 0.0015
WEST = (-1.0, 0.0, 0.0)


def furnish(room: RoomBuilder) -> None:
    """Put everything in its place."""
    _on_the_table(room)
    _on_the_hob(room)
    _on_the_worktops(room)
    _on_the_shelves(room)
    _on_the_sideboard(room)
    _on_the_walls_and_floor(room)


def bowl(centre: Sequence[float], radius: float, height: float, wall: float = 0.006, foot: float = 0.45) -> Shape:
    """A round bowl that stands on `centre`."""
    s = np.linspace(0, 1, 7)[1:]
    outer = [(foot * radius + (1 - foot) * radius * np.sin(np.pi / 2 * t), height * (1 - np.cos(np.pi / 2 * t))) for t in s]
    inner = [(r - wall, max(z, 1.6 * wall)) for r, z in reversed(outer)]
    return lathe([(0, 0), (foot * radius, 0), *outer, *inner, (0.4 * radius, 1.5 * wall), (0, 1.5 * wall)], centre, 32)


def plate(centre: Sequence[float], radius: float) -> Shape:
    """A plate with a raised rim."""
    profile = mm("0,0 580,0 700,6 1000,18 995,22 690,11 600,6 0,5", radius)
    return lathe(profile, centre, 32)


def mug(centre: Sequence[float], radius: float, height: float, turn: float) -> list[Shape]:
    """A mug and its handle."""
    r, h, w = radius, height, 0.004
    body = lathe([(0, 0), (r - w, 0), (r, w), (r, h), (r - w, h), (r - w, 2 * w), (0, 2 * w)], segments=24)
    reach = ((-0.002, 0.80), (0.022, 0.78), (0.028, 0.50), (0.018, 0.26), (-0.002, 0.22))
    handle = tube([(r + out, 0, up * h) for out, up in reach], 0.005, 8)
    return [move(part, centre, turn) for part in (body, handle)]


def bottle(centre: Sequence[float], radius: float, height: float, neck: float = 0.3) -> Shape:
    """A bottle with sloping shoulders; `neck` is the neck's share of the height."""
    r, h = radius, height
    foot = [(0, 0), (r - 0.004, 0), (r, 0.005), (r, h * (0.92 - neck) - 0.02)]
    shoulder = [(0.92 * r, h * (0.96 - neck)), (0.45 * r, h * (1.06 - neck)), (0.34 * r, h * (1.12 - neck))]
    return lathe([*foot, *shoulder, (0.34 * r, h - 0.012), (0.42 * r, h - 0.01), (0.42 * r, h), (0, h)], centre, 24)


def jar(centre: Sequence[float], radius: float, height: float) -> tuple[Shape, Shape]:
    """A storage jar and its lid."""
    r, h = radius, height
    rim = [(r, h - 0.02), (r - 0.008, h - 0.008), (r - 0.012, h), (0, h)]
    body = lathe([(0, 0), (r - 0.006, 0), (r, 0.006), *rim], centre)
    lid = mm("0,0 960,0 1000,4 1000,12 500,24 200,27 160,36 220,50 100,57 0,57", r)
    return body, lathe(lid, (centre[0], centre[1], centre[2] + h + 0.001))


def apple(centre: Sequence[float], radius: float) -> Shape:
    """An apple; `centre` is where it stands."""
    profile = mm("0,120 250,0 620,160 930,620 1000,1050 860,1500 550,1740 220,1720 0,1520", radius, radius)
    return lathe(profile, centre, 20)


def _leaf(length: float, width: float, tilt: float, turn: float, at: Sequence[float]) -> Shape:
    blade = stretch(sphere((0, 0, 0), 1.0, 10), (width / 2, length / 2, 0.0022))
    return move(move(blade, (0, length / 2, 0)), at, turn, tilt)


def _on_the_table(room: RoomBuilder) -> None:
    z = TABLE
    room.add(
        "table runner",
        box((1.60, 1.28, z), (1.90, 2.22, z + 0.004)),
        material=patterned(
            "stripes",
            "#e3d9c3",
            "#47757f",
            "#c9a24a",
            roughness=0.95,
            axes=(EAST, NORTH),
            size=(0.1, 0.047),
            origin=(0, 0.013, 0),
        ),
    )
    fruit = (1.75, 1.75, z + 0.005)
    room.add("fruit bowl", bowl(fruit, 0.15, 0.075), material=recoloured(WHITE_GLAZE, "#2f5f73", "#2a5568"))
    base = fruit[2] + 0.011
    room.add(
        "apples",
        apple((1.71, 1.71, base), 0.039),
        apple((1.79, 1.72, base), 0.037),
        apple((1.745, 1.80, base), 0.040),
        apple((1.75, 1.745, base + 0.062), 0.038),
        material=plain("#b3322a", 0.28, "#cf8a3a", grain=16, vary=0.1),
    )
    room.add(
        "plate west",
        plate((1.24, 1.62, z), 0.12),
        material=patterned("rings", "#efeae0", "#3d6d86", roughness=0.14, size=(0.098, 0.112), origin=(1.24, 1.62, z)),
    )
    room.add(
        "plate east",
        plate((2.24, 1.90, z), 0.12),
        material=patterned("rings", "#efeae0", "#3d6d86", roughness=0.14, size=(0.098, 0.112), origin=(2.24, 1.90, z)),
    )
    room.add(
        "bread roll",
        stretch_to((1.24, 1.62, z + 0.0065), (0.055, 0.045, 0.032)),
        material=plain("#c98d4c", 0.75, "#8d5526", grain=26),
    )
    room.add("mug blue", *mug((1.36, 1.87, z), 0.039, 0.092, 150), material=plain("#4f86a0", 0.18))
    room.add("mug yellow", *mug((2.13, 1.60, z), 0.039, 0.092, -30), material=plain("#d8a335", 0.18))
    room.add(
        "milk jug",
        lathe(mm("0,0 42,0 52,30 48,75 34,115 42,150 38,150 30,115 43,75 46,30 36,7 0,6"), (2.02, 1.99, z)),
        material=WHITE_GLAZE,
    )
    room.add("oil bottle", bottle((1.53, 1.53, z), 0.034, 0.27), material=plain("#4d5d1f", 0.08, "#5b6a25"))


def stretch_to(base: Sequence[float], half: Sequence[float]) -> Shape:
    """An ellipsoid that stands on `base`."""
    return move(stretch(sphere((0, 0, 0), 1.0, 18), half), (base[0], base[1], base[2] + half[2]))


def _on_the_hob(room: RoomBuilder) -> None:
    z = 0.9465
    room.add(
        "copper pot",
        lathe(mm("0,0 100,0 108,8 110,125 114,128 106,130 104,12 0,10"), (2.76, 3.80, z), 36),
        material=COPPER,
    )
    room.add(
        "pot handles",
        *(
            tube(
                [
                    (2.76 + s * 0.108, 3.77, z + 0.10),
                    (2.76 + s * 0.145, 3.775, z + 0.105),
                    (2.76 + s * 0.145, 3.825, z + 0.105),
                    (2.76 + s * 0.108, 3.83, z + 0.10),
                ],
                0.006,
                10,
            )
            for s in (-1, 1)
        ),
        material=BRASS,
    )
    room.add(
        "pot lid",
        lathe(mm("0,0 108,0 112,4 90,18 12,32 10,45 20,55 16,64 0,66"), (2.76, 3.80, z + 0.132), 36),
        material=COPPER,
    )
    room.add(
        "frying pan",
        lathe(mm("0,0 95,0 125,40 120,42 92,6 0,5"), (3.04, 3.585, z), 36),
        tube(
            [(3.13, 3.51, z + 0.03), (3.20, 3.455, z + 0.042), (3.30, 3.375, z + 0.046)],
            (0.008, 0.009, 0.011),
            10,
        ),
        material=IRON,
    )
    room.add(
        "kettle",
        lathe(
            mm("0,0 82,0 94,12 98,50 85,100 50,135 30,142 12,148 10,158 16,168 10,178 0,179"),
            (3.04, 3.83, z),
            36,
        ),
        tube(
            [(2.965, 3.80, z + 0.065), (2.925, 3.785, z + 0.095), (2.905, 3.775, z + 0.135)],
            (0.018, 0.014, 0.010),
            12,
        ),
        material=plain("#b4362c", 0.14, "#a93028"),
    )
    room.add(
        "kettle handle",
        tube(
            [
                (2.985, 3.81, z + 0.115),
                (2.985, 3.81, z + 0.20),
                (3.04, 3.83, z + 0.235),
                (3.095, 3.85, z + 0.20),
                (3.095, 3.85, z + 0.115),
            ],
            0.008,
            10,
        ),
        material=plain("#26262a", 0.4),
    )


def _on_the_worktops(room: RoomBuilder) -> None:
    z = WORKTOP
    room.add(
        "toaster",
        box((0.92, 3.60, z + 0.012), (1.24, 3.78, z + 0.19), 0.022),
        *(box((x, y, z), (x + 0.02, y + 0.02, z + 0.02)) for x in (0.95, 1.19) for y in (3.63, 3.73)),
        material=STEEL,
    )
    room.add(
        "toaster slots",
        *(box((0.97, y, z + 0.186), (1.19, y + 0.028, z + 0.1925)) for y in (3.645, 3.707)),
        material=plain("#1c1c1f", 0.5),
    )
    jars = [(1.50, 0.065, 0.17, "#e4d9c2"), (1.66, 0.058, 0.14, "#c9775a"), (1.80, 0.050, 0.11, "#7d9a8c")]
    for number, (x, radius, height, code) in enumerate(jars, 1):
        body, lid = jar((x, 3.84, z), radius, height)
        room.add(f"jar {number}", body, material=plain(code, 0.2))
        room.add(f"jar lid {number}", lid, material=wood(BIRCH, BIRCH_DARK, EAST, NORTH, 0.45))
    knives = move(box((-0.05, -0.075, 0.0), (0.05, 0.075, 0.20), 0.006), (2.38, 3.80, z + 0.022), 0, 14)
    room.add("knife block", knives, material=wood(WALNUT, WALNUT_DARK, UP, EAST, 0.4))
    grips = [
        move(
            box((u - 0.009, v - 0.013, 0.196), (u + 0.009, v + 0.013, 0.285), 0.004),
            (2.38, 3.80, z + 0.022),
            0,
            14,
        )
        for u in (-0.028, 0.0, 0.028)
        for v in (-0.035, 0.030)
    ]
    room.add("knife grips", *grips, material=plain("#2b2624", 0.35))
    room.add(
        "chopping board",
        move(box((-0.15, -0.011, 0.0), (0.15, 0.011, 0.40), 0.006), (2.06, 3.885, z + 0.003), 0, -11),
        material=wood(OAK, OAK_DARK, UP, EAST, 0.5, 9.0, origin=(0.4, 0, 0.2)),
    )

    room.add(
        "bread board",
        box((3.42, 3.50, z), (3.82, 3.76, z + 0.022), 0.006),
        material=wood(BIRCH, BIRCH_DARK, EAST, NORTH, 0.55),
    )
    room.add(
        "loaf",
        stretch_to((3.60, 3.63, z + 0.0225), (0.135, 0.065, 0.055)),
        material=plain("#c08243", 0.8, "#7d4a22", grain=18, vary=0.05),
    )
    room.add(
        "utensil crock",
        lathe(mm("0,0 56,0 60,5 60,150 54,150 54,10 0,9"), (4.02, 3.82, z), 28),
        material=patterned(
            "stripes",
            "#7c98a8",
            "#d9d2c2",
            roughness=0.25,
            vary=0.1,
            axes=(EAST, UP),
            size=(0.1, 0.031),
            origin=(0, 0, z),
        ),
    )
    spoons = []
    for u, v, w, h in (
        (-0.028, 0.01, -0.06, 0.30),
        (0.02, 0.025, 0.05, 0.33),
        (0.01, -0.03, 0.03, 0.29),
        (-0.01, 0.03, -0.02, 0.34),
    ):
        spoons.append(tube([(4.02 + u, 3.82 + v, z + 0.012), (4.02 + u + w, 3.82 + 1.6 * v, z + h - 0.05)], 0.006, 8))
        spoons.append(
            move(
                stretch(sphere((0, 0, 0), 1.0, 12), (0.026, 0.009, 0.038)),
                (4.02 + u + 1.1 * w, 3.82 + 1.65 * v, z + h - 0.03),
            )
        )
    room.add("wooden spoons", *spoons, material=wood(BIRCH, BIRCH_DARK, UP, EAST, 0.6))
    room.add("wine bottle", bottle((4.28, 3.84, z), 0.038, 0.31), material=plain("#1f3524", 0.06, "#274230"))
    room.add(
        "vinegar bottle",
        bottle((4.40, 3.80, z), 0.032, 0.25, 0.34),
        material=plain("#7c3a1e", 0.08, "#8c4a26"),
    )
    room.add(
        "bottle labels",
        lathe(mm("0,70 38.8,70 38.8,150 0,150"), (4.28, 3.84, z), 24),
        lathe(mm("0,60 32.7,60 32.7,120 0,120"), (4.40, 3.80, z), 24),
        material=plain("#e6dcc2", 0.7),
    )
    room.add("mixing bowl", bowl((4.72, 3.62, z), 0.16, 0.13), material=plain("#d9b24a", 0.2, "#d3aa40"))
    room.add(
        "lemons",
        *(
            move(
                stretch(sphere((0, 0, 0), 1.0, 16), (0.042, 0.032, 0.032)),
                (4.72 + dx, 3.62 + dy, z + 0.011 + dz),
                a,
            )
            for dx, dy, dz, a in (
                (-0.05, -0.03, 0.034, 20),
                (0.05, -0.02, 0.034, 80),
                (0.0, 0.06, 0.036, -30),
                (0.0, 0.0, 0.088, 45),
            )
        ),
        material=plain("#e3c136", 0.4, "#c9a326", grain=24, vary=0.1),
    )

    room.add(
        "plate stack",
        *(plate((4.66, 2.90, z + 0.0105 * k), 0.115) for k in range(6)),
        material=recoloured(WHITE_GLAZE, "#dfe4df", "#d6ddd8"),
    )
    room.add(
        "soap bottle",
        lathe(mm("0,0 30,0 33,4 33,110 12,128 10,150 0,150"), (4.925, 2.50, z), 20),
        tube([(4.925, 2.50, z + 0.148), (4.925, 2.50, z + 0.175), (4.885, 2.50, z + 0.175)], 0.005, 8),
        material=plain("#b9805f", 0.2),
    )
    room.add(
        "glazed vase",
        lathe(
            mm("0,0 45,0 75,60 70,120 32,190 30,215 40,235 35,235 25,215 27,190 64,120 68,60 40,10 0,10"),
            (4.70, 1.66, z),
            32,
        ),
        material=plain("#3c6f6a", 0.1, "#7fa79a", grain=9, vary=0.08),
    )
    stems, blooms = [], []
    for turn, lean, height in (
        (10, 0.05, 0.40),
        (85, 0.08, 0.36),
        (160, 0.06, 0.44),
        (235, 0.09, 0.37),
        (305, 0.07, 0.41),
    ):
        u, v = np.cos(np.radians(turn)), np.sin(np.radians(turn))
        top = (4.70 + lean * u, 1.66 + lean * v, z + height)
        stems.append(
            tube(
                [
                    (4.70 + 0.006 * u, 1.66 + 0.006 * v, z + 0.03),
                    (4.70 + 0.015 * u, 1.66 + 0.015 * v, z + 0.22),
                    top,
                ],
                0.003,
                6,
            )
        )
        blooms.append(move(stretch(sphere((0, 0, 0), 1.0, 14), (0.034, 0.034, 0.022)), top))
    room.add("stems", *stems, material=plain("#4d7038", 0.6))
    room.add("flowers", *blooms, material=plain("#d98a9c", 0.8, "#e9c9c0", grain=34))
    for number, (y, code) in enumerate(((1.85, "#b9674a"), (2.62, "#c9b79a")), 1):
        r = 0.055
        room.add(
            f"herb pot {number}",
            lathe(
                [
                    (0, 0),
                    (0.7 * r, 0),
                    (r, 0.09),
                    (1.1 * r, 0.09),
                    (1.1 * r, 0.11),
                    (0.95 * r, 0.11),
                    (0.9 * r, 0.085),
                    (0, 0.085),
                ],
                (4.935, y, SILL),
                24,
            ),
            material=plain(code, 0.7, grain=14.0),
        )
        leaves = [
            _leaf(0.085, 0.034, 28 + 17 * (k % 3), 137.5 * k, (4.935, y, SILL + 0.086 + 0.012 * (k % 5))) for k in range(13)
        ]
        room.add(f"herb {number}", *leaves, material=plain("#5c8a3a", 0.55, "#3f6b2e", grain=40))


def _on_the_shelves(room: RoomBuilder) -> None:
    low, high = SHELF_LOW, SHELF_HIGH
    room.add(
        "shelf plates",
        *(plate((3.52, 3.86, low + 0.0105 * k), 0.105) for k in range(5)),
        material=plain("#8fb0b5", 0.15),
    )
    room.add(
        "shelf bowls",
        *(bowl((3.78, 3.86, low + 0.022 * k), 0.085, 0.06, 0.005) for k in range(3)),
        material=plain("#dfd3bb", 0.2, "#d2c3a6"),
    )
    for number, (x, code) in enumerate(((3.99, "#b5523f"), (4.12, "#e3d8c3"), (4.25, "#5f8a82"), (4.38, "#d0a040")), 1):
        room.add(f"shelf mug {number}", *mug((x, 3.85, low), 0.040, 0.09, -60), material=plain(code, 0.2))
    body, lid = jar((4.60, 3.86, low), 0.07, 0.19)
    room.add(
        "flour jar",
        body,
        material=patterned(
            "stripes",
            "#e9e4d8",
            "#4a7186",
            roughness=0.15,
            axes=(EAST, UP),
            size=(0.1, 0.042),
            origin=(0, 0, low + 0.01),
        ),
    )
    room.add("flour jar lid", lid, material=wood(WALNUT, WALNUT_DARK, EAST, NORTH, 0.4))
    room.add("brass scale bowl", bowl((3.50, 3.86, high), 0.11, 0.08, 0.005), material=BRASS)
    room.add(
        "teapot",
        lathe(mm("0,0 50,0 78,30 82,65 60,100 30,112 12,116 14,132 0,136"), (3.84, 3.86, high), 30),
        tube(
            [(3.91, 3.86, high + 0.05), (3.945, 3.86, high + 0.085), (3.955, 3.86, high + 0.11)],
            (0.014, 0.010, 0.008),
            10,
        ),
        tube(
            [
                (3.765, 3.86, high + 0.09),
                (3.72, 3.86, high + 0.095),
                (3.712, 3.86, high + 0.055),
                (3.765, 3.86, high + 0.035),
            ],
            0.007,
            8,
        ),
        material=plain("#355e7a", 0.12, "#dcd6c8", grain=15, vary=0.02),
    )
    for number, (x, radius, code) in enumerate(((4.16, 0.05, "#a04a3a"), (4.30, 0.05, "#d4b35a"), (4.44, 0.05, "#6d7f4a")), 1):
        room.add(
            f"spice tin {number}",
            cylinder((x, 3.86, high), radius, 0.12, 0.004),
            material=plain(code, 0.35, metallic=0.0),
        )
    room.add(
        "pepper mill",
        lathe(mm("0,0 32,0 34,10 22,60 20,100 30,140 32,155 20,165 26,190 18,212 0,216"), (4.72, 3.86, high), 24),
        material=wood(WALNUT, WALNUT_DARK, UP, EAST, 0.3),
    )

    books = [
        (1.565, 0.30, 0.19, 0.16, ("#8e3b32", "#2f5a6e", "#e0d5bd"), 0.031),
        (1.95, 0.22, 0.17, 0.15, ("#c69a3c", "#5d7450", "#efe7d6"), 0.037),
    ]
    for number, (x, width, height, depth, codes, thickness) in enumerate(books, 1):
        count = int(width / thickness)
        shapes = [
            box(
                (x + thickness * k + 0.0008, 0.04, BOOKS_LOW),
                (
                    x + thickness * (k + 1) - 0.0008,
                    0.04 + depth - 0.008 * ((k * 5) % 3),
                    BOOKS_LOW + height - 0.012 * ((k * 7) % 4),
                ),
                0.002,
            )
            for k in range(count)
        ]
        room.add(
            f"books {number}",
            *shapes,
            material=patterned(
                "spines",
                codes[0],
                codes[1],
                codes[2],
                roughness=0.6,
                axes=(EAST, UP),
                size=(thickness, 0.13),
                origin=(x, 0, BOOKS_LOW),
            ),
        )
    high_books = [
        box(
            (2.28 + 0.034 * k + 0.0008, 0.04, BOOKS_HIGH),
            (2.28 + 0.034 * (k + 1) - 0.0008, 0.20, BOOKS_HIGH + 0.21 - 0.013 * ((k * 3) % 4)),
            0.002,
        )
        for k in range(11)
    ]
    room.add(
        "books 3",
        *high_books,
        material=patterned(
            "spines",
            "#37566b",
            "#b0643f",
            "#e8dcc4",
            roughness=0.6,
            axes=(EAST, UP),
            size=(0.034, 0.15),
            origin=(2.28, 0, BOOKS_HIGH),
        ),
    )
    for number, (x, radius, height, code) in enumerate(
        ((2.33, 0.055, 0.16, "#6d8f86"), (2.47, 0.050, 0.13, "#dcc9a2"), (2.60, 0.055, 0.18, "#a65a45")), 1
    ):
        body, lid = jar((x, 0.125, BOOKS_LOW), radius, height)
        room.add(f"storage jar {number}", body, lid, material=plain(code, 0.18, grain=11, vary=0.05))
    room.add("trailing plant pot", bowl((1.78, 0.125, BOOKS_HIGH), 0.085, 0.11, 0.008, 0.7), material=TERRAZZO)
    leaves = [
        _leaf(
            0.13 + 0.02 * (k % 3),
            0.055,
            38 - 21 * (k % 4),
            137.5 * k + 20,
            (1.78, 0.13, BOOKS_HIGH + 0.09 + 0.015 * (k % 4)),
        )
        for k in range(16)
    ]
    room.add("trailing plant", *leaves, material=plain("#6f9a4d", 0.5, "#44713a", grain=30))


def _on_the_sideboard(room: RoomBuilder) -> None:
    z = SIDEBOARD
    room.add(
        "radio",
        box((1.42, 0.10, z + 0.004), (1.78, 0.27, z + 0.20), 0.02),
        material=wood(OAK, OAK_DARK, EAST, UP, 0.35),
    )
    room.add(
        "radio front",
        box((1.445, 0.2715, z + 0.03), (1.64, 0.279, z + 0.175), 0.003),
        material=patterned(
            "checks",
            "#cbbfa6",
            "#8c8068",
            "#8c8068",
            roughness=0.9,
            axes=(EAST, UP),
            size=(0.03, 0.03),
            origin=(1.4, 0, z),
        ),
    )
    room.add(
        "radio knobs",
        *(tube([(1.70, 0.271, z + h), (1.70, 0.296, z + h)], (0.024, 0.021), 16) for h in (0.065, 0.135)),
        material=BRASS,
    )
    room.add(
        "candlesticks",
        *(
            lathe(
                [
                    (0, 0),
                    (0.045, 0),
                    (0.045, 0.008),
                    (0.012, 0.02),
                    (0.010, 0.08),
                    (0.018, 0.10),
                    (0.009, 0.12),
                    (0.009, h - 0.02),
                    (0.022, h - 0.012),
                    (0.022, h),
                    (0, h),
                ],
                (x, 0.24, z),
                24,
            )
            for x, h in ((1.98, 0.24), (2.09, 0.19))
        ),
        material=BRASS,
    )
    room.add(
        "candles",
        *(cylinder((x, 0.24, z + h + 0.001), 0.0105, 0.13, 0.002, 14) for x, h in ((1.98, 0.24), (2.09, 0.19))),
        material=plain("#efe6cf", 0.5),
    )
    room.add(
        "cake stand",
        lathe(mm("0,0 70,0 68,8 20,30 18,90 50,105 150,112 155,125 148,125 142,118 0,117"), (2.42, 0.24, z), 36),
        material=recoloured(WHITE_GLAZE, "#dfc9c2", "#d6bdb6"),
    )
    cake = z + 0.118
    room.add(
        "cake",
        cylinder((2.42, 0.24, cake), 0.10, 0.075, 0.012, 32),
        material=plain("#5b3522", 0.55, "#704631", grain=20, vary=0.1),
    )
    room.add(
        "cherries",
        *(
            sphere((2.42 + 0.065 * np.cos(a), 0.24 + 0.065 * np.sin(a), cake + 0.0875), 0.012, 12)
            for a in np.arange(7) * 2 * np.pi / 7
        ),
        material=plain("#a31f2c", 0.1),
    )
    room.add(
        "tea tins",
        *(box((x, 0.12, z), (x + 0.10, 0.24, z + h), 0.006) for x, h in ((2.66, 0.15), (2.78, 0.11))),
        material=patterned(
            "stripes",
            "#41687a",
            "#e2d7bd",
            "#b5563f",
            roughness=0.35,
            vary=0.05,
            axes=(EAST, UP),
            size=(0.1, 0.036),
            origin=(0, 0, z - 0.013),
        ),
    )


def _on_the_walls_and_floor(room: RoomBuilder) -> None:
    y0, y1, z0, z1, t = 1.15, 2.25, 1.22, 1.98, 0.045
    room.add(
        "picture frame",
        box((0.003, y0, z0), (0.04, y0 + t, z1), 0.006),
        box((0.003, y1 - t, z0), (0.04, y1, z1), 0.006),
        box((0.005, y0 + t - 0.004, z0 + 0.001), (0.038, y1 - t + 0.004, z0 + t), 0.006),
        box((0.005, y0 + t - 0.004, z1 - t), (0.038, y1 - t + 0.004, z1 - 0.001), 0.006),
        material=wood(OAK, OAK_DARK, UP, NORTH, 0.4),
    )
    centre = (0.0, (y0 + y1) / 2, (z0 + z1) / 2)
    room.add(
        "picture",
        box((0.004, y0 + 0.03, z0 + 0.03), (0.018, y1 - 0.03, z1 - 0.03)),
        material=patterned(
            "painting",
            "#9cc0cf",
            "#2c5a50",
            "#e9b45a",
            roughness=0.6,
            axes=(NORTH, UP),
            size=((y1 - y0) / 2 - t, (z1 - z0) / 2 - t),
            origin=centre,
            grain=7.0,
        ),
    )
    dial = np.array([0.0, 2.78, 1.95])
    face = lathe(mm("0,0 150,0 150,20 0,20"), (0, 0, 0), 40)
    turn_west = (face[0][:, [2, 0, 1]] + dial + (0.003, 0, 0), face[1])
    room.add(
        "clock face",
        turn_west,
        material=patterned(
            "rings",
            "#efe9da",
            "#3a4a50",
            roughness=0.45,
            axes=(NORTH, UP),
            size=(0.122, 0.136),
            origin=tuple(dial),
        ),
    )
    room.add("clock rim", ring((0.022, dial[1], dial[2]), 0.152, 0.014, NORTH, UP, 40), material=COPPER)
    room.add(
        "clock hands",
        tube([(0.0285, 2.78, 1.95), (0.0285, 2.84, 1.99)], 0.004, 8),
        tube([(0.0285, 2.78, 1.95), (0.0285, 2.745, 2.05)], 0.0032, 8),
        sphere((0.028, 2.78, 1.95), 0.009, 10),
        material=plain("#26282b", 0.4),
    )
    room.add(
        "bin",
        lathe(mm("0,0 125,0 130,6 145,460 138,460 124,12 0,11"), (0.28, 2.95, FLOOR), 36),
        material=STEEL,
    )
    room.add(
        "floor vase",
        lathe(mm("0,0 130,0 170,100 175,220 120,360 125,400 112,400 105,345 0,345"), (0.42, 0.42, FLOOR), 40),
        material=plain("#b5694a", 0.75, "#9c5438", grain=8, vary=0.05),
    )
    stalks, leaves = [], []
    for k in range(9):
        turn, height, lean = 137.5 * k, 0.85 + 0.09 * (k % 5), 0.10 + 0.03 * (k % 3)
        u, v = np.cos(np.radians(turn)), np.sin(np.radians(turn))
        top = (0.42 + lean * u, 0.42 + lean * v, height)
        stalks.append(
            tube(
                [
                    (0.42 + 0.02 * u, 0.42 + 0.02 * v, 0.30),
                    (0.42 + 0.5 * lean * u, 0.42 + 0.5 * lean * v, 0.62),
                    top,
                ],
                (0.007, 0.006, 0.004),
                6,
            )
        )
        leaves.append(_leaf(0.30, 0.15, 22 - 16 * (k % 3), turn - 90, top))
    room.add("plant stalks", *stalks, material=plain("#4a6a38", 0.6))
    room.add("plant leaves", *leaves, material=plain("#4f8148", 0.38, "#2f5c3c", grain=12, vary=0.1))
    towel = box((2.72, 3.338, 0.36), (2.94, 3.345, 0.672), 0.002)
    over = box((2.721, 3.3355, 0.668), (2.939, 3.377, 0.674), 0.002)
    room.add(
        "tea towel",
        towel,
        over,
        material=patterned(
            "checks",
            "#eee7da",
            "#a8453c",
            "#eee7da",
            roughness=0.95,
            axes=(EAST, UP),
            size=(0.0275, 0.026),
            origin=(2.72, 0, 0.36),
        ),
    )
    room.add(
        "apron hooks",
        box((0.90, 0.004, 1.52), (1.14, 0.022, 1.58), 0.004),
        *(tube([(x, 0.020, 1.55), (x, 0.06, 1.55), (x, 0.066, 1.575)], 0.005, 8) for x in (0.95, 1.02, 1.09)),
        material=wood(WALNUT, WALNUT_DARK, EAST, UP, 0.4),
    )
    room.add(
        "basket",
        lathe(mm("0,0 160,0 175,20 200,260 190,260 166,25 0,20"), (3.12, 0.28, FLOOR), 36),
        material=patterned(
            "checks",
            "#b98d55",
            "#8a6236",
            roughness=0.85,
            axes=(EAST, UP),
            size=(0.045, 0.03),
            origin=(0.01, 0, 0),
        ),
    )
    room.add(
        "pears",
        *(
            lathe(
                mm("0,4 20,0 38,20 40,40 26,70 16,92 6,100 0,100"),
                (3.12 + dx, 0.28 + dy, FLOOR + 0.021 + dz),
                18,
            )
            for dx, dy, dz in (
                (-0.07, 0.0, 0),
                (0.02, -0.07, 0),
                (0.05, 0.05, 0),
                (-0.02, 0.08, 0),
                (0.0, 0.0, 0.075),
            )
        ),
        material=plain("#a9b04a", 0.4, "#c2a746", grain=14, vary=0.1),
    )
