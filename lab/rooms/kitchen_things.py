"""The loose things on the kitchen's table, hob and worktops."""

from __future__ import annotations

import numpy as np

from lab.rooms.crockery import apple, bottle, bowl, jar, leaf, loaf, mug, plate
from lab.rooms.palette import (
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
from lab.rooms.shapes import box, ellipsoid, lathe, mm, move, tube

TABLE, HOB, WORKTOP, SILL = 0.746, 0.9465, 0.902, 1.053  # heights, metres


def _table(room: RoomBuilder) -> None:
    z = TABLE
    bands = {"size": (0.1, 0.047), "origin": (0, 0.013, 0), "roughness": 0.95}
    cloth = patterned("stripes", "#e3d9c3", "#47757f", "#c9a24a", **bands)
    room.add("table runner", cloth, box((1.60, 1.28, z), (1.90, 2.22, z + 0.004)))
    room.add("fruit bowl", recoloured(WHITE_GLAZE, "#2f5f73", "#2a5568"), bowl((1.75, 1.75, z + 0.005), 0.15, 0.075))
    base = z + 0.005 + 0.011
    places = (1.71, 1.71, base, 0.039), (1.79, 1.72, base, 0.037), (1.745, 1.80, base, 0.040), (1.75, 1.745, base + 0.062, 0.038)
    room.add("apples", plain("#b3322a", 0.28, "#cf8a3a", grain=16, vary=0.1), *(apple(at, radius) for *at, radius in places))
    for side, x, y in (("west", 1.24, 1.62), ("east", 2.24, 1.90)):
        rim = patterned("rings", "#efeae0", "#3d6d86", roughness=0.14, size=(0.098, 0.112), origin=(x, y, z))
        room.add(f"plate {side}", rim, plate((x, y, z), 0.12))
    roll = loaf((1.24, 1.62, z + 0.0065), (0.055, 0.045, 0.032))
    room.add("bread roll", plain("#c98d4c", 0.75, "#8d5526", grain=26), roll)
    room.add("mug blue", plain("#4f86a0", 0.18), *mug((1.36, 1.87, z), 0.039, 0.092, 150))
    room.add("mug yellow", plain("#d8a335", 0.18), *mug((2.13, 1.60, z), 0.039, 0.092, -30))
    jug = mm("0,0 42,0 52,30 48,75 34,115 42,150 38,150 30,115 43,75 46,30 36,7 0,6")
    room.add("milk jug", WHITE_GLAZE, lathe(jug, (2.02, 1.99, z)))
    room.add("oil bottle", plain("#4d5d1f", 0.08, "#5b6a25"), bottle((1.53, 1.53, z), 0.034, 0.27))


def _hob(room: RoomBuilder) -> None:
    z = HOB
    pot = mm("0,0 100,0 108,8 110,125 114,128 106,130 104,12 0,10")
    room.add("copper pot", COPPER, lathe(pot, (2.76, 3.80, z), 36))
    bow = (0.108, 3.77, 0.10), (0.145, 3.775, 0.105), (0.145, 3.825, 0.105), (0.108, 3.83, 0.10)
    handles = [tube([(2.76 + s * out, y, z + up) for out, y, up in bow], 0.006, 10) for s in (-1, 1)]
    room.add("pot handles", BRASS, *handles)
    lid = mm("0,0 108,0 112,4 90,18 12,32 10,45 20,55 16,64 0,66")
    room.add("pot lid", COPPER, lathe(lid, (2.76, 3.80, z + 0.132), 36))
    pan = lathe(mm("0,0 95,0 125,40 120,42 92,6 0,5"), (3.04, 3.585, z), 36)
    grip = [(3.13, 3.51, z + 0.03), (3.20, 3.455, z + 0.042), (3.30, 3.375, z + 0.046)]
    room.add("frying pan", IRON, pan, tube(grip, (0.008, 0.009, 0.011), 10))
    body = mm("0,0 82,0 94,12 98,50 85,100 50,135 30,142 12,148 10,158 16,168 10,178 0,179")
    spout = [(2.965, 3.80, z + 0.065), (2.925, 3.785, z + 0.095), (2.905, 3.775, z + 0.135)]
    kettle = lathe(body, (3.04, 3.83, z), 36), tube(spout, (0.018, 0.014, 0.010), 12)
    room.add("kettle", plain("#b4362c", 0.14, "#a93028"), *kettle)
    bow = (2.985, 3.81, 0.115), (2.985, 3.81, 0.20), (3.04, 3.83, 0.235), (3.095, 3.85, 0.20), (3.095, 3.85, 0.115)
    room.add("kettle handle", plain("#26262a", 0.4), tube([(x, y, z + up) for x, y, up in bow], 0.008, 10))


def _north_worktop_left(room: RoomBuilder) -> None:
    z = WORKTOP
    feet = [box((x, y, z), (x + 0.02, y + 0.02, z + 0.02)) for x in (0.95, 1.19) for y in (3.63, 3.73)]
    room.add("toaster", STEEL, box((0.92, 3.60, z + 0.012), (1.24, 3.78, z + 0.19), 0.022), *feet)
    slots = [box((0.97, y, z + 0.186), (1.19, y + 0.028, z + 0.1925)) for y in (3.645, 3.707)]
    room.add("toaster slots", plain("#1c1c1f", 0.5), *slots)
    jars = [(1.50, 0.065, 0.17, "#e4d9c2"), (1.66, 0.058, 0.14, "#c9775a"), (1.80, 0.050, 0.11, "#7d9a8c")]
    for number, (x, radius, height, code) in enumerate(jars, 1):
        body, lid = jar((x, 3.84, z), radius, height)
        room.add(f"jar {number}", plain(code, 0.2), body)
        room.add(f"jar lid {number}", wood(BIRCH, BIRCH_DARK, EAST, NORTH, 0.45), lid)
    leaning = ((2.38, 3.80, z + 0.022), 0, 14)
    block = move(box((-0.05, -0.075, 0.0), (0.05, 0.075, 0.20), 0.006), *leaning)
    room.add("knife block", wood(WALNUT, WALNUT_DARK, UP, EAST, 0.4), block)
    grips = [
        move(box((u - 0.009, v - 0.013, 0.196), (u + 0.009, v + 0.013, 0.285), 0.004), *leaning)
        for u in (-0.028, 0.0, 0.028)
        for v in (-0.035, 0.030)
    ]
    room.add("knife grips", plain("#2b2624", 0.35), *grips)
    board = move(box((-0.15, -0.011, 0.0), (0.15, 0.011, 0.40), 0.006), (2.06, 3.885, z + 0.003), 0, -11)
    room.add("chopping board", wood(OAK, OAK_DARK, UP, EAST, 0.5, 9.0, origin=(0.4, 0, 0.2)), board)


def _north_worktop_right(room: RoomBuilder) -> None:
    z = WORKTOP
    board = box((3.42, 3.50, z), (3.82, 3.76, z + 0.022), 0.006)
    room.add("bread board", wood(BIRCH, BIRCH_DARK, EAST, NORTH, 0.55), board)
    bread = loaf((3.60, 3.63, z + 0.0225), (0.135, 0.065, 0.055))
    room.add("loaf", plain("#c08243", 0.8, "#7d4a22", grain=18, vary=0.05), bread)
    bands = {"axes": (EAST, UP), "size": (0.1, 0.031), "origin": (0, 0, z)}
    glaze = patterned("stripes", "#7c98a8", "#d9d2c2", roughness=0.25, vary=0.1, **bands)
    room.add("utensil crock", glaze, lathe(mm("0,0 56,0 60,5 60,150 54,150 54,10 0,9"), (4.02, 3.82, z), 28))
    spoons = []
    places = (-0.028, 0.01, -0.06, 0.30), (0.02, 0.025, 0.05, 0.33), (0.01, -0.03, 0.03, 0.29), (-0.01, 0.03, -0.02, 0.34)
    for u, v, w, h in places:
        handle = [(4.02 + u, 3.82 + v, z + 0.012), (4.02 + u + w, 3.82 + 1.6 * v, z + h - 0.05)]
        head = ellipsoid((4.02 + u + 1.1 * w, 3.82 + 1.65 * v, z + h - 0.03), (0.026, 0.009, 0.038), 12)
        spoons += [tube(handle, 0.006, 8), head]
    room.add("wooden spoons", wood(BIRCH, BIRCH_DARK, UP, EAST, 0.6), *spoons)
    room.add("wine bottle", plain("#1f3524", 0.06, "#274230"), bottle((4.28, 3.84, z), 0.038, 0.31))
    room.add("vinegar bottle", plain("#7c3a1e", 0.08, "#8c4a26"), bottle((4.40, 3.80, z), 0.032, 0.25, 0.34))
    wine, vinegar = mm("0,70 38.8,70 38.8,150 0,150"), mm("0,60 32.7,60 32.7,120 0,120")
    labels = lathe(wine, (4.28, 3.84, z), 24), lathe(vinegar, (4.40, 3.80, z), 24)
    room.add("bottle labels", plain("#e6dcc2", 0.7), *labels)
    room.add("mixing bowl", plain("#d9b24a", 0.2, "#d3aa40"), bowl((4.72, 3.62, z), 0.16, 0.13))
    places = (-0.05, -0.03, 0.034, 20), (0.05, -0.02, 0.034, 80), (0.0, 0.06, 0.036, -30), (0.0, 0.0, 0.088, 45)
    half = (0.042, 0.032, 0.032)
    lemons = [ellipsoid((4.72 + dx, 3.62 + dy, z + 0.011 + dz), half, 16, turn) for dx, dy, dz, turn in places]
    room.add("lemons", plain("#e3c136", 0.4, "#c9a326", grain=24, vary=0.1), *lemons)


def _east_worktop(room: RoomBuilder) -> None:
    z = WORKTOP
    plates = [plate((4.66, 2.90, z + 0.0105 * k), 0.115) for k in range(6)]
    room.add("plate stack", recoloured(WHITE_GLAZE, "#dfe4df", "#d6ddd8"), *plates)
    flask = lathe(mm("0,0 30,0 33,4 33,110 12,128 10,150 0,150"), (4.925, 2.50, z), 20)
    pump = tube([(4.925, 2.50, z + 0.148), (4.925, 2.50, z + 0.175), (4.885, 2.50, z + 0.175)], 0.005, 8)
    room.add("soap bottle", plain("#b9805f", 0.2), flask, pump)
    profile = mm("0,0 45,0 75,60 70,120 32,190 30,215 40,235 35,235 25,215 27,190 64,120 68,60 40,10 0,10")
    room.add("glazed vase", plain("#3c6f6a", 0.1, "#7fa79a", grain=9, vary=0.08), lathe(profile, (4.70, 1.66, z), 32))
    stems, blooms = [], []
    for turn, lean, height in ((10, 0.05, 0.40), (85, 0.08, 0.36), (160, 0.06, 0.44), (235, 0.09, 0.37), (305, 0.07, 0.41)):
        u, v = np.cos(np.radians(turn)), np.sin(np.radians(turn))
        path = [(4.70 + out * u, 1.66 + out * v, z + up) for out, up in ((0.006, 0.03), (0.015, 0.22), (lean, height))]
        stems.append(tube(path, 0.003, 6))
        blooms.append(ellipsoid(path[-1], (0.034, 0.034, 0.022), 14))
    room.add("stems", plain("#4d7038", 0.6), *stems)
    room.add("flowers", plain("#d98a9c", 0.8, "#e9c9c0", grain=34), *blooms)


def _window_sill(room: RoomBuilder) -> None:
    r = 0.055
    pot = [(0, 0), (0.7 * r, 0), (r, 0.09), (1.1 * r, 0.09), (1.1 * r, 0.11), (0.95 * r, 0.11), (0.9 * r, 0.085), (0, 0.085)]
    for number, (y, code) in enumerate(((1.85, "#b9674a"), (2.62, "#c9b79a")), 1):
        room.add(f"herb pot {number}", plain(code, 0.7, grain=14.0), lathe(pot, (4.935, y, SILL), 24))
        leaves = [leaf(0.085, 0.034, 28 + 17 * (k % 3), 137.5 * k, (4.935, y, SILL + 0.086 + 0.012 * (k % 5))) for k in range(13)]
        room.add(f"herb {number}", plain("#5c8a3a", 0.55, "#3f6b2e", grain=40), *leaves)


STEPS = (_table, _hob, _north_worktop_left, _north_worktop_right, _east_worktop, _window_sill)
