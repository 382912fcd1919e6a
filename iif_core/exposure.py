"""Exposure of every view, and the camera response, from surface that several views share.

A surface cell c that views v and w both see is, up to gloss, equally bright in both: log y_vc = g_v + s_c.
Minimising over the cells s_c leaves a small V x V problem in the gains g_v, solved by iteratively re-weighted
least squares (Cauchy).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from iif_core.errors import InputError
from iif_core.response import Response


@dataclass(frozen=True)
class ExposureGains:
    """Result of `estimate_gains`.

    Attributes:
        gain: (V,) float64, what the linearised photographs are multiplied by; geometric mean 1 within each group
            of views that overlap; 1 where not estimated.
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
        value: (n,) or (n, 3) linearised sensor value f^-1(I), unsaturated; not-positive and non-finite values are
            left out. The three channels share the gain.
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
    nothing = ExposureGains(np.ones(n_views), np.zeros(n_views), np.zeros(n_views, bool), np.full(n_views, -1, np.int32), 0.0, 0)
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
    cell: np.ndarray,
    view: np.ndarray,
    log_y: np.ndarray,
    weight: np.ndarray,
    group: np.ndarray,
    n_views: int,
    iterations: int,
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
        before, after: robust spread of log radiance within cells at the start and at the end.
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
    ridge: float = 2e-2,
    channel_ridge: float = 1e-1,
) -> CalibratedResponse:
    """Camera response from surface that is seen under different, known exposures; needs no light and no material.

    The same cell is equally bright in every view, so I_vc = f(e_v exp(s_c + n)). Maximum likelihood over the
    parameters and the size of n (gloss, texture; Student's t) with the cells eliminated; half an 8-bit step limits
    dark pairs. Known exposures fix the exponent that a scene with unknown exposures would leave open.
    Saturated pairs enter as what they are, e exp(s) >= 1 up to noise: they fix the scale of x, which f(1) = 1
    would otherwise leave to extrapolation, and leaving them out would bend the curve near 1.

    Args:
        cell: (n,) surface cell, -1 = leave out; view: (n,) int; value: (n, 3) sensor values.
        exposure: (V,) of the views; start: family and starting parameters.
        saturation: values from here on are bounds.
        min_stops, min_pairs: below, or without free parameters, the start comes back.
        ridge: pull to the start, per pair. Gloss differs from view to view and, in few views, goes along with
            exposure by chance; where nothing is near saturation the scale of x hangs on the shape alone.
        channel_ridge: pull of each channel to the curve of all channels, per pair.
    """
    value = np.asarray(value, np.float64)
    start = start if start.params.ndim == 2 else start.with_params(np.tile(start.params, (3, 1)))
    if not start.names or not len(cell):
        return CalibratedResponse(start, 0.0, 0, 0.0, 0.0)
    channels = [_exposed_pairs(cell, view, value[:, c], exposure, saturation, min_stops) for c in range(3)]
    enough = [c for c in range(3) if len(channels[c][0]) >= min_pairs]
    if not enough:
        return CalibratedResponse(start, 0.0, 0, 0.0, 0.0)
    # One curve for all channels first; each channel then has to earn its difference.
    offsets = np.cumsum([0] + [int(channels[c][0].max()) + 1 for c in enough])
    joined = [np.concatenate([channels[c][k] + (offsets[i] if k == 0 else 0) for i, c in enumerate(enough)]) for k in (0, 1, 2)]
    clipped = np.concatenate([channels[c][3] for c in enough])
    common = start.channel(0).with_params(start.params.mean(0))
    shared, before, after = _fit_channel(*joined, clipped, common, saturation, ridge)
    params, spreads = np.tile(shared, (3, 1)), []
    for c in enough:
        params[c], _, own = _fit_channel(*channels[c][:4], common.with_params(shared), saturation, channel_ridge)
        spreads.append(own)
    pairs, stops = sum(len(channels[c][0]) for c in enough), max(channels[c][4] for c in enough)
    return CalibratedResponse(start.with_params(params), stops, pairs, before, float(np.mean(spreads)))


