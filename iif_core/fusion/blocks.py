"""The usable pixels of a view in segment order: what the compiled loops of the direct solver read."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from iif_core.fusion import kernels
from iif_core.fusion.problem import BaseProblem, Dropped, usable_pixels

_T = TypeVar("_T")


@dataclass(frozen=True)
class Block:
    """Pixels of one view that have a cell, a segment, weight and finite predictions.

    Attributes:
        values: (K, 5, n) words (kernels.as_words), clamped to [0, 1]; predictions that cannot be used are 0.
        cell: (n,) int32; weight: (n,) float32.
        segments: (S,) int32 ids, ascending; start: (S + 1,) int64, pixels of segment s are start[s] ... start[s + 1] - 1.
        usable: (K,) bool.
        inside: (K, n) bool, no albedo channel is exactly 0 or 1; (0, 0) when that holds for all.
    """

    values: NDArray
    cell: NDArray
    weight: NDArray
    segments: NDArray
    start: NDArray
    usable: NDArray
    inside: NDArray

    @property
    def nbytes(self) -> int:
        return sum(getattr(self, name).nbytes for name in ("values", "cell", "weight", "segments", "start", "inside"))


def shared_weight(views: NDArray, floor: float) -> NDArray:
    """(n_cells,) float32 weight of a cell's pixels in the fit of the corrections: 1 - 1 / n + floor, n viewpoints.

    With the cell's value eliminated (it is the mean of n observations u_j), what remains of the squares is, as a function of
    one observation, (1 - 1/n) (u - mean of the others)^2: a cell seen once says nothing about the corrections. The floor
    keeps segments that share no cell; without it they would collapse to a constant.
    """
    return (1 - 1 / np.maximum(views, 1) + floor).astype(np.float32)


def make_block(problem: BaseProblem, view: int) -> tuple[Block, list[Dropped]]:
    """The block of a view, and what of its predictions was left out and why.

    Raises:
        InputError: an id beyond its table.
    """
    maps = problem.view(view)
    words = kernels.as_words(maps)
    found = usable_pixels(problem, view, maps, kernels.finite_pixels(words))
    values, inside = kernels.gather(words, found.pixel, found.usable)
    segments, start = np.unique(found.segment, return_index=True)
    block = Block(
        values,
        found.cell.astype(np.int32),
        found.weight.astype(np.float32),
        segments.astype(np.int32),
        np.append(start, len(found.pixel)).astype(np.int64),
        found.usable,
        np.zeros((0, 0), bool) if inside.all() else inside,
    )
    return block, found.dropped


class Blocks:
    """Blocks of all views; kept in memory as far as `memory` bytes go, made again each time beyond."""

    def __init__(self, problem: BaseProblem, memory: int):
        self.problem, self._left, self._kept = problem, memory, {}

    def __call__(self, view: int) -> Block:
        return self.first(view)[0]

    def first(self, view: int) -> tuple[Block, list[Dropped]]:
        """Block and what was left out."""
        if view in self._kept:
            return self._kept[view], []
        return make_block(self.problem, view)

    def keep(self, view: int, block: Block) -> None:
        """Remember a block if there is room (call in the order of the views, so that the same ones are kept each time)."""
        if block.nbytes <= self._left:
            self._left -= block.nbytes
            self._kept[view] = block


def in_order(work: Callable[[int], _T], n: int, threads: int) -> Iterator[_T]:
    """work(0), work(1), ... in this order, `threads` of them under way at a time."""
    if threads <= 1:
        yield from map(work, range(n))
        return
    with ThreadPoolExecutor(threads) as pool:
        for first in range(0, n, threads):  # in rounds, so that no more results wait than there are threads
            yield from pool.map(work, range(first, min(first + threads, n)))
