"""Exposure, white balance and vignetting from surface that photographs share (docs/method/camera.md, Eq. C.25 to C.27).

The robust fit eliminates the levels of the patches; a term enters the model when it helps on surface that the fit did not use.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from iif_core.camera.exposure import view_groups
from iif_core.errors import InputError

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

SIGNIFICANT = 2.0
"""Number of standard errors by which a term must reduce the loss on held-out surface."""
MIN_EFFECT = 0.01
"""Smallest useful term: median |log gain| of a channel relative to its view, or largest |log vignetting|."""
MIN_ROWS = 8
"""Number of (patch, channel) rows on shared patches that a view needs."""
MAX_ROWS = 40_000
"""Number of rows from which the gains of all views are estimated."""
_VIGNETTING_SIGMA = 1.0  # standard deviation of the prior of a and b


@dataclass(frozen=True)
class Evidence:
    """Effect of a term of the model on held-out surface (Eq. C.27).

    Attributes:
        gain: mean decrease of Cauchy's loss per row; error: its standard error over (block, view).
        size: size of the term; included: whether it enters the model.
        before, after: robust spread of the residuals without and with the term.
    """

    gain: float
    error: float
    size: float
    included: bool
    before: float
    after: float


@dataclass(frozen=True)
class CameraGains:
    """Factors of radiance before the response (Eq. C.8).

    Attributes:
        gain: (V, 3) float64, exposure times white balance; geometric mean 1 in each channel over overlapping views;
            equal channels without white balance; 1 where not estimated.
        vignetting: (2,) a, b of exp(a r^2 + b r^4).
        estimated: (V,) bool.
        residual: robust spread of log y about the model.
        evidence: for `white_balance` and `vignetting`, as far as they were tried.
        group: (V,) int, views with the same number are connected by shared surface, -1 = not estimated; None = not told. Only
            within a group are factors known relative to one another.
    """

    gain: np.ndarray
    vignetting: np.ndarray
    estimated: np.ndarray
    residual: float = 0.0
    evidence: dict[str, Evidence] = field(default_factory=dict)
    group: np.ndarray | None = None

    @classmethod
    def plain(cls, exposure: np.ndarray) -> CameraGains:
        """Gains of views with one known factor (V,) each."""
        exposure = np.asarray(exposure, np.float64)
        return cls(np.repeat(exposure[:, None], 3, 1), np.zeros(2), np.ones(len(exposure), bool))

    @property
    def exposure(self) -> np.ndarray:
        """(V,) geometric mean over the channels."""
        return np.exp(np.log(self.gain).mean(1))

    @property
    def is_plain(self) -> bool:
        """Whether each view has one factor only."""
        return not self.vignetting.any() and bool((self.gain == self.gain[:, :1]).all())

    def raised(self, power: float) -> CameraGains:
        """Return the gains of f(x^(1 / power)) for those of f(x): all that was estimated, to a power, around its mean."""
        own = self.estimated[:, None]
        middle = np.exp(np.log(self.gain[self.estimated]).mean()) if own.any() else 1.0
        gain = np.where(own, middle * (self.gain / middle) ** power, self.gain)
        return replace(self, gain=gain, vignetting=power * self.vignetting)

    def factor(self, view: np.ndarray | int, radius2: np.ndarray) -> np.ndarray:
        """Factors (n, 3) of pixels at squared radius (n,), in views (n,) or in one view."""
        return self.gain[view] * falloff(self.vignetting, radius2)[:, None]


def falloff(vignetting: np.ndarray, radius2: np.ndarray) -> np.ndarray:
    """Compute the vignetting exp(a r^2 + b r^4), in the shape of `radius2`; 1 in the centre of the picture."""
    return np.exp((vignetting[0] + vignetting[1] * radius2) * radius2)


def radius_squared(index: np.ndarray, width: int, height: int) -> np.ndarray:
    """Compute the squared distance (n,) of pixels, given by flat index, from the picture's centre; 1 in its corners (Eq. C.9)."""
    x, y = index % width + 0.5 - 0.5 * width, index // width + 0.5 - 0.5 * height
    return (x**2 + y**2) / (0.25 * (width**2 + height**2))