def _exposed_pairs(
    cell: np.ndarray, view: np.ndarray, value: np.ndarray, exposure: np.ndarray, saturation: float, min_stops: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]:
    """One row a (cell, view): cell 0 ... C - 1, mean value, log exposure, saturated; of cells whose exposures span
    `min_stops` and that one view at least saw unsaturated; and the largest span in stops."""
    good = (cell >= 0) & np.isfinite(value)
    key, inverse = np.unique(cell[good].astype(np.int64) * len(exposure) + view[good], return_inverse=True)
    count = np.maximum(np.bincount(inverse, minlength=len(key)), 1)
    mean = np.bincount(inverse, value[good], len(key)) / count
    clipped = np.bincount(inverse, value[good] >= saturation, len(key)) > 0.5 * count
    owner = np.unique(key // len(exposure), return_inverse=True)[1]
    log_e = np.log(exposure[key % len(exposure)])
    use = (mean > 2.0 / 255.0) & np.isfinite(log_e)
    low, high = np.full(len(key), np.inf), np.full(len(key), -np.inf)
    np.minimum.at(low, owner[use], log_e[use])
    np.maximum.at(high, owner[use], log_e[use])
    span = np.where(use, high[owner] - low[owner], 0.0) / np.log(2.0)
    clear = np.bincount(owner, use & ~clipped, len(key))[owner]
    use &= (span >= min_stops) & (clear > 0)
    if not use.any():
        return owner[:0], mean[:0], log_e[:0], clipped[:0], 0.0
    owner = np.unique(owner[use], return_inverse=True)[1]
    return owner, mean[use], log_e[use], clipped[use], float(span[use].max())


_FREEDOM = 4.0  # of Student's t: gloss and misregistration have heavy tails
_FIT_PAIRS = 10_000
_GRID = np.linspace(0.0, 1.0, 2049) ** 3  # the curve is tabulated for the search: 1e-6 of its range


def _fit_channel(
    cell: np.ndarray,
    value: np.ndarray,
    log_e: np.ndarray,
    clipped: np.ndarray,
    start: Response,
    saturation: float,
    ridge: float,
) -> tuple[np.ndarray, float, float]:
    """Parameters of one channel and the spread of log radiance within cells before and after.

    Maximum likelihood for log f^-1(I) = s + log e + t-distributed n. The density of I brings in log dI/dn: without
    it, or with a residual in sensor units at an estimated s, the fit would flatten the noise by bending the curve.
    """
    from scipy.optimize import minimize

    if len(cell) > _FIT_PAIRS:  # whole cells, spread evenly
        keep = cell % -(-len(cell) // _FIT_PAIRS) == 0
        cell, value, log_e, clipped = (
            np.unique(cell[keep], return_inverse=True)[1],
            value[keep],
            log_e[keep],
            clipped[keep],
        )
    n_cells = int(cell.max()) + 1
    full, full_e = cell[clipped], log_e[clipped]
    cell, value, log_e = cell[~clipped], value[~clipped], log_e[~clipped]
    # A cell of m pairs spends one of them on its own level.
    share = (1.0 - 1.0 / np.maximum(np.bincount(cell, minlength=n_cells), 1))[cell]
    total = max(float(share.sum()), 1.0)

    def spread(params: np.ndarray, sigma: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Deviation from the cell's robust level, its squared scale, log dI / d log x; log x of the saturated pairs."""
        curve = start.with_params(params)
        f, slope, _ = curve.evaluate(_GRID)
        x = np.maximum(np.interp(value, f, _GRID), 1e-9)
        gain = np.maximum(x * np.interp(x, _GRID, slope), 1e-9)
        scale2 = sigma**2 + (0.5 / 255.0 / gain) ** 2
        y = np.log(x) - log_e
        weight = 1.0 / scale2
        for _ in range(4):
            level = np.bincount(cell, weight * y, n_cells) / np.bincount(cell, weight, n_cells)
            weight = 1.0 / (scale2 + (y - level[cell]) ** 2 / _FREEDOM)
        top = float(np.log(np.interp(saturation, f, _GRID)))
        return y - level[cell], scale2, np.log(gain), level[full] + full_e - top

    def objective(z: np.ndarray) -> float:
        sigma = np.exp(np.clip(z[-1], -9.0, 1.0))
        n, scale2, log_gain, above = spread(z[:-1], sigma)
        tail = 0.5 * (_FREEDOM + 1.0) * np.log1p(n**2 / (_FREEDOM * scale2))
        # Logistic stand-in for the normal distribution; 2 % of the saturated pairs may be highlights or errors.
        reached = 0.02 + 0.98 / (1.0 + np.exp(np.clip(-1.702 * above / sigma, -60.0, 60.0)))
        pull = ridge * ((z[:-1] - start.params) ** 2).sum()
        # Parameters outside the monotone range are evaluated at its border; the distance keeps the search inside.
        beyond = ((z[:-1] - start.with_params(z[:-1]).params) ** 2).sum()
        likelihood = (share * (tail + 0.5 * np.log(scale2) + log_gain)).sum() - np.log(reached).sum()
        return float(likelihood / total + pull + beyond)

    def width(n: np.ndarray) -> float:
        return float(1.4826 * np.median(np.abs(n)))

    before = width(spread(start.params, 0.1)[0])
    z = np.r_[start.params, np.log(max(before, 1e-3))]
    for size in (0.3, 0.05):  # a second simplex where the first one came to rest
        simplex = np.concatenate([z[None], z + size * np.eye(len(z))])
        options = {"initial_simplex": simplex, "xatol": 1e-5, "fatol": 1e-9, "maxfev": 400}
        z = minimize(objective, z, method="Nelder-Mead", options=options).x
    theta = start.with_params(z[:-1]).params
    return theta, before, width(spread(theta, np.exp(z[-1]))[0])
