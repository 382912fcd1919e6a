"""Which pixels enter the linear system of emission, and what they show (docs/method/light.md#rows)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from iif_core.numerics.rows import Rows

TILE_PIXELS = 8
"""Pixels of one object in one tile of this edge are averaged into one row, or in a larger one of PIXELS_PER_TILE."""
PIXELS_PER_TILE = 2.4
"""Pixels that are traced for each tile, or more. The noise of a row is the noise of their mean, however large a photograph is."""
FULL_COVERAGE = 0.95
"""Share of a pixel from which an emitter counts as filling it."""
COVERAGE_ERROR = 0.05
"""By which shares of pixels may be wrong: few rays, and edges of a mesh that are not quite where the photograph has them."""
HIGH_BOUND = 0.9
"""Quantile of the lower bounds of a lamp that its radiance exceeds for certain; the highest few may be noise."""
BLOCKED = 0.5
"""Share of that quantile below which a view shows something before the lamp."""
ANCHOR_PIXELS = 64
"""At least this many directly seen pixels of each group enter the solve."""


@dataclass(frozen=True, kw_only=True)
class EmissionPixels(Rows):
    """The pixels whose transport is traced, n of them.

    Attributes:
        radiance: (n, 3) linear; bound: (n, 3) bool, `radiance` is a lower bound.
        object_id, view, tile: (n,) int; pixels that agree in all three are averaged.
        group: (n,) emitter group that the pixel looks at, -1 = none.
        coverage: (n, G) share of each pixel in which it sees each group; None = every pixel sees the group of its middle, or
            none. A pane behind blinds fills its pixels only in part.
        rest: largest radiance of what shares a pixel with an emitter and is none itself.
    """

    radiance: np.ndarray
    bound: np.ndarray
    object_id: np.ndarray
    view: np.ndarray
    tile: np.ndarray
    group: np.ndarray
    coverage: np.ndarray | None = None
    rest: float = 0.0

    def direct(self, groups: int) -> np.ndarray:
        """(n, groups) share of each pixel that looks at an emitter in which it sees each group; 0 for the others."""
        own = np.flatnonzero(self.group >= 0)
        out = np.zeros((len(self.group), groups), np.float32)
        if self.coverage is None:
            out[own, self.group[own]] = 1.0
        else:
            out[own, : self.coverage.shape[1]] = self.coverage[own]
        return out

    def with_majority(self) -> EmissionPixels:
        """Return the pixels; where most of those of a group are lower bounds in a channel, the others are too.

        Compression, blur, noise and wrong poses lower some of the pixels of a saturated lamp to below saturation. They would be
        taken for its radiance, against everything that the other pixels say; what they show is still less than it. A shorter
        exposure shows the radiance itself, which no bound exceeds: views that have no bound in the channel, and a median of at
        least the `HIGH_BOUND` quantile of the bounds, stay as they are. A view that has less than `BLOCKED` of that in any such
        channel shows something before the lamp that the mesh lacks.
        """
        bound = self.bound.copy()
        for group in np.unique(self.group[self.group >= 0]):
            own = np.flatnonzero(self.group == group)
            known, shown = self.bound[own], self.radiance[own]
            mostly = np.flatnonzero(2 * known.sum(0) > len(own))
            least = np.array([np.quantile(shown[known[:, c], c], HIGH_BOUND) for c in mostly])
            for view in np.unique(self.view[own]):
                here = self.view[own] == view
                has_bound, median = known[here][:, mostly].any(0), np.median(shown[here][:, mostly], 0)
                is_blocked = (~has_bound & (median < BLOCKED * least)).any()
                bound[np.ix_(own[here], mostly)] |= has_bound | (median < least) | is_blocked
        return replace(self, bound=bound)

    @property
    def own_share(self) -> np.ndarray:
        """(n,) share of each pixel in which it sees the group of its middle; 1 for pixels that look at none."""
        if self.coverage is None or not self.coverage.shape[1]:
            return np.ones(len(self.group))
        # -1 reads column 0, which the last line replaces by 1.
        own = np.take_along_axis(self.coverage, np.maximum(self.group, 0)[:, None], 1)[:, 0]
        return np.where(self.group >= 0, own, 1.0)

    @property
    def partial(self) -> np.ndarray:
        """(n,) bool: the pixel looks at a group that fills less than `FULL_COVERAGE` of it."""
        return self.own_share < FULL_COVERAGE


def choose_pixels(
    group: np.ndarray, usable: np.ndarray, interior: np.ndarray, elsewhere: int, per_group: int, rng: np.random.Generator
) -> np.ndarray:
    """Draw pixels of one view: some that look at no emitter, and some for every emitter group in sight.

    Every pixel draws a number, and those with the smallest ones are taken, so that a pixel more or less in the view or in a group
    changes the choice by one pixel (docs/method/numerics.md#random-numbers-that-shift).

    Args:
        group: (n,) int emitter group that each pixel looks at, -1 = none.
        usable: (n,) bool.
        interior: (n,) bool, away from the borders of objects; border pixels are drawn only for groups without others.
        elsewhere: pixels to draw that look at no emitter.
        per_group: pixels to draw of every group.
        rng: random numbers.

    Returns:
        Indices of the chosen pixels, increasing.
    """
    on_emitter, drawn = np.flatnonzero(usable & (group >= 0)), rng.random(len(group))

    def some(pixels: np.ndarray, count: int) -> np.ndarray:
        return pixels[np.argsort(drawn[pixels], kind="stable")[:count]]

    chosen = [some(np.flatnonzero(usable & (group < 0)), elsewhere)]
    for g in np.unique(group[on_emitter]):
        own = on_emitter[group[on_emitter] == g]
        inner = own[interior[own]]
        chosen.append(some(inner if len(inner) else own, per_group))
    return np.sort(np.concatenate(chosen))


def row_tile(pixels: int, traced: int) -> int:
    """Return the edge in pixels of the tiles of a photograph of so many pixels, of which `traced` are rows.

    >>> row_tile(192 * 192, 40000 // 24), row_tile(512 * 512, 80000 // 25), row_tile(512 * 512, 80000 // 200)
    (8, 14, 40)
    """
    return max(TILE_PIXELS, round((PIXELS_PER_TILE * pixels / traced) ** 0.5))


def tile_of(index: np.ndarray, width: int, edge: int = TILE_PIXELS) -> np.ndarray:
    """Return (n,) int, the tile with edges of `edge` pixels; index (n,) is flattened, of an image of `width` columns.

    >>> tile_of(np.array([0, 7, 8, 160]), 20).tolist()
    [0, 0, 1, 3]
    """
    row, column = index // width, index % width
    return (row // edge) * (-(-width // edge)) + column // edge
