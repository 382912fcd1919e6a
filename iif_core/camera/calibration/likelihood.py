"""The likelihood of the sensor values under one curve (Eq. C.19), its maximum and its curvature."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from iif_core.camera.calibration.rows import KNOTS, Channel
from iif_core.camera.response import Response

_FREEDOM = 4.0  # degrees of freedom of Student's t distribution
_ROUNDING = 0.29 / 255.0  # standard deviation of rounding to 8 bits
_BLOCK_ROWS = 50.0  # weight of the common width in the width of a block, in rows
_ROUNDS = 5


@dataclass
class _Noise:
    """Width of n: common width, and the width of every block relative to it (Eq. C.18)."""

    width: float
    block: np.ndarray

    def scale2(self, data: Channel, log_gain: np.ndarray) -> np.ndarray:
        return (self.width * self.block[data.block]) ** 2 + (_ROUNDING * np.exp(-log_gain)) ** 2


def _tables(curve: Response) -> tuple[np.ndarray, np.ndarray]:
    """log x and log dI / d log x at the knots."""
    # The inverse is tabulated once for all rows; G = dI / d ln x is one over the slope of the table.
    log_x = np.log(curve.inverse(KNOTS))
    return log_x, -np.log(np.maximum(np.gradient(log_x, KNOTS), 1e-12))


def _table_slopes(curve: Response, log_x: np.ndarray, log_gain: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of the tables by the parameters, (knots, P): d log x = -df / (x f') at constant I."""
    x = np.exp(log_x)
    _, slope, by_params = curve.evaluate(x)
    dx = -by_params / (x * slope)[:, None]
    return dx, -np.gradient(dx, KNOTS, axis=0) * np.exp(log_gain)[:, None]


def _levels(data: Channel, y: np.ndarray, scale2: np.ndarray, rounds: int = 10) -> tuple[np.ndarray, np.ndarray]:
    """Robust level of every patch (C,) and the weights (n,) of its rows (Eq. C.20)."""
    size = data.cells
    weight = 1.0 / scale2
    for _ in range(rounds):
        level = np.bincount(data.cell, weight * y, size) / np.maximum(np.bincount(data.cell, weight, size), 1e-300)
        # Student's weights: a row far from the level counts less and less.
        weight = (_FREEDOM + 1.0) / (_FREEDOM * scale2 + (y - level[data.cell]) ** 2)
    return level, weight


def _saturation_probability(above: np.ndarray, width: float) -> np.ndarray:
    """Probability that a level `above` the edge of saturation is seen saturated (Eq. C.21).

    A logistic function approximates the normal distribution; 2 % of the saturated rows may be highlights or errors.
    """
    return 0.02 + 0.98 / (1.0 + np.exp(np.clip(-1.702 * above / width, -60.0, 60.0)))


@dataclass
class _Fit:
    params: np.ndarray
    covariance: np.ndarray
    score: float
    clusters: dict[int, float]
    width: float


def maximise(data: Channel, curve: Response, mean: np.ndarray, deviation: float, rounds: int = _ROUNDS) -> _Fit:
    """Maximise the likelihood of one curve: robust weights and noise widths alternate with a smooth inner problem.

    Args:
        data: rows.
        curve: start of the parameters.
        mean, deviation: Gaussian prior of the parameters (P,).
        rounds: number of alternations; 0 estimates the noise at the parameters of `curve` only.

    Returns:
        Parameters, covariance, score, log likelihood of the clusters, and spread of the deviations.
    """
    noise, independence = _Noise(0.05, np.ones(int(data.block.max(initial=-1)) + 1)), 1.0
    noise, weight, deviations = _fit_noise(data, curve, noise)
    for number in range(rounds if curve.names else 0):
        last = number == rounds - 1
        if last:
            independence = _curvature(data, curve, weight, noise, mean, deviation, 1.0)[1]
        curve = _improve(data, curve, weight, noise, mean, deviation, independence, 30 if last else 12)
        noise, weight, deviations = _fit_noise(data, curve, noise)
    covariance, _, price = _curvature(data, curve, weight, noise, mean, deviation, independence)
    score, clusters = _likelihood(data, curve, noise)
    width = float(1.4826 * np.median(np.abs(deviations))) if len(deviations) else 0.0
    return _Fit(curve.params, covariance, score - price, clusters, width)


