"""The paper's optimiser on the same problem: stochastic gradient descent on the paper's loss (Eq. M.45, M.46).

The step of an object is proportional to its share of the pixels (docs/method/numerics.md#small-objects-under-a-mean-loss);
`adam`, which is not in the paper, takes steps of one size whatever the gradient.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from iif_core.camera.response import Response
from iif_core.fitting.descent import DescentState, GaussianPrior
from iif_core.fitting.direct import FitProgress, result_of
from iif_core.fitting.pixels import Pixels, penalties_of, prepare_pixels
from iif_core.fitting.problem import FitProblem, FitResult
from iif_core.fitting.selection import measure_texture
from iif_core.fitting.tone import Tone
from iif_core.reflectance.material import IDENTITY, NUMBERS
from lab.published.adam import Moments
from lab.published.fitting import kernels
from lab.published.fitting.reference_loss import reference_loss, reference_options, reference_problem

_EPSILON = 1e-8
_DIVERGED = 1e4
"""Numbers beyond this do not return, because the clamp has no gradient (docs/method/numerics.md#descents-that-diverge)."""


@dataclass(frozen=True)
class SgdOptions:
    """Schedule of the paper's optimiser; the defaults are published, but for `adam`.

    Attributes:
        method: `sgd` or `adam`; rate: step size, None: 10, or 0.01 for adam.
        epochs: passes over the pixels; batch: pixels of a step; decay: factor on the rate after each epoch.
        seed: of the order of the pixels; free_response: fit the response too.
        steps: steps over all epochs, with as many passes over the pixels as they need; None: one pass an epoch.
    """

    method: str = "sgd"
    rate: float | None = None
    epochs: int = 3
    batch: int = 32768
    decay: float = 0.2
    seed: int = 0
    free_response: bool = True
    steps: int | None = None


def fit_affines_sgd(problem: FitProblem, response: Response, options: SgdOptions | None = None) -> FitResult:
    """Fit like `direct.fit_affines`, from the identity; `history` is the paper's loss at the start and after each epoch."""
    opt = options or SgdOptions()
    own = reference_problem(problem, response)
    px, tone = prepare_pixels(own, response)
    affine = np.tile(IDENTITY, (problem.n_objects, 1))
    params = response.params.ravel().astype(np.float64) if tone.size else np.zeros(0)
    history = [reference_loss(problem, affine, response).total]
    reason, converged = f"{opt.epochs} epochs", True
    rate = opt.rate or (10.0 if opt.method == "sgd" else 1e-2)
    rng = np.random.default_rng([0x736764, opt.seed])
    moments = Moments((problem.n_objects, NUMBERS + tone.size))
    for epoch in range(opt.epochs if len(px.obj) else 0):
        for rows in _batches(rng, len(px.obj), opt):
            g, g_w = _gradient(px, rows, affine, tone.at(params), own.n_objects)
            if opt.method == "adam":
                g, g_w = _adam_direction(moments, g, g_w)
            affine = affine - rate * opt.decay**epoch * g
            if opt.free_response and tone.size:
                params = tone.at(params - rate * opt.decay**epoch * g_w).response.params.ravel()
        if not (np.abs(affine).max(initial=0) < _DIVERGED and np.isfinite(params).all()):
            reason, converged = f"diverged in epoch {epoch + 1} at step size {rate:g}", False
            affine = np.tile(IDENTITY, (problem.n_objects, 1))
            params = response.params.ravel().astype(np.float64)
            break
        history.append(reference_loss(problem, affine, tone.at(params).response).total)
    texture = measure_texture(px, reference_options())
    free = np.tile(px.counts[:, None] > 0, (1, NUMBERS))
    state = DescentState(affine, free, params, np.zeros(problem.n_objects), 0.0, tuple(history), converged, reason)
    weight = np.einsum("o,ij->oij", 1e-6 * np.maximum(px.counts, 1.0), np.eye(NUMBERS))
    fit = FitProgress(state, GaussianPrior(affine, weight), None, affine[:, 14:])
    options = reference_options(free_response=opt.free_response)
    return result_of(px, fit, tone, texture, options, params, np.arange(problem.n_objects), px.counts)


def _batches(rng: np.random.Generator, n: int, opt: SgdOptions) -> Iterator[np.ndarray]:
    """Yield the sorted pixels of each step of one epoch."""
    left = -(-(opt.steps or 0) // opt.epochs) or -(-n // opt.batch)
    while left > 0:
        order = rng.permutation(n)
        for begin in range(0, n, opt.batch):
            if left > 0:
                yield np.sort(order[begin : begin + opt.batch])
            left -= 1


def _gradient(px: Pixels, rows: np.ndarray, affine: np.ndarray, tone: Tone, n_objects: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the gradient of the paper's loss over some pixels, (O, 16) and (P,)."""
    g = np.zeros((n_objects, NUMBERS + tone.size))
    kernels.gradient(px.arrays, tone.tables, penalties_of(reference_options()), np.ascontiguousarray(affine), rows, g)
    g /= len(rows)
    return g[:, :NUMBERS], g[:, NUMBERS:].sum(0)


def _adam_direction(moments: Moments, g: np.ndarray, g_w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return Adam's direction; the moments of the response are kept in the row of object 0."""
    both = np.zeros_like(moments.mean)
    both[:, :NUMBERS] = g
    both[0, NUMBERS:] = g_w
    moments.add(both)
    first, second = moments.bias()
    out = moments.mean / first / (np.sqrt(moments.square / second) + _EPSILON)
    return out[:, :NUMBERS], out[0, NUMBERS:]
