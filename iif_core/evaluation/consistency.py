"""Scores without ground truth: shading left in albedo, agreement between views, and the gain of a held-out photograph.

All are sums over pixels to which views are added one after another (docs/method/evaluation.md#scores-without-truth).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

DARKEST = 1e-3
"""Albedo and light are raised to this value; the logarithm of smaller values is noise."""
GAIN_STOPS = 6.0
"""The gain of a held-out photograph is searched within this many stops of the ratio of medians."""


@dataclass(frozen=True)
class ShadingScore:
    """Result of `ShadingLeft`; both scores are 0 where light or albedo does not change inside any object.

    Attributes:
        correlation: in [-1, 1]; slope: of log albedo over log light inside objects; pixels: number of pixels.
    """

    correlation: float
    slope: float
    pixels: int


class ShadingLeft:
    """How much of the variation of the light inside objects remains in an albedo (Eq. E.14).

    With x = log light and y = log albedo (means of the three channels' logs), each less its mean in the pixel's object,

        correlation = sum x y / sqrt(sum x^2 sum y^2),      slope = sum x y / sum x^2

    over all pixels, so objects count by their pixels and by the variation of the light. A photograph used as albedo has slope 1;
    the correct albedo has 0, unless texture follows the light by chance.
    """

    def __init__(self) -> None:
        self.sums = np.zeros((0, 6))  # pixels, x, y, x^2, y^2, x y

    def add(self, albedo: NDArray, light: NDArray, object_id: NDArray) -> None:
        """Add the pixels of one view: linear albedo and diffuse light (n, 3), object (n,) int; -1 is ignored."""
        object_id = np.asarray(object_id, np.int64)
        use = (object_id >= 0) & np.isfinite(albedo).all(-1) & np.isfinite(light).all(-1)
        y, x = (np.log(np.maximum(np.asarray(v, np.float64)[use], DARKEST)).mean(-1) for v in (albedo, light))
        own = object_id[use]
        count = max(len(self.sums), int(own.max(initial=-1)) + 1)
        sums = np.zeros((count, 6))
        sums[: len(self.sums)] = self.sums
        for i, values in enumerate((np.ones_like(x), x, y, x * x, y * y, x * y)):
            sums[:, i] += np.bincount(own, values, count)
        self.sums = sums

    def finish(self) -> ShadingScore:
        """Return the score over everything that was added."""
        n = np.maximum(self.sums[:, 0], 1)
        _, x, y, xx, yy, xy = self.sums.T
        xx, yy, xy = (float(s.sum()) for s in (xx - x * x / n, yy - y * y / n, xy - x * y / n))
        pixels = int(self.sums[:, 0].sum())
        tiny = 1e-9 * max(pixels, 1)
        if xx <= tiny or yy <= tiny:
            return ShadingScore(0.0, 0.0, pixels)
        return ShadingScore(float(np.clip(xy / np.sqrt(xx * yy), -1, 1)), xy / xx, pixels)


class ViewSpread:
    """Standard deviation of log albedo over the views of a surface cell, pooled over cells that several views see (Eq. E.15).

    sqrt( sum_cells sum_views |m_cv - m_c|^2 / (3 sum_cells (views_c - 1)) ),     m_cv = mean of log albedo, (3,)
    """

    def __init__(self) -> None:
        self.keys, self.sums = np.zeros(0, np.uint64), np.zeros((0, 5))  # views, sum of means (3), sum of their squares

    def add(self, albedo: NDArray, cell: NDArray) -> None:
        """Add the pixels of one view: linear albedo (n, 3), key of the surface cell (n,) uint64 (`cells.pack_keys`)."""
        use = np.isfinite(albedo).all(-1)
        keys, index = np.unique(np.asarray(cell, np.uint64)[use], return_inverse=True)
        log = np.log(np.maximum(np.asarray(albedo, np.float64)[use], DARKEST))
        count = np.bincount(index.ravel(), minlength=len(keys))[:, None]
        mean = np.stack([np.bincount(index.ravel(), log[:, c], len(keys)) for c in range(3)], 1) / np.maximum(count, 1)
        rows = np.concatenate([np.ones_like(count), mean, (mean**2).sum(1, keepdims=True)], 1)
        self.keys, place = np.unique(np.r_[self.keys, keys], return_inverse=True)
        sums = np.zeros((len(self.keys), 5))
        place, known = place.ravel(), len(self.sums)
        sums[place[:known]] = self.sums
        sums[place[known:]] += rows  # no key twice
        self.sums = sums

    def finish(self) -> float | None:
        """Return the spread; None if no cell was seen twice."""
        twice = self.sums[self.sums[:, 0] >= 2]
        if not len(twice):
            return None
        views = twice[:, 0]
        variance = twice[:, 4] - (twice[:, 1:4] ** 2).sum(1) / views
        return float(np.sqrt(max(float(variance.sum()), 0.0) / (3 * float((views - 1).sum()))))


def held_out_gain(
    radiance: NDArray, photo: NDArray, mask: NDArray, response: Callable[[NDArray], NDArray], per_channel: bool = False
) -> NDArray:
    """Estimate the gains of one held-out photograph for scoring: argmin over g of sum |f(clip(g L, 0, 1)) - I|^2 (Eq. E.17).

    The search uses a grid of 1/4 stop within GAIN_STOPS of the ratio of medians, then golden section.

    Args:
        radiance: (H, W, 3) of the re-rendering.
        photo: (H, W, 3) sensor values.
        mask: (H, W) bool, pixels that count.
        response: f on (n, 3), each channel by itself.
        per_channel: one gain per channel, for a camera with automatic white balance, instead of one.

    Returns:
        (3,) gains > 0; 1 where no pixel counts or the re-rendering is black.
    """
    light, value = np.asarray(radiance, np.float64)[mask], np.asarray(photo, np.float64)[mask]
    if not len(light) or not np.median(light) > 0:
        return np.ones(3)

    def error(stops: NDArray) -> NDArray:
        own = ((response(np.clip(start * 2**stops * light, 0, 1)) - value) ** 2).mean(0)
        return own if per_channel else np.full(3, own.mean())

    # In usual responses the sensor value 0.5 is about 0.2 of the full radiance.
    start = max(float(np.median(value)), 1e-3) ** 2.2 / float(np.median(light))
    grid = np.arange(-GAIN_STOPS, GAIN_STOPS + 0.125, 0.25)
    best = grid[np.argmin([error(np.full(3, s)) for s in grid], axis=0)]
    low, high, golden = best - 0.25, best + 0.25, (5**0.5 - 1) / 2
    for _ in range(24):
        a, b = high - golden * (high - low), low + golden * (high - low)
        left = error(a) <= error(b)
        low, high = np.where(left, low, a), np.where(left, b, high)
    return start * 2 ** (0.5 * (low + high))
