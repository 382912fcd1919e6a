"""Damped Gauss-Newton on all objects and the response at once (METHOD 7b.iv).

Objects meet only in the few response parameters, so the system is an arrowhead: small blocks per object and one small Schur
complement. Steps are damped per object (Levenberg-Marquardt) and taken only when the objective falls.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from iif_core.fitting.pixels import Pixels, Terms, evaluate
from iif_core.fitting.problem import PARAMETERS, FitOptions
from iif_core.fitting.tone import Tone

_NOTHING = 1e-9
"""Residual, in sensor units, that counts as none: a perfect fit has no relative decrease to judge by."""
_QUIET = 3  # steps that together must lower the objective by more than the tolerance
_BETWEEN, _ALONE = 6, 40  # most steps of the objects alone between those of everything, and once the response is at rest
_POOR = 0.5  # of what the quadratic model promised
_PATIENCE = 6  # refused steps in a row after which no step will be found


@dataclass(frozen=True)
class Pull:
    """Quadratic pull of each object, 0.5 (theta - centre)' weight (theta - centre); centre (O, 16), weight (O, 16, 16).

    `scatter` (O, 16, 16): what the error of the centre adds to the scatter of the gradient; None: nothing (a regulariser).
    `drift` (O, 16, P): weight times how the centre moves with the response; None: it does not.
    """

    centre: np.ndarray
    weight: np.ndarray
    scatter: np.ndarray | None = None
    drift: np.ndarray | None = None

    def only(self, objects: np.ndarray) -> Pull:
        """Of some objects."""
        return Pull(self.centre[objects], self.weight[objects])

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

    def form(self, x: np.ndarray) -> np.ndarray:
        """x' H x of the undamped blocks, x (O, k)."""
        along = np.einsum("oji,oj->oi", self.vectors, x / self.scale)
        return (np.abs(self.values) * along**2).sum(1)


def spectrum(h: np.ndarray) -> Spectrum:
    """Of symmetric blocks (O, k, k)."""
    diagonal = np.abs(np.diagonal(h, axis1=1, axis2=2))
    scale = 1.0 / np.sqrt(np.maximum(diagonal, 1e-12 * np.maximum(diagonal.max(1, keepdims=True), 1e-100)))
    unit = h * scale[:, :, None] * scale[:, None, :]
    values, vectors = np.linalg.eigh(unit)
    return Spectrum(values, vectors, scale)


