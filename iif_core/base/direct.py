"""The material base: K inconsistent predictions of every view fused into one value per surface cell (METHOD 2.3, 7c).

Each segment i (one object in one view) and prediction k has an affine correction T_ik (albedo 3x4, roughness and
metallic 1x2) and, per property, a selection weight alpha_ik. The solver alternates closed forms, one pass over the
views a sweep:

1. T: least squares of the corrected prediction against the texture of the sweep before, with a ridge to identity
   that grows with the pixel count (without it, a constant texture would be a perfect fit);
2. alpha: softmax over k of minus the segment's mean squared error, at a temperature that falls from sweep to sweep
   and is 0 in the last one, where the best prediction is taken;
3. texture: weighted mean (or M-estimate) in each cell of the mixture sum_k alpha_ik T_ik v_nk;
4. gauge: an affine map of an object's texture and its inverse on all T cancel, so the level of an object would drift
   from sweep to sweep. It is moved back to the object's mean over all predictions, so that the mean correction keeps
   the mean colour. Contrast is held by the ridge: with predictions of variance v that correlate by rho it settles at
   about ridge / (ridge + v (1 - rho)) of theirs, it cannot collapse; `history` has the mean gain. Stretching it back
   every sweep was tried and only amplified the noise of plain objects, with no gain elsewhere.

Given T, errors follow from sums over the segment (Gram matrices, made once) and are not a pass of their own. A segment
lies in one view, so T, alpha and the mixture of a view need only the previous texture: memory is one view's predictions
plus the sums. Sums are float64. Last, the Laplace scale of a cell in closed form (laplace.closed_form_scale).

Results do not depend on the order of the predictions, nor on threads.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from .. import laplace
from ..errors import InputError
from .problem import (
    LOWEST,
    NEUTRAL,
    PROPERTIES,
    BaseProblem,
    BaseResult,
    Dropped,
    object_means,
    prediction_faults,
)
from .selection import selection_weights

VARIANTS = ("full", "uniform", "texel_mean", "object_mean")

_PROPERTY_OF_CHANNEL = np.array([0, 0, 0, 1, 2])
_ALBEDO = [0, 1, 2, 5]  # columns of phi = [albedo, roughness, metallic, 1] that each correction reads
_ROUGHNESS = [3, 5]
_METALLIC = [4, 5]

_NOTHING = np.zeros((0, 0, 6))
_T = TypeVar("_T")


@dataclass(frozen=True)
class BaseOptions:
    """How to solve.

    Attributes:
        variant: `full`; `uniform` = corrections, but all predictions alike (no selection); `texel_mean` = mean of all
            predictions a cell; `object_mean` = mean of all predictions an object.
        sweeps: alternations.
        temperature, anneal: selection temperature of the first sweep, in units of the segment's median error, and its
            factor per sweep; the last sweep is at 0.
        ridge: pull of T to identity, times the segment's pixel weight (at least `ridge_pixels`).
        robust: cells take the M-estimate of the Laplace divergence instead of the mean.
        clip_share, clip_pixels: predicted albedo at exactly 0 or 1 is left out of the fit of T where at most this
            share of the segment is, and at least so many pixels remain.
        scale_floor: smallest Laplace scale.
    """

    variant: str = "full"
    sweeps: int = 12
    temperature: float = 1.0
    anneal: float = 0.6
    ridge: float = 0.01
    ridge_pixels: float = 30.0
    robust: bool = False
    clip_share: float = 0.5
    clip_pixels: int = 50
    scale_floor: float = laplace.SCALE_FLOOR

    def __post_init__(self) -> None:
        if self.variant not in VARIANTS:
            raise InputError(f"base variant {self.variant!r}; allowed: {', '.join(VARIANTS)}")
        if self.sweeps < 1 or not self.ridge > 0 or not 0 < self.anneal < 1:
            raise InputError(
                f"base options: sweeps {self.sweeps} (>= 1), ridge {self.ridge} (> 0), anneal {self.anneal} (between 0 and 1)"
            )


# ------------------------------------------------------------------------------------------------------ predictions


# ------------------------------------------------------------------------------------------------------------- views


@dataclass(frozen=True)
class _Block:
    """The usable pixels of one view in segment order, and the range of each segment."""

    phi: NDArray  # (n, K, 6) float64: albedo, roughness, metallic, 1
    cell: NDArray  # (n,) intp
    weight: NDArray  # (n,) float64
    segments: NDArray  # (s,)
    start: NDArray  # (s + 1,)

    def ranges(self) -> Iterator[tuple[int, slice]]:
        for i, segment in enumerate(self.segments):
            yield int(segment), slice(int(self.start[i]), int(self.start[i + 1]))


def _block(problem: BaseProblem, view: int, usable: NDArray | None = None) -> tuple[_Block, NDArray, int]:
    """A view's pixels, which predictions are usable (K,), and how many pixels had a value that is not finite."""
    maps = problem.view(view)
    cell, segment = np.ravel(problem.cell_of_pixel[view]), np.ravel(problem.segment_of_pixel[view])
    weight = np.ones(len(cell)) if problem.weight is None else np.ravel(problem.weight[view]).astype(np.float64)
    if usable is None:
        usable = np.array([not fault for fault in prediction_faults(maps)])
    finite = np.isfinite(maps[usable]).all((0, 2))
    keep = (cell >= 0) & (segment >= 0) & (weight > 0)
    lost = int((keep & ~finite).sum())
    keep = np.flatnonzero(keep & finite) if usable.any() else np.zeros(0, np.intp)
    keep = keep[np.argsort(segment[keep], kind="stable")]
    phi = np.ones((len(keep), len(maps), 6))
    phi[..., :5] = maps[:, keep].swapaxes(0, 1)
    phi[:, ~usable, :5] = 0  # weight 0, but NaN x 0 is NaN
    segments, start = np.unique(segment[keep], return_index=True)
    return _Block(phi, cell[keep], weight[keep], segments, np.r_[start, len(keep)].astype(np.intp)), usable, lost


