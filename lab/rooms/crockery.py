"""Bowls, plates, mugs, bottles, fruit and plants: the shapes of the small things in a kitchen. Lengths are metres."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lab.rooms.shapes import Shape, ellipsoid, lathe, mm, move, tube


def bowl(base: Sequence[float], radius: float, height: float, wall: float = 0.006, foot: float = 0.45) -> Shape:
    """Make a round bowl that stands on `base`.

    Args:
        base: (3,) middle of its foot.
        radius: of the rim, outside.
        height: of the rim above the base.
        wall: thickness.
        foot: radius of the foot as a share of `radius`.

    Returns:
        A closed shape.
    """
    s = np.linspace(0, 1, 7)[1:]
    outer = [(foot * radius + (1 - foot) * radius * np.sin(np.pi / 2 * t), height * (1 - np.cos(np.pi / 2 * t))) for t in s]
    inner = [(r - wall, max(z, 1.6 * wall)) for r, z in reversed(outer)]
    return lathe([(0, 0), (foot * radius, 0), *outer, *inner, (0.4 * radius, 1.5 * wall), (0, 1.5 * wall)], base, 32)


def plate(base: Sequence[float], radius: float) -> Shape:
    """Make a plate with a raised rim that stands on `base`."""
    return lathe(mm("0,0 580,0 700,6 1000,18 995,22 690,11 600,6 0,5", radius), base, 32)


def mug(base: Sequence[float], radius: float, height: float, turn: float) -> list[Shape]:
    """Make a mug and its handle.

    Args:
        base: (3,) middle of its foot.
        radius: outside.
        height: of the rim above the base.
        turn: degrees from +x to the handle, counter-clockwise seen from above.

    Returns:
        Two closed shapes: body and handle.
    """
    r, h, w = radius, height, 0.004
    body = lathe([(0, 0), (r - w, 0), (r, w), (r, h), (r - w, h), (r - w, 2 * w), (0, 2 * w)], segments=24)
    reach = ((-0.002, 0.80), (0.022, 0.78), (0.028, 0.50), (0.018, 0.26), (-0.002, 0.22))
    handle = tube([(r + out, 0, up * h) for out, up in reach], 0.005, 8)
    return [move(part, base, turn) for part in (body, handle)]


def bottle(base: Sequence[float], radius: float, height: float, neck: float = 0.3) -> Shape:
    """Make a bottle with sloping shoulders.

    Args:
        base: (3,) middle of its foot.
        radius: of the body.
        height: of the mouth above the base.
        neck: length of the neck as a share of `height`.

    Returns:
        A closed shape.
    """
    r, h = radius, height
    foot = [(0, 0), (r - 0.004, 0), (r, 0.005), (r, h * (0.92 - neck) - 0.02)]
    shoulder = [(0.92 * r, h * (0.96 - neck)), (0.45 * r, h * (1.06 - neck)), (0.34 * r, h * (1.12 - neck))]
    return lathe([*foot, *shoulder, (0.34 * r, h - 0.012), (0.42 * r, h - 0.01), (0.42 * r, h), (0, h)], base, 24)


def jar(base: Sequence[float], radius: float, height: float) -> tuple[Shape, Shape]:
    """Make a storage jar and its lid."""
    r, h = radius, height
    rim = [(r, h - 0.02), (r - 0.008, h - 0.008), (r - 0.012, h), (0, h)]
    body = lathe([(0, 0), (r - 0.006, 0), (r, 0.006), *rim], base)
    lid = mm("0,0 960,0 1000,4 1000,12 500,24 200,27 160,36 220,50 100,57 0,57", r)
    return body, lathe(lid, (base[0], base[1], base[2] + h + 0.001))


def apple(base: Sequence[float], radius: float) -> Shape:
    """Make an apple that stands on `base`."""
    profile = mm("0,120 250,0 620,160 930,620 1000,1050 860,1500 550,1740 220,1720 0,1520", radius, radius)
    return lathe(profile, base, 20)


def loaf(base: Sequence[float], half: Sequence[float]) -> Shape:
    """Make an ellipsoid with half axes `half` (3,) that stands on `base`."""
    return ellipsoid((base[0], base[1], base[2] + half[2]), half, 18)


def leaf(length: float, width: float, tilt: float, turn: float, stem: Sequence[float]) -> Shape:
    """Make a leaf.

    Args:
        length, width: of the blade.
        tilt: degrees by which the blade rises from the horizontal.
        turn: degrees from +y to the direction of the blade, counter-clockwise seen from above.
        stem: (3,) where it is attached.

    Returns:
        A closed, flat ellipsoid.
    """
    return move(ellipsoid((0, length / 2, 0), (width / 2, length / 2, 0.0022), 10), stem, turn, tilt)
