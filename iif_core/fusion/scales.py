"""Laplace scales: how far mixture and texture are apart, and how far the predictions are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from iif_core.fusion import kernels
from iif_core.fusion.blocks import Block, Blocks, in_order
from iif_core.fusion.options import BaseOptions
from iif_core.fusion.problem import LOWEST, BaseProblem
from iif_core.fusion.sums import PROPERTY_OF_ENTRY, CellSums, State
from iif_core.numerics import laplace


def cell_scales(
    blocks: Blocks, problem: BaseProblem, options: BaseOptions, texture: NDArray, state: State, threads: int
) -> tuple[NDArray, NDArray]:
    """(n_cells, 5) float32: weighted mean of d + b_r e^(-d/b_r) over a cell's pixels; and the votes (S, K, 3)."""
    votes = np.zeros(state.alpha.shape)

    def one_view(view: int) -> tuple[Block, NDArray, NDArray]:
        block = blocks(view)
        target = kernels.texture_at(texture, block.cell)
        mixed, b_ref, votes_of = against(block, state, target, options)
        return block, laplace.scale_contribution(mixed - target, b_ref, options.scale_floor), votes_of

    cells = CellSums(problem.n_cells)
    for block, part, votes_of in in_order(one_view, len(problem.cell_of_pixel), threads):
        votes[block.segments] = votes_of
        cells.add(block.cell, part, block.weight)
    return laplace.floored(cells.mean(np.zeros(5)), np.float32(options.scale_floor)), votes


def against(block: Block, state: State, target: NDArray, options: BaseOptions) -> tuple[NDArray, NDArray, NDArray]:
    """Mixture and reference scale (5, n) of a view under the present corrections, and the votes (s, K, 3) of its segments."""
    rows = block.segments
    affine = state.affine[rows].astype(np.float32)
    blend = (state.affine[rows] * state.alpha[rows][..., PROPERTY_OF_ENTRY]).astype(np.float32)
    mixed = kernels.mixture(block.values, blend, block.start, LOWEST)
    network = kernels.sorting_network(int(block.usable.sum()))
    b_ref, votes = kernels.disagreement(
        block.values, affine, mixed, target, block.weight, block.start, block.usable, network, LOWEST, options.scale_floor
    )
    return mixed, b_ref, votes
