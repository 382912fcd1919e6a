"""Calibrated uncertainty of the base texture per cell and property (docs/method/fusion.md#uncertainty, Eqs. F.44, F.45).

The law is valid for `direct`, `variant: full`, least squares, and for predictions whose errors resemble those of the simulated
prior at strength 1. Elsewhere the same formula ranks cells but does not give calibrated intervals.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from iif_core.errors import InputError

NOMINAL_COVERAGES = (0.50, 0.80, 0.95)
"""Probabilities of the central intervals whose observed coverage studies report."""


@dataclass(frozen=True)
class Calibration:
    """Constants of one property: s = c b^g V^-h K^-q P^-p, shape beta = beta_1 + beta_2 log2 K."""

    c: float
    g: float
    h: float
    q: float
    p: float
    beta_1: float
    beta_2: float

    def deviation(self, b: NDArray, viewpoints: NDArray, pixels: NDArray, predictions: NDArray | int) -> NDArray:
        """Return the standard deviation of the error of the location (Eq. F.45).

        Args:
            b: Laplace scale, > 0; viewpoints: number of viewpoints, 0 counts as 1.
            pixels: pixels of the cell over all viewpoints; predictions: number of predictions per photograph.

        Returns:
            Array of the broadcast shape, in the unit of b.
        """
        return self.c * np.exp(_features(b, viewpoints, pixels, predictions) @ [self.g, self.h, self.q, self.p])

    def beta(self, predictions: NDArray | int) -> NDArray:
        """Return the shape of the distribution."""
        return self.beta_1 + self.beta_2 * np.log2(predictions)


def _features(b: NDArray, viewpoints: NDArray, pixels: NDArray, predictions: NDArray | int) -> NDArray:
    # The power law is linear in logarithms: log b, -log V, -log K and -log P with the exponents g, h, q and p.
    views = np.maximum(viewpoints, 1.0)
    parts = (np.log(np.asarray(b, np.float64)), -np.log(views), -np.log(predictions), -np.log(np.maximum(pixels / views, 1)))
    return np.stack(np.broadcast_arrays(*parts), -1)


CALIBRATION = {
    "albedo": Calibration(0.5664, 0.523, 0.659, 0.444, -0.116, 1.0, 0.05),
    "roughness": Calibration(0.4715, 0.496, 0.602, 0.592, -0.131, 0.8, 0.15),
    "metallic": Calibration(0.4884, 0.502, 0.602, 0.596, -0.133, 0.8, 0.15),
}
"""Fitted to one scene with ground truth, checked on another (docs/method/fusion.md#calibrated-uncertainty)."""

MIN_OBJECT_CELLS = 100
"""Fewest cells of an object that is judged; with fewer, the affine gauge follows the errors themselves."""


def location_uncertainty(scale: NDArray, viewpoints: NDArray, pixels: NDArray, predictions: int) -> NDArray:
    """Return the standard deviation of the error of every location.

    Args:
        scale: (n, 5) Laplace scales; viewpoints: (n,); pixels: (n,) over all viewpoints.
        predictions: number of predictions per photograph.

    Returns:
        (n, 5) float32.
    """
    out = np.empty(scale.shape, np.float32)
    for name, channels in (("albedo", slice(0, 3)), ("roughness", slice(3, 4)), ("metallic", slice(4, 5))):
        law = CALIBRATION[name]
        out[:, channels] = law.deviation(scale[:, channels], viewpoints[:, None], pixels[:, None], predictions)
    return out


def interval(level: float | NDArray, beta: float = 1.0) -> NDArray:
    """Return the half width, in standard deviations, of the central interval of probability `level` (Eq. F.47).

    Raises:
        InputError: a level that is not between 0 and 1.

    Example:
        >>> round(float(interval(0.95, 2.0)), 2), round(float(interval(0.95, 1.0)), 2)
        (1.96, 2.12)
    """
    from scipy.special import gamma, gammaincinv

    if not (np.greater(level, 0) & np.less(level, 1)).all():
        raise InputError(f"interval of level {level}: a number between 0 and 1 is needed, e.g. 0.95")
    return gammaincinv(1 / beta, level) ** (1 / beta) * np.sqrt(gamma(1 / beta) / gamma(3 / beta))


def gauge_free_error(value: NDArray, truth: NDArray, object_id: NDArray, ridge: float = 1e-6) -> NDArray:
    """Return the error of values after the affine gauge of each object, value - (B truth + s) (Eq. F.44).

    Args:
        value, truth: (n, c) cells, c channels of one property; object_id: (n,) int >= 0.
        ridge: added to the variance of the truth, so that an object of one colour has B = 0 and not 0 / 0.

    Returns:
        (n, c) float64.
    """
    value, truth = np.asarray(value, np.float64), np.asarray(truth, np.float64)
    out = np.empty_like(value)
    order = np.argsort(object_id, kind="stable")
    cuts = np.flatnonzero(np.diff(object_id[order])) + 1
    for rows in np.split(order, cuts) if len(order) else []:
        # Centring removes the shift delta; what is left is one ridge regression of the values on the truth.
        y, x = value[rows] - value[rows].mean(0), truth[rows] - truth[rows].mean(0)
        # `slope` is B transposed. The ridge keeps the matrix of an object of one colour regular.
        slope = np.linalg.solve(x.T @ x + ridge * len(rows) * np.eye(x.shape[1]), x.T @ y)
        out[rows] = y - x @ slope
    return out


def coverage(error: NDArray, deviation: NDArray, beta: float = 1.0, levels: tuple[float, ...] = NOMINAL_COVERAGES) -> list[float]:
    """Return the share of the errors inside each central interval.

    Args:
        error, deviation: arrays that broadcast; beta: shape of the distribution; levels: nominal probabilities.

    Returns:
        One share per level.

    Raises:
        InputError: no errors.
    """
    if error.size == 0:
        raise InputError("coverage of no errors; give at least one")
    ratio = np.abs(error) / deviation
    return [float((ratio <= interval(level, beta)).mean()) for level in levels]
