"""Light that the model lacks, as photographs show it: the logarithm of what surface shows over how it is re-rendered, as means
over nested blocks of surface (docs/method/shading.md#unexplained-light).

It belongs to the light under which the photographs were taken and to no material. Other cameras can see it; it cannot be relit.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from iif_core.errors import InputError

EDGES = (16, 4)
"""Edges of the blocks in surface cells; the coarsest block is the object."""
NEAREST = 4
"""Photographs of which a block takes the blend of the nearest."""
FULL = 4.0
"""Pixels of a block from which on a photograph counts in full."""
LARGEST = 2.0
"""Largest |log| that a pixel may add; beyond it surface and re-rendering are not the same thing."""
SIGNIFICANT = 2.0
"""Standard errors by which it must bring photographs nearer that it was not made of."""
MIN_VIEWS = 3
_LEAST_ANGLE = 1e-3  # radians


class Blocks(NamedTuple):
    """Nested blocks of surface cells, each level within the one before: objects, then `EDGES`.

    Attributes:
        of_cell: (L, C) block of every cell at every level; parent: (L, B) block of every finest block, of which there are B.
        centre: (B_l, 3) metres of the blocks of each level.
    """

    of_cell: NDArray
    parent: NDArray
    centre: tuple[NDArray, ...]


def nested_blocks(ijk: NDArray, object_id: NDArray, centre: NDArray) -> Blocks:
    """Group surface cells by object, and within objects by their place; ijk (C, 3) int, object_id (C,), centre (C, 3) metres."""
    keys = [object_id[:, None], *(np.concatenate([object_id[:, None], ijk // edge], 1) for edge in EDGES)]
    of_cell = np.stack([np.unique(key, axis=0, return_inverse=True)[1].ravel() for key in keys])
    centres = []
    for own in of_cell:
        count = np.bincount(own)
        centres.append(np.stack([np.bincount(own, centre[:, axis]) for axis in range(3)], 1) / count[:, None])
    parent = np.zeros((len(keys), len(centres[-1])), np.int64)
    parent[:, of_cell[-1]] = of_cell
    return Blocks(of_cell, parent, tuple(centres))


class _Shown(NamedTuple):
    """What one photograph shows of the blocks of one level: block (n,) ascending, mean log ratio (n, 3), and weight (n,)."""

    block: NDArray
    mean: NDArray
    weight: NDArray


class _View(NamedTuple):
    """One photograph: eye (3,); levels; and of its finest blocks the sums of w, w r and w r^2 over pixels, (n, 3)."""

    eye: NDArray
    levels: tuple[_Shown, ...]
    weight: NDArray
    weighted: NDArray
    square: NDArray


class Strength(NamedTuple):
    """How far the means of other photographs are believed.

    Attributes:
        beta: (5,) >= 0, of the terms of Eq. S.24; all 0 if they do not help.
        share: of the squared error of photographs that the others take away, to first order in the logarithm; error: its standard
            error over photographs.
    """

    beta: NDArray
    share: float
    error: float


class UnexplainedLight:
    """Collects what photographs show, and predicts what another camera would see (Eq. S.23 to S.25)."""

    def __init__(self, blocks: Blocks):
        self.blocks = blocks
        self.views: list[_View] = []
        sizes = [len(centre) for centre in blocks.centre]
        self._sums = [np.zeros((size, 3)) for size in sizes]
        self._weights = [np.zeros(size) for size in sizes]

    def add(self, eye: NDArray, cell: NDArray, log_ratio: NDArray, weight: NDArray) -> None:
        """Add a photograph.

        Args:
            eye: (3,) metres, its place.
            cell: (n,) surface cell of each of its pixels.
            log_ratio: (n, 3) log of what it shows over its re-rendering, finite.
            weight: (n, 3) >= 0, squared change of the sensor value with the logarithm of the radiance.

        Raises:
            InputError: a ratio or a weight that is not finite.
        """
        if not (np.isfinite(log_ratio).all() and np.isfinite(weight).all()):
            raise InputError("unexplained light: ratios and weights must be finite; leave pixels without them out")
        ratio, levels = np.clip(log_ratio, -LARGEST, LARGEST), []
        for of_cell, sums, total in zip(self.blocks.of_cell, self._sums, self._weights, strict=True):
            block, row, pixels = np.unique(of_cell[cell], return_inverse=True, return_counts=True)
            own = np.minimum(pixels, FULL)
            shown = _Shown(block, _sums(row, ratio, len(block)) / pixels[:, None], own)
            sums[block] += own[:, None] * shown.mean
            total[block] += own
            levels.append(shown)
        last = len(levels[-1].block)  # the rows of the finest level are those of the last turn
        moments = (_sums(row, values, last) for values in (weight, weight * ratio, weight * ratio**2))
        self.views.append(_View(np.asarray(eye, np.float64), tuple(levels), *moments))

    def terms(self, eye: NDArray, block: NDArray, without: int | None = None) -> NDArray:
        """Return the five terms of Eq. S.24 for finest blocks (n,) seen from a place, (n, 3, 5); `without` a photograph."""
        coarse = np.zeros((len(block), 3))
        terms, blends = [], []
        for level, centre in enumerate(self.blocks.centre):
            own = self.blocks.parent[level][block]
            mean, known = self._mean(level, own, without)
            mean = np.where(known[:, None], mean, coarse)  # what no photograph shows is as the larger block around it
            terms.append(mean - coarse)
            coarse = mean
            if level:
                blend, found = self._nearest(level, own, eye - centre[own], centre[own], without)
                blends.append(np.where(found[:, None], blend - mean, 0.0))
        terms += [blends[0], *(fine - wide for wide, fine in zip(blends[:-1], blends[1:], strict=True))]
        return np.stack(terms, -1)

    def _mean(self, level: int, block: NDArray, without: int | None) -> tuple[NDArray, NDArray]:
        """Mean over the photographs (n, 3), and whether any shows the block (n,)."""
        sums, weight = self._sums[level][block], self._weights[level][block]
        if without is not None:
            shown = self.views[without].levels[level]
            row, found = _rows(shown.block, block)
            sums, weight = sums.copy(), weight.copy()
            sums[found] -= shown.weight[row, None] * shown.mean[row]
            weight[found] -= shown.weight[row]
        known = weight > 0.5  # weights are whole numbers
        return sums / np.where(known, weight, 1.0)[:, None], known

    def _nearest(
        self, level: int, block: NDArray, towards: NDArray, centre: NDArray, without: int | None
    ) -> tuple[NDArray, NDArray]:
        """Blend of the photographs that see blocks (n,) from the nearest directions (Eq. E.22), (n, 3); whether there is one."""
        others = [view for number, view in enumerate(self.views) if number != without]
        angle = np.full((len(others), len(block)), np.inf, np.float32)
        value = np.zeros((len(others), len(block), 3), np.float32)
        unit = _unit(towards)
        for i, view in enumerate(others):
            shown = view.levels[level]
            row, found = _rows(shown.block, block)
            chord = np.linalg.norm(_unit(view.eye - centre[found]) - unit[found], axis=1)
            angle[i, found] = np.maximum(2 * np.arcsin(np.minimum(chord / 2, 1)), _LEAST_ANGLE)
            value[i, found] = shown.mean[row]
        limit = np.full(len(block), np.inf)
        if len(others) > NEAREST:
            limit = np.partition(angle, NEAREST, axis=0)[NEAREST].astype(np.float64)
        limit = np.where(np.isfinite(limit), limit, np.pi)  # too few photographs show the block to leave one out
        seen = np.isfinite(angle)
        weight = np.where(seen, np.maximum(1 - np.where(seen, angle, 0) / limit, 0) / np.where(seen, angle, 1), 0)
        total = weight.sum(0)
        return (weight[..., None] * value).sum(0) / np.where(total > 0, total, 1)[:, None], total > 0

    def strength(self) -> Strength:
        """Find how far to believe the terms: least squares on every photograph by the terms of the others (Eq. S.25).

        They count only if photographs come nearer by `SIGNIFICANT` standard errors with a strength that was found without them.
        """
        nothing, rows = np.zeros(2 * len(EDGES) + 1), [row for row in self._equations() if row[2] > 0]
        if len(rows) < MIN_VIEWS:
            return Strength(nothing, 0.0, 0.0)
        normal, right, before = (np.array(part) for part in zip(*rows, strict=True))
        taken = np.zeros(len(rows))
        for i in range(len(rows)):
            beta = _solved(normal.sum(0) - normal[i], right.sum(0) - right[i])
            taken[i] = (2 * beta @ right[i] - beta @ normal[i] @ beta) / before.mean()
        share, error = float(taken.mean()), float(taken.std(ddof=1) / np.sqrt(len(taken)))
        helps = share > 0 and share > SIGNIFICANT * error
        return Strength(_solved(normal.sum(0), right.sum(0)) if helps else nothing, share, error)

    def _equations(self) -> Iterator[tuple[NDArray, NDArray, float]]:
        """Normal matrix (5, 5), right-hand side (5,) and sum of squares of each photograph, with the terms of the others."""
        for number, view in enumerate(self.views):
            x = self.terms(view.eye, view.levels[-1].block, number)
            normal = np.einsum("ncp,ncq,nc->pq", x, x, view.weight)
            yield normal, np.einsum("ncp,nc->p", x, view.weighted), float(view.square.sum())

    def factor(self, eye: NDArray, cell: NDArray, beta: NDArray, without: int | None = None) -> NDArray:
        """Return the factor (n, 3) on the re-rendering of surface cells (n,) that are seen from a place; 1 where beta is 0."""
        if not beta.any():
            return np.ones((len(cell), 3))
        block, row = np.unique(self.blocks.of_cell[-1][cell], return_inverse=True)
        return np.exp(np.clip(self.terms(np.asarray(eye, np.float64), block, without) @ beta, -LARGEST, LARGEST))[row]


def _solved(normal: NDArray, right: NDArray) -> NDArray:
    """The strength >= 0 that minimises beta N beta - 2 beta r; a term that no photograph has gets 0."""
    value, vectors = np.linalg.eigh(normal)
    keep = value > 1e-10 * max(value.max(), 1e-300)
    if not keep.any():
        return np.zeros(len(right))
    root = np.sqrt(value[keep])
    # |R beta - q|^2 with R^T R = N and R^T q = r.
    return nnls(root[:, None] * vectors[:, keep].T, (vectors[:, keep].T @ right) / root)[0]


def _rows(known: NDArray, wanted: NDArray) -> tuple[NDArray, NDArray]:
    """Rows of `wanted` in the ascending `known`, of those that are there, and where these are in `wanted`."""
    row = np.minimum(np.searchsorted(known, wanted), max(len(known) - 1, 0))
    found = np.flatnonzero(known[row] == wanted) if len(known) else np.zeros(0, np.int64)
    return row[found], found


def _sums(row: NDArray, values: NDArray, count: int) -> NDArray:
    return np.stack([np.bincount(row, values[:, channel], count) for channel in range(3)], 1)


def _unit(vectors: NDArray) -> NDArray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)
