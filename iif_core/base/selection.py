"""Which of K predictions of a segment to believe: weights by error."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def selection_weights(error: NDArray, temperature: float, usable: NDArray | None = None) -> NDArray:
    """Weights of K predictions by their error: alpha_k ~ exp(-(E_k - min E) / (temperature * median E)).

    `error` (..., K), K last, >= 0; `usable` (..., K) bool. Temperature 0 is the limit: the smallest error takes all,
    equal ones (to an rms of 1e-6) share, so that the result does not depend on the order. Sum 1, or 0 where nothing is
    usable.
    """
    error = np.asarray(error, np.float64)
    usable = np.ones(error.shape, bool) if usable is None else np.broadcast_to(usable, error.shape)
    counted = np.where(usable, error, np.inf)
    lowest = counted.min(-1, keepdims=True)
    any_usable = np.isfinite(lowest)
    excess = np.where(usable, error, 0.0) - np.where(any_usable, lowest, 0.0)
    ranked = np.sort(counted, -1)
    middle = np.maximum(usable.sum(-1, keepdims=True) - 1, 0) // 2
    median = np.where(any_usable, np.take_along_axis(ranked, middle, -1), 0.0)
    if temperature > 0:
        weight = np.exp(-excess / (temperature * (median + 1e-6)))
    else:
        weight = (excess <= 1e-9 * median + 1e-12).astype(np.float64)
    weight = np.where(usable, weight, 0.0)
    total = weight.sum(-1, keepdims=True)
    return weight / np.where(total > 0, total, 1.0)
