"""Laplace scales: the distance between mixture and texture, and the disagreement of the predictions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from iif_core.fusion import kernels
from iif_core.fusion.blocks import Block
from iif_core.fusion.fusion_pass import FusionPass
from iif_core.fusion.problem import LOWEST
from iif_core.fusion.sums import PROPERTY_OF_ENTRY, CellSums
from iif_core.numerics import laplace


def cell_scales(run: FusionPass, texture: NDArray) -> tuple[NDArray, NDArray]:
    """Return the Laplace scales (n_cells, 5) float32 of the cells (Eq. F.31) and the votes (S, K, 3)."""
    votes = np.zeros(run.state.alpha.shape)
    floor = run.options.scale_floor

    def one_view(view: int) -> tuple[Block, NDArray, NDArray]:
        block = run.blocks(view)
        target = kernels.texture_at(texture, block.cell)
        mixed, b_ref, votes_of = reference_distribution(run, block, target)
        if block.scale.size:  # predictions that agree may be wrong together
            # `fmax` ignores NaN: where the prior states no number, the disagreement alone counts (Eq. F.62).
            b_ref = np.fmax(b_ref, block.scale[[0, 0, 0, 1, 2]])
        return block, laplace.scale_contribution(mixed - target, b_ref, floor), votes_of

    cells = CellSums(run.problem.n_cells)
    for block, part, votes_of in run.map_views(one_view):
        votes[block.segments] = votes_of  # a segment lies in one view
        cells.add(block.cell, part, block.weight)
    return laplace.floored(cells.mean(np.zeros(5)), np.float32(floor)), votes


def reference_distribution(run: FusionPass, block: Block, target: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Return the reference distributions of a view's pixels under the present maps: mixture (5, n) of Eq. F.30, scale (5, n) of
    Eq. F.4.

    Also returns votes (s, K, 3): weight of the pixels of each segment at which prediction k is the nearest to `target` (5, n).
    """
    rows, state = block.segments, run.state
    affine = state.affine[rows].astype(np.float32)
    # Maps for the single predictions, and maps times weights for their mixture; both in the CROSS layout.
    blend = (state.affine[rows] * state.alpha[rows][..., PROPERTY_OF_ENTRY]).astype(np.float32)
    mixed = kernels.mixture(block.values, blend, block.start, LOWEST)
    network = kernels.sorting_network(int(block.usable.sum()))
    floor = run.options.scale_floor
    pixels = kernels.Pixels(block.values, mixed, target, block.weight, block.start)
    return mixed, *kernels.disagreement(pixels, affine, block.usable, network, LOWEST, floor)
