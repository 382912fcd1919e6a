"""Adam (D. P. Kingma, J. Ba, 2015): what its implementations on NumPy arrays and in compiled kernels share (Eq. F.55)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class AdamFactors(NamedTuple):
    """Numbers of one update in float32: p <- p - rate m / (root sqrt(v) + eps) with the running moments m and v."""

    beta1: np.float32
    beta2: np.float32
    rate: np.float32
    """lr / (1 - beta1^t) for the update number t."""
    root: np.float32
    """1 / sqrt(1 - beta2^t)."""
    eps: np.float32


def adam_factors(lr: float, step: int, beta1: float = 0.9, beta2: float = 0.999, eps: float = 1e-8) -> AdamFactors:
    """Return the numbers of update number `step`, computed in float64 and rounded once.

    Args:
        lr: learning rate; step: number of the update, from 1.
        beta1, beta2: decay of the mean and of the mean square of the gradient; eps: added to the root of the latter.

    Returns:
        Factors of the parameter update in float32.

    Example:
        >>> float(adam_factors(0.5, 1, beta1=0.5).rate)
        1.0
    """
    rate, root = lr / (1 - beta1**step), 1 / math.sqrt(1 - beta2**step)
    return AdamFactors(*(np.float32(value) for value in (beta1, beta2, rate, root, eps)))


class Moments:
    """Running mean and mean square of a gradient, without the correction of their bias towards 0.

    Attributes:
        mean, square: arrays of the gradient's shape, float64; steps: number of gradients so far.
    """

    def __init__(self, shape: tuple[int, ...], decay: tuple[float, float] = (0.9, 0.999)):
        self.decay = decay
        self.mean, self.square, self.steps = np.zeros(shape), np.zeros(shape), 0

    def add(self, gradient: NDArray) -> None:
        """Take in a gradient: m <- beta1 m + (1 - beta1) g and v <- beta2 v + (1 - beta2) g^2."""
        self.steps += 1
        beta1, beta2 = self.decay
        self.mean = beta1 * self.mean + (1 - beta1) * gradient
        self.square = beta2 * self.square + (1 - beta2) * gradient**2

    def bias(self) -> tuple[float, float]:
        """Return 1 - beta1^t and 1 - beta2^t, by which mean and square are too small after t gradients."""
        return 1 - self.decay[0] ** self.steps, 1 - self.decay[1] ** self.steps
