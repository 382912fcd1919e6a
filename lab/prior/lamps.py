"""Lamps in a room: panels, spots, bulbs, shades, strips, tubes, and strips hidden behind a ledge."""

from __future__ import annotations

import numpy as np

from lab.prior.building import Building, box
from lab.prior.palette import of_tone
from lab.rooms import shapes


def light_up(building: Building) -> None:
    """Add lamps: always where no light comes from outside, at times where it does."""
    rng = building.rng
    outside = bool(building.holes or building.doors)
    count = int(rng.choice([0, 1, 2, 3, 5], p=[0.35, 0.3, 0.2, 0.1, 0.05])) if outside else int(rng.integers(1, 6))
    kinds = (panel, spots, bulb, shade, strip, tube, hidden)
    for _ in range(count):
        kinds[rng.choice(len(kinds), p=[0.3, 0.12, 0.16, 0.14, 0.08, 0.1, 0.1])](building, _level(building))
    if not outside and not any(part.radiance.any() for part in building.parts):
        panel(building, np.array([8.0, 8.0, 7.0]))


def _level(b: Building) -> np.ndarray:
    """Radiance (3,) of a lamp: white to warm, a few coloured."""
    tint = np.clip(1 + b.between(-0.6, 1.0) * np.array([0.35, 0.0, -0.45]), 0.1, None)
    if b.chance(0.04):
        tint = np.array(of_tone(b.rng, "strong")) * 2 + 0.05
    return float(10 ** b.between(0.3, 1.6)) * tint


def panel(b: Building, level: np.ndarray) -> None:
    """A flat box under the ceiling."""
    x, y, z = b.size
    w, d, t = b.between(0.2, min(1.4, 0.6 * x)), b.between(0.2, min(1.0, 0.6 * y)), b.between(0.02, 0.08)
    at = np.array([b.between(0.1, x - w - 0.1), b.between(0.1, y - d - 0.1), z - t - 0.01])
    b.shine("panel", box(at, at + (w, d, t)), radiance=level)


def spots(b: Building, level: np.ndarray) -> None:
    """Small discs under the ceiling."""
    x, y, z = b.size
    places = [(b.between(0.3, x - 0.3), b.between(0.3, y - 0.3), z - 0.02) for _ in range(b.rng.integers(2, 7))]
    b.shine("spots", *[shapes.cylinder(place, 0.05, 0.018, 0, 16) for place in places], radiance=level * 6)


def bulb(b: Building, level: np.ndarray) -> None:
    """A ball on a cord, at times under an open shade."""
    x, y, z = b.between(0.4, b.size[0] - 0.4), b.between(0.4, b.size[1] - 0.4), b.size[2] - b.between(0.3, 1.0)
    radius = b.between(0.04, 0.16)
    b.add("cord", b.material("thin"), shapes.tube([(x, y, z), (x, y, b.size[2] - 0.005)], 0.004, 6))
    b.shine("bulb", shapes.sphere((x, y, z - radius), radius, 18), radiance=level * 2)
    if b.chance(0.5):
        outline = [(0, 0), (radius * 2.4, -radius * 2.2), (radius * 2.35, -radius * 2.2), (0, -0.02)]
        vertices, faces = shapes.lathe(outline, (x, y, z + 0.03), 24)
        b.add("open shade", b.material(), (vertices, faces[:, ::-1]))


def shade(b: Building, level: np.ndarray) -> None:
    """A luminous shade on a stand, on the floor or on furniture."""
    if b.tops and b.chance(0.5):
        top = b.tops[b.rng.integers(len(b.tops))]
        foot, high = np.array([*(top.low + top.high) / 2, top.z]), b.between(0.2, 0.4)
    else:
        foot, high = np.array([b.between(0.3, b.size[0] - 0.3), b.between(0.3, b.size[1] - 0.3), 0.0]), b.between(1.0, 1.6)
    if foot[2] + high + 0.3 > b.size[2]:
        return
    rod = shapes.tube([foot + (0, 0, 0.02), foot + (0, 0, high)], 0.012, 8)
    b.add("stand", b.material("thin"), shapes.cylinder(foot + (0, 0, 0.001), 0.1, 0.02), rod)
    outline = [(0, 0), (b.between(0.1, 0.2), 0), (b.between(0.06, 0.15), b.between(0.15, 0.3)), (0, 0.15)]
    b.shine("shade", shapes.lathe(outline, foot + (0, 0, high), 24), radiance=0.5 * level)


def strip(b: Building, level: np.ndarray) -> None:
    """A bar along the south wall, under the ceiling."""
    x, z = b.size[0], b.size[2]
    start = b.between(0.2, 0.5) * x
    b.shine("strip", box((start, 0.02, z - 0.08), (start + b.between(0.3, 0.45) * x, 0.06, z - 0.04)), radiance=level * 2)


def tube(b: Building, level: np.ndarray) -> None:
    """A thin tube under the ceiling."""
    x, y, z = b.between(0.2, b.size[0] - 1.0), b.between(0.2, b.size[1] - 0.2), b.size[2] - 0.05
    b.shine("tube", shapes.tube([(x, y, z), (x + b.between(0.5, 0.8), y, z)], 0.02, 10), radiance=level * 2)


def hidden(b: Building, level: np.ndarray) -> None:
    """A strip behind a ledge along the west wall, which no camera sees."""
    y, z = b.size[1], b.size[2]
    ledge = box((0.001, 0.2, z - 0.34), (0.2, y - 0.2, z - 0.31)), box((0.18, 0.2, z - 0.31), (0.2, y - 0.2, z - 0.22))
    b.add("ledge", b.material("wall"), *ledge)
    b.shine("hidden", shapes.sheet((0.04, 0.25, z - 0.305), (0.1, 0, 0), (0, y - 0.5, 0), 0.5), radiance=level * 3)