def _inside(phi: NDArray) -> NDArray:
    """Pixels (...) whose albedo is inside (0, 1) in every channel."""
    r, g, b = phi[..., 0], phi[..., 1], phi[..., 2]  # NumPy reduces a short last axis slowly
    return (r > 0) & (r < 1) & (g > 0) & (g < 1) & (b > 0) & (b < 1)


def _in_order(work: Callable[[int], _T], n_views: int, threads: int) -> Iterator[_T]:
    """work(0), work(1), ... in this order, `threads` of them under way at a time."""
    if threads <= 1:
        yield from map(work, range(n_views))
        return
    with ThreadPoolExecutor(threads) as pool:
        for first in range(0, n_views, threads):  # in rounds, so that no more results wait than there are threads
            yield from pool.map(work, range(first, min(first + threads, n_views)))


# ------------------------------------------------------------------------------------------------------------ sums


def _transposed_product(a: NDArray, b: NDArray) -> NDArray:
    """a' b of (m, i) and (m, j), summed over pieces of rows."""
    step = _rows_per_product(a.shape[1] * b.shape[1])
    out = np.zeros((a.shape[1], b.shape[1]))
    for start in range(0, len(a), step):
        out += a[start : start + step].T @ b[start : start + step]
    return out


def _product(a: NDArray, b: NDArray) -> NDArray:
    """a b of (m, i) and (i, j), in pieces of rows."""
    step = _rows_per_product(b.size)
    out = np.empty((len(a), b.shape[1]))
    for start in range(0, len(a), step):
        np.matmul(a[start : start + step], b, out=out[start : start + step])
    return out