def _fit_noise(data: Channel, curve: Response, noise: _Noise) -> tuple[_Noise, np.ndarray, np.ndarray]:
    """Noise at a curve, weights (n,), and deviations (n,) from the levels of the patches."""
    log_x, log_gain = (data.at(table) for table in _tables(curve))
    y = log_x - data.log_e
    for _ in range(5):
        level, weight = _levels(data, y, noise.scale2(data, log_gain))
        noise = _widths(data, noise, data.share * weight * (y - level[data.cell]) ** 2)
    return noise, weight, y - level[data.cell]


def _improve(
    data: Channel,
    curve: Response,
    weight: np.ndarray,
    noise: _Noise,
    mean: np.ndarray,
    deviation: float,
    independence: float,
    steps: int,
) -> Response:
    """Curve at the minimum of `_inner` for constant weights and noise."""
    from scipy.optimize import minimize

    def objective(theta: np.ndarray) -> tuple[float, np.ndarray]:
        return _inner(data, curve, theta, weight, noise.width, mean, deviation, independence)

    options = {"maxiter": steps, "ftol": 1e-10}
    return curve.with_params(minimize(objective, curve.params, jac=True, method="L-BFGS-B", options=options).x)


def _widths(data: Channel, noise: _Noise, ratio: np.ndarray) -> _Noise:
    """One step of the fixed point at which the mean of weight x squared deviation is 1, overall and per block."""
    total = max(float(data.share.sum()), 1e-12)
    # Where the widths are right, weight x deviation^2 is 1 in the mean.
    overall = ratio.sum() / total
    size = len(noise.block)
    # Small blocks are drawn towards the common width. Steps are limited so that one round cannot run away.
    own = np.bincount(data.block, ratio, size) + _BLOCK_ROWS * overall
    rows = np.bincount(data.block, data.share, size) + _BLOCK_ROWS
    block = noise.block * np.sqrt(np.clip(own / rows / max(overall, 1e-12), 0.1, 10.0))
    # Relative widths have geometric mean 1; the common width holds the rest.
    block /= np.exp(np.average(np.log(block), weights=rows))
    return _Noise(float(np.clip(noise.width * np.sqrt(np.clip(overall, 0.1, 10.0)), 1e-3, 1.0)), np.clip(block, 0.2, 20.0))


def _inner(
    data: Channel,
    curve: Response,
    theta: np.ndarray,
    weight: np.ndarray,
    width: float,
    mean: np.ndarray,
    deviation: float,
    independence: float,
) -> tuple[float, np.ndarray]:
    """Negative log posterior for constant weights, and its gradient."""
    # -------- curve, inside the range in which it is monotone --------
    inside = curve.with_params(theta)
    log_x, log_gain = _tables(inside)
    dx, dg = _table_slopes(inside, log_x, log_gain)

    # -------- rows about the levels of their patches --------
    y = data.at(log_x) - data.log_e
    size = data.cells
    total = np.maximum(np.bincount(data.cell, weight, size), 1e-300)
    level = np.bincount(data.cell, weight * y, size) / total
    n = y - level[data.cell]
    cost = float((data.share * (0.5 * weight * n**2 + data.at(log_gain))).sum())
    # The level depends on y too, but drops out: `share` is one number on a patch, where the weighted deviations add up to 0.
    by_x, by_g = data.share * weight * n, data.share
    by_bounds = np.zeros(len(theta))

    # -------- bounds, which act on the curve through the levels and the edge of saturation --------
    if len(data.full):
        edge, edge_slope = np.interp(data.saturation, KNOTS, log_x), _at(dx, data.saturation)
        above = level[data.full] + data.full_e - edge
        reached = _saturation_probability(above, width)
        cost -= float(np.log(reached).sum())
        by_level = -1.702 / width * (reached - 0.02) * (1.0 - (reached - 0.02) / 0.98) / reached
        by_bounds -= by_level.sum() * edge_slope
        by_x = by_x + weight * (np.bincount(data.full, by_level, size) / total)[data.cell]

    # -------- gradient, prior, and a penalty on parameters beyond the range --------
    gradient = dx.T @ data.scatter(by_x) + dg.T @ data.scatter(by_g) + by_bounds
    away, beyond = (theta - mean) / deviation**2, theta - inside.params
    cost = independence * cost + 0.5 * float(((theta - mean) * away).sum()) + 1e3 * float((beyond**2).sum())
    return cost, independence * gradient + away + 2e3 * beyond


def _at(table: np.ndarray, value: float) -> np.ndarray:
    j = int(np.clip(np.searchsorted(KNOTS, value, side="right") - 1, 0, len(KNOTS) - 2))
    part = (value - KNOTS[j]) / (KNOTS[j + 1] - KNOTS[j])
    return (1.0 - part) * table[j] + part * table[j + 1]


