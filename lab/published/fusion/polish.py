"""The paper's own loss, minimised for one selection, starting from the result of the least squares (matching.py)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from iif_core.errors import InputError
from iif_core.fusion import kernels
from iif_core.fusion.blocks import Block
from iif_core.fusion.fusion_pass import FusionPass
from iif_core.fusion.problem import LOWEST
from iif_core.fusion.scales import cell_scales, reference_distribution
from iif_core.fusion.sums import CellSums, SegmentState, SegmentSums, sweep_summary
from iif_core.numerics import laplace
from iif_core.reflectance.material import IDENTITY
from lab.published.fusion import divergence, matching
from lab.published.fusion.kernels import channel_moments, choose

_ALBEDO_ENTRIES = np.array([[0, 1, 2, 6], [1, 3, 4, 7], [2, 4, 5, 8], [6, 7, 8, 9]])  # of channel_moments, as a 4x4 matrix
_PAIR_ENTRIES = np.array([[0, 1], [1, 2]])


def fix_selection(state: SegmentState, sums: SegmentSums, chosen: NDArray | None) -> NDArray:
    """Make the selection one-hot at the `chosen` predictions (S, 3), by default those of the largest weight; return them.

    Raises:
        InputError: `chosen` of another shape or with numbers out of range.
    """
    shape = (len(state.alpha), 3)
    if chosen is not None and (
        np.shape(chosen) != shape or np.min(chosen, initial=0) < 0 or np.max(chosen, initial=0) >= state.alpha.shape[1]
    ):
        raise InputError(f"chosen predictions: {np.shape(chosen)}; needed is {shape} with numbers below {state.alpha.shape[1]}")
    chosen = state.alpha.argmax(1) if chosen is None else np.asarray(chosen, np.int64)
    one_hot = (np.arange(state.alpha.shape[1])[None, :, None] == chosen[:, None]) & sums.usable[:, :, None]
    state.alpha = one_hot.astype(np.float64)
    return chosen


def minimise_distribution_loss(
    run: FusionPass,
    chosen: NDArray,
    polish: int,
    texture: NDArray,
    history: list[dict[str, float]],
    notify: Callable[[int], None],
) -> NDArray:
    """Minimise data term and regulariser of the paper's loss by majorisation.

    Args:
        run: pass whose state has a one-hot selection; its maps are replaced, starting from the identity.
        chosen: (S, 3) int64 selected prediction of each segment and property.
        polish: sweeps.
        texture: (n_cells, 5), kept in cells without observations.
        history: one entry per sweep is appended; notify: called with its length + 1 after every sweep.

    Returns:
        Texture (n_cells, 5) float32.
    """
    state, sums, floor = run.state, run.sums, run.options.scale_floor
    pixels = np.zeros(run.problem.n_segments)
    state.affine[:] = IDENTITY  # the optimum lies near the identity, far from the least-squares optimum
    cells = CellSums(run.problem.n_cells)
    for block in run.map_views(run.blocks):
        pixels[block.segments] = np.add.reduceat(block.weight, block.start[:-1], dtype=np.float64) if len(block.cell) else 0
        planes = choose(block.values, chosen[block.segments], block.start)
        cells.add(block.cell, np.maximum(planes, LOWEST[:, None]), block.weight)
    texture, total_weight = cells.mean(texture), max(pixels.sum(), 1e-30)
    scale, _ = cell_scales(run, texture)

    def one_view(view: int) -> tuple[Block, NDArray, NDArray, NDArray, float]:
        block = run.blocks(view)
        rows = block.segments
        planes = choose(block.values, chosen[rows], block.start)
        target, b = kernels.texture_at(texture, block.cell), kernels.texture_at(scale, block.cell)
        mixed, b_ref, _ = reference_distribution(run, block, target)
        weight = block.weight * divergence.kl_weight(mixed - target, b_ref, b, floor).astype(np.float32) / 5
        second, first = channel_moments(planes, target, weight, block.start)
        strength = matching.REGULARISER * pixels[rows] / np.maximum(sums.usable[rows].sum(1), 1)
        state.affine[rows] = _penalised(state.affine[rows], chosen[rows], second, first, strength)
        mixed, b_ref, _ = reference_distribution(run, block, target)
        loss = (block.weight * divergence.kl(mixed - target, b_ref, b, floor)).sum(dtype=np.float64) / 5
        weight = block.weight * divergence.kl_weight(mixed - target, b_ref, b, floor).astype(np.float32)
        part = laplace.scale_contribution(mixed - target, b_ref, floor)
        return block, mixed, weight, part, float(loss)

    for _ in range(polish):
        cells, scales, data = CellSums(run.problem.n_cells), CellSums(run.problem.n_cells), 0.0
        for block, mixed, weight, part, loss in run.map_views(one_view):
            cells.add(block.cell, mixed, weight)
            scales.add(block.cell, part, block.weight)
            data += loss
        updated = cells.mean(texture)
        change = float(np.sqrt(np.mean((updated - texture) ** 2, dtype=np.float64)))
        texture = updated
        scale = laplace.floored(scales.mean(scale), np.float32(floor))
        penalty = matching.identity_penalty(state.affine[..., :12].reshape(*state.affine.shape[:2], 3, 4))
        penalty = penalty + ((state.affine[..., 12:] - IDENTITY[12:]) ** 2).sum(-1)
        mean_penalty = (penalty * sums.usable).sum(1) / np.maximum(sums.usable.sum(1), 1)
        terms = {"data": data / total_weight, "regulariser": matching.REGULARISER * (pixels @ mean_penalty) / total_weight}
        history.append({"temperature": 0.0, **sweep_summary(sums, state), "change": change, **terms})
        notify(len(history) + 1)
    return texture


def _penalised(affine: NDArray, chosen: NDArray, second: NDArray, first: NDArray, strength: NDArray) -> NDArray:
    """Maps (s, K, CROSS) with those of the chosen predictions fitted again (Eqs. F.33 to F.35)."""
    out, each = affine.copy(), np.arange(len(affine))
    if not len(affine):
        return out
    start = out[each, chosen[:, 0], :12].reshape(-1, 3, 4)
    albedo = matching.penalised_affine(second[:, :3][..., _ALBEDO_ENTRIES], first[:, :3], start, strength)
    out[each, chosen[:, 0], :12] = albedo.reshape(-1, 12)
    for p, part in ((1, slice(12, 14)), (2, slice(14, 16))):
        gain = matching.penalised_gain(second[:, p + 2][..., _PAIR_ENTRIES], first[:, p + 2, :2], strength)
        out[each, chosen[:, p], part] = gain
    return out
