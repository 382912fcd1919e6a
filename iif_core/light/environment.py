"""A latitude-longitude map of the light around a scene: directions, texels and solid angles (Eq. L.7, L.8).

Row 0 is up (+z); radiance is constant in a texel.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from iif_core.errors import InputError
from iif_core.numerics.xp import NUMPY, Namespace

Array = np.ndarray


def solid_angles(height: int, width: int) -> Array:
    """Return the solid angles (H, W) float64 of all texels in steradians (Eq. L.8); they sum to 4 pi.

    >>> bool(abs(solid_angles(4, 8).sum() - 4 * np.pi) < 1e-12)
    True
    """
    # 2 sin sin instead of the difference of two cosines: no cancellation at the poles.
    row = np.arange(height)
    band = 2 * np.sin(np.pi * (row + 0.5) / height) * np.sin(0.5 * np.pi / height)
    return np.repeat((2 * np.pi / width * band)[:, None], width, axis=1)


def texel_of(xp: Namespace, direction: tuple[Any, Any, Any], height: int, width: int) -> tuple[Any, Any]:
    """Find the texel of a direction (Eq. L.7; docs/method/numerics.md#poles-of-the-environment-map).

    Args:
        xp: array namespace.
        direction: unit vector, three arrays.
        height, width: of the map.

    Returns:
        Row and column, whole numbers in the float type of the direction.
    """
    x, y, z = direction
    theta = xp.acos(xp.minimum(xp.maximum(z, -1.0), 1.0))
    phi = xp.atan2(y, x)
    phi = xp.where(phi < 0, phi + 2 * xp.pi, phi)
    # The limits catch theta = pi and an azimuth that rounding brings to 2 pi.
    row = xp.minimum(xp.floor(theta * (height / xp.pi)), height - 1.0)
    return row, xp.minimum(xp.floor(phi * (width / (2 * xp.pi))), width - 1.0)


def direction_in(xp: Namespace, row: Any, column: Any, u1: Any, u2: Any, height: int, width: int) -> tuple[Any, Any, Any]:
    """Draw a direction in a texel, uniform per steradian.

    Args:
        xp: array namespace.
        row, column: of the texel, as floats.
        u1, u2: uniform in [0, 1]; (1/2, 1/2) is the middle.
        height, width: of the map.

    Returns:
        Unit vector, three arrays.
    """
    half = xp.pi / (2 * height)

    def between(first: Any, last: Any) -> Any:
        """2 sin^2 of half the angles from a pole, which keeps its digits where 1 - cos does not."""
        near, far = xp.sin(first * half), xp.sin(last * half)
        return 2 * ((1 - u1) * near * near + u1 * far * far)

    # sin^2 of the polar angle is (1 - z)(1 + z), a product without cancellation at either pole.
    above, below = between(row, row + 1), between(height - row, height - row - 1)  # 1 - z and 1 + z
    phi = (column + u2) * (2 * xp.pi / width)
    sine = xp.sqrt(above * below)
    return sine * xp.cos(phi), sine * xp.sin(phi), 0.5 * (below - above)


def texel_weights(radiance: ArrayLike) -> Array:
    """Return (H, W) float64, how often each texel of (H, W, 3) is to be drawn: mean radiance x solid angle."""
    radiance = as_map(radiance)
    return radiance.mean(-1, dtype=np.float64) * solid_angles(*radiance.shape[:2])


def as_map(radiance: ArrayLike) -> Array:
    """Check a map (H, W, 3), or one radiance (3,) as the map (1, 1, 3), and return it as float32. Raises InputError."""
    radiance = np.asarray(radiance, np.float32)
    if radiance.shape == (3,):
        radiance = radiance[None, None]
    if radiance.ndim != 3 or radiance.shape[2] != 3 or 0 in radiance.shape:
        raise InputError(f"environment radiance has shape {radiance.shape}; expected (3,) or (height, width, 3)")
    if not np.isfinite(radiance).all():
        raise InputError("environment radiance contains NaN or infinity")
    if radiance.min() < 0:
        raise InputError(f"environment radiance is {radiance.min():g} somewhere; radiance is never negative")
    return radiance


def look_up(radiance: ArrayLike, direction: ArrayLike) -> Array:
    """Return the radiance (n, 3) float32 of a map along unit directions (n, 3)."""
    radiance = as_map(radiance)
    height, width = radiance.shape[:2]
    row, column = texel_of(NUMPY, tuple(np.asarray(direction, np.float64).T), height, width)
    return radiance[row.astype(np.int64), column.astype(np.int64)]


def resample(radiance: ArrayLike, map_from_world: ArrayLike, height: int, width: int, points: int = 4) -> Array:
    """Average a map that is turned against the world over the texels of a new map.

    Args:
        radiance: (h, w, 3) or (3,), linear.
        map_from_world: (3, 3), the map's axes (z up, x at the seam) as rows, in world axes.
        height, width: of the new map.
        points: points^2 directions per texel, evenly in z and azimuth; enough of them that no bright texel of a finer map is
            missed.

    Returns:
        (height, width, 3) float32.
    """
    row, column, i, j = np.indices((height, width, points, points), np.float64)
    middle = (i + 0.5) / points, (j + 0.5) / points
    direction = np.stack(direction_in(NUMPY, row, column, *middle, height, width), -1).reshape(-1, 3)
    seen = look_up(radiance, direction @ np.asarray(map_from_world, np.float64).T)
    return seen.reshape(height, width, -1, 3).mean(2, dtype=np.float64).astype(np.float32)
