"""From the solver's state to its result: errors, scales, uncertainty, what nobody saw."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from iif_core.fusion import kernels
from iif_core.fusion.blocks import Blocks, in_order
from iif_core.fusion.gauge import Parts
from iif_core.fusion.options import BaseOptions
from iif_core.fusion.problem import BaseProblem, BaseResult, object_means
from iif_core.fusion.scales import cell_scales
from iif_core.fusion.selection import effective_number, margin
from iif_core.fusion.sums import NO_MASK, Counts, State, Sums
from iif_core.fusion.uncertainty import location_uncertainty


def measure_errors(problem: BaseProblem, blocks: Blocks, sums: Sums, state: State, texture: NDArray, threads: int) -> None:
    """Mean squared error of every corrected prediction against the texture, into `state`."""
    for block in in_order(blocks, len(problem.cell_of_pixel), threads):
        rows, target = block.segments, kernels.texture_at(texture, block.cell)
        weight = sums.fit_weight(block)
        cross = kernels.cross(block.values, target, weight, block.start, NO_MASK)
        square = kernels.square(target, weight, block.start)
        state.error[rows] = sums.errors(rows, state.affine[rows], cross, square)


def result_of(
    problem: BaseProblem,
    blocks: Blocks,
    options: BaseOptions,
    sums: Sums,
    parts: Parts,
    counts: Counts,
    texture: NDArray,
    state: State,
    threads: int,
) -> BaseResult:
    """What a texture (n_cells, 5) and the state that goes with it say, without what was dropped and the history."""
    scale, votes = cell_scales(blocks, problem, options, texture, state, threads)
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


def _unseen_scale(scale: NDArray, seen: NDArray) -> NDArray:
    """Scale of cells nobody saw: as unsure as the least sure tenth of those seen, or 0.5 where there are none."""
    return np.quantile(scale[seen], 0.9, axis=0).astype(np.float32) if seen.any() else np.float32(0.5)


def _filled(problem: BaseProblem, texture: NDArray, counts: Counts) -> tuple[NDArray, NDArray, NDArray]:
    object_value, object_cells = object_means(
        texture, problem.object_of_cell, counts.weight, int(np.max(problem.object_of_segment, initial=-1)) + 1
    )
    value = np.where((counts.weight > 0)[:, None], texture, object_value[problem.object_of_cell])
    return value.astype(np.float32), object_value, object_cells
