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
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from iif_core.errors import InputError
from iif_core.fusion import kernels
from iif_core.fusion.blocks import Block, Blocks, in_order, shared_weight
from iif_core.fusion.gauge import Parts, anchor_shifts, covisible_parts, seam_shifts
from iif_core.fusion.options import BaseOptions
from iif_core.fusion.outcome import measure_errors, result_of
from iif_core.fusion.polish import polished, select
from iif_core.fusion.problem import LOWEST, NEUTRAL, BaseProblem, BaseResult, Dropped, object_means
from iif_core.fusion.selection import selection_weights
from iif_core.fusion.sums import IDENTITY, NO_MASK, PROPERTY_OF_ENTRY, CellSums, Counts, State, Sums, summary
from iif_core.numerics import laplace

_BIAS = [3, 7, 11, 13, 15]  # entries of the CROSS layout that multiply 1


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
    polishing = options.polish if options.objective == "distribution" and not means else 0
    total = sweeps + polishing + 2
    blocks = Blocks(problem, options.memory)

    def notify(done: int) -> None:
        if progress is not None:
            progress(done, total)

    sums, state, first, dropped, counts, parts = _first_pass(problem, blocks, options, threads)
    texture = first
    notify(1)
    history: list[dict[str, float]] = []
    for sweep in range(sweeps):
        temperature = max(options.temperature * options.anneal**sweep, options.final_temperature)
        if sweep == sweeps - 1:
            temperature = options.final_temperature
        cells = CellSums(problem.n_cells)
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
        history.append({"temperature": temperature, **summary(sums, state), "change": change})
        notify(len(history) + 1)

    if polishing:
        chosen = select(state, sums, chosen)
        texture = polished(blocks, problem, options, sums, state, chosen, texture, threads, history, notify)
    elif options.seams and not means and problem.neighbours is not None:
        shift, _ = seam_shifts(parts, texture, counts.weight, problem.neighbours, _level_spread(parts, sums))
        texture = _shifted(parts, shift, texture, state)
    texture = np.clip(texture, LOWEST, 1.0)
    if polishing:
        measure_errors(problem, blocks, sums, state, texture, threads)
    if options.variant == "object_mean":
        object_value, _ = object_means(texture, problem.object_of_cell, counts.weight)
        texture = object_value[problem.object_of_cell]
    result = result_of(problem, blocks, options, sums, parts, counts, texture, state, threads)
    notify(total)
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
    measure_errors(problem, blocks, sums, state, texture, threads)
    result = result_of(problem, blocks, options, sums, parts, counts, texture, state, threads)
    own = np.where((counts.weight > 0)[:, None], scale, result.scale).astype(np.float32)
    return replace(result, scale=own, dropped=dropped, history=history or [])


def _sweep_view(
    blocks: Blocks, options: BaseOptions, sums: Sums, texture: NDArray, temperature: float, state: State, view: int
) -> tuple[Block, NDArray]:
    """T, error and alpha of a view's segments against the texture; the mixture at its pixels.

    Writes only the rows of its own segments in `state`, so views can run side by side.
    """
    block = blocks(view)
    rows = block.segments
    values, target = block.values, kernels.texture_at(texture, block.cell)
    weight = sums.fit_weight(block)
    cross = kernels.cross(values, target, weight, block.start, NO_MASK)
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
    blend = (state.affine[rows] * alpha[..., PROPERTY_OF_ENTRY]).astype(np.float32)
    return block, kernels.mixture(values, blend, block.start, LOWEST)


def _first_pass(
    problem: BaseProblem, blocks: Blocks, options: BaseOptions, threads: int
) -> tuple[Sums, State, NDArray, list[Dropped], Counts, Parts]:
    """Gram matrices, the first texture (cell mean of the predictions' median), what was dropped, counts, parts."""
    counts = Counts(*(np.zeros(problem.n_cells, t) for t in (np.int32, np.int32, np.int32, np.float64)))
    cells, n_k = CellSums(problem.n_cells), 0
    dropped: list[Dropped] = []
    known: set[bytes] = set()
    pairs = []
    n_views = len(problem.cell_of_pixel)

    def start_of(view: int) -> tuple[Block, list[Dropped], NDArray]:
        block, left_out = blocks.first(view)
        if options.variant in ("texel_mean", "object_mean"):
            share = np.float32(block.usable / max(block.usable.sum(), 1))
            blend = np.broadcast_to(share[:, None] * np.float32(IDENTITY), (len(block.segments), len(share), kernels.CROSS))
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
    sums = Sums(problem.n_segments, max(n_k, 1), shared_weight(counts.viewpoints, options.alone))
    for block in in_order(blocks, n_views, threads):
        sums.add(block, options)
    state = State(problem.n_segments, max(n_k, 1))
    share = sums.usable / np.maximum(sums.usable.sum(1, keepdims=True), 1)
    state.alpha = np.repeat(share[:, :, None], 3, 2)
    parts = covisible_parts(problem.n_segments, problem.n_cells, pairs)
    return sums, state, cells.mean(NEUTRAL), dropped, counts, parts


def _shifted(parts: Parts, shift: NDArray, texture: NDArray, state: State) -> NDArray:
    """Texture with each part moved by its shift (parts, 5); corrections in `state` move along."""
    if not parts.count:
        return texture
    state.affine[..., _BIAS] += shift[parts.of_segment][:, None, :]
    of_cell = np.where((parts.of_cell >= 0)[:, None], shift[parts.of_cell], 0)
    return texture + of_cell.astype(np.float32)


def _level_spread(parts: Parts, sums: Sums) -> NDArray:
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
