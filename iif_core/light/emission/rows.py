"""Rows of the linear system: what pixels show, and two noisy estimates of how emitters make them show it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from iif_core.errors import InputError


@dataclass(frozen=True)
class EmissionRows:
    """Rows of the linear system; G groups, three channels that decouple.

    Attributes:
        first, second: (n, G, 3) float32, two independent estimates of A (`second` may be `first` when A is exact).
        target, target_second: (n, 3) observed radiance minus h of the same two estimates. h and A of one trace
            share their noise, so the right-hand side crosses them too: b = (A1' W t2 + A2' W t1) / 2.
        weight: (n, 3) >= 0, weight of the squared residual.
        lower_bound: (n, 3) bool: the sensor was saturated, the target is a lower bound and only a prediction below
            it counts.
        cluster: (n,) int, rows with the same number >= 0 may err together (one object in one view: its albedo is off);
            -1 or None = alone.
        noise: (n,) > 0, relative size of the noise of one pixel of a row (radiance, up to a common factor that the
            residuals tell): how sharp a bound is, and what the weights are relative to. None = bounds are exact.
    """

    first: np.ndarray
    second: np.ndarray
    target: np.ndarray
    target_second: np.ndarray
    weight: np.ndarray
    lower_bound: np.ndarray
    cluster: np.ndarray | None = None
    noise: np.ndarray | None = None

    def __post_init__(self) -> None:
        n, groups = self.first.shape[:2]
        shapes = {"first": (n, groups, 3), "second": (n, groups, 3)}
        shapes |= dict.fromkeys(("target", "target_second", "weight", "lower_bound"), (n, 3))
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise InputError(f"emission rows: {name} has shape {getattr(self, name).shape}, needed {shape}")

    @property
    def groups(self) -> int:
        return self.first.shape[1]

    @property
    def mean_target(self) -> np.ndarray:
        return 0.5 * (self.target + self.target_second)

    def columns(self, keep: np.ndarray) -> EmissionRows:
        """The system of a subset of the groups."""
        return replace(self, first=self.first[:, keep], second=self.second[:, keep])


def block_rows(rows: EmissionRows, block: np.ndarray) -> EmissionRows:
    """Averages of the rows of each block: the answer is the same, the noise of A falls with the block's size.

    Args:
        rows: pixel rows.
        block: (n,) int; pixels of one block should see one object in one small tile of one view (rows of different
            objects
            must not be averaged: they differ for a reason). Lower bounds and equalities never mix.

    Returns:
        Rows in order of block number; weight is the sum of the weights, target and A are weighted means per channel.
    """
    if not len(block):
        return rows
    code = rows.lower_bound @ np.array([1, 2, 4])
    order = np.lexsort((code, block))
    key = np.asarray(block, np.int64)[order] * 8 + code[order]
    starts = np.flatnonzero(np.r_[True, np.diff(key) != 0])
    size = np.diff(np.r_[starts, len(key)])
    omega = rows.weight[order].astype(np.float64)
    total = np.add.reduceat(omega, starts, 0)
    # A block whose weights are all 0 keeps weight 0; its mean is then a plain one.
    share = np.where(np.repeat(total > 0, size, 0), omega / np.maximum(np.repeat(total, size, 0), 1e-300), 0.0)
    share = share.astype(np.float32)

    def mean(values: np.ndarray) -> np.ndarray:
        return np.add.reduceat(values[order] * (share[:, None] if values.ndim == 3 else share), starts, 0)

    return EmissionRows(
        mean(rows.first),
        mean(rows.second),
        mean(rows.target),
        mean(rows.target_second),
        total,
        rows.lower_bound[order][starts],
    )


@dataclass(frozen=True)
class GlossRows:
    """The part of A and h (as in `EmissionRows`, n rows in the same order) that the specular lobe reflects.

    Attributes:
        first, second: (n, G, 3); cached, cached_second: (n, 3).
    """

    first: np.ndarray
    second: np.ndarray
    cached: np.ndarray
    cached_second: np.ndarray


def scale_rows(
    rows: EmissionRows,
    observed: np.ndarray,
    gain: np.ndarray,
    gloss: GlossRows | None = None,
    gloss_gain: np.ndarray | None = None,
) -> EmissionRows:
    """The system for materials that reflect `gain` times as much: A and h are scaled, the observation is not.

    Args:
        observed: (n, 3) radiance y, so that h = y - target; gain: (n, 3) > 0.
        gloss: this part is scaled by gloss_gain (n,) instead.
    """
    factor = gain[:, None].astype(np.float32)
    first, second = rows.first * factor, rows.second * factor
    cached, cached_second = gain * (observed - rows.target), gain * (observed - rows.target_second)
    if gloss is not None and gloss_gain is not None:
        more = gloss_gain[:, None] - gain
        first, second = (a + more[:, None].astype(np.float32) * s for a, s in ((first, gloss.first), (second, gloss.second)))
        cached, cached_second = cached + more * gloss.cached, cached_second + more * gloss.cached_second
    return replace(rows, first=first, second=second, target=observed - cached, target_second=observed - cached_second)