def object_blocks(h: np.ndarray, free: np.ndarray, pull: Pull) -> Spectrum:
    """Of the object blocks (O, 16 + P, 16 + P) with the pull; fixed numbers have rows of the identity."""
    some = np.flatnonzero(free.any(1))  # of thousands of objects, most may have nothing to fit
    own = free[some]
    keep = own[:, :, None] & own[:, None, :]
    block = np.where(keep, h[some, :PARAMETERS, :PARAMETERS] + pull.weight[some], 0.0)
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
    gradient = terms.g
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
    The response moves with everything else, until it has nothing to gain by it; between such steps, and after the last, each
    object goes on alone until it has nothing to gain either. Returns the state and the system there.
    """
    most = opt.iterations if iterations is None else iterations
    start_params = state.params if start_params is None else start_params
    fitted = bool((opt.free_response if fit_response is None else fit_response) and tone.size)
    prior = response_prior(opt, len(px.obj), start_params)

    def total_of(cost: np.ndarray, affine: np.ndarray, params: np.ndarray) -> float:
        return float((cost + pull.cost(affine)).sum() + prior.cost(params))

    tone = tone.at(state.params)
    terms = evaluate(px, state.affine, tone, opt, True, state.free)
    total = total_of(terms.cost, state.affine, state.params)
    state = replace(state, history=(total,), converged=False, reason="no step was allowed")
    refused, taken, settled = 0, 0, False
    floor = len(px.obj) * _NOTHING**2
    for step in range(most + 1):
        blocks = object_blocks(terms.h, state.free, pull)
        objects, response = _decrement(arrowhead(terms, state, pull, prior, fitted, blocks, damped=False))
        scale = terms.size.sum() + pull.cost(state.affine).sum()
        enough = opt.tolerance * scale + floor
        if objects + response <= enough or (settled and response <= 0.5 * enough):
            return replace(state, converged=True, reason="the expected fall is below the tolerance"), terms
        if taken >= _QUIET and state.history[-1 - _QUIET] - total <= opt.tolerance * scale:
            return replace(state, converged=True, reason=f"{_QUIET} steps gained less than the tolerance"), terms
        if step == most:
            return replace(state, reason=f"{most} steps were allowed"), terms
        if refused >= _PATIENCE:
            return replace(state, converged=True, reason="no step lowers the objective"), terms
        moves = fitted and response > 0.5 * enough
        moved = _step(px, state, terms, pull, tone, opt, prior, blocks) if moves else None
        if moved is not None:
            state, terms, tone = moved
        elif moves:
            state = replace(state, response_damping=float(_adapt(state.response_damping, False)))
        if moved is None or iterations is None:
            rounds = 1 if iterations is not None else _BETWEEN if moved is not None else _ALONE
            state, settled = _settle(px, state, terms, pull, tone, opt, rounds)
        new_total = total_of(terms.cost, state.affine, state.params)
        fell = new_total < total - 1e-15 * abs(total)
        refused, taken = (0, taken + 1) if fell else (refused + 1, taken)
        total = min(total, new_total)
        state = replace(state, history=(*state.history, total)) if fell else state
    raise AssertionError("unreachable")


def _decrement(system: Arrowhead) -> tuple[float, float]:
    """What the objects are expected to gain with the response held, and what moving it adds."""
    objects = 0.5 * np.einsum("oi,oij,oj->", system.g, system.inverse, system.g)
    right = system.g_w - np.einsum("oip,oi->p", system.through, system.g)
    return float(abs(objects)), float(abs(0.5 * right @ system.schur @ right))


def _step(
    px: Pixels, state: State, terms: Terms, pull: Pull, tone: Tone, opt: FitOptions, prior: ResponsePrior, blocks: Spectrum
) -> tuple[State, Terms, Tone] | None:
    """One step of everything; objects that lose by theirs stay. None: it does not pay."""
    system = arrowhead(terms, state, pull, prior, True, blocks)
    right = -system.g_w + np.einsum("oip,oi->p", system.through, system.g)
    new_tone = tone.at(state.params + (system.schur @ right).clip(-0.5, 0.5))
    params = new_tone.response.params.ravel()
    shift = params - state.params
    delta = -np.einsum("oij,oj->oi", system.inverse, system.g) - system.through @ shift
    tried = state.affine + delta
    go = evaluate(px, tried, new_tone, opt, True, state.free)
    # what staying costs under the new response, to second order: only the choice depends on it
    stay = terms.cost + terms.g[:, PARAMETERS:] @ shift + 0.5 * terms.h[:, PARAMETERS:, PARAMETERS:] @ shift @ shift
    better = go.cost + pull.cost(tried) < stay + pull.cost(state.affine)
    affine = np.where(better[:, None], tried, state.affine)
    left = np.flatnonzero(~better)
    if len(left):
        go.put(evaluate(px, affine, new_tone, opt, True, state.free, left), left)
    gained = (go.cost + pull.cost(affine) - terms.cost - pull.cost(state.affine)).sum() + prior.cost(params)
    if not gained < prior.cost(state.params):
        return None
    damping, mu = _adapt(state.damping, better), float(_adapt(state.response_damping, True))
    return replace(state, affine=affine, params=params, damping=damping, response_damping=mu), go, new_tone


def _settle(px: Pixels, state: State, terms: Terms, pull: Pull, tone: Tone, opt: FitOptions, rounds: int) -> tuple[State, bool]:
    """Steps of the objects alone, the response held; `terms` become those of where they lead. An object is left alone once
    it is not expected to gain, or several steps did not gain, more than the tolerance; all are when six rounds together did not.
    Also: whether it came to that."""
    affine, damping = state.affine.copy(), state.damping.copy()
    idle, gains = np.zeros(px.n_objects, np.int64), list[float]()
    whole = terms.size.sum() + pull.cost(affine).sum()
    active = np.flatnonzero(state.free.any(1))
    for _ in range(rounds):
        own, free = pull.only(active), state.free[active]
        keep = free[:, :, None] & free[:, None, :]
        blocks = object_blocks(terms.h[active], free, own)
        g = np.where(free, terms.g[active, :PARAMETERS] + own.gradient(affine[active]), 0.0)
        expected = 0.5 * np.einsum("oi,oij,oj->o", g, np.where(keep, blocks.inverse(), 0.0), g)
        here = own.cost(affine[active])
        little = opt.tolerance * (terms.size[active] + here)
        hopeful = expected > little
        if not hopeful.any():
            return replace(state, affine=affine, damping=damping), True
        delta = np.einsum("oij,oj->oi", np.where(keep, blocks.inverse(damping[active]), 0.0), g)
        promised = np.einsum("oi,oi->o", g, delta) - 0.5 * blocks.form(delta)
        tried = affine.copy()
        tried[active] -= delta
        active, here, little, promised = active[hopeful], here[hopeful], little[hopeful], promised[hopeful]
        go = evaluate(px, tried, tone, opt, True, state.free, active)
        gained = terms.cost[active] + here - go.cost[active] - pull.only(active).cost(tried[active])
        better = gained > 0
        chosen = active[better]
        affine[chosen] = tried[chosen]
        terms.put(go, chosen)
        kept = better & (gained < _POOR * promised)  # at a kink, a bolder step would be refused
        damping[active] = np.where(kept, damping[active], _adapt(damping[active], better))
        gains.append(float(gained[better].sum()))
        idle[active] = np.where(gained > little, 0, idle[active] + np.where(better, _PATIENCE // _QUIET, 1))
        active = active[idle[active] < _PATIENCE]
        if not len(active) or (len(gains) >= _PATIENCE and sum(gains[-_PATIENCE:]) <= opt.tolerance * whole):
            return replace(state, affine=affine, damping=damping), True
    return replace(state, affine=affine, damping=damping), False
