"""The divergence of two Laplace distributions, its weight, and the scale of the reference (Eqs. F.4, F.7, F.32).

Scales are floored as in `iif_core.numerics.laplace`; arrays may have any shapes that broadcast, float32 or float64.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from iif_core.errors import InputError
from iif_core.numerics.laplace import SCALE_FLOOR, floored


def kl(distance: NDArray, b_ref: NDArray, b_pred: NDArray, floor: float = SCALE_FLOOR) -> NDArray:
    """Compute the divergence KL(reference || texture) of two Laplace distributions (Eq. F.7).

    KL = log(b_p / b_r) + d / b_p + (b_r / b_p) exp(-d / b_r) - 1, which is 0 for d = 0 and equal scales. It is the sum of two
    terms that are not negative, (q - 1 - log q) + q (x + exp(-x) - 1) with q = b_r / b_p and x = d / b_r
    (docs/method/numerics.md#divergence-of-equal-distributions).

    Args:
        distance: |mu_ref - mu_pred|; the sign is ignored.
        b_ref, b_pred: scales of the reference and of the texture.
        floor: smallest scale, > 0.

    Returns:
        Divergence in nat, >= 0.

    Example:
        >>> round(float(kl(0.3, 0.1, 0.2)), 7)
        1.2180407
    """
    d = np.abs(distance)
    b_r, b_p = floored(b_ref, floor), floored(b_pred, floor)
    x, off = d / b_r, (b_r - b_p) / b_p
    near = np.abs(off) < 0.5
    scales = np.where(near, off - np.log1p(np.where(near, off, 0.0)), b_r / b_p - 1.0 - np.log(b_r / b_p))
    return scales + b_r / b_p * _above_tangent(x)


_SMALL = 0.25
_SERIES = [1.0]  # of (x + exp(-x) - 1) 2 / x^2 in powers of x, exact in double precision below _SMALL
for _n in range(3, 14):
    _SERIES.append(-_SERIES[-1] / _n)


def _above_tangent(x: NDArray) -> NDArray:
    """x + exp(-x) - 1 for x >= 0, without cancellation."""
    small = np.minimum(x, _SMALL)
    series = np.full_like(small, _SERIES[-1])
    for coefficient in reversed(_SERIES[:-1]):
        series = series * small + coefficient
    return np.where(x < _SMALL, 0.5 * small * small * series, x + np.expm1(-x))


def kl_weight(distance: NDArray, b_ref: NDArray, b_pred: NDArray, floor: float = SCALE_FLOOR) -> NDArray:
    """Compute the weight of the quadratic function of d that majorises `kl` (Eq. F.32).

    w = (1 - exp(-d / b_r)) / (d b_p), with the limit 1 / (b_r b_p) at d = 0 (docs/method/numerics.md#weight-of-a-zero-residual).
    Least squares, reweighted with w, minimises the summed divergence over the location. The weight falls as 1 / d, so the
    influence of an outlier is bounded.

    Args:
        distance, b_ref, b_pred, floor: as for `kl`.

    Returns:
        Weight > 0.
    """
    d = np.abs(distance)
    b_r, b_p = floored(b_ref, floor), floored(b_pred, floor)
    x = d / b_r
    ratio = np.where(x > 0, -np.expm1(-x) / np.where(x > 0, x, 1.0), 1.0)
    return ratio / (b_r * b_p)


def lower_median(values: NDArray) -> NDArray:
    """Return the median along axis 0 that is one of the values: for an even count the smaller of the two in the middle.

    See docs/method/numerics.md#median-subgradient.
    """
    count = len(values)
    if count == 0:
        raise InputError("lower median of no values; give at least one along the axis")
    rank = (count - 1) // 2
    return np.partition(values, rank, axis=0)[rank]


def reference_scale(mu_ref: NDArray, predictions: NDArray) -> NDArray:
    """Compute the scale of the reference, b_ref = lower median over k of |mu_ref - v_k|, floored (Eq. F.4).

    `predictions` has shape (K, ...), `mu_ref` and the result (...).
    """
    return floored(lower_median(np.abs(predictions - mu_ref[None])))
