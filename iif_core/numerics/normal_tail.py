"""The hazard of the standard normal distribution, from which the likelihood of one-sided observations is made."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

_FAR = 4.0
_TERMS = 50
"""Of Laplace's continued fraction, exact in double precision from `_FAR` on."""


def hazard(z: ArrayLike) -> tuple[NDArray, NDArray]:
    """Compute h = phi(z) / Phi(-z) and h - z (docs/method/numerics.md#tail-of-the-normal-distribution).

    h comes from the scaled complementary error function, sqrt(2 / pi) / erfcx(z / sqrt 2), and h - z far out from the continued
    fraction 1 / (z + 2 / (z + 3 / (z + ...))), because there it is a small difference of large numbers.

    Args:
        z: standard deviations, -37 and above; below it the density underflows.

    Returns:
        Two float64 arrays of the shape of z, both > 0.

    Example:
        >>> [round(float(v), 6) for v in hazard(0.0)]
        [0.797885, 0.797885]
    """
    from scipy.special import erfcx

    z = np.asarray(z, np.float64)
    ratio = np.sqrt(2 / np.pi) / erfcx(z * np.sqrt(0.5))
    far = np.maximum(z, _FAR)
    tail = far
    for n in range(_TERMS, 1, -1):
        tail = far + n / tail
    return ratio, np.where(z > _FAR, 1 / tail, ratio - z)