@dataclass(frozen=True)
class GainRows:
    """n rows: patch and view numbers (n,), y = f^-1(I) (n, 3) with NaN = unknown, radius2 (n,), block (n,)."""

    patch: np.ndarray
    view: np.ndarray
    y: np.ndarray
    radius2: np.ndarray
    block: np.ndarray

    def take(self, choice: np.ndarray) -> GainRows:
        """Select rows."""
        return GainRows(*(getattr(self, name)[choice] for name in ("patch", "view", "y", "radius2", "block")))

    def thinned(self, limit: int = MAX_ROWS) -> GainRows:
        """Select about `limit` rows: whole patches, by a hash of their number."""
        if len(self.view) <= limit:
            return self
        # A multiplicative hash, of which the upper 24 bits are spread evenly. A patch keeps all of its rows or none.
        mixed = self.patch.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15) >> np.uint64(40)
        return self.take(mixed.astype(np.float64) < limit / len(self.view) * 2.0**24)


def estimate(rows: GainRows, n_views: int, white_balance: bool = True, vignetting: bool = True, rounds: int = 20) -> CameraGains:
    """Estimate the gains of the views under one of the four models (Eq. C.25, C.26).

    Args:
        rows: shared surface.
        n_views: V.
        white_balance, vignetting: terms of the model besides the exposure.
        rounds: largest number of reweighted solves.

    Returns:
        Gains without evidence.

    Raises:
        InputError: a view number out of range.
    """
    if len(rows.view) and (rows.view.min() < 0 or rows.view.max() >= n_views):
        raise InputError(f"gains: view {int(rows.view.min())}..{int(rows.view.max())} out of range 0..{n_views - 1}")
    data = _Entries.of(rows, n_views)
    if not len(data.value):
        return CameraGains(np.ones((n_views, 3)), np.zeros(2), np.zeros(n_views, bool))

    # -------- unknowns: gains of the views, then a and b --------
    design = data.design(n_views, white_balance, vignetting)
    tied, group = data.tied(n_views, white_balance), view_groups(data.cell, data.view, n_views)
    gauge = _means(tied, design.shape[1])
    theta, weight, scale = np.zeros(design.shape[1]), np.ones(len(data.value)), 0.0
    known = np.flatnonzero(np.asarray(np.abs(design).sum(0)).ravel())  # columns of views without rows are empty
    for _ in range(rounds):
        # -------- levels of the patches eliminated: X'Q'WQX and X'Q'WQ ln y (Eq. C.26) --------
        # `mixed` sums weighted rows of X over each patch; the product below is what the mean of each patch takes away.
        total = np.bincount(data.cell, weight)
        mixed = data.members(weight) @ design
        weighted = design.multiply(weight[:, None]).tocsr()
        normal = np.asarray((design.T @ weighted - mixed.T @ mixed.multiply(1.0 / total[:, None])).todense())
        level = np.bincount(data.cell, weight * data.value) / total
        right = np.asarray(design.T @ (weight * (data.value - level[data.cell]))).ravel()

        # -------- gauge and prior --------
        # The data leave the mean of the views that a channel ties open. A projector on these means sets them to 0 and changes
        # no ratio.
        normal += gauge * max(float(np.trace(normal)) / len(theta), 1e-12)
        if vignetting:
            normal[[-2, -1], [-2, -1]] += max(scale, 1e-3) ** 2 / _VIGNETTING_SIGMA**2  # rows count 1, not 1 / scale^2
        step = np.zeros(len(theta))
        step[known] = np.linalg.solve(normal[np.ix_(known, known)], right[known])

        # -------- Cauchy weights from the residuals about the levels --------
        left = data.value - design @ step
        residual = left - (np.bincount(data.cell, weight * left) / total)[data.cell]
        scale = float(1.4826 * np.median(np.abs(residual)))
        # 2.385 scale gives Cauchy's weights 95 % efficiency; the floor prevents division by zero for exact data.
        weight = 1.0 / (1.0 + (residual / max(2.385 * scale, 1e-6)) ** 2)
        done = np.abs(step - theta).max() < 1e-7
        theta = step
        if done:
            break
    gains = theta[: 3 * n_views].reshape(n_views, 3) if white_balance else np.repeat(theta[:n_views, None], 3, 1)
    gains, seen = _grey(gains, tied, group), group >= 0
    found = np.exp(np.where(seen[:, None], gains, 0.0))
    return CameraGains(found, theta[-2:] if vignetting else np.zeros(2), seen, scale, group=group)


def choose_gains(rows: GainRows, n_views: int) -> CameraGains:
    """Estimate the smallest model that held-out surface supports: exposure; then white balance; then vignetting.

    The blocks (objects) are divided into two halves. Each half is judged by the gains fitted to the other, through the loss of
    its rows about levels of their own. A term enters when the loss decreases by more than SIGNIFICANT standard errors and the
    term is larger than MIN_EFFECT.
    """
    half = _halves(rows)
    model = {"white_balance": False, "vignetting": False}
    evidence: dict[str, Evidence] = {}
    best = estimate(rows, n_views, **model)
    for term in model:
        wider = estimate(rows, n_views, **{**model, term: True})
        size = _chroma(wider) if term == "white_balance" else _depth(wider)
        gain, error, before, after = _judge(rows, half, n_views, model, term)
        included = gain > SIGNIFICANT * error and size > MIN_EFFECT
        evidence[term] = Evidence(gain, error, size, included, before, after)
        if included:
            model[term], best = True, wider
    return replace(best, evidence=evidence)


