"""The paper's optimiser on the same problem: stochastic gradient descent on the reference loss (METHOD 2.8).

One step size for the numbers of all objects and of the response; 3 epochs of batches of 32,768 pixels, x 0.2 after each. The loss
is a mean over pixels, so an object's step is proportional to its share of them. `adam` is the safe variant: steps of one size
whatever the gradient.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from iif_core.camera.response import Response
from iif_core.errors import InputError
from iif_core.fitting import kernels
from iif_core.fitting.descent import Pull, State
from iif_core.fitting.direct import Fit, result_of
from iif_core.fitting.pixels import Pixels, prepare
from iif_core.fitting.problem import IDENTITY, PARAMETERS, FitProblem, FitResult
from iif_core.fitting.reference_loss import reference_loss, reference_options, reference_problem
from iif_core.fitting.selection import texture_of
from iif_core.fitting.tone import Tone

_BETAS = (0.9, 0.999)
_EPSILON = 1e-8
_FAR = 1e4  # numbers beyond this come back from nowhere: the clamp has no gradient


@dataclass(frozen=True)
class SgdOptions:
    """The published schedule.

    Attributes:
        method: `sgd` or `adam`; rate: step size (10; adam 0.01); epochs; batch: pixels; decay: of the rate after each epoch.
        seed: of the order of the pixels; free_response: fit the response too.
        steps: steps over all epochs, for pixels that are a sample of the photographs' (the published 3 epochs are 4,848 steps);
            the sample is gone through as often as that needs. None: what the pixels give.
    """

    method: str = "sgd"
    rate: float | None = None
    epochs: int = 3
    batch: int = 32768
    decay: float = 0.2
    seed: int = 0
    free_response: bool = True
    steps: int | None = None

    def __post_init__(self) -> None:
        if self.method not in ("sgd", "adam"):
            raise InputError(f"solver {self.method!r}; allowed: sgd, adam")


def fit_affines_sgd(problem: FitProblem, response: Response, options: SgdOptions | None = None) -> FitResult:
    """The same result as `fit_affines`, from the identity; `history` is the reference loss before and after each epoch."""
    opt = options or SgdOptions()
    own = reference_problem(problem, response)
    px, tone = prepare(own, response)
    affine = np.tile(IDENTITY, (problem.n_objects, 1))
    params = response.params.ravel().astype(np.float64) if tone.size else np.zeros(0)
    history = [reference_loss(problem, affine, response).total]
    reason, converged = f"{opt.epochs} epochs", True
    rate = opt.rate or (10.0 if opt.method == "sgd" else 1e-2)
    rng = np.random.default_rng([0x736764, opt.seed])
    moments = [np.zeros((problem.n_objects, PARAMETERS + tone.size)) for _ in range(2)]
    step = 0
    for epoch in range(opt.epochs if len(px.obj) else 0):
        for rows in _batches(rng, len(px.obj), opt):
            g, g_w = _gradient(px, rows, affine, tone.at(params), own.n_objects)
            step += 1
            if opt.method == "adam":
                g, g_w = _adam(moments, step, g, g_w)
            affine = affine - rate * opt.decay**epoch * g
            if opt.free_response and tone.size:
                params = tone.at(params - rate * opt.decay**epoch * g_w).response.params.ravel()
        if not (np.abs(affine).max(initial=0) < _FAR and np.isfinite(params).all()):
            reason, converged = f"diverged in epoch {epoch + 1} at step size {rate:g}", False
            affine = np.tile(IDENTITY, (problem.n_objects, 1))
            params = response.params.ravel().astype(np.float64)
            break
        history.append(reference_loss(problem, affine, tone.at(params).response).total)
    texture = texture_of(px, reference_options())
    free = np.tile(px.counts[:, None] > 0, (1, PARAMETERS))
    state = State(affine, free, params, np.zeros(problem.n_objects), 0.0, tuple(history), converged, reason)
    weight = np.einsum("o,ij->oij", 1e-6 * np.maximum(px.counts, 1.0), np.eye(PARAMETERS))
    fit = Fit(state, Pull(affine, weight), None, affine[:, 14:])
    options = reference_options(free_response=opt.free_response)
    return result_of(px, fit, tone, texture, options, params, np.arange(problem.n_objects), px.counts)


def _batches(rng: np.random.Generator, n: int, opt: SgdOptions) -> Iterator[np.ndarray]:
    """Sorted pixels of the steps of one epoch."""
    left = -(-(opt.steps or 0) // opt.epochs) or -(-n // opt.batch)
    while left > 0:
        order = rng.permutation(n)
        for begin in range(0, n, opt.batch):
            if left > 0:
                yield np.sort(order[begin : begin + opt.batch])
            left -= 1


def _gradient(px: Pixels, rows: np.ndarray, affine: np.ndarray, tone: Tone, n_objects: int) -> tuple[np.ndarray, np.ndarray]:
    """Of the reference loss over some pixels: (O, 16) and (P,)."""
    curve, ends, by_params = tone.tables
    g = np.zeros((n_objects, PARAMETERS + tone.size))
    own = reference_options()
    kernels.gradient(
        px.obj,
        px.base,
        px.diffuse,
        px.lobes,
        px.levels,
        px.target,
        px.exposure,
        px.saturated,
        rows,
        np.ascontiguousarray(affine),
        tone.knee,
        tone.gain,
        curve,
        ends,
        by_params,
        tone.per_channel,
        own.roughness_weight,
        own.metallic_weight,
        g,
    )
    g /= len(rows)
    return g[:, :PARAMETERS], g[:, PARAMETERS:].sum(0)


def _adam(moments: list[np.ndarray], step: int, g: np.ndarray, g_w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Adam's direction; the response's moments are kept with object 0's."""
    both = np.zeros_like(moments[0])
    both[:, :PARAMETERS] = g
    both[0, PARAMETERS:] = g_w
    for k, power in enumerate((1, 2)):
        moments[k] *= _BETAS[k]
        moments[k] += (1 - _BETAS[k]) * both**power
    mean, square = (moments[k] / (1 - _BETAS[k] ** step) for k in range(2))
    out = mean / (np.sqrt(square) + _EPSILON)
    return out[:, :PARAMETERS], out[0, PARAMETERS:]
