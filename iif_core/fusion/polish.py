"""The paper's own loss, minimised from the least squares on for one selection (matching.py)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from iif_core.errors import InputError
from iif_core.fusion import kernels, matching
from iif_core.fusion.blocks import Block, Blocks, in_order
from iif_core.fusion.options import BaseOptions
from iif_core.fusion.problem import LOWEST, BaseProblem
from iif_core.fusion.scales import against, cell_scales
from iif_core.fusion.sums import IDENTITY, CellSums, State, Sums, summary
from iif_core.numerics import laplace


def select(state: State, sums: Sums, chosen: NDArray | None) -> NDArray:
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


def polished(
    blocks: Blocks,
    problem: BaseProblem,
    options: BaseOptions,
    sums: Sums,
    state: State,
    chosen: NDArray,
    texture: NDArray,
    threads: int,
    history: list[dict[str, float]],
    notify: Callable[[int], None],
) -> NDArray:
    """Texture (n_cells, 5) after `options.polish` sweeps of majorisation on the paper's loss."""
    n_views = len(problem.cell_of_pixel)
    floor = options.scale_floor
    pixels = np.zeros(problem.n_segments)
    state.affine[:] = IDENTITY  # its optimum lies near the identity, far from that of the least squares
    cells = CellSums(problem.n_cells)
    for block in in_order(blocks, n_views, threads):
        pixels[block.segments] = np.add.reduceat(block.weight, block.start[:-1], dtype=np.float64) if len(block.cell) else 0
        planes = kernels.choose(block.values, chosen[block.segments], block.start)
        cells.add(block.cell, np.maximum(planes, LOWEST[:, None]), block.weight)
    texture, total_weight = cells.mean(texture), max(pixels.sum(), 1e-30)
    scale, _ = cell_scales(blocks, problem, options, texture, state, threads)

    def one_view(view: int) -> tuple[Block, NDArray, NDArray, NDArray, float]:
        block = blocks(view)
        rows = block.segments
        planes = kernels.choose(block.values, chosen[rows], block.start)
        target, b = kernels.texture_at(texture, block.cell), kernels.texture_at(scale, block.cell)
        mixed, b_ref, _ = against(block, state, target, options)
        weight = block.weight * laplace.kl_weight(mixed - target, b_ref, b, floor).astype(np.float32) / 5
        second, first = kernels.channel_moments(planes, target, weight, block.start)
        strength = matching.REGULARISER * pixels[rows] / np.maximum(sums.usable[rows].sum(1), 1)
        state.affine[rows] = _penalised(state.affine[rows], chosen[rows], second, first, strength)
        mixed, b_ref, _ = against(block, state, target, options)
        loss = (block.weight * laplace.kl(mixed - target, b_ref, b, floor)).sum(dtype=np.float64) / 5
        weight = block.weight * laplace.kl_weight(mixed - target, b_ref, b, floor).astype(np.float32)
        part = laplace.scale_contribution(mixed - target, b_ref, floor)
        return block, mixed, weight, part, float(loss)

    for _ in range(options.polish):
        cells, scales, data = CellSums(problem.n_cells), CellSums(problem.n_cells), 0.0
        for block, mixed, weight, part, loss in in_order(one_view, n_views, threads):
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
        history.append({"temperature": 0.0, **summary(sums, state), "change": change, **terms})
        notify(len(history) + 1)
    return texture


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
