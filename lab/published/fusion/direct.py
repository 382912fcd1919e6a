"""The direct solver of the product on the paper's own loss, and what other solvers found in the form of its result."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from iif_core.fusion import kernels
from iif_core.fusion.direct import alternate
from iif_core.fusion.fusion_pass import FusionPass, first_pass
from iif_core.fusion.options import FusionOptions
from iif_core.fusion.outcome import build_result
from iif_core.fusion.problem import LOWEST, FusionProblem, FusionResult
from iif_core.fusion.sums import NO_MASK
from lab.published.fusion.polish import fix_selection, minimise_distribution_loss

POLISH = 25
"""Sweeps on the paper's loss."""


def measure_errors(run: FusionPass, texture: NDArray) -> None:
    """Write the mean squared error of every corrected prediction against the texture (n_cells, 5) to the state."""
    for block in run.map_views(run.blocks):
        rows, target = block.segments, kernels.texture_at(texture, block.cell)
        weight = run.sums.fit_weight(block)
        # No mask: errors count all pixels, also those that the fit of the albedo map leaves out.
        cross = kernels.cross(block.values, target, weight, block.start, NO_MASK)
        square = kernels.square(target, weight, block.start)
        run.state.error[rows] = run.sums.errors(rows, run.state.affine[rows], cross, square)


def solve_distribution(
    problem: FusionProblem,
    options: FusionOptions | None = None,
    progress: Callable[[int, int], None] | None = None,
    threads: int = 1,
    polish: int = POLISH,
    chosen: NDArray | None = None,
) -> FusionResult:
    """Minimise the paper's loss for the selection that the least squares make, or for a given one.

    Args:
        problem, options, progress, threads: as of `iif_core.fusion.direct.solve_direct`.
        polish: sweeps on the paper's loss.
        chosen: (S, 3) int prediction of each segment and property to use in place of the solver's own selection, for comparing
            solvers at one selection.

    Returns:
        The base texture with its maps, selection and uncertainty.

    Raises:
        InputError: as `solve_direct`.
    """
    options = options or FusionOptions()
    # With a given selection maps and texture start again, so further sweeps of least squares would be lost.
    sweeps = 1 if chosen is not None else options.sweeps

    def notify(done: int) -> None:
        if progress is not None:
            progress(done, sweeps + polish + 2)

    run, texture = first_pass(problem, options, threads)
    notify(1)
    texture, history = alternate(run, texture, sweeps, notify)
    chosen = fix_selection(run.state, run.sums, chosen)
    texture = minimise_distribution_loss(run, chosen, polish, texture, history, notify)
    texture = np.clip(texture, LOWEST, 1.0)
    measure_errors(run, texture)  # the state still has the errors of the maps of the least squares
    result = build_result(run, texture, history)
    notify(sweeps + polish + 2)
    return result


def describe_fit(
    problem: FusionProblem,
    value: NDArray,
    scale: NDArray,
    affine: NDArray,
    weight: NDArray,
    history: list[dict[str, float]] | None = None,
    threads: int = 1,
    memory: int = 1 << 30,
) -> FusionResult:
    """Describe what another solver found in the way that `solve_direct` describes its own result.

    Args:
        problem: predictions on cells.
        value, scale: (n_cells, 5) texture and its Laplace scale, which is kept as the solver found it.
        affine: (S, K, CROSS) affine maps; weight: (S, K, 3) selection weights.
        history: entries for the result.
        threads: views at a time; memory: bytes of predictions that stay in memory.

    Returns:
        The result, with errors, votes, counts and fills measured on the problem.

    Raises:
        InputError: shapes that do not match, ids out of range, a segment in two views.
    """
    run, _ = first_pass(problem, FusionOptions(memory=memory), threads)
    run.state.affine, run.state.alpha = affine.astype(np.float64), weight.astype(np.float64)
    texture = np.clip(value, LOWEST, 1.0).astype(np.float32)
    measure_errors(run, texture)
    result = build_result(run, texture, history or [])
    # Cells without weight have no scale of the solver; they keep the fill of `build_result`.
    own = np.where((run.counts.weight > 0)[:, None], scale, result.scale).astype(np.float32)
    return replace(result, scale=own)
