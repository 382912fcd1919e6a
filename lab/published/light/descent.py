"""Emission as the published method finds it: a radiance for every bright triangle, by gradient descent on freshly traced pixels
(lab/docs/published.md#emission).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from iif_core.camera.response import Response

START = 0.01
"""Radiance of every channel of every triangle at first."""
THRESHOLD = 0.99
"""Mean radiance of a triangle, in its brightest channel, above which it is an emitter. `published_repaired`: sensor value
above which a pixel counts as saturated."""
CLAMP = 0.9
"""Sensor value at which prediction and photograph are clamped."""
CACHE_CELLS = 256
"""Voxels of the radiance cache along an axis."""
MARGIN = 0.01
"""Share of its edge by which the bounding cube of the cache is enlarged on each side."""


class Paths(Protocol):
    """Contributions of emitters to the pixels of a batch; see `transport.single_bounce.BouncePaths`."""

    def radiance(self, emission: np.ndarray) -> np.ndarray: ...

    def gradient(self, by_ray: np.ndarray, emitters: int) -> np.ndarray: ...


@dataclass(frozen=True)
class PublishedOptions:
    """Schedule of the published descent.

    Attributes:
        batch: pixels of a step; rate: size of a step; steps: how many, None = one pass over the pixels.
        started: (step, sum of the channels): emitters that have not grown beyond it by that step are switched off.
        bright: (step, share): so are those whose sum of channels is at most this share of the largest.
        seed: of the order of the pixels.
    """

    batch: int = 8192
    rate: float = 100.0
    steps: int | None = None
    started: tuple[int, float] = (100, 0.031)
    bright: tuple[int, float] = (1000, 0.05)
    seed: int = 0

    def total(self, pixels: int) -> int:
        """Return the number of steps for so many pixels."""
        return self.steps or -(-pixels // self.batch)


@dataclass(frozen=True)
class PublishedState:
    """Where a descent is.

    Attributes:
        stored: (G, 3) float64, as the optimiser moves it; keep: (G,) bool, emitters that are not switched off.
        sampling: (G,) how often the triangles of an emitter are drawn, refreshed when emitters are switched off.
        step: steps that were taken; loss: (step,) the loss of each.
    """

    stored: np.ndarray
    keep: np.ndarray
    sampling: np.ndarray
    step: int = 0
    loss: tuple[float, ...] = ()

    @classmethod
    def start(cls, emitters: int) -> PublishedState:
        """Return the state before the first step."""
        return cls(np.full((emitters, 3), START), np.ones(emitters, bool), np.ones(emitters))

    @property
    def radiance(self) -> np.ndarray:
        """(G, 3) float64 radiance: never negative, 0 of emitters that are switched off."""
        return np.maximum(self.stored, 0.0) * self.keep[:, None]


def bright_triangles(mean: np.ndarray, count: np.ndarray, limit: float = THRESHOLD) -> np.ndarray:
    """Return which triangles are emitters, (F,) bool: seen at all, and the mean (F, 3) of what they show above the limit in one
    channel."""
    return (count > 0) & (mean.max(1) > limit)


def bounding_cube(low: float, high: float) -> tuple[float, float]:
    """Return lower corner (of all axes) and voxel edge of the cache, in metres, for the smallest and largest coordinate seen."""
    span = max(high - low, 1e-6)
    low, span = low - MARGIN * span, (1 + 2 * MARGIN) * span
    return low, span / CACHE_CELLS


def clamped_loss(radiance: np.ndarray, exposure: np.ndarray, shown: np.ndarray, response: Response) -> tuple[float, np.ndarray]:
    """Return the loss of a batch and its derivative by the radiance (Eq. T.2).

    Args:
        radiance: (n, 3) predicted, linear; exposure: (n,) of the photographs.
        shown: (n, 3) sensor values of the photographs.
        response: curve of the camera.

    Returns:
        Mean square of the difference of values that are clamped at 0.9, and (n, 3) float64. The derivative is 0 where the
        prediction is clamped.
    """
    x = exposure[:, None] * radiance
    value, slope = response(np.clip(x, 0, 1)), response.derivative(np.clip(x, 0, 1))
    difference = np.minimum(value, CLAMP) - np.minimum(shown, CLAMP)
    inside = (x < 1) & (value < CLAMP)
    return float(np.mean(difference**2)), np.where(inside, 2 * difference * slope * exposure[:, None] / difference.size, 0.0)


def descend(
    state: PublishedState,
    pixels: int,
    trace: Callable[[np.ndarray, PublishedState, int], Paths],
    loss: Callable[[np.ndarray, np.ndarray], tuple[float, np.ndarray]],
    options: PublishedOptions,
) -> Iterator[PublishedState]:
    """Descend from a state to the end of the schedule; yields the state after every step.

    Args:
        state: where to begin. An interrupted descent continues from any yielded state and ends with the same result.
        pixels: number of pixels that can be drawn.
        trace: (pixels (n,), state, step) -> fresh paths of these pixels, to the emitters that the state keeps.
        loss: (pixels (n,), radiance (n, 3)) -> loss and its derivative by the radiance.
        options: the schedule.
    """
    emitters, order, epoch = len(state.keep), np.zeros(0, np.int64), -1
    per_epoch = -(-pixels // options.batch)
    for step in range(state.step, options.total(pixels)):
        if step // per_epoch != epoch:
            epoch = step // per_epoch
            order = np.random.default_rng([0x707562, options.seed, epoch]).permutation(pixels)
        first = step % per_epoch * options.batch
        some = order[first : first + options.batch]
        paths = trace(some, state, step)
        value, by_ray = loss(some, paths.radiance(state.radiance))
        gradient = paths.gradient(by_ray, emitters) * (state.keep[:, None] & (state.stored > 0))
        state = replace(state, stored=state.stored - options.rate * gradient, step=step + 1, loss=(*state.loss, value))
        state = _pruned(state, step, options)
        yield state


def _pruned(state: PublishedState, step: int, options: PublishedOptions) -> PublishedState:
    """Switch emitters off at the two steps of the schedule, unless none would remain, and refresh how often they are drawn."""
    total = state.radiance.sum(1)
    if step == options.started[0]:
        keep = state.keep & (total > options.started[1])
    elif step == options.bright[0]:
        keep = state.keep & (total > options.bright[1] * total.max(initial=0.0))
    else:
        return state
    if not keep.any():
        return state
    state = replace(state, keep=keep)
    return replace(state, sampling=state.radiance.sum(1))
