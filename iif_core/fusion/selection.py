"""Selection among the K predictions of a segment by their errors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def selection_weights(error: NDArray, temperature: float, usable: NDArray | None = None) -> NDArray:
    """Return the weights (..., K) float64 of K predictions by their errors >= 0 (Eq. F.28), with sum 1, or 0 where none is
    usable.

    `temperature` is in units of the median error. Temperature 0 is the limit: the smallest error takes all weight, and errors
    that are equal (to an rms of 1e-6) share it, so the result does not depend on the order.

    Example:
        >>> selection_weights([0.1, 0.4, 0.1], 0.0).tolist()
        [0.5, 0.0, 0.5]
    """
    error = np.asarray(error, np.float64)
    usable = np.ones(error.shape, bool) if usable is None else np.broadcast_to(usable, error.shape)
    # Infinity puts unusable predictions last in every order below.
    counted = np.where(usable, error, np.inf)
    lowest = counted.min(-1, keepdims=True)
    any_usable = np.isfinite(lowest)
    # With the smallest error subtracted, the best prediction has exp(0) = 1, and the sum cannot underflow at any temperature
    # (docs/method/numerics.md#cold-temperatures).
    excess = np.where(usable, np.where(usable, error, 0.0) - np.where(any_usable, lowest, 0.0), 0.0)
    ranked = np.sort(counted, -1)
    middle = np.maximum(usable.sum(-1, keepdims=True) - 1, 0) // 2  # rank of the lower median among the usable ones
    median = np.where(any_usable, np.take_along_axis(ranked, middle, -1), 0.0)
    if temperature > 0:
        weight = np.exp(-excess / (temperature * (median + 1e-6)))  # 1e-6: all errors may be 0
    else:
        weight = (excess <= 1e-9 * median + 1e-12).astype(np.float64)
    # An unusable prediction has the excess 0, and would share the largest weight.
    weight = np.where(usable, weight, 0.0)
    total = weight.sum(-1, keepdims=True)
    return weight / np.where(total > 0, total, 1.0)


def margin(error: NDArray, usable: NDArray) -> NDArray:
    """Return how clear a selection is, 1 - smallest error / second smallest error over the last axis.

    `error` (..., K) >= 0; `usable` (..., K) bool. 0 = a tie, or nothing is usable; 1 = one prediction fits exactly, or only
    one is usable.
    """
    counted = np.where(usable, np.asarray(error, np.float64), np.inf)
    if counted.shape[-1] == 1:
        return usable[..., 0].astype(np.float64)
    two = np.partition(counted, 1, axis=-1)[..., :2]
    best, second = two[..., 0], two[..., 1]
    known = np.isfinite(second) & (second > 0)
    ratio = 1 - np.where(known, best, 0) / np.where(known, second, 1)
    # Otherwise the second error is infinite (one prediction is usable: 1), or 0 (a tie of exact fits: 0).
    return np.where(known, ratio, (np.isfinite(best) & ~np.isfinite(second)).astype(np.float64))


def effective_number(probability: NDArray) -> NDArray:
    """Return exp(entropy) of probabilities over the last axis (Eq. F.49): 1 = one prediction, K = all alike; 0 where all
    are 0."""
    p = np.asarray(probability, np.float64)
    entropy = -(p * np.log(np.where(p > 0, p, 1.0))).sum(-1)
    return np.where(p.sum(-1) > 0, np.exp(entropy), 0.0)
