"""Laplace distributions: closed-form scales of the fusion (docs/method/fusion.md, Eqs. F.6, F.31).

Given scales are floored (docs/method/numerics.md#laplace-scale-at-zero). Arrays may have any shapes that
broadcast, float32 or float64; distances and scales have the unit of the texture values.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from iif_core.errors import InputError

SCALE_FLOOR = 0.01
"""Smallest scale; 2.5 steps of an 8-bit map."""


def floored(scale: NDArray, floor: float = SCALE_FLOOR) -> NDArray:
    """Return max(b, floor)."""
    if not floor > 0:
        raise InputError(f"Laplace scale floor is {floor}; it must be positive, for example {SCALE_FLOOR}")
    return np.maximum(scale, floor)


def scale_contribution(distance: NDArray, b_ref: NDArray, floor: float = SCALE_FLOOR) -> NDArray:
    """Compute E|x - mu_pred| = d + b_r exp(-d / b_r) for x drawn from the reference (Eq. F.6).

    The weighted mean of these values is the b_pred that minimises the summed divergence (Eq. F.31).
    """
    d = np.abs(distance)
    b_r = floored(b_ref, floor)
    return d + b_r * np.exp(-d / b_r)
