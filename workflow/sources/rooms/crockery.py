"""Bowls, plates, mugs, bottles and fruit: the shapes that stand about in a kitchen."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from workflow.sources.rooms.shapes import Shape, lathe, mm, move, sphere, stretch, tube


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


def leaf(length: float, width: float, tilt: float, turn: float, at: Sequence[float]) -> Shape:
    blade = stretch(sphere((0, 0, 0), 1.0, 10), (width / 2, length / 2, 0.0022))
    return move(move(blade, (0, length / 2, 0)), at, turn, tilt)


def stretch_to(base: Sequence[float], half: Sequence[float]) -> Shape:
    """An ellipsoid that stands on `base`."""
    return move(stretch(sphere((0, 0, 0), 1.0, 18), half), (base[0], base[1], base[2] + half[2]))
