"""Damped Gauss-Newton on all objects and the response at once (METHOD 7b.iv).

Objects meet only in the few response parameters, so the system is an arrowhead: small blocks per object and one small Schur
complement. Steps are damped per object (Levenberg-Marquardt) and taken only when the objective falls.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from iif_core.affines.pixels import Pixels, Terms, evaluate, other_tone, restore, revise
from iif_core.affines.problem import PARAMETERS, FitOptions
from iif_core.affines.tone import Tone

_NOTHING = 1e-9
"""Residual, in sensor units, that counts as none: a perfect fit has no relative decrease to judge by."""
_QUIET = 3  # steps that together must lower the objective by more than the tolerance
_ALONE = 12  # steps of objects alone after one of everything
_REST = 0.1  # of the tolerance, that an object may be expected to gain and still be left where it is
_PATIENCE = 6  # refused steps in a row after which no step will be found


@dataclass(frozen=True)
class Pull:
    """Quadratic pull of each object, 0.5 (theta - centre)' weight (theta - centre); centre (O, 16), weight (O, 16, 16).

    `scatter` (O, 16, 16): what the error of the centre adds to the scatter of the gradient; None: nothing (a regulariser).
    """

    centre: np.ndarray
    weight: np.ndarray
    scatter: np.ndarray | None = None

    def cost(self, affine: np.ndarray) -> np.ndarray:
        away = affine - self.centre
        return 0.5 * np.einsum("oi,oij,oj->o", away, self.weight, away)

    def gradient(self, affine: np.ndarray) -> np.ndarray:
        return np.einsum("oij,oj->oi", self.weight, affine - self.centre)


@dataclass(frozen=True)
class State:
    """Where a descent is: affine (O, 16), free (O, 16) bool, params (P,), damping (O,) and of the response."""

    affine: np.ndarray
    free: np.ndarray
    params: np.ndarray
    damping: np.ndarray
    response_damping: float = 1e-2
    history: tuple[float, ...] = ()
    converged: bool = False
    reason: str = ""


@dataclass(frozen=True)
class Arrowhead:
    """The system with the pull, and its elimination; fixed numbers have zero rows in `inverse`.

    Attributes:
        inverse: (O, 16, 16) of the object blocks; coupling: (O, 16, P); schur: (P, P) inverse of the reduced response block;
        g: (O, 16) and g_w: (P,) gradients; through: (O, 16, P) inverse times coupling.
    """

    inverse: np.ndarray
    coupling: np.ndarray
    schur: np.ndarray
    g: np.ndarray
    g_w: np.ndarray
    through: np.ndarray


@dataclass(frozen=True)
class Spectrum:
    """Symmetric blocks (O, k, k) scaled to unit diagonal, and what their inverse needs."""

    values: np.ndarray
    vectors: np.ndarray
    scale: np.ndarray

    def inverse(self, damping: np.ndarray | float = 0.0) -> np.ndarray:
        """Inverses of the damped blocks; negative directions of the cross moment count by their size."""
        values = np.maximum(np.abs(self.values), 1e-10) + np.reshape(damping, (-1, 1))
        unit = (self.vectors / values[:, None, :]) @ self.vectors.transpose(0, 2, 1)
        return unit * self.scale[:, :, None] * self.scale[:, None, :]


def spectrum(h: np.ndarray) -> Spectrum:
    """Of symmetric blocks (O, k, k)."""
    diagonal = np.abs(np.diagonal(h, axis1=1, axis2=2))
    scale = 1.0 / np.sqrt(np.maximum(diagonal, 1e-12 * np.maximum(diagonal.max(1, keepdims=True), 1e-100)))
    unit = h * scale[:, :, None] * scale[:, None, :]
    values, vectors = np.linalg.eigh(unit)
    return Spectrum(values, vectors, scale)


def object_blocks(terms: Terms, free: np.ndarray, pull: Pull) -> Spectrum:
    """Of the object blocks with the pull; fixed numbers have rows of the identity."""
    some = np.flatnonzero(free.any(1))  # of thousands of objects, most may have nothing to fit
    own = free[some]
    keep = own[:, :, None] & own[:, None, :]
    block = np.where(keep, terms.h[some, :PARAMETERS, :PARAMETERS] + pull.weight[some], 0.0)
    i = np.arange(PARAMETERS)
    block[:, i, i] += ~own
    found = spectrum(block)
    values, scale = np.ones((2, len(free), PARAMETERS))
    vectors = np.tile(np.eye(PARAMETERS), (len(free), 1, 1))
    values[some], vectors[some], scale[some] = found.values, found.vectors, found.scale
    return Spectrum(values, vectors, scale)


@dataclass(frozen=True)
class ResponsePrior:
    """Gaussian prior of the response parameters (P,), row by row: mean, and precision (P, P) times the weight of the pixels.

    `scatter` (P, P): of its gradient, weight^2 times the precision."""

    mean: np.ndarray
    precision: np.ndarray
    scatter: np.ndarray

    def cost(self, params: np.ndarray) -> float:
        """Half the squared distance."""
        away = params - self.mean
        return float(0.5 * away @ self.precision @ away)

    def gradient(self, params: np.ndarray) -> np.ndarray:
        """(P,)"""
        return self.precision @ (params - self.mean)


def response_prior(opt: FitOptions, pixels: int, start_params: np.ndarray) -> ResponsePrior:
    """That of the options, or the start with precision one; weighted by `response_ridge` per pixel."""
    mean, precision = opt.response_prior or (start_params, np.eye(len(start_params)))
    weight, precision = opt.response_ridge * pixels, np.asarray(precision, np.float64)
    return ResponsePrior(np.asarray(mean, np.float64), weight * precision, weight**2 * precision)


def arrowhead(
    terms: Terms,
    px: Pixels,
    state: State,
    pull: Pull,
    prior: ResponsePrior,
    fit_response: bool,
    blocks: Spectrum,
    damped: bool = True,
) -> Arrowhead:
    """Eliminate the objects (`blocks`, of `object_blocks`) from the system at `state`."""
    free = state.free
    keep = free[:, :, None] & free[:, None, :]
    inverse = np.where(keep, blocks.inverse(state.damping if damped else 0.0), 0.0)
    gradient = terms.gradient(px.first)
    g = np.where(free, gradient[:, :PARAMETERS] + pull.gradient(state.affine), 0.0)
    size = terms.h.shape[1] - PARAMETERS
    coupling = np.where(free[:, :, None], terms.h[:, :PARAMETERS, PARAMETERS:], 0.0)
    through = inverse @ coupling
    if not (fit_response and size):
        return Arrowhead(inverse, coupling, np.zeros((size, size)), g, np.zeros(size), through)
    h_w = terms.h[:, PARAMETERS:, PARAMETERS:].sum(0) + prior.precision
    g_w = gradient[:, PARAMETERS:].sum(0) + prior.gradient(state.params)
    reduced = h_w - np.einsum("oip,oiq->pq", coupling, through)
    schur = spectrum(reduced[None]).inverse(state.response_damping if damped else 0.0)[0]
    return Arrowhead(inverse, coupling, schur, g, g_w, through)


def _adapt(damping: np.ndarray, better: np.ndarray) -> np.ndarray:
    """Levenberg-Marquardt's rule; a refused step jumps to a damping that is felt."""
    return np.where(better, np.maximum(damping * 0.2, 1e-9), np.clip(damping * 10.0, 1e-4, 1e6))


