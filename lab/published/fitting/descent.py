"""The material fit as published: stochastic gradient descent with one step size on the clamped loss of all pixels
(lab/docs/published.md#materials).

It shares no code with the solvers of this project but the response of the camera, so that it can judge them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np

from iif_core.camera.response import Response
from iif_core.fitting.problem import FitProblem, FitResult
from iif_core.reflectance.material import IDENTITY, LOWEST, NUMBERS, unclamped_material
from lab.published.fitting.reference_loss import merged

CLAMP = 0.9
ROUGHNESS_WEIGHT = 1e-3
METALLIC_WEIGHT = 5e-3
_DIVERGED = 1e4


@dataclass(frozen=True)
class PublishedOptions:
    """Schedule of the published descent.

    Attributes:
        rate: size of a step; decay: factor on it after each epoch.
        epochs: passes over the pixels; batch: pixels of a step; seed: of their order.
        free_response: fit the parameters of the response, too.
        steps: steps over all epochs, with as many passes over the pixels as they need; None: one pass an epoch.
    """

    rate: float = 10.0
    decay: float = 0.2
    epochs: int = 3
    batch: int = 32768
    seed: int = 0
    free_response: bool = True
    steps: int | None = None

    def per_epoch(self, pixels: int) -> int:
        """Return the number of steps of an epoch for so many pixels."""
        return (-(-(self.steps or 0) // self.epochs) or -(-pixels // self.batch)) if pixels else 0


@dataclass(frozen=True)
class PublishedState:
    """Where a descent is: affine (O, 16), params (C, P) of the response, steps taken, and the loss of each."""

    affine: np.ndarray
    params: np.ndarray
    step: int = 0
    loss: tuple[float, ...] = ()

    @classmethod
    def start(cls, objects: int, response: Response) -> PublishedState:
        """Return the state before the first step: the identity of every object, and the given response."""
        return cls(np.tile(IDENTITY, (objects, 1)), np.array(response.params, np.float64))


def interpolate_linearly(shading: np.ndarray, levels: np.ndarray, roughness: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return shading (n, J, 3) at any roughness (n,) between levels (J,), and its derivative, (n, 3) float64 each (Eq. T.6)."""
    r = np.clip(roughness, levels[0], levels[-1])
    j = np.clip(np.searchsorted(levels, r, side="right") - 1, 0, len(levels) - 2)
    at = np.arange(len(r))
    low, high = shading[at, j].astype(np.float64), shading[at, j + 1].astype(np.float64)
    span = (levels[j + 1] - levels[j])[:, None]
    slope = (high - low) / span
    return low + (r - levels[j])[:, None] * slope, slope


@dataclass(frozen=True)
class _Prediction:
    """What the model predicts for n pixels, with what its derivatives need.

    difference: (n, 3) clamped prediction minus clamped photograph. owner (n,); base, raw, value: (n, 5) base material, and fitted
    material before and after clamping. d, s0: (n, 3) light; s0_r, s1_r: its slopes in roughness. slope, exposure, by_params: of
    the curve; inside: (n, 3) bool, the prediction is not clamped.
    """

    difference: np.ndarray
    owner: np.ndarray
    base: np.ndarray
    raw: np.ndarray
    value: np.ndarray
    d: np.ndarray
    s0: np.ndarray
    s0_r: np.ndarray
    s1_r: np.ndarray
    slope: np.ndarray
    exposure: np.ndarray
    by_params: np.ndarray
    inside: np.ndarray


def _predicted(problem: FitProblem, rows: np.ndarray, affine: np.ndarray, response: Response) -> _Prediction:
    owner, base = problem.object_id[rows], problem.base[rows].astype(np.float64)
    raw = unclamped_material(affine[owner], base)
    value = np.clip(raw, LOWEST, 1.0)
    a, r, m = value[:, :3], value[:, 3], value[:, 4:]
    d = problem.diffuse[0][rows].astype(np.float64)
    (s0, s0_r), (s1, s1_r) = (interpolate_linearly(part[0][rows], problem.levels, r) for part in (problem.s0, problem.s1))
    exposure = problem.exposure[rows][:, None]
    x = exposure * ((1 - m) * a * d + (0.04 * (1 - m) + m * a) * s0 + s1)
    sensor, slope, by_params = response.evaluate(np.clip(x, 0, 1))
    inside = (x < 1) & (sensor < CLAMP)
    difference = np.minimum(sensor, CLAMP) - np.minimum(problem.value[rows], CLAMP)
    return _Prediction(difference, owner, base, raw, value, d, s0, s0_r, s1_r, slope, exposure, by_params, inside)


