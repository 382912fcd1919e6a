"""Laplace distributions: weights and closed-form scales of the fusion (docs/method/fusion.md, Eqs. F.31, F.32).

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


def kl_weight(distance: NDArray, b_ref: NDArray, b_pred: NDArray, floor: float = SCALE_FLOOR) -> NDArray:
    """Compute the weight of the quadratic function of d that majorises the divergence KL(reference || texture) (Eqs. F.7,
    F.32).

    w = (1 - exp(-d / b_r)) / (d b_p), with the limit 1 / (b_r b_p) at d = 0 (docs/method/numerics.md#weight-of-a-zero-residual).
    Least squares, reweighted with w, minimises the summed divergence over the location. The weight falls as 1 / d, so the
    influence of an outlier is bounded.

    Args:
        distance: |mu_ref - mu_pred|; the sign is ignored.
        b_ref, b_pred: scales of the reference and of the texture.
        floor: smallest scale, > 0.

    Returns:
        Weight > 0.
    """
    d = np.abs(distance)
    b_r, b_p = floored(b_ref, floor), floored(b_pred, floor)
    x = d / b_r
    ratio = np.where(x > 0, -np.expm1(-x) / np.where(x > 0, x, 1.0), 1.0)
    return ratio / (b_r * b_p)


def scale_contribution(distance: NDArray, b_ref: NDArray, floor: float = SCALE_FLOOR) -> NDArray:
    """Compute E|x - mu_pred| = d + b_r exp(-d / b_r) for x drawn from the reference (Eq. F.6).

    The weighted mean of these values is the b_pred that minimises the summed divergence (Eq. F.31).
    """
    d = np.abs(distance)
    b_r = floored(b_ref, floor)
    return d + b_r * np.exp(-d / b_r)