@dataclass(frozen=True)
class _Entries:
    """One entry per (row, channel) with a value, on patches that two views share."""

    cell: np.ndarray
    view: np.ndarray
    channel: np.ndarray
    value: np.ndarray
    radius2: np.ndarray

    @classmethod
    def of(cls, rows: GainRows, n_views: int) -> _Entries:
        row, channel = np.nonzero(np.isfinite(rows.y) & (rows.y > 0))
        # A cell is one channel of one patch, which has a level to itself.
        key = rows.patch[row].astype(np.int64) * 3 + channel
        view = rows.view[row].astype(np.int64)
        keep = np.ones(len(row), bool)
        while keep.any():  # dropping a view can leave patches that only one view sees
            cell = np.unique(key[keep], return_inverse=True)[1]
            pairs = np.unique(cell.astype(np.int64) * n_views + view[keep]) // n_views
            shared = np.bincount(pairs, minlength=int(cell.max()) + 1)[cell] >= 2
            enough = np.bincount(view[keep][shared], minlength=n_views) >= MIN_ROWS
            good = shared & enough[view[keep]]
            if good.all():
                break
            keep[np.flatnonzero(keep)[~good]] = False
        row, channel, view, key = row[keep], channel[keep], view[keep], key[keep]
        cell = np.unique(key, return_inverse=True)[1]
        return cls(cell, view, channel, np.log(rows.y[row, channel]), rows.radius2[row])

    def design(self, n_views: int, white_balance: bool, vignetting: bool) -> csr_matrix:
        """Sparse design matrix (n, V or 3 V, plus 2 with vignetting)."""
        from scipy.sparse import coo_matrix

        number = np.arange(len(self.value))
        gains = n_views * (3 if white_balance else 1)
        column = 3 * self.view + self.channel if white_balance else self.view
        parts = [(number, column, np.ones(len(number)))]
        if vignetting:
            parts += [(number, np.full(len(number), gains + k), self.radius2 ** (k + 1)) for k in range(2)]
        row, column, value = (np.concatenate(part) for part in zip(*parts, strict=True))
        return coo_matrix((value, (row, column)), (len(number), gains + 2 * vignetting)).tocsr()

    def members(self, weight: np.ndarray) -> csr_matrix:
        """Sparse (cells, n) matrix that sums entries with `weight` over each cell."""
        from scipy.sparse import coo_matrix

        return coo_matrix((weight, (self.cell, np.arange(len(weight)))), (int(self.cell.max()) + 1, len(weight))).tocsr()

    def tied(self, n_views: int, white_balance: bool) -> np.ndarray:
        """Groups of views (V, 1), or (V, 3) with white balance, whose ratios a channel tells; -1 without entries."""
        if not white_balance:
            return view_groups(self.cell, self.view, n_views)[:, None]
        out = np.full((n_views, 3), -1, np.int32)
        for c in range(3):
            own = self.channel == c
            if own.any():
                out[:, c] = view_groups(self.cell[own], self.view[own], n_views)
        return out


def _means(tied: np.ndarray, size: int) -> np.ndarray:
    """Projector (size, size) on the mean of each group of each channel (V, C); unknown C v + c is channel c of view v."""
    out, channels = np.zeros((size, size)), tied.shape[1]
    for c in range(channels):
        for g in range(int(tied[:, c].max(initial=-1)) + 1):
            own = np.flatnonzero(tied[:, c] == g) * channels + c
            out[np.ix_(own, own)] = 1.0 / len(own)
    return out


