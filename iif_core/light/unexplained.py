"""What re-renderings lack, as photographs agree on it: light that was not found, above all. The logarithm of what surface shows
over how it is re-rendered, on nested blocks of surface (docs/method/shading.md#unexplained-light).

It belongs to the light under which the photographs were taken. Other cameras can see it; it cannot be relit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from iif_core.camera.interpolation import NEAREST, angles_between, blend_weights, unit
from iif_core.errors import InputError

EDGE = 4
"""Edge of the smallest blocks in surface cells, of photographs of up to `PIXELS`. That of larger ones grows with their sides:
what is lacking is smooth."""
PIXELS = 1 << 16
STEP = 4
"""Ratio of the edges of the larger blocks and of the smallest ones; the largest block of all is the object."""
FULL = 4.0
"""Pixels of a block from which on a photograph counts in full."""
LARGEST = 2.0
"""Largest |log|; beyond it surface and re-rendering are not the same thing."""
SIGNIFICANT = 2.0
"""Standard errors by which it must bring photographs nearer that it was not made of."""
MIN_VIEWS = 5
"""Photographs from which on the standard error over them means something."""
MOST_VIEWS = 32
"""Photographs, evenly spread, by which the strength is found; all of them tell what is lacking."""
TERMS = 5
_RIDGE = 1e-6


class Blocks(NamedTuple):
    """Nested blocks of surface cells, each level within the one before: objects, large blocks, small blocks.

    Attributes:
        of_cell: (3, C) block of every cell at every level; parent: (3, B) block of every small block, of which there are B.
        centre: (B_l, 3) metres of the blocks of each level.
    """

    of_cell: NDArray
    parent: NDArray
    centre: tuple[NDArray, ...]


def nested_blocks(ijk: NDArray, object_id: NDArray, centre: NDArray, pixels: float = PIXELS) -> Blocks:
    """Group surface cells by object, and within objects by their place.

    Args:
        ijk: (C, 3) int; object_id: (C,); centre: (C, 3) metres.
        pixels: of a photograph, mean.
    """
    small = EDGE * max(1, int(np.ceil(np.sqrt(pixels / PIXELS))))
    keys = [object_id[:, None], *(np.concatenate([object_id[:, None], ijk // edge], 1) for edge in (STEP * small, small))]
    of_cell = np.stack([np.unique(key, axis=0, return_inverse=True)[1].ravel() for key in keys]).astype(np.int32)
    centres = []
    for own in of_cell:
        count = np.bincount(own)
        centres.append(np.stack([np.bincount(own, centre[:, axis]) for axis in range(3)], 1) / count[:, None])
    parent = np.zeros((len(keys), len(centres[-1])), np.int32)
    parent[:, of_cell[-1]] = of_cell
    return Blocks(of_cell, parent, tuple(centres))


class _Shown(NamedTuple):
    """What one photograph shows of the blocks of one level: block (n,) ascending, log ratio (n, 3), how far it counts (n,)."""

    block: NDArray
    ratio: NDArray
    count: NDArray


class _View(NamedTuple):
    """One photograph: eye (3,); levels; and the weight (n, 3) of its small blocks."""

    eye: NDArray
    levels: tuple[_Shown, ...]
    weight: NDArray


class Strength(NamedTuple):
    """How far what the other photographs show is believed.

    Attributes:
        beta: (5,) in [0, 1], of the terms of Eq. S.24; all 0 if they do not help.
        share: of the squared error of blocks that the other photographs take away, to first order in the logarithm; error: its
            standard error over photographs.
        views: photographs by which it was found; 0 if they are too few.
    """

    beta: NDArray
    share: float
    error: float
    views: int


class UnexplainedLight:
    """Collects what photographs show, and predicts what another camera would see (Eq. S.23 to S.25)."""

    def __init__(self, blocks: Blocks):
        self.blocks = blocks
        self.views: list[_View] = []
        sizes = [len(centre) for centre in blocks.centre]
        self._sums = [np.zeros((size, 3)) for size in sizes]
        self._counts = [np.zeros(size) for size in sizes]

    def add(self, eye: NDArray, cell: NDArray, shown: NDArray, rendered: NDArray, weight: NDArray) -> None:
        """Add a photograph.

        Args:
            eye: (3,) metres, its place.
            cell: (n,) surface cell of each of its pixels.
            shown, rendered: (n, 3) radiance of the photograph and of its re-rendering, > 0.
            weight: (n, 3) >= 0, squared change of the sensor value with the logarithm of the radiance.

        Raises:
            InputError: radiance that is not finite and positive, or a weight that is not finite and >= 0.
        """
        radiance = np.concatenate([shown, rendered])
        if not (np.isfinite(radiance).all() and (radiance > 0).all() and np.isfinite(weight).all() and (weight >= 0).all()):
            raise InputError("unexplained light: radiance must be finite and positive, weights finite; leave other pixels out")
        levels = []
        for of_cell, sums, total in zip(self.blocks.of_cell, self._sums, self._counts, strict=True):
            block, row, pixels = np.unique(of_cell[cell], return_inverse=True, return_counts=True)
            # The logarithm of sums, not the sum of logarithms, which the noise of a re-rendering would bias.
            ratio = np.log(_sums(row, shown, len(block))) - np.log(_sums(row, rendered, len(block)))
            own = _Shown(block, np.clip(ratio, -LARGEST, LARGEST).astype(np.float32), np.minimum(pixels, FULL).astype(np.float32))
            sums[block] += own.count[:, None] * own.ratio.astype(np.float64)
            total[block] += own.count
            levels.append(own)
        # The rows of the last level are those of the small blocks.
        self.views.append(_View(np.asarray(eye, np.float64), tuple(levels), _sums(row, weight, len(block)).astype(np.float32)))

    def terms(self, eye: NDArray, block: NDArray, without: int | None = None) -> NDArray:
        """Return the terms of Eq. S.24 for small blocks (n,) seen from a place, (n, 3, 5); `without` a photograph."""
        terms, blends = [], []
        coarse = np.zeros((len(block), 3))
        for level, centre in enumerate(self.blocks.centre):
            own, row = np.unique(self.blocks.parent[level][block], return_inverse=True)
            mean, known = self._mean(level, own, without)
            mean = np.where(known[row, None], mean[row], coarse)  # what no photograph shows is as the larger block around it
            terms.append(mean - coarse)
            coarse = mean
            if level:
                blend, found = self._nearest(level, own, eye - centre[own], centre[own], without)
                around = blends[-1] if blends else np.zeros((len(block), 3))
                blends.append(np.where(found[row, None], blend[row] - mean, around))
        terms += [blends[0], blends[1] - blends[0]]
        return np.stack(terms, -1)

    def _mean(self, level: int, block: NDArray, without: int | None) -> tuple[NDArray, NDArray]:
        """Mean over the photographs (n, 3), and whether any shows the block (n,)."""
        sums, count = self._sums[level][block], self._counts[level][block]
        if without is not None:
            shown = self.views[without].levels[level]
            row, found = _rows(shown.block, block)
            sums[found] -= shown.count[row, None] * shown.ratio[row].astype(np.float64)
            count[found] -= shown.count[row]
        known = count > 0.5  # counts are whole numbers
        return sums / np.where(known, count, 1.0)[:, None], known

    def _nearest(
        self, level: int, block: NDArray, towards: NDArray, centre: NDArray, without: int | None
    ) -> tuple[NDArray, NDArray]:
        """Blend of the photographs that see blocks (n,) from the nearest directions (Eq. E.22), (n, 3), and whether there is one;
        a single photograph is the mean already."""
        angle, value = np.full((len(block), NEAREST + 1), np.inf), np.zeros((len(block), NEAREST + 1, 3))
        seen_from = unit(towards)
        for number, view in enumerate(self.views):
            if number == without:
                continue
            shown = view.levels[level]
            row, found = _rows(shown.block, block)
            own = angles_between(unit(view.eye - centre[found]), seen_from[found])
            # The five smallest angles so far: a smaller one takes the place of the largest.
            place = angle[found].argmax(1)
            nearer = own < angle[found, place]
            angle[found[nearer], place[nearer]], value[found[nearer], place[nearer]] = own[nearer], shown.ratio[row[nearer]]
        seen = np.isfinite(angle)
        limit = np.where(seen.all(1), angle.max(1), np.pi)  # too few photographs show the block to leave one out
        weight = seen * blend_weights(np.where(seen, angle, 0.0), limit[:, None])
        total = weight.sum(1)
        found = (total > 0) & (seen.sum(1) > 1)
        return (weight[..., None] * value).sum(1) / np.where(total > 0, total, 1)[:, None], found

    def strength(self, progress: Callable[[int, int], None] = lambda done, of: None) -> Strength:
        """Find how far to believe the terms: least squares on photographs by the terms of the others (Eq. S.25).

        They count only if photographs come nearer by `SIGNIFICANT` standard errors with a strength that was fitted to the others.
        """
        nothing, rows = np.zeros(TERMS), [row for row in self._equations(progress) if row[2] > 0]
        if len(rows) < MIN_VIEWS:
            return Strength(nothing, 0.0, 0.0, 0)
        normal, right, before = (np.array(part) for part in zip(*rows, strict=True))
        taken = np.zeros(len(rows))
        for i in range(len(rows)):
            beta = _solved(normal.sum(0) - normal[i], right.sum(0) - right[i])
            taken[i] = (2 * beta @ right[i] - beta @ normal[i] @ beta) / before.mean()
        share, error = float(taken.mean()), float(taken.std(ddof=1) / np.sqrt(len(taken)))
        helps = share > 0 and share > SIGNIFICANT * error
        return Strength(_solved(normal.sum(0), right.sum(0)) if helps else nothing, share, error, len(rows))

    def _equations(self, progress: Callable[[int, int], None]) -> Iterator[tuple[NDArray, NDArray, float]]:
        """Normal matrix (5, 5), right-hand side (5,) and sum of squares of photographs, with the terms of the others."""
        chosen = np.unique(np.linspace(0, len(self.views) - 1, min(len(self.views), MOST_VIEWS)).round().astype(int))
        for done, number in enumerate(chosen):
            progress(done, len(chosen))
            view = self.views[number]
            own, ratio = view.levels[-1], view.levels[-1].ratio.astype(np.float64)
            x, weight = self.terms(view.eye, own.block, number), view.weight.astype(np.float64)
            normal = np.einsum("ncp,ncq,nc->pq", x, x, weight)
            yield normal, np.einsum("ncp,nc->p", x, weight * ratio), float((weight * ratio**2).sum())

    def factor(self, eye: NDArray, cell: NDArray, beta: NDArray, without: int | None = None) -> NDArray:
        """Return the factor (n, 3) on the re-rendering of surface cells (n,) that are seen from a place; 1 where beta is 0."""
        if not beta.any():
            return np.ones((len(cell), 3))
        block, row = np.unique(self.blocks.of_cell[-1][cell], return_inverse=True)
        return np.exp(np.clip(self.terms(np.asarray(eye, np.float64), block, without) @ beta, -LARGEST, LARGEST))[row]


def _solved(normal: NDArray, right: NDArray) -> NDArray:
    """The strength in [0, 1] that minimises beta N beta - 2 beta r; 0 of a term that no photograph has."""
    scale = np.diagonal(normal).max()
    if scale <= 0:
        return np.zeros(len(right))
    # A little weight on 0 decides where photographs do not. With N + ridge = R^T R this is |R beta - q|^2, R^T q = r.
    root = np.linalg.cholesky(normal + _RIDGE * scale * np.eye(len(right))).T
    return lsq_linear(root, np.linalg.solve(root.T, right), (0.0, 1.0), method="bvls").x


def _rows(known: NDArray, wanted: NDArray) -> tuple[NDArray, NDArray]:
    """Rows of `wanted` in the ascending `known`, of those that are there, and where these are in `wanted`."""
    row = np.minimum(np.searchsorted(known, wanted), max(len(known) - 1, 0))
    found = np.flatnonzero(known[row] == wanted) if len(known) else np.zeros(0, np.int64)
    return row[found], found


def _sums(row: NDArray, values: NDArray, count: int) -> NDArray:
    return np.stack([np.bincount(row, values[:, channel], count) for channel in range(3)], 1)
