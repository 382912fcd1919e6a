"""The usable pixels of a view in segment order, which the compiled loops of the direct solver read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from iif_core.fusion import kernels
from iif_core.fusion.problem import Dropped, FusionProblem, usable_pixels


@dataclass(frozen=True)
class Block:
    """Pixels of one view that have a cell, a segment, weight and finite predictions.

    Attributes:
        values: (K, 5, n) words (kernels.as_words), clamped to [0, 1]; predictions that cannot be used are 0.
        cell: (n,) int32; weight: (n,) float32.
        segments: (s,) int32 ids, ascending; start: (s + 1,) int64, the pixels of segments[j] are start[j] ... start[j + 1] - 1.
        usable: (K,) bool.
        inside: (K, n) bool, no albedo channel is exactly 0 or 1; (0, 0) if that holds for all.
        scale: (3, n) float32 Laplace scales that the prior states for albedo, roughness and metallic; (3, 0) if it states none.
    """

    values: NDArray
    cell: NDArray
    weight: NDArray
    segments: NDArray
    start: NDArray
    usable: NDArray
    inside: NDArray
    scale: NDArray

    @property
    def nbytes(self) -> int:
        return sum(getattr(self, name).nbytes for name in ("values", "cell", "weight", "segments", "start", "inside", "scale"))


def covisibility_weight(viewpoints: NDArray, floor: float) -> NDArray:
    """Return the factor 1 - 1 / V + floor (n_cells,) float32 on a cell's pixels in the fit of the maps (Eq. F.24).

    The value of a cell that one viewpoint sees is the view's own mixture and carries no evidence about the view's maps. The
    floor keeps a value for segments that share no cell; without it their texture would collapse to a constant.
    """
    # A cell without a viewpoint holds no pixel; the 1 only keeps its factor finite.
    return (1 - 1 / np.maximum(viewpoints, 1) + floor).astype(np.float32)


def make_block(problem: FusionProblem, view: int) -> tuple[Block, list[Dropped]]:
    """Read the block of a view, and say which of its predictions were left out and why.

    Raises:
        InputError: shapes that do not match, an id beyond its table.
    """
    maps = problem.view(view)
    words = kernels.as_words(maps)
    found = usable_pixels(problem, view, maps, kernels.finite_pixels(words))
    # (K, 5, n): the pixels of one channel of one prediction are adjacent, as the loops of the kernels run over them.
    values, inside = kernels.gather(words, found.pixel, found.usable)
    # The pixels are in segment order, so the first index of an id is where its segment starts.
    segments, start = np.unique(found.segment, return_index=True)
    block = Block(
        values,
        found.cell.astype(np.int32),
        found.weight.astype(np.float32),
        segments.astype(np.int32),
        np.append(start, len(found.pixel)).astype(np.int64),
        found.usable,
        # An empty mask spares SegmentSums a second Gram matrix.
        np.zeros((0, 0), bool) if inside.all() else inside,
        problem.stated_scale(view, found.pixel),
    )
    return block, found.dropped


class Blocks:
    """Blocks of all views; `memory` bytes of them stay in memory, the others go through `spill`, or are read again each time."""

    def __init__(self, problem: FusionProblem, memory: int, spill: Callable[[NDArray], NDArray] | None = None):
        self.problem, self._left, self._kept, self._spill = problem, memory, {}, spill

    def __call__(self, view: int) -> Block:
        return self._kept[view] if view in self._kept else make_block(self.problem, view)[0]

    def keep(self, view: int, block: Block) -> None:
        """Keep a block, in memory if there is room. Call in the order of the views, so that the same ones are kept each time."""
        if block.nbytes <= self._left:
            self._left -= block.nbytes
            self._kept[view] = block
        elif self._spill is not None:  # only what has K entries a pixel; the rest is small
            self._kept[view] = replace(block, values=self._spill(block.values), inside=self._spill(block.inside))