def descend(
    px: Pixels,
    state: State,
    pull: Pull,
    tone: Tone,
    opt: FitOptions,
    iterations: int | None = None,
    fit_response: bool | None = None,
    start_params: np.ndarray | None = None,
) -> tuple[State, Terms]:
    """Steps until the objective is expected to fall by less than `opt.tolerance` of its size, or `iterations`.

    The expected fall is the Newton decrement g' H^-1 g / 2 of the undamped system. Where pixels sit at the edge of the allowed
    range the objective has a kink and the decrement never vanishes: three steps that gain less than the tolerance count too.
    Returns the state and the system there.
    """
    most = opt.iterations if iterations is None else iterations
    start_params = state.params if start_params is None else start_params
    fitted = bool((opt.free_response if fit_response is None else fit_response) and tone.size)
    prior = response_prior(opt, len(px.obj), start_params)

    def total_of(cost: np.ndarray, affine: np.ndarray, params: np.ndarray) -> float:
        return float((cost + pull.cost(affine)).sum() + prior.cost(params))

    terms = evaluate(px, state.affine, tone.at(state.params), opt, True)
    total = total_of(terms.cost, state.affine, state.params)
    state = replace(state, history=(total,), converged=False, reason="no step was allowed")
    refused, taken, blocks = 0, 0, None
    floor = len(px.obj) * _NOTHING**2
    for step in range(most + 1):
        if blocks is None:
            blocks = object_blocks(terms, state.free, pull)
        plain = arrowhead(terms, px, state, pull, prior, fitted, blocks, damped=False)
        expected = _decrement(plain)
        scale = terms.size.sum() + pull.cost(state.affine).sum()
        if expected <= opt.tolerance * scale + floor:
            return replace(state, converged=True, reason="the expected fall is below the tolerance"), terms
        if taken >= _QUIET and state.history[-1 - _QUIET] - total <= opt.tolerance * scale:
            return replace(state, converged=True, reason=f"{_QUIET} steps gained less than the tolerance"), terms
        if step == most:
            return replace(state, reason=f"{most} steps were allowed"), terms
        if refused >= _PATIENCE:
            return replace(state, converged=True, reason="no step lowers the objective"), terms
        moved = _step(px, state, terms, pull, tone, opt, prior, fitted, blocks)
        if fitted and iterations is None:
            moved = _settle(px, moved, pull, tone, opt)
        new_total = total_of(moved.terms.cost, moved.state.affine, moved.state.params)
        refused = 0 if new_total < total - 1e-15 * abs(total) else refused + 1
        changed = new_total < total
        state = (
            moved.state if changed else replace(state, damping=moved.state.damping, response_damping=moved.state.response_damping)
        )
        if changed:
            state = replace(state, history=(*state.history, new_total))
            terms, blocks = moved.terms, None
            total, taken = new_total, taken + 1
    raise AssertionError("unreachable")