def _grey(gains: np.ndarray, tied: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Return log gains (V, 3) with the groups of each channel moved, each as a whole, to where the views are greyest.

    A channel that is saturated on all surface which two groups of views share leaves their ratio in this channel open; the
    other channels tell it. The gains are those of least squared difference from the mean of their view, among all that the
    rows do not tell apart and whose mean over the views of each `group` (V,) is 0 in each channel.
    """
    out = gains.copy()
    if tied.shape[1] == 1:
        return out
    for g in range(int(group.max(initial=-1)) + 1):
        views = np.flatnonzero(group == g)
        # A view without entries in a channel is a group of its own there.
        own = np.where(tied[views] < 0, -1 - np.arange(len(views))[:, None], tied[views])
        labels = [np.unique(own[:, c], return_inverse=True)[1] for c in range(3)]
        if not any(label.any() for label in labels):
            continue
        # -------- moves of the groups, which keep the mean of each channel: one column each --------
        move = np.zeros((len(views), 3, sum(int(label.max()) + 1 for label in labels)))
        start = 0
        for c, label in enumerate(labels):
            move[np.arange(len(views)), c, start + label] = 1.0
            start += int(label.max()) + 1
        move -= move.mean(0)
        moved_chroma = (move - move.mean(1, keepdims=True)).reshape(-1, start)
        chroma = out[views] - out[views].mean(1, keepdims=True)
        out[views] -= move @ np.linalg.lstsq(moved_chroma, chroma.ravel(), rcond=1e-9)[0]
    return out


def _chroma(gains: CameraGains) -> float:
    logs = np.log(gains.gain[gains.estimated])
    return float(np.median(np.abs(logs - logs.mean(1, keepdims=True)))) if len(logs) else 0.0


def _depth(gains: CameraGains) -> float:
    return float(np.abs(np.log(falloff(gains.vignetting, np.linspace(0, 1, 33)))).max())


def _halves(rows: GainRows) -> np.ndarray:
    """(n,) bool: blocks dealt from the largest into two halves of equal size; patches where one block dominates."""
    blocks, number, count = np.unique(rows.block, return_inverse=True, return_counts=True)
    # One large object would leave one half nearly empty; its patches are divided instead.
    if not len(blocks) or count.max() > 0.6 * count.sum():
        return rows.patch.astype(np.int64) % 2 == 0
    side, load = np.zeros(len(blocks), bool), [0, 0]
    for b in np.argsort(-count, kind="stable"):
        side[b] = load[1] < load[0]
        load[int(side[b])] += count[b]
    return side[number]


def _judge(
    rows: GainRows, half: np.ndarray, n_views: int, model: dict[str, bool], term: str
) -> tuple[float, float, float, float]:
    """Mean decrease of the held-out loss when `term` joins `model`, its standard error, and the robust spreads."""
    losses, clusters, spreads = [], [], []
    for side in (False, True):
        fitted, judged = rows.take(half == side), rows.take(half != side)
        both = [estimate(fitted, n_views, **m) for m in (model, {**model, term: True})]
        own = both[0].estimated & both[1].estimated
        judged = judged.take(own[judged.view])
        residual = [_held_residual(judged, gains, n_views) for gains in both]
        if not len(residual[0][0]):
            continue
        spread = [float(1.4826 * np.median(np.abs(r))) for r, _ in residual]
        # One width for both models, or the better one would be judged by a narrower loss.
        width = max(2.385 * spread[0], 1e-4)
        losses.append(np.log1p((residual[0][0] / width) ** 2) - np.log1p((residual[1][0] / width) ** 2))
        clusters.append(judged.block[residual[0][1]].astype(np.int64) * n_views + judged.view[residual[0][1]])
        spreads.append(spread)
    if not losses:
        return 0.0, np.inf, 0.0, 0.0
    loss, cluster = np.concatenate(losses), np.unique(np.concatenate(clusters), return_inverse=True)[1]
    total, count = np.bincount(cluster, loss), np.bincount(cluster)
    mean = float(loss.mean())
    # Rows of one object in one view err together, so their sum counts as one observation (Eq. C.27).
    error = float(np.sqrt(((total - mean * count) ** 2).sum()) / len(loss))
    before, after = np.mean(spreads, 0)
    return mean, error, float(before), float(after)


def _held_residual(rows: GainRows, gains: CameraGains, n_views: int) -> tuple[np.ndarray, np.ndarray]:
    """log y less the gains and the robust level of its patch, and the row of each value."""
    log_y = np.log(np.where(rows.y > 0, rows.y, np.nan)) - np.log(gains.factor(rows.view, rows.radius2))
    row, channel = np.nonzero(np.isfinite(log_y))
    cell = np.unique(rows.patch[row].astype(np.int64) * 3 + channel, return_inverse=True)[1]
    if not len(cell):
        return np.zeros(0), row
    value, weight = log_y[row, channel], np.ones(len(row))
    for _ in range(5):
        level = np.bincount(cell, weight * value) / np.bincount(cell, weight)
        residual = value - level[cell]
        scale = max(1.4826 * float(np.median(np.abs(residual))), 1e-6)
        weight = 1.0 / (1.0 + (residual / (2.385 * scale)) ** 2)
    # The only row of a cell equals its level and says nothing.
    several = np.bincount(cell)[cell] >= 2
    return residual[several], row[several]
