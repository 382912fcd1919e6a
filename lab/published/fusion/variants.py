"""Parts of the method left out of the fusion: the selection, or maps and selection (lab/docs/published.md#fusion-variants)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from iif_core.fusion import kernels
from iif_core.fusion.blocks import Block
from iif_core.fusion.direct import solve_direct
from iif_core.fusion.fusion_pass import FusionPass, first_pass
from iif_core.fusion.options import FusionOptions
from iif_core.fusion.outcome import build_result
from iif_core.fusion.problem import LOWEST, NEUTRAL, FusionProblem, FusionResult, object_means
from iif_core.fusion.sums import PROPERTY_OF_ENTRY, CellSums, sweep_summary
from lab.published.fusion.direct import measure_errors

MEANS = ("texel_mean", "object_mean")
EVEN = 1e30
"""Selection temperature at which all usable predictions weigh alike."""


def solve_variant(
    problem: FusionProblem,
    variant: str,
    options: FusionOptions | None = None,
    progress: Callable[[int, int], None] | None = None,
    threads: int = 1,
) -> FusionResult:
    """Solve a problem by a part of the method.

    Args:
        problem, options, progress, threads: as of `iif_core.fusion.direct.solve_direct`.
        variant: `full`; `uniform` = affine maps without selection, all usable predictions count alike; `texel_mean` = mean of all
            predictions of a cell; `object_mean` = mean of all predictions of an object.
    """
    options = options or FusionOptions()
    if variant in MEANS:
        return _mean(problem, variant == "object_mean", options, progress or (lambda done, total: None), threads)
    if variant == "uniform":
        options = replace(options, temperature=EVEN, final_temperature=EVEN)
    return solve_direct(problem, options, progress, threads)


def _mean(
    problem: FusionProblem, of_objects: bool, options: FusionOptions, progress: Callable[[int, int], None], threads: int
) -> FusionResult:
    """Average all predictions under identity maps, in each cell or in each object."""
    run, _ = first_pass(problem, options, threads)
    progress(1, 3)
    cells = CellSums(problem.n_cells)
    for block, mixed in run.map_views(partial(_mean_of_view, run)):
        cells.add(block.cell, mixed, block.weight)
    texture = np.clip(cells.mean(NEUTRAL), LOWEST, 1.0)
    measure_errors(run, texture)
    progress(2, 3)
    if of_objects:
        object_value, _ = object_means(texture, problem.object_of_cell, run.counts.weight)
        texture = object_value[problem.object_of_cell]
    history = [{"temperature": EVEN, **sweep_summary(run.sums, run.state), "change": 0.0}]
    result = build_result(run, texture, history)
    progress(3, 3)
    return result


def _mean_of_view(run: FusionPass, view: int) -> tuple[Block, NDArray]:
    """Return the mean (5, n) of the usable predictions at the pixels of a view."""
    block = run.blocks(view)
    rows = block.segments
    blend = (run.state.affine[rows] * run.state.alpha[rows][..., PROPERTY_OF_ENTRY]).astype(np.float32)
    return block, kernels.mixture(block.values, blend, block.start, LOWEST)
