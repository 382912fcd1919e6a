"""Direct solver: alternating closed forms on surface cells (METHOD 7c).

Each segment i (one object in one view) and prediction k has an affine correction T_ik (albedo 3x4, roughness and
metallic 1x2) and, per property, a selection weight alpha_ik. One pass over the views a sweep:

1. T: least squares of the corrected prediction against the texture of the sweep before, with a ridge to identity
   that grows with the pixel count (without it, a constant texture would be a perfect fit). Pixels count by how much
   their cell can say (blocks.shared_weight): next to nothing where only this view sees it, for there the texture is
   this view's own mixture and would hold back the agreement with the others;
2. alpha: softmax over k of minus the segment's mean squared error, at a temperature that falls from sweep to sweep
   to a last one at which only predictions nearly as good as the best count (0 = the best alone);
3. texture: weighted mean (or M-estimate) in each cell of the mixture sum_k alpha_ik T_ik v_nk;
4. gauge: an affine map of a part's texture and its inverse on all T cancel, so the level of a part would drift from
   sweep to sweep. It is moved back to that of the predictions' median (gauge.anchor_shifts; their mean was
   0.8 dB worse on Country Kitchen: bad predictions are bad upwards). Contrast is held by the
   ridge: with predictions of variance v that correlate by rho it settles at about ridge / (ridge + v (1 - rho)) of
   theirs, it cannot collapse; `history` has the mean gain. Stretching it back every sweep was tried and only
   amplified the noise of plain objects, with no gain elsewhere. At the end, seams between the parts of an object
   are closed (gauge.seam_shifts).

`objective="distribution"` then minimises the paper's own loss from there, for the selection found (matching.py).

Given T, errors follow from sums over the segment (Gram matrices, made once) and are not a pass of their own. A segment
lies in one view, so T, alpha and the mixture of a view need only the previous texture: memory is one view's predictions
a thread plus the sums, plus what `memory` allows to keep. Last, the Laplace scale of a cell in closed form
(laplace.closed_form_scale).

The same bytes whatever the number of threads; the order of the predictions matters to rounding alone.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from .. import laplace
from ..errors import InputError
from . import kernels, matching
from .blocks import Block, Blocks, in_order, shared_weight
from .gauge import Parts, anchor_shifts, covisible_parts, seam_shifts
from .problem import LOWEST, NEUTRAL, PROPERTIES, BaseProblem, BaseResult, Dropped, object_means
from .selection import effective_number, margin, selection_weights
from .uncertainty import location_uncertainty

VARIANTS = ("full", "uniform", "texel_mean", "object_mean")
OBJECTIVES = ("least_squares", "distribution")

_PROPERTY_OF_ENTRY = np.repeat([0, 1, 2], [12, 2, 2])  # of the CROSS layout
_GRAM_4 = np.array([[0, 1, 2, 6], [1, 3, 4, 7], [2, 4, 5, 8], [6, 7, 8, 13]])  # where a 4x4 entry is in the GRAM layout
_GRAM_R = np.array([[9, 10], [10, 13]])
_GRAM_M = np.array([[11, 12], [12, 13]])
_IDENTITY = kernels.IDENTITY.astype(np.float64)
_BIAS = [3, 7, 11, 13, 15]  # entries of the CROSS layout that multiply 1
_NO_MASK = np.zeros((0, 0), bool)


@dataclass(frozen=True)
class BaseOptions:
    """How to solve.

    Attributes:
        variant: `full`; `uniform` = corrections, but all predictions alike (no selection); `texel_mean` = mean of all
            predictions a cell; `object_mean` = mean of all predictions an object.
        sweeps: alternations.
        temperature, anneal, final_temperature: selection temperature of the first sweep, in units of the segment's
            median error, its factor per sweep, and where it stops. At the default 0.1 a prediction whose error exceeds
            the best by a tenth of the median has 1/e of its weight: averaging near-ties is worth 0.7-1.4 dB over
            the single best one (0).
        ridge: pull of T to identity, times the segment's weight in the fit; more for segments below `ridge_pixels` pixels.
        robust: cells take the M-estimate of the Laplace divergence instead of the mean.
        clip_share, clip_pixels: predicted albedo at exactly 0 or 1 is left out of the fit of T where at most this
            share of the segment is, and at least so many pixels remain.
        scale_floor: smallest Laplace scale.
        objective: `least_squares`, or `distribution`: afterwards `polish` sweeps on the paper's loss, hard selection.
        alone: weight in the fit of T of cells that one viewpoint sees (1 - 1/n + this for n viewpoints); must not be 0.
        seams: close seams between parts of an object (needs `BaseProblem.neighbours`).
        memory: bytes of predictions that may stay in memory between sweeps; the others are read again.
    """

    variant: str = "full"
    sweeps: int = 9
    temperature: float = 1.0
    anneal: float = 0.6
    ridge: float = 0.01
    ridge_pixels: float = 30.0
    robust: bool = False
    clip_share: float = 0.5
    clip_pixels: int = 50
    scale_floor: float = laplace.SCALE_FLOOR
    memory: int = 1 << 30
    final_temperature: float = 0.1
    objective: str = "least_squares"
    polish: int = 20
    seams: bool = True
    alone: float = 0.01

    def __post_init__(self) -> None:
        if self.variant not in VARIANTS:
            raise InputError(f"base variant {self.variant!r}; allowed: {', '.join(VARIANTS)}")
        if self.objective not in OBJECTIVES:
            raise InputError(f"base objective {self.objective!r}; allowed: {', '.join(OBJECTIVES)}")
        if self.final_temperature < 0 or self.temperature < self.final_temperature or self.polish < 1:
            raise InputError(
                f"base options: temperature {self.temperature} must not be below final_temperature {self.final_temperature}"
                f" (>= 0), polish {self.polish} must be >= 1"
            )
        if self.sweeps < 1 or not self.ridge > 0 or not 0 < self.anneal < 1 or not self.alone > 0:
            raise InputError(
                f"base options: sweeps {self.sweeps} (>= 1), ridge {self.ridge} (> 0), anneal {self.anneal} (between 0 and 1),"
                f" alone {self.alone} (> 0)"
            )


class _State:
    """What a sweep changes, by segment and prediction: corrections (S, K, CROSS), alpha and error (S, K, 3)."""

    def __init__(self, n_segments: int, k: int):
        self.affine = np.tile(_IDENTITY, (n_segments, k, 1))
        self.alpha = np.zeros((n_segments, k, 3))
        self.error = np.zeros((n_segments, k, 3))


class _Sums:
    """What does not change: Gram matrices of every (segment, prediction) and the regularised inverses."""

    def __init__(self, n_segments: int, k: int, fit_of_cell: NDArray):
        self.fit_of_cell = fit_of_cell
        self.weight = np.zeros(n_segments)
        self.gram = np.zeros((n_segments, k, kernels.GRAM))
        self.usable = np.zeros((n_segments, k), bool)
        self.masked = np.zeros((n_segments, k), bool)  # fitted without its clipped pixels
        self.ridge = np.zeros(n_segments)
        self.inverse = (np.zeros((n_segments, k, 4, 4)), np.zeros((n_segments, k, 2, 2)), np.zeros((n_segments, k, 2, 2)))

    def fit_weight(self, block: Block) -> NDArray:
        """(n,) float32 weight of the pixels of a view in the fit of the corrections."""
        return block.weight * self.fit_of_cell[block.cell]

    def add(self, block: Block, options: BaseOptions) -> None:
        """Sums of the segments of one view."""
        rows = block.segments
        if not len(rows):
            return
        if (self.weight[rows] > 0).any():
            segment = rows[np.argmax(self.weight[rows] > 0)]
            raise InputError(f"segment {segment} has pixels in two views; a segment is one object in one view")
        weight = self.fit_weight(block)
        gram = kernels.gram(block.values, weight, block.start, _NO_MASK)
        self.gram[rows], self.weight[rows], self.usable[rows] = gram, gram[:, 0, 13], block.usable
        fit = gram
        if block.inside.size:
            count = np.diff(block.start)
            remain = np.add.reduceat(block.inside, block.start[:-1], axis=1, dtype=np.int64).T
            enough = (remain >= options.clip_pixels) & (remain >= (1 - options.clip_share) * count[:, None])
            self.masked[rows] = block.usable & enough & (remain < count[:, None])
            fit = np.where(self.masked[rows][..., None], kernels.gram(block.values, weight, block.start, block.inside), gram)
        few = np.maximum(1, options.ridge_pixels / np.diff(block.start))  # small segments are held more
        self.ridge[rows] = options.ridge * self.weight[rows] * few
        for out, where, source in zip(self.inverse, (_GRAM_4, _GRAM_R, _GRAM_M), (fit, gram, gram), strict=True):
            out[rows] = np.linalg.inv(source[..., where] + self.ridge[rows, None, None, None] * np.eye(len(where)))

    def corrections(self, rows: NDArray, cross: NDArray, cross_albedo: NDArray) -> NDArray:
        """(s, K, CROSS) ridge regression of the predictions on the texture: (G + lambda I)^-1 (phi'W t + lambda T_id)."""
        ridge = self.ridge[rows, None, None]
        out = np.empty(cross.shape)
        right = cross_albedo[..., :12] + ridge * _IDENTITY[:12]
        out[..., :12] = (right.reshape(*right.shape[:2], 3, 4) @ self.inverse[0][rows]).reshape(*right.shape)
        for part, inverse in ((slice(12, 14), self.inverse[1]), (slice(14, 16), self.inverse[2])):
            right = cross[..., part] + ridge * _IDENTITY[part]
            out[..., part] = (right[..., None, :] @ inverse[rows])[..., 0, :]
        return out

    def errors(self, rows: NDArray, affine: NDArray, cross: NDArray, square: NDArray) -> NDArray:
        """(s, K, 3) mean squared error per property of phi T - t from sums: (T G T' - 2 T c + t't) / weight."""
        gram, weight = self.gram[rows], self.weight[rows, None]
        out = np.zeros((*affine.shape[:2], 3))
        for p, part, where in ((0, slice(0, 12), _GRAM_4), (1, slice(12, 14), _GRAM_R), (2, slice(14, 16), _GRAM_M)):
            channels = 3 if p == 0 else 1
            t = affine[..., part].reshape(*affine.shape[:2], channels, len(where))
            c = cross[..., part].reshape(t.shape)
            total = (t @ gram[..., where] * t).sum((-1, -2)) - 2 * (t * c).sum((-1, -2))
            total += square[:, :3].sum(1)[:, None] if p == 0 else square[:, p + 2][:, None]
            out[..., p] = np.maximum(total / (channels * weight), 0)
        return out


class _CellSums:
    """Weighted sums per cell, per channel; added in pixel order, so the result is the same every time."""

    def __init__(self, n_cells: int):
        self.sum = np.zeros((n_cells, 5))
        self.total = np.zeros((n_cells, 5))

    def add(self, cell: NDArray, value: NDArray, weight: NDArray) -> None:
        """`value` (5, n); `weight` (n,), or (5, n) by channel."""
        kernels.add_to_cells(self.total, self.sum, cell, value, np.atleast_2d(weight))

    def mean(self, fallback: NDArray) -> NDArray:
        """(n_cells, 5) float32; cells without weight keep the fallback."""
        return kernels.cell_means(self.total, self.sum, np.broadcast_to(fallback, self.sum.shape))


# ---------------------------------------------------------------------------------------------------------- solver


def solve_base(
    problem: BaseProblem,
    options: BaseOptions | None = None,
    progress: Callable[[int, int], None] | None = None,
    threads: int = 1,
    chosen: NDArray | None = None,
) -> BaseResult:
    """Base texture of a problem by alternating closed forms; deterministic.

    `chosen` (S, 3) int: with `objective="distribution"`, the prediction of each segment and property to use instead of
    those that the solver would select (twins are compared at one selection).

    `progress(done, total)` is called after every pass over the views. `threads` views are worked on at a time (and are
    in memory); the result does not depend on it.

    Raises:
        InputError: shapes that do not match, ids out of range, a segment in two views.
    """
    options = options or BaseOptions()
    if chosen is not None and options.objective != "distribution":
        raise InputError("a given selection needs objective `distribution`; least squares selects for itself")
    means = options.variant in ("texel_mean", "object_mean")
    sweeps = 1 if means or chosen is not None else options.sweeps
    n_views = len(problem.cell_of_pixel)
    polish = options.polish if options.objective == "distribution" and not means else 0
    total = sweeps + polish + 2
    blocks = Blocks(problem, options.memory)

    sums, state, first, dropped, counts, parts = _first_pass(problem, blocks, options, threads)
    texture = first
    _notify(progress, 1, total)
    history: list[dict[str, float]] = []
    for sweep in range(sweeps):
        temperature = max(options.temperature * options.anneal**sweep, options.final_temperature)
        if sweep == sweeps - 1:
            temperature = options.final_temperature
        cells = _CellSums(problem.n_cells)
        work = partial(_sweep_view, blocks, options, sums, texture, temperature, state)
        for block, mixed in in_order(work, n_views, threads):
            cells.add(block.cell, mixed, _robust_weight(block, mixed, texture, options) if sweep else block.weight)
        updated = cells.mean(texture)
        if not means:
            shift = anchor_shifts(parts, first, updated, counts.weight)
            updated = _shifted(parts, shift, updated, state)
        seen = counts.weight > 0
        change = float(np.sqrt(np.mean((updated - texture)[seen] ** 2, dtype=np.float64))) if seen.any() else 0.0
        texture = updated
        history.append({"temperature": temperature, **_summary(sums, state), "change": change})
        _notify(progress, sweep + 2, total)

    if polish:
        chosen = _select(state, sums, chosen)
        texture = _polish(blocks, problem, options, sums, state, chosen, texture, threads, history, progress, total)
    elif options.seams and not means and problem.neighbours is not None:
        shift, _ = seam_shifts(parts, texture, counts.weight, problem.neighbours, _level_spread(parts, sums))
        texture = _shifted(parts, shift, texture, state)
    texture = np.clip(texture, LOWEST, 1.0)
    if polish:
        _measure_errors(problem, blocks, sums, state, texture, threads)
    if options.variant == "object_mean":
        object_value, _ = object_means(texture, problem.object_of_cell, counts.weight)
        texture = object_value[problem.object_of_cell]
    result = _outcome(problem, blocks, options, sums, parts, counts, texture, state, threads)
    _notify(progress, total, total)
    return replace(result, dropped=dropped, history=history)


def describe_fit(
    problem: BaseProblem,
    value: NDArray,
    scale: NDArray,
    affine: NDArray,
    weight: NDArray,
    history: list[dict[str, float]] | None = None,
    threads: int = 1,
    memory: int = 1 << 30,
) -> BaseResult:
    """The result of another solver described like that of `solve_base`, so that both can be compared.

    Args:
        value, scale: (n_cells, 5) texture and its Laplace scale; affine: (S, K, CROSS) corrections; weight: (S, K, 3).

    Errors, votes, counts and fills are measured on the problem; `scale` is kept as the solver found it.
    """
    options = BaseOptions(memory=memory)
    blocks = Blocks(problem, memory)
    sums, state, _, dropped, counts, parts = _first_pass(problem, blocks, replace(options, variant="texel_mean"), threads)
    state.affine, state.alpha = affine.astype(np.float64), weight.astype(np.float64)
    texture = np.clip(value, LOWEST, 1.0).astype(np.float32)
    _measure_errors(problem, blocks, sums, state, texture, threads)
    result = _outcome(problem, blocks, options, sums, parts, counts, texture, state, threads)
    own = np.where((counts.weight > 0)[:, None], scale, result.scale).astype(np.float32)
    return replace(result, scale=own, dropped=dropped, history=history or [])


def _measure_errors(problem: BaseProblem, blocks: Blocks, sums: _Sums, state: _State, texture: NDArray, threads: int) -> None:
    """Mean squared error of every corrected prediction against the texture, into `state`."""
    for block in in_order(blocks, len(problem.cell_of_pixel), threads):
        rows, target = block.segments, kernels.texture_at(texture, block.cell)
        weight = sums.fit_weight(block)
        cross = kernels.cross(block.values, target, weight, block.start, _NO_MASK)
        square = kernels.square(target, weight, block.start)
        state.error[rows] = sums.errors(rows, state.affine[rows], cross, square)


def _outcome(
    problem: BaseProblem,
    blocks: Blocks,
    options: BaseOptions,
    sums: _Sums,
    parts: Parts,
    counts: _Counts,
    texture: NDArray,
    state: _State,
    threads: int,
) -> BaseResult:
    scale, votes = _scales(blocks, problem, options, texture, state, threads)
    value, object_value, object_cells = _filled(problem, texture, counts)
    seen = counts.weight > 0
    repeats = np.maximum(counts.views, 1) / np.maximum(counts.viewpoints, 1)  # of the same photograph
    uncertainty = location_uncertainty(scale, counts.viewpoints, counts.observations / repeats, state.alpha.shape[1])
    for array in (scale, uncertainty):
        array[~seen] = _unseen_scale(array, seen)
    n, k = state.alpha.shape[:2]
    probability = votes / np.maximum(votes.sum(1, keepdims=True), 1e-30)
    by_property = state.error.swapaxes(1, 2), np.repeat(sums.usable[:, None], 3, 1)  # (S, 3, K)
    return BaseResult(
        value=value,
        scale=scale,
        uncertainty=uncertainty,
        coverage=counts.weight.astype(np.float32),
        part_of_cell=parts.of_cell,
        observations=counts.observations,
        views=counts.views,
        object_value=object_value,
        object_cells=object_cells,
        weight=state.alpha.astype(np.float32),
        affine_albedo=state.affine[..., :12].reshape(n, k, 3, 4).astype(np.float32),
        affine_roughness=state.affine[..., 12:14].astype(np.float32),
        affine_metallic=state.affine[..., 14:16].astype(np.float32),
        error=state.error.astype(np.float32),
        probability=probability.astype(np.float32),
        margin=margin(*by_property).astype(np.float32),
        effective=effective_number(probability.swapaxes(1, 2)).astype(np.float32),
        dropped=[],
        history=[],
    )


def _sweep_view(
    blocks: Blocks, options: BaseOptions, sums: _Sums, texture: NDArray, temperature: float, state: _State, view: int
) -> tuple[Block, NDArray]:
    """T, error and alpha of a view's segments against the texture; the mixture at its pixels.

    Writes only the rows of its own segments in `state`, so views can run side by side.
    """
    block = blocks(view)
    rows = block.segments
    values, target = block.values, kernels.texture_at(texture, block.cell)
    weight = sums.fit_weight(block)
    cross = kernels.cross(values, target, weight, block.start, _NO_MASK)
    if options.variant in ("full", "uniform"):
        albedo = cross
        if sums.masked[rows].any():
            inside = kernels.cross(values, target, weight, block.start, block.inside)
            albedo = np.where(sums.masked[rows][..., None], inside, cross)
        state.affine[rows] = sums.corrections(rows, cross, albedo)
    square = kernels.square(target, weight, block.start)
    state.error[rows] = sums.errors(rows, state.affine[rows], cross, square)
    if options.variant == "full" and len(rows):
        for p in range(3):
            state.alpha[rows, :, p] = selection_weights(state.error[rows, :, p], temperature, sums.usable[rows])
    alpha = state.alpha[rows]
    blend = (state.affine[rows] * alpha[..., _PROPERTY_OF_ENTRY]).astype(np.float32)
    return block, kernels.mixture(values, blend, block.start, LOWEST)


@dataclass
class _Counts:
    """Per cell: pixels, views, different viewpoints, weight of the pixels."""

    observations: NDArray
    views: NDArray
    viewpoints: NDArray
    weight: NDArray


def _first_pass(
    problem: BaseProblem, blocks: Blocks, options: BaseOptions, threads: int
) -> tuple[_Sums, _State, NDArray, list[Dropped], _Counts, Parts]:
    """Gram matrices, the first texture (cell mean of the predictions' median), what was dropped, counts, parts."""
    counts = _Counts(*(np.zeros(problem.n_cells, t) for t in (np.int32, np.int32, np.int32, np.float64)))
    cells, n_k = _CellSums(problem.n_cells), 0
    dropped: list[Dropped] = []
    known: set[bytes] = set()
    pairs = []
    n_views = len(problem.cell_of_pixel)

    def start_of(view: int) -> tuple[Block, list[Dropped], NDArray]:
        block, left_out = blocks.first(view)
        if options.variant in ("texel_mean", "object_mean"):
            share = np.float32(block.usable / max(block.usable.sum(), 1))
            blend = np.broadcast_to(share[:, None] * np.float32(_IDENTITY), (len(block.segments), len(share), kernels.CROSS))
            start = kernels.mixture(block.values, np.ascontiguousarray(blend), block.start, LOWEST)
        else:
            start = kernels.medians(block.values, block.usable, kernels.sorting_network(int(block.usable.sum())))
        return block, left_out, start

    for view, (block, left_out, start) in enumerate(in_order(start_of, n_views, threads)):
        n_k = n_k or len(block.usable)
        if len(block.usable) != n_k:
            raise InputError(
                f"view {view} has {len(block.usable)} predictions, view 0 has {n_k}; give every view the same number"
            )
        blocks.keep(view, block)
        dropped += left_out
        cells.add(block.cell, start, block.weight)
        counts.observations += np.bincount(block.cell, minlength=problem.n_cells).astype(np.int32)
        seen = np.unique(block.cell)
        counts.views[seen] += 1
        digest = hashlib.sha256(block.cell.tobytes()).digest()
        if digest not in known:  # the same photograph twice is one viewpoint
            known.add(digest)
            counts.viewpoints[seen] += 1
        pairs.append((np.repeat(block.segments, np.diff(block.start)), block.cell))
    counts.weight = cells.total[:, 0]
    sums = _Sums(problem.n_segments, max(n_k, 1), shared_weight(counts.viewpoints, options.alone))
    for block in in_order(blocks, n_views, threads):
        sums.add(block, options)
    state = _State(problem.n_segments, max(n_k, 1))
    share = sums.usable / np.maximum(sums.usable.sum(1, keepdims=True), 1)
    state.alpha = np.repeat(share[:, :, None], 3, 2)
    parts = covisible_parts(problem.n_segments, problem.n_cells, pairs)
    return sums, state, cells.mean(NEUTRAL), dropped, counts, parts


def _shifted(parts: Parts, shift: NDArray, texture: NDArray, state: _State) -> NDArray:
    """Texture with each part moved by its shift (parts, 5); corrections in `state` move along."""
    if not parts.count:
        return texture
    state.affine[..., _BIAS] += shift[parts.of_segment][:, None, :]
    of_cell = np.where((parts.of_cell >= 0)[:, None], shift[parts.of_cell], 0)
    return texture + of_cell.astype(np.float32)


def _level_spread(parts: Parts, sums: _Sums) -> NDArray:
    """(parts, 5) standard deviation over the predictions of a segment's mean, pixel-weighted mean over the part's segments."""
    means = sums.gram[:, :, [6, 7, 8, 10, 12]] / np.maximum(sums.weight, 1e-30)[:, None, None]
    share = sums.usable / np.maximum(sums.usable.sum(1, keepdims=True), 1)
    centre = np.einsum("sk,skc->sc", share, means)
    spread = np.sqrt(np.einsum("sk,skc->sc", share, (means - centre[:, None]) ** 2))
    total = np.bincount(parts.of_segment, sums.weight, parts.count)
    summed = np.stack([np.bincount(parts.of_segment, sums.weight * spread[:, c], parts.count) for c in range(5)], 1)
    return summed / np.maximum(total, 1e-30)[:, None]


def _robust_weight(block: Block, mixed: NDArray, texture: NDArray, options: BaseOptions) -> NDArray:
    """Weight of the pixels in their cells: as given, or (5, n) of the M-estimate about the texture."""
    if not options.robust:
        return block.weight
    distance = mixed - kernels.texture_at(texture, block.cell)
    return block.weight * laplace.kl_weight(distance, options.scale_floor, 1.0).astype(np.float32)


def _summary(sums: _Sums, state: _State) -> dict[str, float]:
    """Error of each property after selection, entropy of the selection in nats, and mean gain; weighted by pixels.

    The gain (trace of A / 3 of the selected albedo corrections) is to be watched: METHOD H14.
    """
    total = max(sums.weight.sum(), 1e-30)
    mixed = (sums.weight[:, None] * (state.alpha * state.error).sum(1)).sum(0) / total
    log = np.log(np.where(state.alpha > 0, state.alpha, 1.0))
    entropy = -(sums.weight * (state.alpha * log).sum(1).mean(1)).sum() / total
    gains = (state.alpha[..., 0] * state.affine[..., [0, 5, 10]].mean(-1)).sum(1)
    gain = (sums.weight * gains).sum() / total
    errors = {f"error_{name}": float(mixed[p]) for p, name in enumerate(PROPERTIES)}
    return {**errors, "entropy": float(entropy) + 0.0, "gain": float(gain)}  # + 0.0: no minus zero


def _scales(
    blocks: Blocks, problem: BaseProblem, options: BaseOptions, texture: NDArray, state: _State, threads: int
) -> tuple[NDArray, NDArray]:
    """(n_cells, 5) float32: weighted mean of d + b_r e^(-d/b_r) over a cell's pixels; and the votes (S, K, 3)."""
    votes = np.zeros(state.alpha.shape)

    def one_view(view: int) -> tuple[Block, NDArray, NDArray]:
        block = blocks(view)
        rows = block.segments
        values, target = block.values, kernels.texture_at(texture, block.cell)
        blend = (state.affine[rows] * state.alpha[rows][..., _PROPERTY_OF_ENTRY]).astype(np.float32)
        mixed = kernels.mixture(values, blend, block.start, LOWEST)
        affine = state.affine[rows].astype(np.float32)
        network = kernels.sorting_network(int(block.usable.sum()))
        b_ref, votes_of = kernels.disagreement(
            values, affine, mixed, target, block.weight, block.start, block.usable, network, LOWEST, options.scale_floor
        )
        return block, laplace.scale_contribution(mixed - target, b_ref, options.scale_floor), votes_of

    cells = _CellSums(problem.n_cells)
    for block, part, votes_of in in_order(one_view, len(problem.cell_of_pixel), threads):
        votes[block.segments] = votes_of
        cells.add(block.cell, part, block.weight)
    return laplace.floored(cells.mean(np.zeros(5)), np.float32(options.scale_floor)), votes


def _select(state: _State, sums: _Sums, chosen: NDArray | None) -> NDArray:
    """Chosen prediction (S, 3) int64, by default that of the largest weight; alpha becomes one-hot there."""
    shape = (len(state.alpha), 3)
    if chosen is not None and (
        np.shape(chosen) != shape or np.min(chosen, initial=0) < 0 or np.max(chosen, initial=0) >= state.alpha.shape[1]
    ):
        raise InputError(f"chosen predictions: {np.shape(chosen)}; needed is {shape} with numbers below {state.alpha.shape[1]}")
    chosen = state.alpha.argmax(1) if chosen is None else np.asarray(chosen, np.int64)
    one_hot = (np.arange(state.alpha.shape[1])[None, :, None] == chosen[:, None]) & sums.usable[:, :, None]
    state.alpha = one_hot.astype(np.float64)
    return chosen


def _polish(
    blocks: Blocks,
    problem: BaseProblem,
    options: BaseOptions,
    sums: _Sums,
    state: _State,
    chosen: NDArray,
    texture: NDArray,
    threads: int,
    history: list[dict[str, float]],
    progress: Callable[[int, int], None] | None,
    total: int,
) -> NDArray:
    """Texture (n_cells, 5) after `options.polish` sweeps of majorisation on the paper's loss."""
    n_views = len(problem.cell_of_pixel)
    floor = options.scale_floor
    pixels = np.zeros(problem.n_segments)
    state.affine[:] = _IDENTITY  # its optimum lies near the identity, far from that of the least squares
    cells = _CellSums(problem.n_cells)
    for block in in_order(blocks, n_views, threads):
        pixels[block.segments] = np.add.reduceat(block.weight, block.start[:-1], dtype=np.float64) if len(block.cell) else 0
        planes = kernels.choose(block.values, chosen[block.segments], block.start)
        cells.add(block.cell, np.maximum(planes, LOWEST[:, None]), block.weight)
    texture, total_weight = cells.mean(texture), max(pixels.sum(), 1e-30)
    scale, _ = _scales(blocks, problem, options, texture, state, threads)

    def one_view(view: int) -> tuple[Block, NDArray, NDArray, NDArray, float]:
        block = blocks(view)
        rows = block.segments
        planes = kernels.choose(block.values, chosen[rows], block.start)
        target, b = kernels.texture_at(texture, block.cell), kernels.texture_at(scale, block.cell)
        mixed, b_ref = _against(block, state, rows, target, options)
        weight = block.weight * laplace.kl_weight(mixed - target, b_ref, b, floor).astype(np.float32) / 5
        second, first = kernels.channel_moments(planes, target, weight, block.start)
        strength = matching.REGULARISER * pixels[rows] / np.maximum(sums.usable[rows].sum(1), 1)
        state.affine[rows] = _penalised(state.affine[rows], chosen[rows], second, first, strength)
        mixed, b_ref = _against(block, state, rows, target, options)
        loss = (block.weight * laplace.kl(mixed - target, b_ref, b, floor)).sum(dtype=np.float64) / 5
        weight = block.weight * laplace.kl_weight(mixed - target, b_ref, b, floor).astype(np.float32)
        part = laplace.scale_contribution(mixed - target, b_ref, floor)
        return block, mixed, weight, part, float(loss)

    for sweep in range(options.polish):
        cells, scales, data = _CellSums(problem.n_cells), _CellSums(problem.n_cells), 0.0
        for block, mixed, weight, part, loss in in_order(one_view, n_views, threads):
            cells.add(block.cell, mixed, weight)
            scales.add(block.cell, part, block.weight)
            data += loss
        updated = cells.mean(texture)
        change = float(np.sqrt(np.mean((updated - texture) ** 2, dtype=np.float64)))
        texture = updated
        scale = laplace.floored(scales.mean(scale), np.float32(floor))
        penalty = matching.identity_penalty(state.affine[..., :12].reshape(*state.affine.shape[:2], 3, 4))
        penalty = penalty + ((state.affine[..., 12:] - _IDENTITY[12:]) ** 2).sum(-1)
        mean_penalty = (penalty * sums.usable).sum(1) / np.maximum(sums.usable.sum(1), 1)
        terms = {"data": data / total_weight, "regulariser": matching.REGULARISER * (pixels @ mean_penalty) / total_weight}
        history.append({"temperature": 0.0, **_summary(sums, state), "change": change, **terms})
        _notify(progress, total - options.polish + sweep, total)
    return texture


def _against(block: Block, state: _State, rows: NDArray, target: NDArray, options: BaseOptions) -> tuple[NDArray, NDArray]:
    """Mixture and reference scale (5, n) of a view under the present corrections."""
    affine = state.affine[rows].astype(np.float32)
    blend = (state.affine[rows] * state.alpha[rows][..., _PROPERTY_OF_ENTRY]).astype(np.float32)
    mixed = kernels.mixture(block.values, blend, block.start, LOWEST)
    network = kernels.sorting_network(int(block.usable.sum()))
    b_ref, _ = kernels.disagreement(
        block.values, affine, mixed, target, block.weight, block.start, block.usable, network, LOWEST, options.scale_floor
    )
    return mixed, b_ref


def _penalised(affine: NDArray, chosen: NDArray, second: NDArray, first: NDArray, strength: NDArray) -> NDArray:
    """Corrections (s, K, CROSS) with those of the chosen predictions renewed."""
    out, each = affine.copy(), np.arange(len(affine))
    if not len(affine):
        return out
    where = np.array([[0, 1, 2, 6], [1, 3, 4, 7], [2, 4, 5, 8], [6, 7, 8, 9]])
    start = out[each, chosen[:, 0], :12].reshape(-1, 3, 4)
    albedo = matching.penalised_affine(second[:, :3][..., where], first[:, :3], start, strength)
    out[each, chosen[:, 0], :12] = albedo.reshape(-1, 12)
    pair = np.array([[0, 1], [1, 2]])
    for p, part in ((1, slice(12, 14)), (2, slice(14, 16))):
        out[each, chosen[:, p], part] = matching.penalised_gain(second[:, p + 2][..., pair], first[:, p + 2, :2], strength)
    return out


def _unseen_scale(scale: NDArray, seen: NDArray) -> NDArray:
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
