"""How far the base is from the truth, per cell and property, calibrated (and how that was done).

The Laplace scale b of a cell says how much the corrected predictions of a pixel and the views of a cell disagree. It is
the scale of one observation, not the error of the cell's location, which the views average. The error of the location
has the standard deviation

    s = c b^g / views^h                                              (one c, g, h, beta for each property)

and an exponential power distribution of shape beta (1 = Laplace, 2 = normal). The four are fitted to cells of one scene
with truth (`fit_calibration`) and used on all others.

The error is that of the location *after its object's affine gauge*: e = mu - (A t + b), with the affine per object that
takes the truth t nearest to mu. The base leaves that affine open and the photographs decide it (METHOD 7c, G1); no
disagreement between predictions can tell a bias that all of them share.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .problem import PROPERTIES

LEVELS = (0.50, 0.80, 0.95)
"""Nominal coverages that studies report."""


@dataclass(frozen=True)
class Calibration:
    """Standard deviation s = c b^g / views^h, shape beta."""

    c: float
    g: float
    h: float
    beta: float

    def deviation(self, b: NDArray, views: NDArray) -> NDArray:
        """Standard deviation of the location's error; `b` > 0, `views` >= 1 (0 counts as 1)."""
        return self.c * np.asarray(b, np.float64) ** self.g / np.maximum(views, 1.0) ** self.h


CALIBRATION = {
    "albedo": Calibration(0.2058, 0.586, 0.732, 1.15),
    "roughness": Calibration(0.0555, 0.392, 0.506, 2.1),
    "metallic": Calibration(0.0541, 0.388, 0.523, 2.1),
}
"""Fitted to the built-in kitchen (24 views of 256 x 256, K = 16, `direct`, prior seed 0)."""


def location_uncertainty(scale: NDArray, views: NDArray) -> NDArray:
    """(n, 5) float32 standard deviation of each location's error, from the cell's scale (n, 5) and its views (n,)."""
    out = np.empty(scale.shape, np.float32)
    for p, channels in ((0, slice(0, 3)), (1, slice(3, 4)), (2, slice(4, 5))):
        out[:, channels] = CALIBRATION[PROPERTIES[p]].deviation(scale[:, channels], np.asarray(views)[:, None])
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


def fit_calibration(error: NDArray, b: NDArray, views: NDArray) -> Calibration:
    """c, g, h, beta for errors (n,) of cells with scale `b` (n,) and `views` (n,) >= 1.

    g, h have the largest likelihood for beta = 1, the minimum of mean(log s + |e| / s); for given g, h the best c is a
    mean, so two numbers are searched (Nelder-Mead; smooth, started at 1, 0.5). beta and c are then those whose coverages at
    `LEVELS` are off by as little as possible at worst.
    """
    from scipy.optimize import minimize

    e, log_b, log_v = np.abs(np.asarray(error, np.float64)), np.log(b), np.log(np.maximum(views, 1))

    def shape(g: float, h: float) -> NDArray:
        return g * log_b - h * log_v

    def cost(x: NDArray) -> float:
        log_s = shape(*x)
        return float(np.log(np.mean(e * np.exp(-log_s)) + 1e-30) + log_s.mean())

    g, h = minimize(cost, [1.0, 0.5], method="Nelder-Mead", options={"xatol": 1e-3, "fatol": 1e-6}).x
    ratio = np.sort(e * np.exp(-shape(g, h)))
    candidates = np.sqrt(np.mean(ratio**2)) * np.linspace(0.5, 1.5, 201)
    best = (np.inf, 0.0, 1.0)
    for beta in np.linspace(0.7, 3.0, 47):
        widths = candidates[:, None] * interval(np.float64(LEVELS), beta)
        worst = np.abs(np.searchsorted(ratio, widths, "right") / len(ratio) - LEVELS).max(1)
        i = int(worst.argmin())
        best = min(best, (float(worst[i]), float(candidates[i]), float(beta)))
    return Calibration(best[1], float(g), float(h), best[2])
