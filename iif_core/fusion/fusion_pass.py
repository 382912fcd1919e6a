"""The first pass over the views and what it hands to all later passes of the direct solver."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from iif_core.errors import InputError
from iif_core.fusion import kernels
from iif_core.fusion.blocks import Block, Blocks, covisibility_weight, make_block
from iif_core.fusion.gauge import Parts, covisible_parts
from iif_core.fusion.options import FusionOptions
from iif_core.fusion.problem import NEUTRAL, Dropped, FusionProblem
from iif_core.fusion.sums import CellCounts, CellSums, SegmentState, SegmentSums
from iif_core.numerics.parallel import map_in_order

_T = TypeVar("_T")


@dataclass
class FusionPass:
    """A problem, how it is solved, and what the passes over its views share.

    Attributes:
        problem, options: as given; threads: views that are worked on (and held in memory) at a time.
        blocks: usable pixels of the views; sums: what no sweep changes; state: what every sweep changes.
        parts: connected parts of segments and cells; counts: observations of every cell; dropped: unused predictions.
    """

    problem: FusionProblem
    options: FusionOptions
    threads: int
    blocks: Blocks
    sums: SegmentSums
    state: SegmentState
    parts: Parts
    counts: CellCounts
    dropped: list[Dropped]

    def map_views(self, work: Callable[[int], _T]) -> Iterator[_T]:
        """Yield work(view) of every view, in the order of the views."""
        return map_in_order(work, len(self.problem.cell_of_pixel), self.threads)


def first_pass(problem: FusionProblem, options: FusionOptions, threads: int) -> tuple[FusionPass, NDArray]:
    """Read every view: Gram matrices, counts, parts and the first texture (n_cells, 5) float32.

    The texture is the cell means of the median of the predictions (Eq. F.23). The pass has identity maps and equal selection
    weights.

    Raises:
        InputError: shapes that do not match, ids out of range, a segment in two views.
    """
    counts = CellCounts(*(np.zeros(problem.n_cells, t) for t in (np.int32, np.int32, np.int32, np.float64)))
    blocks, cells, n_k = Blocks(problem, options.memory, options.spill), CellSums(problem.n_cells), 0
    dropped: list[Dropped] = []
    known: set[bytes] = set()  # digests of the maps of cells
    pairs = []  # (segment, cell) of the pixels of each view
    n_views = len(problem.cell_of_pixel)

    def start_of(view: int) -> tuple[Block, list[Dropped], NDArray]:
        block, left_out = make_block(problem, view)
        return block, left_out, _medians(block)

    # -------- first loop: texture, counts, edges of the graph of parts --------
    for view, (block, left_out, values) in enumerate(map_in_order(start_of, n_views, threads)):
        n_k = n_k or len(block.usable)
        if len(block.usable) != n_k:
            raise InputError(
                f"view {view} has {len(block.usable)} predictions, view 0 has {n_k}; give every view the same number"
            )
        blocks.keep(view, block)
        dropped += left_out
        cells.add(block.cell, values, block.weight)
        counts.observations += np.bincount(block.cell, minlength=problem.n_cells).astype(np.int32)
        seen = np.unique(block.cell)
        counts.views[seen] += 1
        digest = hashlib.sha256(block.cell.tobytes()).digest()
        if digest not in known:  # the same photograph twice is one viewpoint
            known.add(digest)
            counts.viewpoints[seen] += 1
        pairs.append((np.repeat(block.segments, np.diff(block.start)), block.cell))
    # All channels of a pixel weigh the same here, so the first one stands for all.
    counts.weight = cells.total[:, 0]
    # -------- second loop: Gram matrices, whose weights need the viewpoints from all views (Eq. F.24) --------
    sums = SegmentSums(problem.n_segments, max(n_k, 1), covisibility_weight(counts.viewpoints, options.single_view_weight))
    for block in map_in_order(blocks, n_views, threads):
        sums.add(block, options)
    # -------- identity maps, and equal weights of the usable predictions; 0 for a segment without any --------
    state = SegmentState(problem.n_segments, max(n_k, 1))
    share = sums.usable / np.maximum(sums.usable.sum(1, keepdims=True), 1)
    state.alpha = np.repeat(share[:, :, None], 3, 2)
    parts = covisible_parts(problem.n_segments, problem.n_cells, pairs)
    run = FusionPass(problem, options, threads, blocks, sums, state, parts, counts, dropped)
    return run, cells.mean(NEUTRAL)


def _medians(block: Block) -> NDArray:
    """(5, n) median of the usable predictions of each pixel."""
    return kernels.medians(block.values, block.usable, kernels.sorting_network(int(block.usable.sum())))
