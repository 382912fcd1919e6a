"""Exposure of every view from surface that several views share (Eq. C.25 with one gain per view, Eq. C.26)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from iif_core.errors import InputError
from iif_core.numerics.graph import component_labels

_MIN_PAIRS = 8  # (cell, view) pairs on shared cells that a view needs


@dataclass(frozen=True)
class ExposureGains:
    """Result of `estimate_gains`.

    Attributes:
        gain: (V,) float64, factors of the linearised photographs; geometric mean 1 within each group of views that overlap; 1
            where not estimated.
        error: (V,) float64 standard error of the log gain; 0 where not estimated.
        estimated: (V,) bool.
        group: (V,) int32, views with the same number are connected by shared surface; -1 = no overlap.
        residual: robust standard deviation of log y - g - s (1.4826 x median absolute value); 0 without overlap.
        pairs: number of (cell, view) pairs used.
    """

    gain: np.ndarray
    error: np.ndarray
    estimated: np.ndarray
    group: np.ndarray
    residual: float
    pairs: int


def estimate_gains(cell: np.ndarray, view: np.ndarray, value: np.ndarray, n_views: int) -> ExposureGains:
    """Estimate the relative exposure of the views: the robust minimum of sum w (log y_vc - g_v - s_c)^2 over g and s.

    Args:
        cell: (n,) int, surface cell that a pixel sees; -1 = ignore.
        view: (n,) int in [0, n_views).
        value: (n,) or (n, 3) linearised, unsaturated sensor values f^-1(I); values that are not positive and finite are
            ignored. The three channels share the gain.
        n_views: V.

    Returns:
        Gains, up to one factor per group of overlapping views: the mean of the log gains of a group is 0.

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
    # A cell that only one view sees carries no information; dropping a view may create such cells, hence the loop.
    while len(cell):
        count = np.bincount(cell)
        shared = count[cell] >= 2
        enough = np.bincount(view[shared], minlength=n_views) >= _MIN_PAIRS
        keep = shared & enough[view]
        if keep.all():
            break
        cell, view, log_y, weight = cell[keep], view[keep], log_y[keep], weight[keep]
    if not len(cell):
        return nothing
    cell = np.unique(cell, return_inverse=True)[1]
    group = view_groups(cell, view, n_views)
    gains, error, scale = _solve(cell, view, log_y, weight, group, n_views)
    estimated = group >= 0
    return ExposureGains(np.where(estimated, np.exp(gains), 1.0), error, estimated, group, scale, len(cell))


def _pairs(
    cell: np.ndarray, view: np.ndarray, value: np.ndarray, n_views: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """One row per (cell, view, channel): mean log value and weight sqrt(pixels); the channels become cells of their own."""
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


def view_groups(cell: np.ndarray, view: np.ndarray, n_views: int) -> np.ndarray:
    """Number the groups of views that are connected by shared cells (n,), (V,) int32; -1 for a view without cells."""
    label = component_labels(n_views + int(cell.max()) + 1, view, cell + n_views)[:n_views]
    present = np.bincount(view, minlength=n_views) > 0
    out = np.full(n_views, -1, np.int32)
    out[present] = np.unique(label[present], return_inverse=True)[1]
    return out


def _solve(
    cell: np.ndarray, view: np.ndarray, log_y: np.ndarray, weight: np.ndarray, group: np.ndarray, n_views: int
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
    for _ in range(20):
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
        # 2.385 scale gives Cauchy's weights 95 % efficiency; the floor prevents division by zero for exact data.
        robust = 1.0 / (1.0 + (residual / max(2.385 * scale, 1e-6)) ** 2)
        converged = np.max(np.abs(step - gains)) < 1e-10
        gains = step
        if converged:
            break
    error = np.zeros(n_views)
    inverse = np.linalg.inv(normal)
    error[present] = scale * np.sqrt(np.clip(np.diag(inverse - gauge @ inverse @ gauge), 0, None) * np.mean(weight))
    return gains, error, scale
