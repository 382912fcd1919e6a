"""What stands on the kitchen's shelves and sideboard, hangs on its walls and stands on its floor."""

from __future__ import annotations

import numpy as np

from workflow.sources.rooms.crockery import bowl, jar, leaf, mug, plate
from workflow.sources.rooms.palette import (
    BRASS,
    COPPER,
    EAST,
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
from workflow.sources.rooms.shapes import box, cylinder, lathe, mm, ring, sphere, tube

SIDEBOARD, SHELF_LOW, SHELF_HIGH, BOOKS_LOW, BOOKS_HIGH, FLOOR = 0.833, 1.491, 1.891, 1.389, 1.789, 0.0015


def on_the_shelves(room: RoomBuilder) -> None:
    """What stands on the open shelves and on the shelf of books."""
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
        leaf(
            0.13 + 0.02 * (k % 3),
            0.055,
            38 - 21 * (k % 4),
            137.5 * k + 20,
            (1.78, 0.13, BOOKS_HIGH + 0.09 + 0.015 * (k % 4)),
        )
        for k in range(16)
    ]
    room.add("trailing plant", *leaves, material=plain("#6f9a4d", 0.5, "#44713a", grain=30))


def on_the_sideboard(room: RoomBuilder) -> None:
    """The sideboard's things."""
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


def on_the_walls_and_floor(room: RoomBuilder) -> None:
    """Picture, clock, towel and apron on the walls; bin, vase and basket on the floor."""
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
        leaves.append(leaf(0.30, 0.15, 22 - 16 * (k % 3), turn - 90, top))
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
