"""How far the base is from the truth, per cell and property, calibrated (and how that was done).

The Laplace scale b of a cell says how much the corrected predictions of a pixel and the views of a cell disagree. It is
the scale of one observation, not the error of the cell's location, which the views average. The error of the location
has the standard deviation

    s = c b^g V^-h K^-q P^-p          V viewpoints, K predictions, P pixels of the cell a viewpoint

and an exponential power distribution of shape beta (1 = Laplace, 2 = normal), which nears the normal as K grows. The
numbers are fitted to cells of one scene with truth over K = 1 ... 16 and three sizes of cells (`fit_calibration`).

The error is that of the location *after its object's affine gauge*: e = mu - (A t + b), with the affine per object that
takes the truth t nearest to mu. The base leaves that affine open and the photographs decide it (METHOD 7c, G1); no
disagreement between predictions can tell a bias that all of them share.

Valid for `direct`, `variant: full`, least squares, and for predictions whose errors are like those of the simulated prior
at strength 1; other variants and solvers get the same formula, which then is a ranking, not an interval.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from iif_core.errors import InputError

LEVELS = (0.50, 0.80, 0.95)
"""Nominal coverages that studies report."""


@dataclass(frozen=True)
class Calibration:
    """s = c b^g V^-h K^-q P^-p; shape beta = beta_1 + beta_2 log2 K."""

    c: float
    g: float
    h: float
    q: float
    p: float
    beta_1: float
    beta_2: float

    def deviation(self, b: NDArray, viewpoints: NDArray, pixels: NDArray, predictions: NDArray | int) -> NDArray:
        """Standard deviation of the location's error.

        `b` > 0; `viewpoints` (0 counts as 1); `pixels` of the cell over all viewpoints; `predictions` a photograph.
        """
        return self.c * np.exp(_features(b, viewpoints, pixels, predictions) @ [self.g, self.h, self.q, self.p])

    def beta(self, predictions: NDArray | int) -> NDArray:
        """Shape of the distribution."""
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
"""Fitted to the built-in kitchen (24 views of 256 x 256; K = 1, 2, 4, 8, 16 at 0.4 footprints, K = 16 at 0.8 and 1.6, K = 4
at 1.6; prior seed 0). On Country Kitchen, which had no part in it, observed coverages at 50 / 80 / 95 % are within 5 points
for K = 16 at the default cells and within 9 points for all of these."""

SMALLEST = 100
"""Cells of an object below which its affine follows the errors; such objects are not judged."""


def location_uncertainty(scale: NDArray, viewpoints: NDArray, pixels: NDArray, predictions: int) -> NDArray:
    """(n, 5) float32 standard deviation of each location's error: see `Calibration.deviation`; `scale` (n, 5)."""
    out = np.empty(scale.shape, np.float32)
    for name, channels in (("albedo", slice(0, 3)), ("roughness", slice(3, 4)), ("metallic", slice(4, 5))):
        law = CALIBRATION[name]
        out[:, channels] = law.deviation(scale[:, channels], viewpoints[:, None], pixels[:, None], predictions)
    return out


def interval(level: float | NDArray, beta: float = 1.0) -> NDArray:
    """Half width of the central interval that holds the share `level`, in standard deviations.

    Exponential power distribution: P(|e| < x) = P(1 / beta, (x / a)^beta) with the regularised incomplete gamma function
    and a^2 = Gamma(1 / beta) / Gamma(3 / beta) s^2. Examples: 95 % -> 1.96 for beta = 2, 2.12 for beta = 1.
    """
    from scipy.special import gamma, gammaincinv

    if not (np.greater(level, 0) & np.less(level, 1)).all():
        raise InputError(f"interval of level {level}: a number between 0 and 1 is needed, e.g. 0.95")
    return gammaincinv(1 / beta, level) ** (1 / beta) * np.sqrt(gamma(1 / beta) / gamma(3 / beta))


def gauge_free_error(value: NDArray, truth: NDArray, object_id: NDArray, ridge: float = 1e-6) -> NDArray:
    """(n, c) value - (A truth + b), the affine of each object that brings the truth nearest to the value.

    Args:
        value, truth: (n, c) cells, c channels of one property; object_id: (n,) >= 0.
        ridge: variance added to the truth's, so that an object of one colour has A = 0, not 0 / 0.
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


def coverage(error: NDArray, deviation: NDArray, beta: float = 1.0, levels: tuple[float, ...] = LEVELS) -> list[float]:
    """Share of the errors inside each central interval; an empty input is an error."""
    if error.size == 0:
        raise InputError("coverage of no errors; give at least one")
    ratio = np.abs(error) / deviation
    return [float((ratio <= interval(level, beta)).mean()) for level in levels]


def fit_calibration(samples: list[tuple[NDArray, NDArray, NDArray, NDArray, int]]) -> Calibration:
    """The law for one property from several runs, each (error, b, viewpoints, pixels, predictions), arrays (n,).

    The exponents have the largest likelihood for beta = 1, the minimum of mean(log s + |e| / s); for given exponents the best
    c is a mean, so four numbers are searched (Nelder-Mead). c and beta are then those for which the coverage at `LEVELS` of
    the worst run is off by as little as possible.
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
                widths = around[:, None] * interval(np.float64(LEVELS), beta_1 + beta_2 * log_k)
                off = np.abs(np.searchsorted(ratio, widths, "right") / len(ratio) - LEVELS).max(1)
                worst = np.maximum(worst, off)
            i = int(worst.argmin())
            best = min(best, (float(worst[i]), float(around[i]), float(beta_1), float(beta_2)))
    return Calibration(best[1], *(float(v) for v in exponents), best[2], best[3])
