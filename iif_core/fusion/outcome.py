"""From the state of the solver to its result: errors, scales, uncertainty and fills for cells without observations."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from iif_core.fusion.fusion_pass import FusionPass
from iif_core.fusion.problem import FusionResult, object_means
from iif_core.fusion.scales import cell_scales
from iif_core.fusion.selection import effective_number, margin
from iif_core.fusion.uncertainty import location_uncertainty


def build_result(run: FusionPass, texture: NDArray, history: list[dict[str, float]]) -> FusionResult:
    """Describe a texture (n_cells, 5) and the maps and selection of `run.state` that belong to it."""
    counts, state = run.counts, run.state
    scale, votes = cell_scales(run, texture)
    seen = counts.weight > 0
    n_objects = int(np.max(run.problem.object_of_segment, initial=-1)) + 1
    object_of_cell = run.problem.object_of_cell
    object_value, object_cells = object_means(texture, object_of_cell, counts.weight, n_objects)
    repeats = np.maximum(counts.views, 1) / np.maximum(counts.viewpoints, 1)  # of the same photograph
    uncertainty = location_uncertainty(scale, counts.viewpoints, counts.observations / repeats, state.alpha.shape[1])
    for array in (scale, uncertainty):  # unseen cells are as uncertain as the least certain tenth of those seen
        array[~seen] = np.quantile(array[seen], 0.9, axis=0).astype(np.float32) if seen.any() else np.float32(0.5)
    n, k = state.alpha.shape[:2]
    probability = votes / np.maximum(votes.sum(1, keepdims=True), 1e-30)  # 0 where a segment has no pixel
    by_property = state.error.swapaxes(1, 2), np.repeat(run.sums.usable[:, None], 3, 1)  # (S, 3, K)
    return FusionResult(
        value=np.where(seen[:, None], texture, object_value[object_of_cell]).astype(np.float32),
        scale=scale,
        uncertainty=uncertainty,
        coverage=counts.weight.astype(np.float32),
        part_of_cell=run.parts.of_cell,
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
        dropped=run.dropped,
        history=history,
    )
