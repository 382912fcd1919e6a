"""Laplace distributions: divergence, its weights, and the closed-form scales of the material base.

Every texture value is a Laplace distribution (location mu, scale b); the predictions of one pixel make a
reference distribution and the surface cell the texture distribution. Matching the two is a Kullback-Leibler
divergence that depends on the distance d = |mu_ref - mu_pred| and the two scales alone (METHOD 2.3.4), so the
scale of a cell has a closed form (METHOD 7c, b-step) and the location an M-estimator with the weight `kl_weight`.

Scales are floored where they enter: two predictions that agree exactly have scale 0, and a density of width 0 has
no finite divergence. The floor 0.01 is the reference's; it is 2.5 steps of an 8-bit map.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from iif_core.errors import InputError

SCALE_FLOOR = 0.01


def floored(scale: NDArray, floor: float = SCALE_FLOOR) -> NDArray:
    """Scales not below `floor`: max(b, floor), the hard clamp of the reference (exact for closed forms)."""
    if not floor > 0:
        raise InputError(f"Laplace scale floor is {floor}; it must be positive, for example {SCALE_FLOOR}")
    return np.maximum(scale, floor)


def kl(distance: NDArray, b_ref: NDArray, b_pred: NDArray, floor: float = SCALE_FLOOR) -> NDArray:
    """Divergence KL(reference || texture) of two Laplace distributions, element by element.

    KL = log(b_p / b_r) + d / b_p + (b_r / b_p) exp(-d / b_r) - 1,   d = |mu_ref - mu_pred| >= 0.

    Any shapes that broadcast; the unit of `distance` and the scales is the unit of the values. The result is >= 0,
    0 where d = 0 and the scales agree. Source: METHOD 2.3.4. Example: kl(0.3, 0.1, 0.2) = 1.2180407.
    """
    d = np.abs(distance)
    b_r, b_p = floored(b_ref, floor), floored(b_pred, floor)
    return np.log(b_p) - np.log(b_r) + (d + b_r * np.exp(-d / b_r)) / b_p - 1.0


def kl_weight(distance: NDArray, b_ref: NDArray, b_pred: NDArray, floor: float = SCALE_FLOOR) -> NDArray:
    """Weight of the quadratic that majorises `kl` in d: w = (1 - e^(-d/b_r)) / (d b_p), 1 / (b_r b_p) at d = 0.

    Reweighted least squares with this weight minimises the summed divergence over the location (METHOD 7c,
    mu-step). It falls as 1/d, so an outlier pulls with a bounded force.
    """
    d = np.abs(distance)
    b_r, b_p = floored(b_ref, floor), floored(b_pred, floor)
    x = d / b_r
    # below 1e-4 the series 1 - x/2 is exact to float32 and avoids 0/0
    ratio = np.where(x > 1e-4, -np.expm1(-x) / np.where(x > 1e-4, x, 1.0), 1.0 - 0.5 * x)
    return ratio / (b_r * b_p)


def lower_median(values: NDArray, axis: int = 0) -> NDArray:
    """Median that is always one of the values: for an even count the smaller of the two middle ones (METHOD H3)."""
    count = values.shape[axis]
    if count == 0:
        raise InputError("lower median of no values; give at least one along the axis")
    rank = (count - 1) // 2
    return np.take(np.partition(values, rank, axis=axis), rank, axis=axis)


def reference_scale(mu_ref: NDArray, predictions: NDArray, floor: float = SCALE_FLOOR) -> NDArray:
    """Scale of the reference: b_ref = max(lower median over k of |mu_ref - v_k|, floor).

    `predictions` (K, ...), `mu_ref` (...); returns (...). K = 1 gives |mu_ref - v|. Source: METHOD 2.3.3.
    """
    return floored(lower_median(np.abs(predictions - mu_ref[None]), axis=0), floor)


def scale_contribution(distance: NDArray, b_ref: NDArray, floor: float = SCALE_FLOOR) -> NDArray:
    """What one observation adds to a cell's scale: d + b_r e^(-d/b_r) = E|x - mu_pred| under the reference.

    The minimiser of the summed divergence over b_pred is the weighted mean of these (METHOD 7c, b-step).
    """
    d = np.abs(distance)
    b_r = floored(b_ref, floor)
    return d + b_r * np.exp(-d / b_r)


def closed_form_scale(
    distance: NDArray, b_ref: NDArray, weight: NDArray | None = None, axis: int = 0, floor: float = SCALE_FLOOR
) -> NDArray:
    """Scale that minimises the summed divergence of its observations, b_p = mean(d + b_r e^(-d/b_r)), floored.

    Observations lie along `axis`; `weight` broadcasts. Where the weights sum to 0 the result is the floor.
    """
    contribution = scale_contribution(distance, b_ref, floor)
    if weight is None:
        return floored(contribution.mean(axis=axis), floor)
    weight = np.broadcast_to(weight, contribution.shape)
    total = weight.sum(axis=axis)
    mean = (weight * contribution).sum(axis=axis) / np.where(total > 0, total, 1.0)
    return floored(mean, floor)