def _curvature(
    data: Channel,
    curve: Response,
    weight: np.ndarray,
    noise: _Noise,
    mean: np.ndarray,
    deviation: float,
    independence: float,
) -> tuple[np.ndarray, float, float]:
    """Covariance of the parameters (P, P), independence of a row (at most 1) and price of the parameters (Eq. C.22, C.23).

    The scores are summed over clusters. `_inner` majorises the likelihood; H has the curvature of Student's t itself, which is
    flatter.
    """
    theta, size = curve.params, curve.params.size
    if not size:
        return np.zeros((0, 0)), 1.0, 0.0

    # -------- H: differences of the gradient, then Student's own curvature --------
    # An infinite deviation leaves the prior out.
    hessian = np.zeros((size, size))
    for k, step in enumerate(1e-3 * np.eye(size)):
        up = _inner(data, curve, theta + step, weight, noise.width, mean, np.inf, 1.0)[1]
        down = _inner(data, curve, theta - step, weight, noise.width, mean, np.inf, 1.0)[1]
        hessian[k] = (up - down) / 2e-3
    log_x, log_gain = _tables(curve)
    dx, dg = (data.at(t) for t in _table_slopes(curve, log_x, log_gain))
    y = data.at(log_x) - data.log_e
    cells = data.cells
    total = np.maximum(np.bincount(data.cell, weight, cells), 1e-300)
    n = y - (np.bincount(data.cell, weight * y, cells) / total)[data.cell]
    centre = np.stack([np.bincount(data.cell, weight * dx[:, k], cells) / total for k in range(size)], -1)
    lever = dx - centre[data.cell]
    # psi' = w (nu s^2 - n^2) / (nu s^2 + n^2), and nu s^2 + n^2 = (nu + 1) / w.
    excess = weight * 2.0 * n**2 * weight / (_FREEDOM + 1.0)
    hessian = 0.5 * (hessian + hessian.T) - lever.T @ ((data.share * excess)[:, None] * lever)
    # H has to be positive for the inverses below; noise and Student's tails may make a direction flat or concave.
    values, vectors = np.linalg.eigh(hessian)
    values = np.maximum(values, 1e-6 * max(float(values.max()), 1e-6))

    # -------- J: scores by cluster --------
    # The level follows its rows, so n has the share (m - 1) / m of a row's variance. With the root of the share, squared scores
    # of single rows add up to the variance of sum share w n lever.
    score = np.sqrt(data.share)[:, None] * (weight * n)[:, None] * lever + data.share[:, None] * dg
    owner = np.unique(data.cluster, return_inverse=True)[1]
    summed = np.stack([np.bincount(owner, score[:, k]) for k in range(size)], -1)
    # The factor corrects for a small number of clusters.
    spread = summed.T @ summed * len(summed) / max(len(summed) - 1, 1)

    # -------- price, independence and sandwich (Eq. C.22, C.23) --------
    prior = np.eye(size) / deviation**2
    known = np.linalg.inv((vectors * values) @ vectors.T + prior)
    price = float(np.trace(known @ spread))
    # The traces exclude the prior: directions that it determines say nothing about correlated rows.
    independence = float(np.clip(np.trace(known @ (vectors * values) @ vectors.T) / max(price, 1e-12), 1e-4, 1.0))
    adjusted = np.linalg.inv(independence * (vectors * values) @ vectors.T + prior)
    return adjusted @ (independence**2 * spread + prior) @ adjusted, independence, price


def _likelihood(data: Channel, curve: Response, noise: _Noise) -> tuple[float, dict[int, float]]:
    """Log likelihood of the sensor values, and of every cluster."""
    log_x, log_gain = _tables(curve)
    gain = data.at(log_gain)
    y, scale2 = data.at(log_x) - data.log_e, noise.scale2(data, gain)
    level, _ = _levels(data, y, scale2)
    n = y - level[data.cell]
    tail = 0.5 * (_FREEDOM + 1.0) * np.log1p(n**2 / (_FREEDOM * scale2))
    rows = -data.share * (tail + 0.5 * np.log(scale2) + gain)
    bounds = np.log(
        _saturation_probability(level[data.full] + data.full_e - np.interp(data.saturation, KNOTS, log_x), noise.width)
    )
    # Sums by cluster, from which families are compared with an error (Eq. C.24).
    names, owner = np.unique(np.concatenate([data.cluster, data.full_cluster]), return_inverse=True)
    summed = np.bincount(owner, np.concatenate([rows, bounds]))
    return float(rows.sum() + bounds.sum()), dict(zip(names.tolist(), summed.tolist(), strict=True))