def _rows_per_product(work_per_row: int) -> int:
    """Rows whose product OpenBLAS computes on one thread (below 2^18 multiplications): larger ones are shared out, and
    then the rounding depends on the number of threads."""
    return max(1, (1 << 17) // work_per_row)


class _Sums:
    """Gram matrices of every (segment, prediction) and the regularised inverses, made in one pass."""

    def __init__(self, n_segments: int, k: int):
        self.weight = np.zeros(n_segments)
        self.gram = np.zeros((n_segments, k, 6, 6))  # all pixels
        self.fit = np.zeros((n_segments, k, 4, 4))  # albedo without clipped pixels
        self.usable = np.zeros((n_segments, k), bool)
        self.clipped = np.zeros((n_segments, k), bool)  # predictions that are fitted without their clipped pixels

    def add(self, segment: int, phi: NDArray, weight: NDArray, usable: NDArray, options: BaseOptions) -> None:
        if self.weight[segment] > 0:
            raise InputError(f"segment {segment} has pixels in two views; a segment is one object in one view")
        self.weight[segment] = weight.sum()
        self.usable[segment] = usable
        for k in np.flatnonzero(usable):
            one = np.ascontiguousarray(phi[:, k])
            self.gram[segment, k] = _transposed_product(one, weight[:, None] * one)
        self.fit[segment] = self.gram[segment][:, _ALBEDO][:, :, _ALBEDO]
        inside = _inside(phi).T  # (K, m)
        remain = inside.sum(1)
        enough = (remain >= options.clip_pixels) & (remain >= (1 - options.clip_share) * len(phi))
        self.clipped[segment] = usable & enough & (remain < len(phi))
        for k in np.flatnonzero(self.clipped[segment]):
            one = phi[inside[k], k][:, _ALBEDO]
            self.fit[segment, k] = _transposed_product(one, weight[inside[k], None] * one)

    def invert(self, options: BaseOptions) -> None:
        self.ridge = options.ridge * np.maximum(self.weight, options.ridge_pixels)
        ridge = self.ridge[:, None, None, None]
        self.inverse_albedo = np.linalg.inv(self.fit + ridge * np.eye(4))
        self.inverse_roughness, self.inverse_metallic = (
            np.linalg.inv(self.gram[:, :, rows][:, :, :, rows] + ridge * np.eye(2)) for rows in (_ROUGHNESS, _METALLIC)
        )


class _State:
    """What a sweep changes: corrections (S, K, 6, 5) with phi @ T = corrected values, alpha and error (S, K, 3)."""

    def __init__(self, n_segments: int, sums: _Sums):
        k = sums.usable.shape[1]
        self.affine = np.zeros((n_segments, k, 6, 5))
        self.affine[..., range(5), range(5)] = 1
        share = sums.usable / np.maximum(sums.usable.sum(1, keepdims=True), 1)
        self.alpha = np.repeat(share[:, :, None], 3, 2)
        self.error = np.zeros((n_segments, k, 3))


# ---------------------------------------------------------------------------------------------------------- solver


def solve_base(
    problem: BaseProblem,
    options: BaseOptions | None = None,
    progress: Callable[[int, int], None] | None = None,
    threads: int = 1,
) -> BaseResult:
    """Base texture of a problem by alternating closed forms; deterministic, independent of the order of predictions.

    `progress(done, total)` is called after every pass over the views. `threads` views are worked on at a time (and are
    in memory); the result does not depend on it.

    Raises:
        InputError: shapes that do not match, ids out of range, a segment in two views.
    """
    options = options or BaseOptions()
    means = options.variant in ("texel_mean", "object_mean")
    sweeps = 1 if means else options.sweeps
    n_views = len(problem.cell_of_pixel)
    total = sweeps + 2

    sums, texture, usable, dropped, counts = _first_pass(problem, options)
    _notify(progress, 1, total)
    state = _State(problem.n_segments, sums)
    history: list[dict[str, float]] = []

    for sweep in range(sweeps):
        temperature = 0.0 if sweep == sweeps - 1 else options.temperature * options.anneal**sweep
        centre = texture if options.robust and sweep else None
        cells = _CellSums(problem.n_cells)
        work = partial(_sweep_view, problem, options, sums, usable, texture, temperature, state)
        for block, mixture in _in_order(work, n_views, threads):
            cells.add(block.cell, mixture, block.weight, centre, options)
        updated = cells.mean(texture)
        if not means:
            updated = _anchored(problem, sums, updated, state, counts)
        change = float(np.sqrt(np.mean((updated - texture)[cells.seen] ** 2))) if cells.seen.any() else 0.0
        texture = updated
        history.append({"temperature": temperature, **_summary(sums, state), "change": change})
        _notify(progress, sweep + 2, total)

    texture = np.clip(texture, LOWEST, 1.0)
    if options.variant == "object_mean":
        object_value, _ = object_means(texture, problem.object_of_cell, counts.weight)
        texture = object_value.astype(np.float64)[problem.object_of_cell]
    scale = _scales(problem, options, texture, state, usable, threads)
    _notify(progress, total, total)
    value, object_value, object_cells = _filled(problem, texture, counts)
    scale[counts.weight == 0] = _unseen_scale(scale, counts.weight > 0, options)
    return BaseResult(
        value=value,
        scale=scale,
        observations=counts.observations,
        views=counts.views,
        object_value=object_value,
        object_cells=object_cells,
        weight=state.alpha.astype(np.float32),
        affine_albedo=state.affine[..., _ALBEDO, :3].swapaxes(-1, -2).astype(np.float32),
        affine_roughness=state.affine[..., _ROUGHNESS, 3].astype(np.float32),
        affine_metallic=state.affine[..., _METALLIC, 4].astype(np.float32),
        error=state.error.astype(np.float32),
        dropped=dropped,
        history=history,
    )


def _sweep_view(
    problem: BaseProblem,
    options: BaseOptions,
    sums: _Sums,
    usable: list[NDArray],
    texture: NDArray,
    temperature: float,
    state: _State,
    view: int,
) -> tuple[_Block, NDArray]:
    """T, error and alpha of a view's segments against the texture, and the mixture at its pixels.

    Writes only the rows of its own segments in `state`, so views can run side by side.
    """
    block, _, _ = _block(problem, view, usable[view])
    mixture = np.empty((len(block.cell), 5))
    for segment, rows in block.ranges():
        phi, t = block.phi[rows], texture[block.cell[rows]]
        weighted = block.weight[rows, None] * t
        cross = _transposed_product(phi.reshape(len(phi), -1), weighted).reshape(-1, 6, 5)
        if options.variant in ("full", "uniform"):
            state.affine[segment] = _fit(sums, segment, phi, cross, weighted)
        state.error[segment] = _errors(sums, segment, state.affine[segment], cross, (weighted * t).sum(0))
        if options.variant == "full":
            weights = selection_weights(state.error[segment].T, temperature, sums.usable[segment])
            state.alpha[segment] = weights.T
        mixture[rows] = _mixture(phi, state.affine[segment], state.alpha[segment])
    return replace(block, phi=_NOTHING), mixture


@dataclass
class _Counts:
    observations: NDArray
    views: NDArray
    weight: NDArray


def _first_pass(problem: BaseProblem, options: BaseOptions) -> tuple[_Sums, NDArray, list[NDArray], list[Dropped], _Counts]:
    """Gram matrices, the first texture (cell mean of the predictions' median), usable predictions, counts."""
    n_views = len(problem.cell_of_pixel)
    counts = _Counts(*(np.zeros(problem.n_cells, t) for t in (np.int32, np.int32, np.float64)))
    cells = _CellSums(problem.n_cells)
    sums, usable_of_view, dropped = None, [], []
    for view in range(n_views):
        _check_ids(problem, view)
        block, usable, lost = _block(problem, view)
        if sums is None:
            sums = _Sums(problem.n_segments, len(usable))
        if len(usable) != sums.usable.shape[1]:
            raise InputError(
                f"view {view} has {len(usable)} predictions, view 0 has {sums.usable.shape[1]}; give every view the same number"
            )
        usable_of_view.append(usable)
        if not usable.all():
            faults = prediction_faults(problem.view(view))
            dropped += [Dropped(view, i, fault) for i, fault in enumerate(faults) if fault]
        if lost and usable.any():
            dropped.append(Dropped(view, -1, f"{lost} pixels are not finite in some prediction and were left out"))
        for segment, rows in block.ranges():
            phi = block.phi[rows]
            sums.add(segment, phi, block.weight[rows], usable, options)
            if options.variant in ("texel_mean", "object_mean"):
                start = phi[:, usable, :5].mean(1)
            else:
                start = np.median(phi[:, usable, :5], 1)
            cells.add(block.cell[rows], start, block.weight[rows], None, options)
        np.add.at(counts.observations, block.cell, 1)
        counts.views[np.unique(block.cell)] += 1
    if sums is None:
        sums = _Sums(problem.n_segments, 1)
    sums.invert(options)
    counts.weight = cells.total[0]
    return sums, cells.mean(np.broadcast_to(NEUTRAL, (problem.n_cells, 5))), usable_of_view, dropped, counts


def _check_ids(problem: BaseProblem, view: int) -> None:
    for name, ids, n in (
        ("cell", problem.cell_of_pixel[view], problem.n_cells),
        ("segment", problem.segment_of_pixel[view], problem.n_segments),
    ):
        highest = int(np.max(ids, initial=-1))
        if highest >= n:
            raise InputError(f"view {view}: {name} id {highest}, but there are {n}; map and table differ")


def _fit(sums: _Sums, segment: int, phi: NDArray, cross: NDArray, weighted: NDArray) -> NDArray:
    """Corrections (K, 6, 5) of a segment: (G + lambda I)^-1 (phi' W t + lambda T_identity); `weighted` = W t."""
    ridge = sums.ridge[segment]
    out = np.zeros((phi.shape[1], 6, 5))
    albedo = cross[:, _ALBEDO, :3]
    for k in np.flatnonzero(sums.clipped[segment]):
        inside = _inside(phi[:, k])
        albedo[k] = _transposed_product(phi[inside, k][:, _ALBEDO], weighted[inside, :3])
    out[:, _ALBEDO, :3] = sums.inverse_albedo[segment] @ (albedo + ridge * np.eye(4, 3))
    for rows, inverse, channel in ((_ROUGHNESS, sums.inverse_roughness, 3), (_METALLIC, sums.inverse_metallic, 4)):
        right = cross[:, rows, channel] + ridge * np.array([1.0, 0.0])
        out[:, rows, channel] = (inverse[segment] @ right[..., None])[..., 0]
    return out


def _errors(sums: _Sums, segment: int, affine: NDArray, cross: NDArray, square: NDArray) -> NDArray:
    """(K, 3) mean squared error per property of phi T - t from sums: (T' G T - 2 T' c + t't) / weight."""
    by_channel = (affine * (sums.gram[segment] @ affine - 2 * cross)).sum(1) + square
    by_channel = np.maximum(by_channel / sums.weight[segment], 0)
    return np.stack([by_channel[:, :3].mean(1), by_channel[:, 3], by_channel[:, 4]], 1)


def _mixture(phi: NDArray, affine: NDArray, alpha: NDArray) -> NDArray:
    """(m, 5) sum_k alpha_k T_k v_k."""
    blended = affine * alpha[:, None, _PROPERTY_OF_CHANNEL]
    active = np.flatnonzero((alpha > 0).any(1))
    if 2 * len(active) <= len(alpha):  # after the last sweep all but one
        phi, blended = phi[:, active], blended[active]
    return _product(phi.reshape(len(phi), -1), blended.reshape(-1, 5))


class _CellSums:
    """Weighted sums per cell, per channel; added in pixel order, so the result is the same every time."""

    def __init__(self, n_cells: int):
        self.sum = np.zeros((5, n_cells))
        self.total = np.zeros((5, n_cells))

    def add(self, cell: NDArray, value: NDArray, weight: NDArray, centre: NDArray | None, options: BaseOptions) -> None:
        """`centre` (n_cells, 5): texture about which the M-estimate weighs; None = mean."""
        value = np.clip(value, LOWEST, 1.0)
        for c in range(5):
            w = weight
            if centre is not None:
                w = weight * laplace.kl_weight(value[:, c] - centre[cell, c], options.scale_floor, 1.0)
            np.add.at(self.sum[c], cell, w * value[:, c])
            np.add.at(self.total[c], cell, w)

    @property
    def seen(self) -> NDArray:
        return self.total[0] > 0

    def mean(self, fallback: NDArray) -> NDArray:
        """(n_cells, 5) float64; cells without weight keep the fallback."""
        mean = self.sum / np.where(self.total > 0, self.total, 1.0)
        return np.where(self.seen[:, None], mean.T, fallback)


def _anchored(problem: BaseProblem, sums: _Sums, texture: NDArray, state: _State, counts: _Counts) -> NDArray:
    """Texture (and corrections in `state`), shifted so that each object's mean is that of its usable predictions."""
    of_segment, of_cell = problem.object_of_segment, problem.object_of_cell
    n_objects = int(max(np.max(of_segment, initial=-1), np.max(of_cell, initial=-1))) + 1
    usable = np.maximum(sums.usable.sum(1), 1)
    predicted = (sums.gram[:, :, :5, 5] * sums.usable[:, :, None]).sum(1) / usable[:, None]  # (S, 5) weighted sums
    total = np.bincount(of_cell, counts.weight, n_objects)
    shift = np.zeros((n_objects, 5))
    for c in range(5):
        wanted = np.bincount(of_segment, predicted[:, c], n_objects)
        found = np.bincount(of_cell, counts.weight * texture[:, c], n_objects)
        shift[:, c] = (wanted - found) / np.where(total > 0, total, np.inf)
    state.affine[..., 5, :] += shift[of_segment][:, None, :]
    return texture + shift[of_cell]


def _summary(sums: _Sums, state: _State) -> dict[str, float]:
    """Error of each property after selection, entropy of the selection in nats, and mean gain; weighted by pixels.

    The gain (trace of A / 3 of the selected albedo corrections) is to be watched: METHOD H14.
    """
    total = max(sums.weight.sum(), 1e-30)
    mixed = (sums.weight[:, None] * (state.alpha * state.error).sum(1)).sum(0) / total
    log = np.log(np.where(state.alpha > 0, state.alpha, 1.0))
    entropy = -(sums.weight * (state.alpha * log).sum(1).mean(1)).sum() / total
    gains = (state.alpha[..., 0] * state.affine[..., range(3), range(3)].mean(-1)).sum(1)
    gain = (sums.weight * gains).sum() / total
    errors = {f"error_{name}": float(mixed[p]) for p, name in enumerate(PROPERTIES)}
    return {**errors, "entropy": float(entropy) + 0.0, "gain": float(gain)}  # + 0.0: no minus zero


def _scales(
    problem: BaseProblem, options: BaseOptions, texture: NDArray, state: _State, usable: list[NDArray], threads: int
) -> NDArray:
    """(n_cells, 5) float32: weighted mean of d + b_r e^(-d/b_r) over a cell's pixels, b_r the spread over k."""

    def one_view(view: int) -> tuple[_Block, NDArray]:
        block, use, _ = _block(problem, view, usable[view])
        part = np.empty((len(block.cell), 5))
        for segment, rows in block.ranges():
            phi = block.phi[rows]
            mixture = np.clip(_mixture(phi, state.affine[segment], state.alpha[segment]), LOWEST, 1)
            corrected = np.empty((int(use.sum()), len(phi), 5), np.float32)
            for i, k in enumerate(np.flatnonzero(use)):
                corrected[i] = np.clip(_product(phi[:, k], state.affine[segment, k]), LOWEST, 1)
            b_ref = laplace.reference_scale(mixture.astype(np.float32), corrected, options.scale_floor)
            part[rows] = laplace.scale_contribution(mixture - texture[block.cell[rows]], b_ref, options.scale_floor)
        return replace(block, phi=_NOTHING), part

    total = np.zeros(problem.n_cells)
    summed = np.zeros((5, problem.n_cells))
    for block, part in _in_order(one_view, len(problem.cell_of_pixel), threads):
        np.add.at(total, block.cell, block.weight)
        for c in range(5):
            np.add.at(summed[c], block.cell, block.weight * part[:, c])
    return laplace.floored((summed / np.where(total > 0, total, 1.0)).T, options.scale_floor).astype(np.float32)


def _unseen_scale(scale: NDArray, seen: NDArray, options: BaseOptions) -> NDArray:
    """Scale of cells nobody saw: as unsure as the least sure tenth of those seen, or 0.5 where there are none."""
    return np.quantile(scale[seen], 0.9, axis=0).astype(np.float32) if seen.any() else np.float32(0.5)


def _filled(problem: BaseProblem, texture: NDArray, counts: _Counts) -> tuple[NDArray, NDArray, NDArray]:
    object_value, object_cells = object_means(
        texture, problem.object_of_cell, counts.weight, int(np.max(problem.object_of_segment, initial=-1)) + 1
    )
    value = np.where((counts.weight > 0)[:, None], texture, object_value[problem.object_of_cell])
    return value.astype(np.float32), object_value, object_cells


def _notify(progress: Callable[[int, int], None] | None, done: int, total: int) -> None:
    if progress is not None:
        progress(done, total)
