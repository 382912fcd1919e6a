"""The things on the kitchen's shelves and sideboard, on its walls and on its floor."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lab.rooms.crockery import bowl, jar, leaf, mug, plate
from lab.rooms.palette import (
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
from lab.rooms.room import RoomBuilder
from lab.rooms.shapes import box, cylinder, lathe, mm, ring, sphere, tube

# Heights of surfaces, metres.
SIDEBOARD, SHELF_LOW, SHELF_HIGH, BOOKS_LOW, BOOKS_HIGH, FLOOR = 0.833, 1.491, 1.891, 1.389, 1.789, 0.0015


def _low_shelf(room: RoomBuilder) -> None:
    z = SHELF_LOW
    room.add("shelf plates", plain("#8fb0b5", 0.15), *(plate((3.52, 3.86, z + 0.0105 * k), 0.105) for k in range(5)))
    bowls = [bowl((3.78, 3.86, z + 0.022 * k), 0.085, 0.06, 0.005) for k in range(3)]
    room.add("shelf bowls", plain("#dfd3bb", 0.2, "#d2c3a6"), *bowls)
    for number, (x, code) in enumerate(((3.99, "#b5523f"), (4.12, "#e3d8c3"), (4.25, "#5f8a82"), (4.38, "#d0a040")), 1):
        room.add(f"shelf mug {number}", plain(code, 0.2), *mug((x, 3.85, z), 0.040, 0.09, -60))
    body, lid = jar((4.60, 3.86, z), 0.07, 0.19)
    bands = {"axes": (EAST, UP), "size": (0.1, 0.042), "origin": (0, 0, z + 0.01)}
    room.add("flour jar", patterned("stripes", "#e9e4d8", "#4a7186", roughness=0.15, **bands), body)
    room.add("flour jar lid", wood(WALNUT, WALNUT_DARK, EAST, NORTH, 0.4), lid)


def _high_shelf(room: RoomBuilder) -> None:
    z = SHELF_HIGH
    room.add("brass scale bowl", BRASS, bowl((3.50, 3.86, z), 0.11, 0.08, 0.005))
    spout = (3.91, 0.05), (3.945, 0.085), (3.955, 0.11)
    handle = (3.765, 0.09), (3.72, 0.095), (3.712, 0.055), (3.765, 0.035)
    room.add(
        "teapot",
        plain("#355e7a", 0.12, "#dcd6c8", grain=15, vary=0.02),
        lathe(mm("0,0 50,0 78,30 82,65 60,100 30,112 12,116 14,132 0,136"), (3.84, 3.86, z), 30),
        tube([(x, 3.86, z + up) for x, up in spout], (0.014, 0.010, 0.008), 10),
        tube([(x, 3.86, z + up) for x, up in handle], 0.007, 8),
    )
    for number, (x, code) in enumerate(((4.16, "#a04a3a"), (4.30, "#d4b35a"), (4.44, "#6d7f4a")), 1):
        room.add(f"spice tin {number}", plain(code, 0.35), cylinder((x, 3.86, z), 0.05, 0.12, 0.004))
    mill = mm("0,0 32,0 34,10 22,60 20,100 30,140 32,155 20,165 26,190 18,212 0,216")
    room.add("pepper mill", wood(WALNUT, WALNUT_DARK, UP, EAST, 0.3), lathe(mill, (4.72, 3.86, z), 24))


def _books(room: RoomBuilder) -> None:
    spines = {"roughness": 0.6, "axes": (EAST, UP)}
    rows = (
        (1.565, BOOKS_LOW, 9, 0.031, 0.13, ("#8e3b32", "#2f5a6e", "#e0d5bd")),
        (1.95, BOOKS_LOW, 5, 0.037, 0.13, ("#c69a3c", "#5d7450", "#efe7d6")),
        (2.28, BOOKS_HIGH, 11, 0.034, 0.15, ("#37566b", "#b0643f", "#e8dcc4")),
    )
    extents = (
        lambda k: (0.04 + 0.16 - 0.008 * ((k * 5) % 3), BOOKS_LOW + 0.19 - 0.012 * ((k * 7) % 4)),
        lambda k: (0.04 + 0.15 - 0.008 * ((k * 5) % 3), BOOKS_LOW + 0.17 - 0.012 * ((k * 7) % 4)),
        lambda k: (0.20, BOOKS_HIGH + 0.21 - 0.013 * ((k * 3) % 4)),
    )
    for number, ((x, z, count, thick, title, codes), extent) in enumerate(zip(rows, extents, strict=True), 1):
        ends = [(x + thick * k + 0.0008, x + thick * (k + 1) - 0.0008, *extent(k)) for k in range(count)]
        books = [box((left, 0.04, z), (right, depth, top), 0.002) for left, right, depth, top in ends]
        room.add(f"books {number}", patterned("spines", *codes, size=(thick, title), origin=(x, 0, z), **spines), *books)


def _book_shelves(room: RoomBuilder) -> None:
    _books(room)
    jars = (2.33, 0.055, 0.16, "#6d8f86"), (2.47, 0.050, 0.13, "#dcc9a2"), (2.60, 0.055, 0.18, "#a65a45")
    for number, (x, radius, height, code) in enumerate(jars, 1):
        room.add(f"storage jar {number}", plain(code, 0.18, grain=11, vary=0.05), *jar((x, 0.125, BOOKS_LOW), radius, height))
    room.add("trailing plant pot", TERRAZZO, bowl((1.78, 0.125, BOOKS_HIGH), 0.085, 0.11, 0.008, 0.7))
    leaves = []
    for k in range(16):
        stem = (1.78, 0.13, BOOKS_HIGH + 0.09 + 0.015 * (k % 4))
        leaves.append(leaf(0.13 + 0.02 * (k % 3), 0.055, 38 - 21 * (k % 4), 137.5 * k + 20, stem))
    room.add("trailing plant", plain("#6f9a4d", 0.5, "#44713a", grain=30), *leaves)


def _sideboard(room: RoomBuilder) -> None:
    z = SIDEBOARD
    room.add("radio", wood(OAK, OAK_DARK, EAST, UP, 0.35), box((1.42, 0.10, z + 0.004), (1.78, 0.27, z + 0.20), 0.02))
    weave = {"axes": (EAST, UP), "size": (0.03, 0.03), "origin": (1.4, 0, z), "roughness": 0.9}
    cloth = patterned("checks", "#cbbfa6", "#8c8068", "#8c8068", **weave)
    room.add("radio front", cloth, box((1.445, 0.2715, z + 0.03), (1.64, 0.279, z + 0.175), 0.003))
    knobs = [tube([(1.70, 0.271, z + h), (1.70, 0.296, z + h)], (0.024, 0.021), 16) for h in (0.065, 0.135)]
    room.add("radio knobs", BRASS, *knobs)
    candles = ((1.98, 0.24), (2.09, 0.19))
    room.add("candlesticks", BRASS, *(lathe(_candlestick(h), (x, 0.24, z), 24) for x, h in candles))
    wax = [cylinder((x, 0.24, z + h + 0.001), 0.0105, 0.13, 0.002, 14) for x, h in candles]
    room.add("candles", plain("#efe6cf", 0.5), *wax)
    stand = mm("0,0 70,0 68,8 20,30 18,90 50,105 150,112 155,125 148,125 142,118 0,117")
    room.add("cake stand", recoloured(WHITE_GLAZE, "#dfc9c2", "#d6bdb6"), lathe(stand, (2.42, 0.24, z), 36))
    cake = z + 0.118
    crumb = plain("#5b3522", 0.55, "#704631", grain=20, vary=0.1)
    room.add("cake", crumb, cylinder((2.42, 0.24, cake), 0.10, 0.075, 0.012, 32))
    ring_of_seven = [(2.42 + 0.065 * np.cos(a), 0.24 + 0.065 * np.sin(a)) for a in np.arange(7) * 2 * np.pi / 7]
    room.add("cherries", plain("#a31f2c", 0.1), *(sphere((x, y, cake + 0.0875), 0.012, 12) for x, y in ring_of_seven))
    bands = {"axes": (EAST, UP), "size": (0.1, 0.036), "origin": (0, 0, z - 0.013), "roughness": 0.35, "vary": 0.05}
    tins = [box((x, 0.12, z), (x + 0.10, 0.24, z + h), 0.006) for x, h in ((2.66, 0.15), (2.78, 0.11))]
    room.add("tea tins", patterned("stripes", "#41687a", "#e2d7bd", "#b5563f", **bands), *tins)


def _candlestick(height: float) -> list[Sequence[float]]:
    foot = mm("0,0 45,0 45,8 12,20 10,80 18,100 9,120")
    return [*foot, (0.009, height - 0.02), (0.022, height - 0.012), (0.022, height), (0, height)]


def _walls(room: RoomBuilder) -> None:
    y0, y1, z0, z1, t = 1.15, 2.25, 1.22, 1.98, 0.045
    frame = [box((0.003, a, z0), (0.04, b, z1), 0.006) for a, b in ((y0, y0 + t), (y1 - t, y1))]
    bars = (z0 + 0.001, z0 + t), (z1 - t, z1 - 0.001)
    frame += [box((0.005, y0 + t - 0.004, a), (0.038, y1 - t + 0.004, b), 0.006) for a, b in bars]
    room.add("picture frame", wood(OAK, OAK_DARK, UP, NORTH, 0.4), *frame)
    place = {"size": ((y1 - y0) / 2 - t, (z1 - z0) / 2 - t), "origin": (0.0, (y0 + y1) / 2, (z0 + z1) / 2)}
    picture = patterned("painting", "#9cc0cf", "#2c5a50", "#e9b45a", roughness=0.6, axes=(NORTH, UP), grain=7.0, **place)
    room.add("picture", picture, box((0.004, y0 + 0.03, z0 + 0.03), (0.018, y1 - 0.03, z1 - 0.03)))
    dial = np.array([0.0, 2.78, 1.95])
    vertices, faces = lathe(mm("0,0 150,0 150,20 0,20"), (0, 0, 0), 40)
    marks = {"size": (0.122, 0.136), "origin": tuple(dial), "axes": (NORTH, UP), "roughness": 0.45}
    facing_east = (vertices[:, [2, 0, 1]] + dial + (0.003, 0, 0), faces)
    room.add("clock face", patterned("rings", "#efe9da", "#3a4a50", **marks), facing_east)
    room.add("clock rim", COPPER, ring((0.022, dial[1], dial[2]), 0.152, 0.014, NORTH, UP, 40))
    room.add(
        "clock hands",
        plain("#26282b", 0.4),
        tube([(0.0285, 2.78, 1.95), (0.0285, 2.84, 1.99)], 0.004, 8),
        tube([(0.0285, 2.78, 1.95), (0.0285, 2.745, 2.05)], 0.0032, 8),
        sphere((0.028, 2.78, 1.95), 0.009, 10),
    )


def _floor(room: RoomBuilder) -> None:
    steel_bin = mm("0,0 125,0 130,6 145,460 138,460 124,12 0,11")
    room.add("bin", STEEL, lathe(steel_bin, (0.28, 2.95, FLOOR), 36))
    vase = mm("0,0 130,0 170,100 175,220 120,360 125,400 112,400 105,345 0,345")
    room.add("floor vase", plain("#b5694a", 0.75, "#9c5438", grain=8, vary=0.05), lathe(vase, (0.42, 0.42, FLOOR), 40))
    stalks, leaves = [], []
    for k in range(9):
        turn, height, lean = 137.5 * k, 0.85 + 0.09 * (k % 5), 0.10 + 0.03 * (k % 3)
        u, v = np.cos(np.radians(turn)), np.sin(np.radians(turn))
        path = [(0.42 + out * u, 0.42 + out * v, up) for out, up in ((0.02, 0.30), (0.5 * lean, 0.62), (lean, height))]
        stalks.append(tube(path, (0.007, 0.006, 0.004), 6))
        leaves.append(leaf(0.30, 0.15, 22 - 16 * (k % 3), turn - 90, path[-1]))
    room.add("plant stalks", plain("#4a6a38", 0.6), *stalks)
    room.add("plant leaves", plain("#4f8148", 0.38, "#2f5c3c", grain=12, vary=0.1), *leaves)


def _textiles_and_basket(room: RoomBuilder) -> None:
    checks = {"roughness": 0.95, "axes": (EAST, UP), "size": (0.0275, 0.026), "origin": (2.72, 0, 0.36)}
    towel = box((2.72, 3.338, 0.36), (2.94, 3.345, 0.672), 0.002), box((2.721, 3.3355, 0.668), (2.939, 3.377, 0.674), 0.002)
    room.add("tea towel", patterned("checks", "#eee7da", "#a8453c", "#eee7da", **checks), *towel)
    hooks = [tube([(x, 0.020, 1.55), (x, 0.06, 1.55), (x, 0.066, 1.575)], 0.005, 8) for x in (0.95, 1.02, 1.09)]
    rail = box((0.90, 0.004, 1.52), (1.14, 0.022, 1.58), 0.004)
    room.add("apron hooks", wood(WALNUT, WALNUT_DARK, EAST, UP, 0.4), rail, *hooks)
    weave = {"roughness": 0.85, "axes": (EAST, UP), "size": (0.045, 0.03), "origin": (0.01, 0, 0)}
    basket = lathe(mm("0,0 160,0 175,20 200,260 190,260 166,25 0,20"), (3.12, 0.28, FLOOR), 36)
    room.add("basket", patterned("checks", "#b98d55", "#8a6236", **weave), basket)
    pear = mm("0,4 20,0 38,20 40,40 26,70 16,92 6,100 0,100")
    places = (-0.07, 0.0, 0), (0.02, -0.07, 0), (0.05, 0.05, 0), (-0.02, 0.08, 0), (0.0, 0.0, 0.075)
    pears = [lathe(pear, (3.12 + dx, 0.28 + dy, FLOOR + 0.021 + dz), 18) for dx, dy, dz in places]
    room.add("pears", plain("#a9b04a", 0.4, "#c2a746", grain=14, vary=0.1), *pears)


STEPS = (_low_shelf, _high_shelf, _book_shelves, _sideboard, _walls, _floor, _textiles_and_basket)
