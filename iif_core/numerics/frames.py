"""Frames around directions, for any array namespace, and the side of a cube that a direction passes through."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iif_core.numerics.xp import Namespace

SEAM = -0.625
"""Height at which the frame turns over. It has to somewhere; at 0, where the customary form has it, it would on every vertical
wall whose normal is horizontal to rounding (docs/method/numerics.md#frames-that-turn-over)."""

AXIS_WEIGHTS = (1.0, 1.0477, 0.9431)
"""Factors of |x|, |y| and |z| before they are compared. With equal ones rounding would decide on every surface at 45 degrees
(docs/method/numerics.md#sides-of-slanted-surfaces)."""

Vector = tuple[Any, Any, Any]


def tangent_frame(xp: Namespace, x: Any, y: Any, z: Any) -> tuple[Vector, Vector]:
    """Return two unit vectors that form a right-handed frame with a unit vector (Duff et al. 2017, with another seam).

    Args:
        xp: array namespace.
        x, y, z: components of the unit vector.

    Returns:
        Tangent t and bitangent b with t x b = (x, y, z), three arrays each.
    """
    one = 0 * z + 1  # in the type of z
    sign = xp.where(z < SEAM, -one, one)
    a = -1 / (sign + z)
    b = x * y * a
    return (1 + sign * x * x * a, sign * b, -sign * x), (b, sign + y * y * a, -y)


def dominant_side(normals: ArrayLike) -> NDArray:
    """Number the side of a box that each direction passes through.

    Args:
        normals: (n, 3) directions of any length.

    Returns:
        (n,) int64, 0 ... 5: twice the axis with the largest weighted component (`AXIS_WEIGHTS`), plus 1 where it is negative.
    """
    normals = np.asarray(normals)
    axis = (np.abs(normals) * np.asarray(AXIS_WEIGHTS, normals.dtype)).argmax(1)
    return 2 * axis + (np.take_along_axis(normals, axis[:, None], 1)[:, 0] < 0)