def _decrement(system: Arrowhead) -> float:
    objects = 0.5 * np.einsum("oi,oij,oj->", system.g, system.inverse, system.g)
    right = system.g_w - np.einsum("oip,oi->p", system.through, system.g)
    return float(abs(objects) + abs(0.5 * right @ system.schur @ right))


@dataclass(frozen=True)
class _Moved:
    """Where a step led, and the system there."""

    state: State
    terms: Terms
    better: np.ndarray


def _step(
    px: Pixels,
    state: State,
    terms: Terms,
    pull: Pull,
    tone: Tone,
    opt: FitOptions,
    prior: ResponsePrior,
    fitted: bool,
    blocks: Spectrum,
) -> _Moved:
    """One step of everything; where it does not pay, one of the objects alone with the response held."""
    system = arrowhead(terms, px, state, pull, prior, fitted, blocks)
    mu = state.response_damping
    if fitted:
        right = -system.g_w + np.einsum("oip,oi->p", system.through, system.g)
        params = tone.at(state.params + (system.schur @ right).clip(-0.5, 0.5)).response.params.ravel()
        shift = params - state.params
        delta = -np.einsum("oij,oj->oi", system.inverse, system.g) - system.through @ shift
        new_tone = tone.at(params)
        stay = other_tone(terms, px, new_tone, opt)
        go = evaluate(px, state.affine + delta, new_tone, opt, True)
        away = pull.cost(state.affine + delta) - pull.cost(state.affine)
        better = go.cost + away < stay
        affine = np.where(better[:, None], state.affine + delta, state.affine)
        cost = np.where(better, go.cost, stay)
        gained = float((cost - terms.cost + np.where(better, away, 0.0)).sum())
        gained += prior.cost(params) - prior.cost(state.params)
        if gained < 0:
            revise(go, px, affine, new_tone, opt, np.flatnonzero(~better))
            damping = _adapt(state.damping, better)
            moved = replace(state, affine=affine, params=params, damping=damping, response_damping=float(_adapt(mu, True)))
            return _Moved(moved, go, better)
        mu = float(_adapt(mu, False))
    moved = _alone(px, replace(state, response_damping=mu), terms, pull, tone, opt, np.ones(len(terms.cost), bool))
    return moved or _Moved(replace(state, response_damping=mu), terms, np.zeros(len(terms.cost), bool))


def _alone(px: Pixels, state: State, terms: Terms, pull: Pull, tone: Tone, opt: FitOptions, active: np.ndarray) -> _Moved | None:
    """A step of the `active` objects (O,) that are expected to gain something by it, with the response held; None: there is none.

    What the others are expected to gain adds up to less than the tolerance: they are not looked at."""
    free = state.free & active[:, None]
    keep = free[:, :, None] & free[:, None, :]
    blocks = object_blocks(terms, free, pull)
    g = np.where(free, terms.gradient(px.first)[:, :PARAMETERS] + pull.gradient(state.affine), 0.0)
    expected = 0.5 * np.einsum("oi,oij,oj->o", g, np.where(keep, blocks.inverse(), 0.0), g)
    here = terms.cost + pull.cost(state.affine)
    active = active & (expected > _REST * opt.tolerance * (terms.size + pull.cost(state.affine)))
    if not active.any():
        return None
    delta = -np.einsum("oij,oj->oi", np.where(keep, blocks.inverse(state.damping), 0.0), g)
    go = terms.copy()
    tried = state.affine + np.where(active[:, None], delta, 0.0)
    revise(go, px, tried, tone.at(state.params), opt, np.flatnonzero(active))
    better = active & (go.cost + pull.cost(tried) < here)
    restore(go, terms, px, active & ~better)
    damping = np.where(active, _adapt(state.damping, better), state.damping)
    affine = np.where(better[:, None], tried, state.affine)
    return _Moved(replace(state, affine=affine, damping=damping), go, better)


def _settle(px: Pixels, moved: _Moved, pull: Pull, tone: Tone, opt: FitOptions) -> _Moved:
    """Further steps of the objects that still gain, a few pixels of all, with the response held."""
    active = np.ones(px.n_objects, bool)
    for _ in range(_ALONE):
        here = moved.terms.cost + pull.cost(moved.state.affine)
        further = _alone(px, moved.state, moved.terms, pull, tone, opt, active)
        if further is None:
            break
        gained = here - further.terms.cost - pull.cost(further.state.affine)
        active = further.better & (gained > _REST * opt.tolerance * further.terms.size)
        moved = further
        if not active.any():
            break
    return moved
