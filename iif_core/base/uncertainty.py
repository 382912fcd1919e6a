"""How far the base is from the truth, per cell and property, calibrated (and how that was done).

The Laplace scale b of a cell says how much the corrected predictions of a pixel and the views of a cell disagree. It is
the scale of one observation, not the error of the cell's location, which the views average. The error of the location
follows a Laplace distribution too, to a few points of coverage, with the scale

    s = c b^g / views^h                                                   (one c, g, h for each property)

c, g, h are fitted by maximum likelihood (`fit_calibration`) to cells of a scene with truth and hold for others.

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
    """s = c b^g / views^h."""

    c: float
    g: float
    h: float

    def scale(self, b: NDArray, views: NDArray) -> NDArray:
        """Laplace scale of the location's error; `b` > 0, `views` >= 1 (0 counts as 1)."""
        return self.c * np.asarray(b, np.float64) ** self.g / np.maximum(views, 1.0) ** self.h


CALIBRATION = {
    "albedo": Calibration(0.255, 0.676, 0.816),
    "roughness": Calibration(0.0958, 0.493, 0.675),
    "metallic": Calibration(0.0695, 0.411, 0.716),
}
"""Fitted to the built-in kitchen (24 views of 256 x 256, K = 16, `direct`, prior seed 0)."""


def location_uncertainty(scale: NDArray, views: NDArray) -> NDArray:
    """(n, 5) float32 Laplace scale of each location's error, from the cell's scale (n, 5) and number of views (n,)."""
    out = np.empty(scale.shape, np.float32)
    for p, channels in ((0, slice(0, 3)), (1, slice(3, 4)), (2, slice(4, 5))):
        out[:, channels] = CALIBRATION[PROPERTIES[p]].scale(scale[:, channels], np.asarray(views)[:, None])
    return out


def interval(scale: NDArray, level: float | NDArray) -> NDArray:
    """Half width of the central interval of a Laplace distribution: -b log(1 - level). Example: 95 % -> 3.0 b."""
    if not (np.greater(level, 0) & np.less(level, 1)).all():
        raise InputError(f"interval of level {level}: a number between 0 and 1 is needed, e.g. 0.95")
    return -np.log1p(-level) * scale


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


def coverage(error: NDArray, scale: NDArray, levels: tuple[float, ...] = LEVELS) -> list[float]:
    """Share of the errors inside each central interval; nan-free: an empty input is an error."""
    if error.size == 0:
        raise InputError("coverage of no errors; give at least one")
    return [float((np.abs(error) <= interval(scale, level)).mean()) for level in levels]


def fit_calibration(error: NDArray, b: NDArray, views: NDArray) -> Calibration:
    """c, g, h for errors (n,) of cells with scale `b` (n,) and `views` (n,) >= 1.

    g, h have the largest likelihood, the minimum of mean(log s + |e| / s); for given g, h the best c is a mean, so two
    numbers are searched (Nelder-Mead; smooth, started at 1, 0.5). The errors are a little flatter than a Laplace
    distribution; c is then chosen so that the coverages at `LEVELS` are off by as little as possible at worst.
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
    candidates = ratio.mean() * np.linspace(0.5, 2.0, 301)
    inside = np.searchsorted(ratio, interval(candidates[:, None], np.float64(LEVELS)), "right") / len(ratio)
    best = np.abs(inside - LEVELS).max(1).argmin()
    return Calibration(float(candidates[best]), float(g), float(h))
