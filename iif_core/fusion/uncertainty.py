"""Calibrated uncertainty of the base texture per cell and property (docs/method/fusion.md#uncertainty).

The Laplace scale b of a cell measures the disagreement of the corrected predictions and of the views. It is the scale of
one observation, not the error of the cell's location, over which the views are averaged. The error of the location has the
standard deviation

    s = c b^g V^-h K^-q P^-p          V viewpoints, K predictions, P pixels of the cell per viewpoint     (Eq. F.45)

and an exponential power distribution of shape beta (1 = Laplace, 2 = normal) that tends to the normal as K grows.

The error is that of the location *after the affine gauge of its object* (Eq. F.44). The photographs decide that gauge
later; no disagreement between predictions can reveal an error that all of them share.

The law is valid for `direct`, `variant: full`, least squares, and for predictions whose errors resemble those of the
simulated prior at strength 1. Other variants and solvers use the same formula, which then ranks cells but does not give
calibrated intervals.
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
    views = np.maximum(viewpoints, 1.0)
    parts = (np.log(np.asarray(b, np.float64)), -np.log(views), -np.log(predictions), -np.log(np.maximum(pixels / views, 1)))
    return np.stack(np.broadcast_arrays(*parts), -1)


CALIBRATION = {
    "albedo": Calibration(0.5664, 0.523, 0.659, 0.444, -0.116, 1.0, 0.05),
    "roughness": Calibration(0.4715, 0.496, 0.602, 0.592, -0.131, 0.8, 0.15),
    "metallic": Calibration(0.4884, 0.502, 0.602, 0.596, -0.133, 0.8, 0.15),
}
"""Fitted by `fit_calibration` to one scene with ground truth; data and check on another scene: docs/results/fusion.md."""

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
        ridge: variance added to that of the truth, so that an object of one colour has B = 0 and not 0 / 0.

    Returns:
        (n, c) float64.
    """
    value, truth = np.asarray(value, np.float64), np.asarray(truth, np.float64)
    out = np.empty_like(value)
    order = np.argsort(object_id, kind="stable")
    cuts = np.flatnonzero(np.diff(object_id[order])) + 1
    for rows in np.split(order, cuts) if len(order) else []:
        y, x = value[rows] - value[rows].mean(0), truth[rows] - truth[rows].mean(0)
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


def fit_calibration(samples: list[tuple[NDArray, NDArray, NDArray, NDArray, int]]) -> Calibration:
    """Fit the law of one property to several runs, each (error, b, viewpoints, pixels, predictions) with arrays (n,).

    The exponents maximise the likelihood for beta = 1 (Eq. F.48) by Nelder-Mead. Then c and beta minimise the largest
    deviation of the observed coverage from `NOMINAL_COVERAGES` over all runs.
    """
    from scipy.optimize import minimize

    errors = [np.abs(np.asarray(sample[0], np.float64)) for sample in samples]
    features = [_features(*sample[1:]) for sample in samples]
    e, x = np.concatenate(errors), np.concatenate(features)

    def cost(exponents: NDArray) -> float:
        log_s = x @ exponents
        return float(np.log(np.mean(e * np.exp(-log_s)) + 1e-30) + log_s.mean())

    exponents = minimize(cost, [0.6, 0.6, 0.3, 0.1], method="Nelder-Mead", options={"maxiter": 2000, "xatol": 1e-3}).x
    ratios = [np.sort(a * np.exp(-(b @ exponents))) for a, b in zip(errors, features, strict=True)]
    k = np.log2([sample[4] for sample in samples])
    around = np.sqrt(np.mean(np.concatenate(ratios) ** 2)) * np.linspace(0.7, 1.4, 71)
    best = (np.inf, 0.0, 1.0, 0.0)
    for beta_1 in np.linspace(0.7, 2.2, 16):
        for beta_2 in np.linspace(0, 0.35, 8) if np.ptp(k) > 0 else [0.0]:
            worst = np.zeros(len(around))
            for ratio, log_k in zip(ratios, k, strict=True):
                widths = around[:, None] * interval(np.float64(NOMINAL_COVERAGES), beta_1 + beta_2 * log_k)
                off = np.abs(np.searchsorted(ratio, widths, "right") / len(ratio) - NOMINAL_COVERAGES).max(1)
                worst = np.maximum(worst, off)
            i = int(worst.argmin())
            best = min(best, (float(worst[i]), float(around[i]), float(beta_1), float(beta_2)))
    return Calibration(best[1], *(float(v) for v in exponents), best[2], best[3])
