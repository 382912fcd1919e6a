"""Direct solver: alternating closed forms on surface cells (docs/method/fusion.md#direct).

A sweep is one pass over the views, which fits the affine maps to the texture of the previous sweep (Eq. F.25), sets the
selection weights (Eqs. F.27 to F.29) and averages the mixture in each cell (Eq. F.30). Levels are fixed after every sweep
(Eq. F.40). Memory holds the predictions of one view per thread, the sums, and what `memory` allows to keep; `spill` may keep the
rest elsewhere. The bytes of the result do not depend on the number of threads; the order of the predictions changes it by
rounding only.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from iif_core.fusion import kernels
from iif_core.fusion.blocks import Block
from iif_core.fusion.fusion_pass import FusionPass, first_pass
from iif_core.fusion.gauge import Parts, anchor_shifts, seam_shifts
from iif_core.fusion.options import FusionOptions
from iif_core.fusion.outcome import build_result
from iif_core.fusion.problem import LOWEST, FusionProblem, FusionResult
from iif_core.fusion.selection import selection_weights
from iif_core.fusion.sums import NO_MASK, PROPERTY_OF_ENTRY, CellSums, SegmentState, SegmentSums, sweep_summary

_BIAS = [3, 7, 11, 13, 15]  # entries of the CROSS layout that multiply 1


def solve_direct(
    problem: FusionProblem,
    options: FusionOptions | None = None,
    progress: Callable[[int, int], None] | None = None,
    threads: int = 1,
) -> FusionResult:
    """Solve a problem by alternating closed forms; deterministic.

    Args:
        problem: predictions on cells.
        options: how to solve; None = the defaults.
        progress: called as progress(done, total) after every pass over the views.
        threads: views that are worked on (and held in memory) at a time; the result does not depend on it.

    Returns:
        The base texture with its maps, selection and uncertainty.

    Raises:
        InputError: shapes that do not match, ids out of range, a segment in two views.
    """
    options = options or FusionOptions()
    total = options.sweeps + 2  # 2: the first pass, and the one that measures the scales

    def notify(done: int) -> None:
        if progress is not None:
            progress(done, total)

    # -------- maps, selection and texture in turn (Eq. F.23 to F.30) --------
    run, texture = first_pass(problem, options, threads)
    notify(1)
    texture, history = alternate(run, texture, options.sweeps, notify)
    # -------- the seams between parts (Eq. F.41 to F.43) --------
    if options.seams and problem.neighbours is not None:
        spread = _level_spread(run.parts, run.sums)
        shift, _ = seam_shifts(run.parts, texture, run.counts.weight, problem.neighbours, spread)
        texture = _shifted(run.parts, shift, texture, run.state)
    # -------- range, errors, description --------
    texture = np.clip(texture, LOWEST, 1.0)
    result = build_result(run, texture, history)
    notify(total)
    return result


def alternate(
    run: FusionPass, first: NDArray, sweeps: int, notify: Callable[[int], None]
) -> tuple[NDArray, list[dict[str, float]]]:
    """Texture (n_cells, 5) and history after the sweeps, from the first texture on."""
    options, counts, state = run.options, run.counts, run.state
    texture = first
    history: list[dict[str, float]] = []
    for sweep in range(sweeps):
        temperature = max(options.temperature * options.anneal**sweep, options.final_temperature)
        # However few sweeps there are, the last one selects at the final temperature (Eq. F.29).
        if sweep == sweeps - 1:
            temperature = options.final_temperature
        cells = CellSums(run.problem.n_cells)
        for block, mixed in run.map_views(partial(_sweep_view, run, texture, temperature)):
            cells.add(block.cell, mixed, block.weight)
        updated = cells.mean(texture)
        # The reference is the first texture, whose level is set by the medians of the raw predictions (Eq. F.38).
        shift = anchor_shifts(run.parts, first, updated, counts.weight)
        updated = _shifted(run.parts, shift, updated, state)
        seen = counts.weight > 0
        change = float(np.sqrt(np.mean((updated - texture)[seen] ** 2, dtype=np.float64))) if seen.any() else 0.0
        texture = updated
        history.append({"temperature": temperature, **sweep_summary(run.sums, state), "change": change})
        notify(len(history) + 1)
    return texture, history


def _sweep_view(run: FusionPass, texture: NDArray, temperature: float, view: int) -> tuple[Block, NDArray]:
    """Fit maps, errors and selection of a view's segments to the texture; return the mixture (5, n) at its pixels.

    Writes only the rows of this view's segments in `run.state`, so views can run in parallel.
    """
    sums, state = run.sums, run.state
    block = run.blocks(view)
    rows = block.segments
    # -------- affine maps (Eq. F.25), float64, from products (s, K, CROSS) --------
    values, target = block.values, kernels.texture_at(texture, block.cell)
    weight = sums.fit_weight(block)
    cross = kernels.cross(values, target, weight, block.start, NO_MASK)
    albedo = cross
    if sums.masked[rows].any():
        # Where the Gram matrix leaves out clipped pixels, the products must leave out the same ones.
        inside = kernels.cross(values, target, weight, block.start, block.inside)
        albedo = np.where(sums.masked[rows][..., None], inside, cross)
    state.affine[rows] = sums.corrections(rows, cross, albedo)
    # -------- errors over all pixels, clipped ones too (Eq. F.27), and selection by them (Eq. F.28) --------
    square = kernels.square(target, weight, block.start)
    state.error[rows] = sums.errors(rows, state.affine[rows], cross, square)
    if len(rows):
        for p in range(3):
            state.alpha[rows, :, p] = selection_weights(state.error[rows, :, p], temperature, sums.usable[rows])
    alpha = state.alpha[rows]
    # -------- mixture (Eq. F.30): the weight of a property scales its map, so one pass forms the sum of alpha_k T_k v_k --------
    blend = (state.affine[rows] * alpha[..., PROPERTY_OF_ENTRY]).astype(np.float32)
    return block, kernels.mixture(values, blend, block.start, LOWEST)


def _shifted(parts: Parts, shift: NDArray, texture: NDArray, state: SegmentState) -> NDArray:
    """Texture with each part moved by its shift (parts, 5); the offsets of the maps in `state` move along (Eq. F.40)."""
    if not parts.count:
        return texture
    state.affine[..., _BIAS] += shift[parts.of_segment][:, None, :]
    # Cells without a part have the number -1, which reads the last row; the condition discards what it read.
    of_cell = np.where((parts.of_cell >= 0)[:, None], shift[parts.of_cell], 0)
    return texture + of_cell.astype(np.float32)


def _level_spread(parts: Parts, sums: SegmentSums) -> NDArray:
    """(parts, 5) standard deviation over the predictions of a segment's mean, weighted mean over the part's segments."""
    # Entries of GRAM that sum r, g, b, roughness and metallic: the weighted mean of each raw prediction, (S, K, 5).
    means = sums.gram[:, :, [6, 7, 8, 10, 12]] / np.maximum(sums.weight, 1e-30)[:, None, None]
    share = sums.usable / np.maximum(sums.usable.sum(1, keepdims=True), 1)
    centre = np.einsum("sk,skc->sc", share, means)
    spread = np.sqrt(np.einsum("sk,skc->sc", share, (means - centre[:, None]) ** 2))
    total = np.bincount(parts.of_segment, sums.weight, parts.count)
    summed = np.stack([np.bincount(parts.of_segment, sums.weight * spread[:, c], parts.count) for c in range(5)], 1)
    return summed / np.maximum(total, 1e-30)[:, None]
