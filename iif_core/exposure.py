"""Exposure of every view, and the camera response, from surface that several views share.

A surface cell c that views v and w both see is, up to gloss, equally bright in both: log y_vc = g_v + s_c. Minimising over the
cells s_c leaves a small V x V problem in the gains g_v, solved by iteratively re-weighted least squares (Cauchy).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from iif_core.errors import InputError
from iif_core.response import Response


@dataclass(frozen=True)
class ExposureGains:
    """Result of `estimate_gains`.

    Attributes:
        gain: (V,) float64, what the linearised photographs are multiplied by; geometric mean 1 within each group of views
            that overlap; 1 where not estimated.
        error: (V,) float64 standard error of log gain (0 where not estimated).
        estimated: (V,) bool.
        group: (V,) int32, views with the same number are tied together by shared surface; -1 = no overlap.
        residual: robust scale of log y - g - s (1.4826 x median absolute), 0 without overlap.
        pairs: number of (cell, view) pairs used.
    """

    gain: np.ndarray
    error: np.ndarray
    estimated: np.ndarray
    group: np.ndarray
    residual: float
    pairs: int


def estimate_gains(
    cell: np.ndarray, view: np.ndarray, value: np.ndarray, n_views: int, iterations: int = 20, min_pairs: int = 8
) -> ExposureGains:
    """Relative exposure of the views: robust minimum of sum w (log y_vc - g_v - s_c)^2 over g and s.

    Args:
        cell: (n,) int, surface cell that a pixel sees; -1 = leave out.
        view: (n,) int in [0, n_views).
        value: (n,) or (n, 3) linearised sensor value f^-1(I), unsaturated; not-positive and non-finite values are left out.
            The three channels share the gain.
        n_views: V.
        iterations: re-weighted solves.
        min_pairs: (cell, view) pairs on shared cells that a view needs.

    Returns:
        `ExposureGains`. Only ratios are known: the mean of log gain is 0 in each group of overlapping views.

    Raises:
        InputError: shapes that do not match, or a view number out of range.
    """
    cell, view = np.asarray(cell), np.asarray(view)
    value = np.asarray(value, np.float64).reshape(len(cell), -1) if len(cell) else np.zeros((0, 1))
    if view.shape != cell.shape or len(value) != len(cell):
        raise InputError(f"exposure: {len(cell)} cells, {len(view)} views, {len(value)} values; they must be as many")
    if len(view) and (view.min() < 0 or view.max() >= n_views):
        raise InputError(f"exposure: view {int(view.min())}..{int(view.max())} out of range 0..{n_views - 1}")
    cell, view, log_y, weight = _pairs(cell, view, value, n_views)
    nothing = ExposureGains(
        np.ones(n_views), np.zeros(n_views), np.zeros(n_views, bool), np.full(n_views, -1, np.int32), 0.0, 0
    )
    # Cells that one view alone sees say nothing; dropping thin views can leave new ones, hence the loop.
    while len(cell):
        count = np.bincount(cell)
        shared = count[cell] >= 2
        enough = np.bincount(view[shared], minlength=n_views) >= min_pairs
        keep = shared & enough[view]
        if keep.all():
            break
        cell, view, log_y, weight = cell[keep], view[keep], log_y[keep], weight[keep]
    if not len(cell):
        return nothing
    cell = np.unique(cell, return_inverse=True)[1]
    group = _components(cell, view, n_views)
    gains, error, scale = _solve(cell, view, log_y, weight, group, n_views, iterations)
    estimated = group >= 0
    return ExposureGains(np.where(estimated, np.exp(gains), 1.0), error, estimated, group, scale, len(cell))


def _pairs(
    cell: np.ndarray, view: np.ndarray, value: np.ndarray, n_views: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """One row a (cell, view, channel): mean log value and weight sqrt(pixels); channels become cells of their own."""
    rows = []
    for c in range(value.shape[1]):
        good = (cell >= 0) & np.isfinite(value[:, c]) & (value[:, c] > 0)
        key = cell[good].astype(np.int64) * n_views + view[good]
        unique, inverse = np.unique(key, return_inverse=True)
        count = np.bincount(inverse, minlength=len(unique))
        mean = np.bincount(inverse, np.log(value[good, c]), len(unique)) / np.maximum(count, 1)
        rows.append((unique // n_views * value.shape[1] + c, unique % n_views, mean, np.sqrt(count)))
    cells, views, logs, weights = (np.concatenate(parts) for parts in zip(*rows, strict=True))
    return np.unique(cells, return_inverse=True)[1], views.astype(np.int64), logs, weights


def _components(cell: np.ndarray, view: np.ndarray, n_views: int) -> np.ndarray:
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    size = n_views + int(cell.max()) + 1
    graph = coo_matrix((np.ones(len(cell)), (view, cell + n_views)), (size, size))
    label = connected_components(graph, directed=False)[1][:n_views]
    present = np.bincount(view, minlength=n_views) > 0
    out = np.full(n_views, -1, np.int32)
    out[present] = np.unique(label[present], return_inverse=True)[1]
    return out


def _solve(
    cell: np.ndarray, view: np.ndarray, log_y: np.ndarray, weight: np.ndarray, group: np.ndarray, n_views: int, iterations: int
) -> tuple[np.ndarray, np.ndarray, float]:
    from scipy.sparse import coo_matrix

    n_cells = int(cell.max()) + 1
    gains = np.zeros(n_views)
    robust = np.ones(len(cell))
    present = np.flatnonzero(group >= 0)
    one_hot = (group[present][:, None] == np.arange(group.max() + 1)).astype(np.float64)  # (V', groups)
    gauge = one_hot @ (one_hot / one_hot.sum(0)).T  # projector on the group means
    scale = 0.0
    normal = np.eye(len(present))
    for _ in range(max(iterations, 1)):
        w = weight * robust
        total = np.bincount(cell, w, n_cells)
        mixed = coo_matrix((w, (view, cell)), (n_views, n_cells)).tocsr()
        laplacian = np.diag(np.asarray(mixed.sum(1)).ravel()) - (mixed.multiply(1.0 / total) @ mixed.T).toarray()
        mean = np.bincount(cell, w * log_y, n_cells) / total
        right = np.bincount(view, w * (log_y - mean[cell]), n_views)
        normal = laplacian[np.ix_(present, present)]
        normal = normal + gauge * max(np.trace(normal) / len(present), 1e-12)
        step = np.zeros(n_views)
        step[present] = np.linalg.solve(normal, right[present])
        level = np.bincount(cell, w * (log_y - step[view]), n_cells) / total
        residual = log_y - step[view] - level[cell]
        scale = float(1.4826 * np.median(np.abs(residual)))
        # 2.385 scale: 95 % efficiency of Cauchy's weights; the floor keeps exact data from dividing by zero.
        robust = 1.0 / (1.0 + (residual / max(2.385 * scale, 1e-6)) ** 2)
        converged = np.max(np.abs(step - gains)) < 1e-10
        gains = step
        if converged:
            break
    error = np.zeros(n_views)
    inverse = np.linalg.inv(normal)
    error[present] = scale * np.sqrt(np.clip(np.diag(inverse - gauge @ inverse @ gauge), 0, None) * np.mean(weight))
    return gains, error, scale


@dataclass(frozen=True)
class CalibratedResponse:
    """Result of `calibrate_response`.

    Attributes:
        response: fitted curve, one row of parameters a channel; the start where the data say nothing.
        stops: largest difference of exposure within the cells that were used, in stops.
        pairs: (cell, view) pairs used, of all channels.
        before, after: weighted root mean square of the log differences within cells, at the start and at the end.
    """

    response: Response
    stops: float
    pairs: int
    before: float
    after: float


def calibrate_response(
    cell: np.ndarray,
    view: np.ndarray,
    value: np.ndarray,
    exposure: np.ndarray,
    start: Response,
    saturation: float = 0.99,
    min_stops: float = 1.0,
    min_pairs: int = 200,
    iterations: int = 30,
    ridge: float = 1e-4,
) -> CalibratedResponse:
    """Camera response from surface that is seen under different, known exposures; needs no light and no material.

    The same cell is equally bright in every view, so I_vc = f(e_v exp(s_c)). Robust Gauss-Newton over the parameters with
    the cells eliminated; a pair counts by the sensor's resolution there (half an 8-bit step) and 5 % of
    gloss and texture. Known exposures fix the exponent that a scene with unknown exposures would leave open.
    Pairs near saturation are chosen by what the other views of the cell predict for them, not by their own value: leaving
    out what came out bright would bend the curve near 1.

    Args:
        cell: (n,) surface cell, -1 = leave out; view: (n,) int; value: (n, 3) sensor values.
        exposure: (V,) of the views; start: family and starting parameters.
        saturation: pairs that the other views predict above 0.85 of this are left out, as are those predicted below
            four 8-bit steps.
        min_stops, min_pairs: below, or without free parameters, the start comes back.
        ridge: pull to the start relative to the number of pairs.
    """
    value = np.asarray(value, np.float64)
    start = start if start.params.ndim == 2 else start.with_params(np.tile(start.params, (3, 1)))
    if not start.names or not len(cell):
        return CalibratedResponse(start, 0.0, 0, 0.0, 0.0)
    params, stops, pairs, squares, weights = start.params.copy(), 0.0, 0, [0.0, 0.0], 0.0
    for c in range(3):
        data = _exposed_pairs(cell, view, value[:, c], exposure, start.channel(c), 0.85 * saturation, min_stops)
        if len(data[0]) < min_pairs:
            continue
        theta, before, after, weight = _fit_channel(*data[:4], start.channel(c), iterations, ridge)
        params[c] = theta
        stops, pairs, weights = max(stops, data[4]), pairs + len(data[0]), weights + weight
        squares = [squares[0] + before, squares[1] + after]
    scale = 1.0 / max(weights, 1e-300)
    return CalibratedResponse(
        start.with_params(params), stops, pairs, float(np.sqrt(squares[0] * scale)), float(np.sqrt(squares[1] * scale))
    )


def _exposed_pairs(
    cell: np.ndarray, view: np.ndarray, value: np.ndarray, exposure: np.ndarray, curve: Response, top: float, min_stops: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]:
    """One row a (cell, view): cell 0 ... C - 1, mean value, log exposure, pixels; cells whose exposures span `min_stops`."""
    good = (cell >= 0) & np.isfinite(value)
    key, inverse = np.unique(cell[good].astype(np.int64) * len(exposure) + view[good], return_inverse=True)
    count = np.bincount(inverse, minlength=len(key)).astype(np.float64)
    mean = np.bincount(inverse, value[good], len(key)) / np.maximum(count, 1)
    owner = np.unique(key // len(exposure), return_inverse=True)[1]
    log_e = np.log(exposure[key % len(exposure)])
    use = (mean > 2.0 / 255.0) & (mean < 1.0)
    if not use.any():
        return owner[:0], mean[:0], log_e[:0], count[:0], 0.0
    predicted = curve(np.exp(_others(owner, np.log(np.maximum(curve.inverse(mean), 1e-9)) - log_e, use) + log_e))
    use = (predicted < top) & (predicted > 4.0 / 255.0) & (mean > 0)
    low, high = np.full(len(key), np.inf), np.full(len(key), -np.inf)
    np.minimum.at(low, owner[use], log_e[use])
    np.maximum.at(high, owner[use], log_e[use])
    span = np.where(use, high[owner] - low[owner], 0.0) / np.log(2.0)
    use &= span >= min_stops
    if not use.any():
        return owner[:0], mean[:0], log_e[:0], count[:0], 0.0
    return np.unique(owner[use], return_inverse=True)[1], mean[use], log_e[use], count[use], float(span[use].max())


def _others(owner: np.ndarray, log_radiance: np.ndarray, use: np.ndarray) -> np.ndarray:
    """Mean of log radiance over the other usable pairs of the same cell; infinity where there are none."""
    total = np.bincount(owner, np.where(use, log_radiance, 0.0))
    number = np.bincount(owner, use)
    rest = number[owner] - use
    mean = (total[owner] - np.where(use, log_radiance, 0.0)) / np.maximum(rest, 1)
    return np.where(rest > 0, mean, np.inf)


def _fit_channel(
    cell: np.ndarray, value: np.ndarray, log_e: np.ndarray, count: np.ndarray, start: Response, iterations: int, ridge: float
) -> tuple[np.ndarray, float, float, float]:
    """Parameters of one channel, weighted squares before and after, sum of the weights.

    The residual is I - f(e exp(s)) with one unknown s a cell: in log radiance, noise of I would be divided by the slope of the
    curve, and the fit would flatten the noise by steepening the curve.
    """
    n_cells, theta = int(cell.max()) + 1, start.params.copy()

    def sums(x: np.ndarray) -> np.ndarray:
        return np.bincount(cell, x, n_cells)

    def state(p: np.ndarray, s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Residual, its derivative by s, its derivatives by the parameters (both negative)."""
        x = np.exp(log_e + s[cell])
        f, slope, dparams = start.with_params(p).evaluate(x)
        return value - f, slope * x, dparams

    def variance(gain: np.ndarray) -> np.ndarray:
        return (0.5 / 255.0) ** 2 + (0.05 * gain) ** 2

    trust = np.sqrt(count)  # pixels of one cell share texture and gloss: less than independent
    logs = np.log(np.maximum(start.inverse(value), 1e-9)) - log_e
    level = sums(trust * logs) / sums(trust)
    level = _settle(state, sums, theta, level, trust)
    residual, gain, dparams = state(theta, level)
    first = residual
    damping = 1e-3
    robust = np.ones(len(cell))
    for _ in range(iterations):
        unit = residual / np.sqrt(variance(gain))
        scale = max(2.385 * 1.4826 * float(np.median(np.abs(unit))), 1e-6)
        robust = 1.0 / (1.0 + (unit / scale) ** 2)
        w = trust * robust / variance(gain)
        stiff = np.maximum(sums(w * gain**2), 1e-300)
        through = np.stack([sums(w * gain * dparams[:, k]) for k in range(len(theta))], 1)
        pull = ridge * float((w[:, None] * dparams**2).sum(0).max())
        normal = dparams.T @ (w[:, None] * dparams) - through.T @ (through / stiff[:, None])
        g_s = sums(w * gain * residual)
        right = dparams.T @ (w * residual) - through.T @ (g_s / stiff) - pull * (theta - start.params)
        cost = float((w * residual**2).sum() + pull * ((theta - start.params) ** 2).sum())
        moved = False
        for _ in range(12):
            damped = normal + np.diag(np.diag(normal) * damping + pull + 1e-12 * np.trace(normal))
            candidate = start.with_params(theta + np.linalg.solve(damped, right)).params
            new_level = level + np.clip((g_s - through @ (candidate - theta)) / stiff, -1.0, 1.0)
            new = state(candidate, new_level)
            new_cost = float((w * new[0] ** 2).sum() + pull * ((candidate - start.params) ** 2).sum())
            if new_cost < cost:
                moved, damping = True, max(damping * 0.2, 1e-9)
                break
            damping *= 10.0
        if not moved:
            break
        step = float(np.abs(candidate - theta).max())
        theta, level, (residual, gain, dparams) = candidate, new_level, new
        if step < 1e-9 and new_cost > (1 - 1e-9) * cost:
            break
    w = robust * trust / variance(gain)
    # Sensor differences over the slope by log radiance: reported as differences in log radiance.
    weight = float((w * gain**2).sum())
    return theta, float((w * first**2).sum()), float((w * residual**2).sum()), weight


def _settle(state: Callable, sums: Callable, theta: np.ndarray, level: np.ndarray, trust: np.ndarray) -> np.ndarray:
    """Cell levels at fixed parameters: a few Gauss-Newton steps."""
    for _ in range(4):
        residual, gain, _ = state(theta, level)
        level = level + np.clip(sums(trust * gain * residual) / np.maximum(sums(trust * gain**2), 1e-300), -1.0, 1.0)
    return level
