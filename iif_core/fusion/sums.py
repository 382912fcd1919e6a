"""Sums by segment and by cell that the direct solver keeps between its passes, and the state that a sweep changes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from iif_core.errors import InputError
from iif_core.fusion import kernels
from iif_core.fusion.blocks import Block
from iif_core.fusion.options import FusionOptions
from iif_core.reflectance.material import IDENTITY, PROPERTIES

PROPERTY_OF_ENTRY = np.repeat([0, 1, 2], [12, 2, 2])  # of the CROSS layout
_GRAM_4 = np.array([[0, 1, 2, 6], [1, 3, 4, 7], [2, 4, 5, 8], [6, 7, 8, 13]])  # where a 4x4 entry is in the GRAM layout
_GRAM_R = np.array([[9, 10], [10, 13]])
_GRAM_M = np.array([[11, 12], [12, 13]])
NO_MASK = np.zeros((0, 0), bool)


class SegmentState:
    """What a sweep changes: affine maps (S, K, CROSS), selection weights alpha and errors (S, K, 3), all float64."""

    def __init__(self, n_segments: int, k: int):
        self.affine = np.tile(IDENTITY, (n_segments, k, 1))
        self.alpha = np.zeros((n_segments, k, 3))
        self.error = np.zeros((n_segments, k, 3))


class SegmentSums:
    """What no sweep changes: Gram matrices of every segment and prediction and the regularised inverses (Eq. F.25).

    `covisibility` (n_cells,): factor on the weight of a cell's pixels in the fit of the maps.
    """

    def __init__(self, n_segments: int, k: int, covisibility: NDArray):
        self.covisibility = covisibility
        self.weight = np.zeros(n_segments)
        self.gram = np.zeros((n_segments, k, kernels.GRAM))
        self.usable = np.zeros((n_segments, k), bool)
        self.masked = np.zeros((n_segments, k), bool)  # whose albedo map is fitted without clipped pixels
        self.ridge = np.zeros(n_segments)
        self.inverse = (np.zeros((n_segments, k, 4, 4)), np.zeros((n_segments, k, 2, 2)), np.zeros((n_segments, k, 2, 2)))

    def fit_weight(self, block: Block) -> NDArray:
        """Return the weight (n,) float32 of the pixels of a view in the fit of the maps (Eq. F.24)."""
        return block.weight * self.covisibility[block.cell]

    def add(self, block: Block, options: FusionOptions) -> None:
        """Add the segments of one view; raises InputError for a segment that another view has already added."""
        rows = block.segments
        if not len(rows):
            return
        if (self.weight[rows] > 0).any():
            segment = rows[np.argmax(self.weight[rows] > 0)]
            raise InputError(f"segment {segment} has pixels in two views; a segment is one object in one view")
        weight = self.fit_weight(block)
        gram = kernels.gram(block.values, weight, block.start, NO_MASK)
        # The summed weight is the same for all predictions: one that is unusable has values 0, but its pixels keep their weight.
        self.gram[rows], self.weight[rows], self.usable[rows] = gram, gram[:, 0, 13], block.usable
        fit = gram
        if block.inside.size:
            count = np.diff(block.start)
            # Pixels (s, K) that are not clipped. Every segment of a block has a pixel; `reduceat` would return a single element
            # for an empty one.
            remain = np.add.reduceat(block.inside, block.start[:-1], axis=1, dtype=np.int64).T
            enough = (remain >= options.clip_pixels) & (remain >= (1 - options.clip_share) * count[:, None])
            self.masked[rows] = block.usable & enough & (remain < count[:, None])
            fit = np.where(self.masked[rows][..., None], kernels.gram(block.values, weight, block.start, block.inside), gram)
        few = np.maximum(1, options.ridge_pixels / np.diff(block.start))  # Eq. F.26
        self.ridge[rows] = options.ridge * self.weight[rows] * few
        # The sweeps change the right-hand side alone, so the inverse is formed once and a sweep multiplies (Eq. F.25). Values lie
        # in [0, 1]: the eigenvalues of G are at most 4 W, the ridge adds at least rho W, and the condition number is at most 1 +
        # 4/rho.
        for out, where, source in zip(self.inverse, (_GRAM_4, _GRAM_R, _GRAM_M), (fit, gram, gram), strict=True):
            out[rows] = np.linalg.inv(source[..., where] + self.ridge[rows, None, None, None] * np.eye(len(where)))

    def corrections(self, rows: NDArray, cross: NDArray, cross_albedo: NDArray) -> NDArray:
        """Fit the maps (s, K, CROSS) of the segments `rows` by ridge regression (Eq. F.25) from products with the texture.

        `cross` (s, K, CROSS) over all pixels; `cross_albedo`: the same over the pixels that the albedo map is fitted to.
        """
        ridge = self.ridge[rows, None, None]
        out = np.empty(cross.shape)
        right = cross_albedo[..., :12] + ridge * IDENTITY[:12]  # c + lambda T_id, times the symmetric inverse
        out[..., :12] = (right.reshape(*right.shape[:2], 3, 4) @ self.inverse[0][rows]).reshape(*right.shape)
        for part, inverse in ((slice(12, 14), self.inverse[1]), (slice(14, 16), self.inverse[2])):
            right = cross[..., part] + ridge * IDENTITY[part]
            out[..., part] = (right[..., None, :] @ inverse[rows])[..., 0, :]
        return out

    def errors(self, rows: NDArray, affine: NDArray, cross: NDArray, square: NDArray) -> NDArray:
        """Return the mean squared errors of corrected predictions against the texture, from sums (Eq. F.27).

        Args:
            rows: (s,) segments; affine: (s, K, CROSS) maps; cross: (s, K, CROSS) and square: (s, 5) of the kernels.

        Returns:
            (s, K, 3) float64.
        """
        gram, weight = self.gram[rows], self.weight[rows, None]  # over all pixels, whatever the map was fitted to
        out = np.zeros((*affine.shape[:2], 3))
        for p, part, where in ((0, slice(0, 12), _GRAM_4), (1, slice(12, 14), _GRAM_R), (2, slice(14, 16), _GRAM_M)):
            channels = 3 if p == 0 else 1
            t = affine[..., part].reshape(*affine.shape[:2], channels, len(where))
            c = cross[..., part].reshape(t.shape)
            # sum_c T_c G T_c' - 2 T_c c_c', (s, K). A difference of large sums: rounding can leave a tiny negative error.
            total = (t @ gram[..., where] * t).sum((-1, -2)) - 2 * (t * c).sum((-1, -2))
            total += square[:, :3].sum(1)[:, None] if p == 0 else square[:, p + 2][:, None]
            out[..., p] = np.maximum(total / (channels * weight), 0)
        return out


class CellSums:
    """Weighted sums per cell and channel, added in pixel order, so that the bytes do not depend on threads."""

    def __init__(self, n_cells: int):
        self.sum = np.zeros((n_cells, 5))
        self.total = np.zeros((n_cells, 5))

    def add(self, cell: NDArray, value: NDArray, weight: NDArray) -> None:
        """Add pixels: `cell` (n,), `value` (5, n), `weight` (n,), or (5, n) by channel."""
        kernels.add_to_cells(self.total, self.sum, cell, value, np.atleast_2d(weight))

    def mean(self, fallback: NDArray) -> NDArray:
        """Return the weighted mean (n_cells, 5) float32; cells without weight take the fallback."""
        return kernels.cell_means(self.total, self.sum, np.broadcast_to(fallback, self.sum.shape))


@dataclass
class CellCounts:
    """Per cell: pixels, views, different viewpoints (int32), summed weight of the pixels (float64)."""

    observations: NDArray
    views: NDArray
    viewpoints: NDArray
    weight: NDArray


def sweep_summary(sums: SegmentSums, state: SegmentState) -> dict[str, float]:
    """Return the error of each property after selection, the entropy of the selection in nats and the mean gain.

    All are weighted by pixels. The gain, tr(A) / 3 of the selected albedo maps, shows whether the contrast of the texture
    collapses (docs/method/numerics.md#collapse-of-contrast).
    """
    total = max(sums.weight.sum(), 1e-30)
    mixed = (sums.weight[:, None] * (state.alpha * state.error).sum(1)).sum(0) / total
    log = np.log(np.where(state.alpha > 0, state.alpha, 1.0))  # 0 log 0 = 0
    entropy = -(sums.weight * (state.alpha * log).sum(1).mean(1)).sum() / total
    gains = (state.alpha[..., 0] * state.affine[..., [0, 5, 10]].mean(-1)).sum(1)
    gain = (sums.weight * gains).sum() / total
    errors = {f"error_{name}": float(mixed[p]) for p, name in enumerate(PROPERTIES)}
    return {**errors, "entropy": float(entropy) + 0.0, "gain": float(gain)}  # + 0.0: no minus zero
