"""An orthonormal frame around a direction, for any array namespace."""

from __future__ import annotations

from typing import Any

from iif_core.numerics.xp import Namespace

SEAM = -0.625
"""Height at which the frame turns over. It has to somewhere; at 0, where the customary form has it, it would on every vertical
wall whose normal is horizontal to rounding (docs/method/numerics.md#frames-that-turn-over)."""

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
