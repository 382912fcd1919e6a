"""A latitude-longitude map of the light around a scene: directions, texels, solid angles, densities (METHOD 2.6).

Row 0 is up (+z): theta = acos(d_z), phi = atan2(d_y, d_x) mod 2 pi, row = floor(theta / pi H), column =
floor(phi / 2 pi W); radiance is constant in a texel. A direction drawn in texel e with probability p(e), uniform
in z and in phi, has the density p(e) / Omega_e per steradian, Omega_e the texel's solid angle.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from iif_core.errors import InputError
from iif_core.numerics.xp import NUMPY, Namespace

Array = np.ndarray


def solid_angles(height: int, width: int) -> Array:
    """(H, W) float64 in steradians, 2 pi / W (cos theta_row - cos theta_row+1); they sum to 4 pi."""
    # 2 sin sin instead of the difference of two cosines: no cancellation at the poles.
    row = np.arange(height)
    band = 2 * np.sin(np.pi * (row + 0.5) / height) * np.sin(0.5 * np.pi / height)
    return np.repeat((2 * np.pi / width * band)[:, None], width, axis=1)


def texel_of(xp: Namespace, direction: tuple[Any, Any, Any], height: int, width: int) -> tuple[Any, Any]:
    """(row, column), whole numbers in the float type of the unit direction; poles and the seam belong to a texel too."""
    x, y, z = direction
    theta = xp.acos(xp.minimum(xp.maximum(z, -1.0), 1.0))
    phi = xp.atan2(y, x)
    phi = xp.where(phi < 0, phi + 2 * xp.pi, phi)
    row = xp.minimum(xp.floor(theta * (height / xp.pi)), height - 1.0)
    return row, xp.minimum(xp.floor(phi * (width / (2 * xp.pi))), width - 1.0)


def direction_in(xp: Namespace, row: Any, column: Any, u1: Any, u2: Any, height: int, width: int) -> tuple[Any, Any, Any]:
    """Unit direction in a texel, uniform per steradian for uniform u1, u2 in [0, 1]; (1/2, 1/2) is its middle."""
    upper, lower = xp.cos(row * (xp.pi / height)), xp.cos((row + 1) * (xp.pi / height))
    z = upper + u1 * (lower - upper)
    phi = (column + u2) * (2 * xp.pi / width)
    sine = xp.sqrt(xp.maximum((1 - z) * (1 + z), 0.0))
    return sine * xp.cos(phi), sine * xp.sin(phi), z


def texel_weights(radiance: ArrayLike) -> Array:
    """(H, W) float64 mean radiance x solid angle of (H, W, 3): how often a texel is to be drawn."""
    radiance = as_map(radiance)
    return radiance.mean(-1, dtype=np.float64) * solid_angles(*radiance.shape[:2])


def as_map(radiance: ArrayLike) -> Array:
    """(H, W, 3) float32 of a map or of one radiance (3,), which is the map (1, 1, 3). Raises InputError."""
    radiance = np.asarray(radiance, np.float32)
    if radiance.shape == (3,):
        radiance = radiance[None, None]
    if radiance.ndim != 3 or radiance.shape[2] != 3 or 0 in radiance.shape:
        raise InputError(f"environment radiance has shape {radiance.shape}; expected (3,) or (height, width, 3)")
    if not np.isfinite(radiance).all():
        raise InputError("environment radiance contains NaN or infinity")
    if radiance.min() < 0:
        raise InputError("environment radiance is negative somewhere; radiance is never negative")
    return radiance


def look_up(radiance: ArrayLike, direction: ArrayLike) -> Array:
    """(n, 3) float32 radiance of a map along unit directions (n, 3)."""
    radiance = as_map(radiance)
    height, width = radiance.shape[:2]
    row, column = texel_of(NUMPY, tuple(np.asarray(direction, np.float64).T), height, width)
    return radiance[row.astype(np.int64), column.astype(np.int64)]


def resample(radiance: ArrayLike, map_from_world: ArrayLike, height: int, width: int, points: int = 4) -> Array:
    """(H, W, 3) float32 mean over every texel of a map that is turned against the world.

    map_from_world (3, 3): the map's axes (z up, x at the seam) as rows, in world axes. points^2 directions a texel, evenly
    in z and phi; take enough of them that no bright texel of a finer map is missed.
    """
    row, column, i, j = np.indices((height, width, points, points), np.float64)
    middle = (i + 0.5) / points, (j + 0.5) / points
    direction = np.stack(direction_in(NUMPY, row, column, *middle, height, width), -1).reshape(-1, 3)
    seen = look_up(radiance, direction @ np.asarray(map_from_world, np.float64).T)
    return seen.reshape(height, width, -1, 3).mean(2, dtype=np.float64).astype(np.float32)