def loss_and_gradient(
    problem: FitProblem, rows: np.ndarray, affine: np.ndarray, response: Response
) -> tuple[float, np.ndarray, np.ndarray]:
    """Evaluate the published loss of some pixels (Eq. T.7).

    Args:
        problem: with one half of the cache (`merged`), from photographs of sensor values.
        rows: (n,) pixels, at least one.
        affine: (O, 16) numbers of the objects.
        response: curve of the camera.

    Returns:
        The loss, its gradient by `affine` (O, 16), and by the parameters of the response (in their shape).
    """
    p, n = _predicted(problem, rows, affine, response), len(rows)
    a, r, m = p.value[:, :3], p.value[:, 3], p.value[:, 4:]
    total = np.mean(p.difference**2) + ROUGHNESS_WEIGHT * np.mean(1 - r) + METALLIC_WEIGHT * np.mean(m)
    by_sensor = np.where(p.inside, 2 * p.difference / p.difference.size, 0.0)
    by_light = by_sensor * p.slope * p.exposure
    by_value = np.empty_like(p.value)
    by_value[:, :3] = by_light * ((1 - m) * p.d + m * p.s0)
    by_value[:, 3] = (by_light * ((0.04 * (1 - m) + m * a) * p.s0_r + p.s1_r)).sum(1) - ROUGHNESS_WEIGHT / n
    by_value[:, 4] = (by_light * (-a * p.d + (a - 0.04) * p.s0)).sum(1) + METALLIC_WEIGHT / n
    by_value *= p.raw == p.value  # a clamped number has no gradient
    one, columns = np.ones((n, 1)), np.empty((n, NUMBERS))
    columns[:, :12] = (by_value[:, :3, None] * np.hstack([p.base[:, :3], one])[:, None]).reshape(-1, 12)
    columns[:, 12:14] = by_value[:, 3:4] * np.hstack([p.base[:, 3:4], one])
    columns[:, 14:] = by_value[:, 4:] * np.hstack([p.base[:, 4:], one])
    gradient = np.stack([np.bincount(p.owner, column, len(affine)) for column in columns.T], 1)
    by_response = np.einsum("nc,ncp->cp", by_sensor, p.by_params)
    return float(total), gradient, by_response if response.params.ndim == 2 else by_response.sum(0)


def descend(
    problem: FitProblem, response: Response, state: PublishedState, options: PublishedOptions
) -> Iterator[PublishedState]:
    """Descend from a state to the end of the schedule; yields the state after every epoch.

    An interrupted descent continues from any yielded state and ends with the same result. Numbers beyond 1e4 do not return,
    because the clamps have no gradient. They end the descent, and the last yielded state is the one before.
    """
    n = len(problem.object_id)
    per_epoch = options.per_epoch(n)
    for epoch in range(state.step // max(per_epoch, 1), options.epochs if n else 0):
        affine, params, losses = state.affine, state.params, []
        rate = options.rate * options.decay**epoch
        for rows in islice(_batches(np.random.default_rng([0x616666, options.seed, epoch]), n, options.batch), per_epoch):
            value, by_affine, by_params = loss_and_gradient(problem, rows, affine, replace(response, params=params))
            affine = affine - rate * by_affine
            if options.free_response and params.size:
                params = response.with_params(params - rate * by_params).params
            losses.append(value)
        if not (np.abs(affine).max(initial=0) < _DIVERGED and np.isfinite(params).all()):
            return
        state = PublishedState(affine, params, state.step + per_epoch, (*state.loss, *losses))
        yield state


def _batches(rng: np.random.Generator, n: int, size: int) -> Iterator[np.ndarray]:
    """Yield the sorted pixels of step after step, without end; each pass over the pixels has another order."""
    while True:
        order = rng.permutation(n)
        for first in range(0, n, size):
            yield np.sort(order[first : first + size])


def fit_published(
    problem: FitProblem,
    response: Response,
    options: PublishedOptions | None = None,
    state: PublishedState | None = None,
    keep: Callable[[PublishedState], None] | None = None,
) -> FitResult:
    """Fit like `direct.fit_affines`, from the identity or from a `state`; `history` is the mean loss of the steps of each epoch.

    `keep` is called with the state after each epoch. An interrupted fit continues from it and ends with the same result.
    """
    opt, mean = options or PublishedOptions(), merged(problem)
    seen = mean.object_id >= 0
    used = mean if seen.all() else mean.take(np.flatnonzero(seen))  # a copy may not fit into memory
    n, per_epoch = len(used.object_id), opt.per_epoch(len(used.object_id))
    state = PublishedState.start(problem.n_objects, response) if state is None else state
    for after in descend(used, response, state, opt):
        state = after
        if keep is not None:
            keep(state)
    done, whole = state.step, opt.epochs * per_epoch
    pixels = np.bincount(used.object_id, minlength=problem.n_objects)
    found = replace(response, params=state.params)
    size = state.params.size
    return FitResult(
        affine=state.affine,
        covariance=np.zeros((problem.n_objects, NUMBERS, NUMBERS)),
        free=np.tile(pixels[:, None] > 0, (1, NUMBERS)),
        pixels=pixels,
        residual=_residual(used, state.affine, found, opt.batch),
        model=["published" if count else "identity (0 pixels)" for count in pixels],
        response=found,
        light_scale=1.0,
        history=[float(np.mean(part)) for part in np.split(np.array(state.loss), max(done // max(per_epoch, 1), 1)) if len(part)],
        converged=done == whole,
        response_covariance=np.zeros((size, size)),
        iterations=done,
        reason=f"{whole} steps, {n} pixels" if done == whole else f"diverged after {done} of {whole} steps",
    )


def _residual(problem: FitProblem, affine: np.ndarray, response: Response, batch: int) -> np.ndarray:
    """Return the root of the mean clamped square of each object, without the penalties, (O,)."""
    total, count = np.zeros(len(affine)), np.zeros(len(affine))
    for first in range(0, len(problem.object_id), batch):
        rows = np.arange(first, min(first + batch, len(problem.object_id)))
        difference = _predicted(problem, rows, affine, response).difference
        total += np.bincount(problem.object_id[rows], (difference**2).mean(1), len(affine))
        count += np.bincount(problem.object_id[rows], minlength=len(affine))
    return np.sqrt(total / np.maximum(count, 1))
