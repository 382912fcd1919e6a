"""Random solids for clutter: boxes, balls, vases, bowls, stones, rings, bent rods."""

from __future__ import annotations

import numpy as np

from lab.prior.building import box
from lab.rooms import shapes
from lab.rooms.shapes import Shape


def solid(rng: np.random.Generator, size: float) -> Shape:
    """Draw a solid of about `size` metres radius around the origin."""
    kinds = (_box, _ball, _cylinder, _vase, _bowl, _ellipsoid, _stone, _ring, _rod)
    return kinds[rng.integers(len(kinds))](rng, size)


def _box(rng: np.random.Generator, size: float) -> Shape:
    half = rng.uniform(0.3, 1, 3) * size
    return shapes.move(box(-half, half, 0.03 * size if rng.random() < 0.5 else 0), (0, 0, 0), rng.uniform(0, 90))


def _ball(rng: np.random.Generator, size: float) -> Shape:
    return shapes.sphere((0, 0, 0), size, 28)


def _cylinder(rng: np.random.Generator, size: float) -> Shape:
    return shapes.cylinder((0, 0, 0), size * rng.uniform(0.3, 0.9), size * rng.uniform(0.3, 2.2), 0.03 * size, 32)


def _profile(rng: np.random.Generator, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Radii and heights (14,) of a smooth random outline, metres."""
    knots = int(rng.uniform(3, 8))
    radii = np.interp(np.linspace(0, 1, 14), np.linspace(0, 1, knots), rng.uniform(0.25, 1, knots)) * size
    return radii, np.linspace(0, size * rng.uniform(0.6, 2.5), 14)


def _vase(rng: np.random.Generator, size: float) -> Shape:
    radii, z = _profile(rng, size)
    return shapes.lathe([(0, 0), *zip(radii, z, strict=True), (0, z[-1])], (0, 0, 0), 28)


def _bowl(rng: np.random.Generator, size: float) -> Shape:
    radii, z = _profile(rng, size)
    inner = [(max(r - 0.04 * size, 0.01), h) for r, h in zip(radii[::-1][:-2], z[::-1][:-2], strict=True)]
    return shapes.lathe([(0, 0), *zip(radii, z, strict=True), *inner, (0, z[2])], (0, 0, 0), 28)


def _ellipsoid(rng: np.random.Generator, size: float) -> Shape:
    return shapes.ellipsoid((0, 0, 0), rng.uniform(0.3, 1, 3) * size, 24, rng.uniform(0, 90))


def _stone(rng: np.random.Generator, size: float) -> Shape:
    return shapes.hull(rng.normal(0, 0.5, (14, 3)) * size)


def _ring(rng: np.random.Generator, size: float) -> Shape:
    axes = rng.permutation(np.eye(3))
    return shapes.ring((0, 0, 0), size * 0.8, size * rng.uniform(0.08, 0.3), axes[0], axes[1], 32)


def _rod(rng: np.random.Generator, size: float) -> Shape:
    steps = np.abs(rng.normal(0.4, 0.3, (4, 3))) * (1, rng.choice([-1, 1]), 1)
    return shapes.tube(np.cumsum(np.concatenate([[[0, 0, 0]], steps]), 0) * size * 0.6, size * rng.uniform(0.05, 0.2), 12)
