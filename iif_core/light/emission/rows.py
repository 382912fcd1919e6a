"""Rows of the linear system y = A E + h: what averaged pixels show, and two independent traces of how they are lit
(docs/method/light.md#rows)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from iif_core.errors import InputError


@dataclass(frozen=True)
class TracedTransport:
    """A and h (Eq. L.13) of n points, from two independent traces (first axis).

    Attributes:
        matrix: (2, L, n, G, 3) float32. The second axis is the lobe: 0 = what is proportional to the albedo (the diffuse lobe,
            and the specular lobe of metals), 1 = the specular lobe of dielectrics; L = 1: both together.
        cached: (2, L, n, 3) radiance that was photographed where it was last reflected.
    """

    matrix: np.ndarray
    cached: np.ndarray

    def take(self, keep: np.ndarray) -> TracedTransport:
        """Return some of the points."""
        return TracedTransport(self.matrix[:, :, keep], self.cached[:, :, keep])

    def without_lobes(self) -> TracedTransport:
        """Add the lobes up."""
        return TracedTransport(self.matrix.sum(1, keepdims=True), self.cached.sum(1, keepdims=True))


@dataclass(frozen=True)
class EmissionRows:
    """Rows of the linear system; the three channels are independent of each other.

    Attributes:
        matrix: (2, L, n, G, 3), cached: (2, L, n, 3) as in `TracedTransport`. The two traces may be the same array when A is
            exact. A and h of one trace share their noise, so the right-hand side of the normal equations crosses the traces
            as well (Eq. L.22).
        observed: (n, 3) radiance y; a row asks for A E = y - h.
        weight: (n, 3) >= 0, weight of the squared residual.
        lower_bound: (n, 3) bool: the sensor was saturated, y is a lower bound and only a prediction below it counts.
        cluster: (n,) int, rows with the same number >= 0 may err together (one object in one view: its albedo is off); -1 or
            None = independent.
        noise: (n,) > 0, relative size of the noise of one pixel of a row (nu of Eq. L.15). None = bounds are exact.
    """

    matrix: np.ndarray
    observed: np.ndarray
    cached: np.ndarray
    weight: np.ndarray
    lower_bound: np.ndarray
    cluster: np.ndarray | None = None
    noise: np.ndarray | None = None

    def __post_init__(self) -> None:
        lobes, n, groups = self.matrix.shape[1:4]
        shapes = {"matrix": (2, lobes, n, groups, 3), "cached": (2, lobes, n, 3)}
        shapes |= dict.fromkeys(("observed", "weight", "lower_bound"), (n, 3))
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise InputError(f"emission rows: {name} has shape {getattr(self, name).shape}, needed {shape}")

    @property
    def groups(self) -> int:
        return self.matrix.shape[3]

    @property
    def has_lobes(self) -> bool:
        """The specular lobe of dielectrics is kept apart."""
        return self.matrix.shape[1] == 2

    @property
    def matrices(self) -> np.ndarray:
        """(2, n, G, 3) A of both traces, all lobes together."""
        return self.matrix.sum(1) if self.has_lobes else self.matrix[:, 0]

    @property
    def targets(self) -> np.ndarray:
        """(2, n, 3) what emission must explain in both traces: y - h."""
        return self.observed - self.cached.sum(1)

    @property
    def mean_target(self) -> np.ndarray:
        """(n, 3) mean of the two targets."""
        return self.targets.mean(0)

    def take(self, keep: np.ndarray) -> EmissionRows:
        """Return some of the rows."""
        rows = {name: getattr(self, name) for name in _OF_ROW if getattr(self, name) is not None}
        traces = {name: getattr(self, name)[:, :, keep] for name in _OF_TRACE}
        return replace(self, **traces, **{name: value[keep] for name, value in rows.items()})

    def beside(self, other: EmissionRows) -> EmissionRows:
        """These rows, followed by others of the same groups; both must know clusters and noise, or neither."""
        traces = {name: np.concatenate([getattr(self, name), getattr(other, name)], 2) for name in _OF_TRACE}
        names = [name for name in _OF_ROW if getattr(self, name) is not None]
        return replace(self, **traces, **{name: np.concatenate([getattr(self, name), getattr(other, name)]) for name in names})

    def columns(self, keep: np.ndarray) -> EmissionRows:
        """The system of a subset of the groups, a mask (G,)."""
        return replace(self, matrix=self.matrix[:, :, :, keep])

    def without_lobes(self) -> EmissionRows:
        """Add the lobes up."""
        return replace(self, matrix=self.matrix.sum(1, keepdims=True), cached=self.cached.sum(1, keepdims=True))

    def scaled(self, gain: np.ndarray, gloss_gain: np.ndarray) -> EmissionRows:
        """Rows, lobes added up, of materials whose albedo lobe reflects `gain` (n, 3) > 0 times as much and whose gloss reflects
        `gloss_gain` (n,) >= 0 times as much; without lobes `gain` holds for everything. The observation is not scaled."""
        factors = (gain, np.repeat(gloss_gain[:, None], 3, 1))[: self.matrix.shape[1]]
        matrix = sum(factor[:, None].astype(np.float32) * self.matrix[:, lobe] for lobe, factor in enumerate(factors))
        cached = sum(factor * self.cached[:, lobe] for lobe, factor in enumerate(factors))
        return replace(self, matrix=matrix[:, None], cached=cached[:, None])


_OF_TRACE = ("matrix", "cached")
_OF_ROW = ("observed", "weight", "lower_bound", "cluster", "noise")


def light_of(matrix: np.ndarray, radiance: np.ndarray) -> np.ndarray:
    """Return A E for each channel, (..., 3) float64: matrix (..., G, 3), radiance (G, 3).

    One matrix product over groups and channels; `einsum` with the channels innermost takes up to four times as long.
    """
    groups = matrix.shape[-2]
    # (3 G, 3): column c holds E of channel c in the rows of that channel and 0 elsewhere, so one product serves all channels.
    spread = np.zeros((groups, 3, 3))
    spread[:, range(3), range(3)] = radiance
    spread, flat = spread.reshape(3 * groups, 3), matrix.reshape(int(np.prod(matrix.shape[:-2])), 3 * groups)
    out = np.empty((len(flat), 3))
    for start in range(0, len(flat), _ROWS_AT_ONCE):  # which are converted to float64
        out[start : start + _ROWS_AT_ONCE] = flat[start : start + _ROWS_AT_ONCE] @ spread
    return out.reshape(*matrix.shape[:-2], 3)


_ROWS_AT_ONCE = 2048


def block_rows(rows: EmissionRows, block: np.ndarray) -> tuple[EmissionRows, np.ndarray]:
    """Average the rows of each block (n,) int: the answer stays the same, and the noise of A falls with the size of the block.

    Pixels of one block should see one object in one small tile of one view. Lower bounds and equalities are never mixed. Returns
    the rows in the order of the block numbers (weights are sums) and for each of them the index of a pixel row of its block.
    """
    if not len(block):
        return rows, np.zeros(0, np.int64)
    # Three bits for the channels that are bounds: only rows with the same pattern are averaged.
    code = rows.lower_bound @ np.array([1, 2, 4])
    order = np.lexsort((code, block))
    key = np.asarray(block, np.int64)[order] * 8 + code[order]
    starts = np.flatnonzero(np.r_[True, np.diff(key) != 0])
    size = np.diff(np.r_[starts, len(key)])
    # Sorted rows of a block are neighbours, so sums over blocks are sums between `starts`.
    omega = rows.weight[order].astype(np.float64)
    total = np.add.reduceat(omega, starts, 0)
    # A block whose weights are all 0 keeps weight 0; its mean is then a plain one.
    share = np.where(np.repeat(total > 0, size, 0), omega / np.maximum(np.repeat(total, size, 0), 1e-300), 0.0)
    share = share.astype(np.float32)

    def mean(values: np.ndarray) -> np.ndarray:
        return np.add.reduceat(values[order] * (share[:, None] if values.ndim == 3 else share), starts, 0)

    matrix, cached = (np.array([[mean(lobe) for lobe in trace] for trace in both]) for both in (rows.matrix, rows.cached))
    first = order[starts]
    return EmissionRows(matrix, mean(rows.observed), cached, total, rows.lower_bound[first]), first
