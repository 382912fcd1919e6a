"""Damped Gauss-Newton on all objects and the response at once (Eq. M.16 to M.18).

The system is an arrowhead: a small block for each object and one small Schur complement for the response.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from iif_core.fitting.pixels import Pixels, Terms, evaluate
from iif_core.fitting.problem import FitOptions
from iif_core.fitting.tone import Tone
from iif_core.reflectance.material import NUMBERS

_NEGLIGIBLE_RESIDUAL = 1e-9
"""Residual in sensor units that counts as none (docs/method/numerics.md#objective-near-zero)."""
_STALLED_STEPS = 3
"""Steps that together must lower the objective by more than the tolerance."""
_ROUNDS_BETWEEN_STEPS, _ROUNDS_AT_THE_END = 6, 40
"""Largest number of rounds of the objects alone, between steps of everything and once the response is at rest."""
_POOR_GAIN = 0.5
"""Share of the fall that the quadratic model predicted, below which damping is kept after a step."""
_REFUSED_STEPS = 6
"""Refused steps in a row after which the descent ends."""


@dataclass(frozen=True)
class GaussianPrior:
    """Gaussian prior of the numbers of each object: 0.5 (theta - centre)' weight (theta - centre).

    Attributes:
        centre: (O, 16); weight: (O, 16, 16).
        scatter: (O, 16, 16) covariance that the error of the centre adds to the gradient; None: 0, as for a regulariser.
        drift: (O, 16, P) weight times the derivative of the centre by the response; None: 0.
    """

    centre: np.ndarray
    weight: np.ndarray
    scatter: np.ndarray | None = None
    drift: np.ndarray | None = None

    def only(self, objects: np.ndarray) -> GaussianPrior:
        """Return centre and weight for some objects."""
        return GaussianPrior(self.centre[objects], self.weight[objects])

    def cost(self, affine: np.ndarray) -> np.ndarray:
        """Return the prior's term of the objective, (O,)."""
        away = affine - self.centre
        return 0.5 * np.einsum("oi,oij,oj->o", away, self.weight, away)

    def gradient(self, affine: np.ndarray) -> np.ndarray:
        """Return its gradient, (O, 16)."""
        return np.einsum("oij,oj->oi", self.weight, affine - self.centre)


@dataclass(frozen=True)
class DescentState:
    """State of a descent: affine (O, 16), free (O, 16) bool, params (P,) of the response, damping (O,) of the objects."""

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
    """Normal equations with the priors, objects eliminated (Eq. M.17); fixed numbers have zero rows in `inverse`.

    Attributes:
        inverse: (O, 16, 16) B_o; coupling: (O, 16, P) C_o; schur: (P, P) inverse of the reduced block of the response.
        g: (O, 16) and g_w: (P,) gradients.
        by_response: (O, 16, P) B_o C_o; the numbers of an object follow a step d of the response by -B_o C_o d.
    """

    inverse: np.ndarray
    coupling: np.ndarray
    schur: np.ndarray
    g: np.ndarray
    g_w: np.ndarray
    by_response: np.ndarray


@dataclass(frozen=True)
class Spectrum:
    """Eigenvalues and eigenvectors of symmetric blocks (O, k, k) scaled to unit diagonal."""

    values: np.ndarray
    vectors: np.ndarray
    scale: np.ndarray

    def inverse(self, damping: np.ndarray | float = 0.0) -> np.ndarray:
        """Return the inverses of the damped blocks; eigenvalues count by their modulus
        (docs/method/numerics.md#indefinite-normal-matrices)."""
        # The blocks have unit diagonal: the floor bounds their condition, and the damping is relative to the curvature of each
        # number.
        values = np.maximum(np.abs(self.values), 1e-10) + np.reshape(damping, (-1, 1))
        unit = (self.vectors / values[:, None, :]) @ self.vectors.transpose(0, 2, 1)
        return unit * self.scale[:, :, None] * self.scale[:, None, :]

    def form(self, x: np.ndarray) -> np.ndarray:
        """Return x' H x of the undamped blocks for x (O, k)."""
        along = np.einsum("oji,oj->oi", self.vectors, x / self.scale)
        return (np.abs(self.values) * along**2).sum(1)


def decompose(h: np.ndarray) -> Spectrum:
    """Decompose symmetric blocks (O, k, k)."""
    diagonal = np.abs(np.diagonal(h, axis1=1, axis2=2))
    # A number that no pixel moves has diagonal 0 and keeps a finite scale (docs/method/numerics.md#black-metal).
    scale = 1.0 / np.sqrt(np.maximum(diagonal, 1e-12 * np.maximum(diagonal.max(1, keepdims=True), 1e-100)))
    unit = h * scale[:, :, None] * scale[:, None, :]
    values, vectors = np.linalg.eigh(unit)
    return Spectrum(values, vectors, scale)


def decompose_objects(h: np.ndarray, free: np.ndarray, prior: GaussianPrior) -> Spectrum:
    """Decompose the blocks of the objects in h (O, 16 + P, 16 + P) with the prior; fixed numbers get rows of the identity."""
    some = np.flatnonzero(free.any(1))  # most of thousands of objects may have nothing to fit
    own = free[some]
    keep = own[:, :, None] & own[:, None, :]
    block = np.where(keep, h[some, :NUMBERS, :NUMBERS] + prior.weight[some], 0.0)
    i = np.arange(NUMBERS)
    # Fixed numbers get an identity block, so that the whole is invertible and the free numbers do not notice them.
    block[:, i, i] += ~own
    found = decompose(block)
    values, scale = np.ones((2, len(free), NUMBERS))
    vectors = np.tile(np.eye(NUMBERS), (len(free), 1, 1))
    values[some], vectors[some], scale[some] = found.values, found.vectors, found.scale
    return Spectrum(values, vectors, scale)


@dataclass(frozen=True)
class ResponsePrior:
    """Gaussian prior of the response parameters (Eq. M.15), row by row.

    Attributes:
        mean: (P,); precision: (P, P) times the weight of the pixels; scatter: (P, P) covariance of the gradient that the error of
            the mean causes, weight^2 times the precision.
    """

    mean: np.ndarray
    precision: np.ndarray
    scatter: np.ndarray

    def cost(self, params: np.ndarray) -> float:
        """Return half the squared distance from the mean."""
        away = params - self.mean
        return float(0.5 * away @ self.precision @ away)

    def gradient(self, params: np.ndarray) -> np.ndarray:
        """Return the gradient, (P,)."""
        return self.precision @ (params - self.mean)


def make_response_prior(opt: FitOptions, pixels: int, start_params: np.ndarray) -> ResponsePrior:
    """Make the prior of the options, or one around the start with precision 1, weighted by `response_ridge` for each pixel."""
    mean, precision = opt.response_prior or (start_params, np.eye(len(start_params)))
    # The prior has the gradient weight * precision * (params - mean). An error of the mean of covariance precision^-1 therefore
    # gives it the covariance weight^2 * precision.
    weight, precision = opt.response_ridge * pixels, np.asarray(precision, np.float64)
    return ResponsePrior(np.asarray(mean, np.float64), weight * precision, weight**2 * precision)


def eliminate_objects(
    terms: Terms,
    state: DescentState,
    prior: GaussianPrior,
    curve_prior: ResponsePrior,
    fit_response: bool,
    blocks: Spectrum,
    damped: bool = True,
) -> Arrowhead:
    """Eliminate the objects from the system at `state` (Eq. M.17).

    Args:
        terms: objective and system; state: numbers, response and damping at which they were evaluated.
        prior: of the objects; curve_prior: of the response; fit_response: whether the response moves.
        blocks: `decompose_objects` of the same terms and prior.
        damped: add the damping of `state`.

    Returns:
        The eliminated system; without a response to fit `schur` and `g_w` are 0.
    """
    free = state.free
    # B_o of Eq. M.17. Rows of fixed numbers become 0, so they do not move and do not enter the response.
    keep = free[:, :, None] & free[:, None, :]
    inverse = np.where(keep, blocks.inverse(state.damping if damped else 0.0), 0.0)
    gradient = terms.g
    g = np.where(free, gradient[:, :NUMBERS] + prior.gradient(state.affine), 0.0)
    size = terms.h.shape[1] - NUMBERS
    coupling = np.where(free[:, :, None], terms.h[:, :NUMBERS, NUMBERS:], 0.0)
    by_response = inverse @ coupling
    if not (fit_response and size):
        return Arrowhead(inverse, coupling, np.zeros((size, size)), g, np.zeros(size), by_response)
    h_w = terms.h[:, NUMBERS:, NUMBERS:].sum(0) + curve_prior.precision
    g_w = gradient[:, NUMBERS:].sum(0) + curve_prior.gradient(state.params)
    # Left side of Eq. M.17. A difference of noisy matrices may be indefinite, hence the same decomposition as for the blocks.
    reduced = h_w - np.einsum("oip,oiq->pq", coupling, by_response)
    schur = decompose(reduced[None]).inverse(state.response_damping if damped else 0.0)[0]
    return Arrowhead(inverse, coupling, schur, g, g_w, by_response)


def _adapt_damping(damping: np.ndarray, better: np.ndarray) -> np.ndarray:
    """Return the damping after accepted and refused steps (Levenberg-Marquardt); a refused step raises it to at least 1e-4."""
    return np.where(better, np.maximum(damping * 0.2, 1e-9), np.clip(damping * 10.0, 1e-4, 1e6))


def descend(
    px: Pixels,
    state: DescentState,
    prior: GaussianPrior,
    tone: Tone,
    opt: FitOptions,
    iterations: int | None = None,
    start_params: np.ndarray | None = None,
) -> tuple[DescentState, Terms]:
    """Minimise the objective (Eq. M.14) until its expected fall is below `opt.tolerance` of its size.

    The expected fall is the Newton decrement of the undamped system (Eq. M.18). Where pixels sit at the edge of the allowed range
    the objective has a kink and the decrement does not vanish, so three steps that together gain less than the tolerance end the
    descent too. The response moves with the objects as long as that is expected to pay; between such steps, and after the last,
    the objects move alone.

    Args:
        px: pixels; their targets and weights are held.
        state: start; prior: of the objects; tone: curve of the residuals; opt: options.
        iterations: largest number of steps of everything, each followed by at most one of the objects alone if it was refused;
            None: `opt.iterations`, with several rounds of the objects between them.
        start_params: (P,) mean of the response's prior where `opt.response_prior` is None; None: those of `state`.

    Returns:
        The state where the descent ended, and objective and system there.
    """
    most = opt.iterations if iterations is None else iterations
    start_params = state.params if start_params is None else start_params
    fitted = bool(opt.free_response and tone.size)
    curve_prior = make_response_prior(opt, len(px.obj), start_params)

    def total_of(cost: np.ndarray, affine: np.ndarray, params: np.ndarray) -> float:
        return float((cost + prior.cost(affine)).sum() + curve_prior.cost(params))

    tone = tone.at(state.params)
    terms = evaluate(px, state.affine, tone, opt, True, state.free)
    total = total_of(terms.cost, state.affine, state.params)
    state = replace(state, history=(total,), converged=False, reason="no step was allowed")
    refused, taken, settled = 0, 0, False
    floor = len(px.obj) * _NEGLIGIBLE_RESIDUAL**2
    for step in range(most + 1):
        # -------- is the descent over? (Eq. M.18) --------
        blocks = decompose_objects(terms.h, state.free, prior)
        objects, response = _expected_fall(eliminate_objects(terms, state, prior, curve_prior, fitted, blocks, damped=False))
        # The moduli of the terms are the scale: with two halves the objective itself may be near 0 or negative. `floor` makes a
        # perfect fit, whose size is 0, converge (docs/method/numerics.md#objective-near-zero).
        scale = terms.size.sum() + prior.cost(state.affine).sum()
        enough = opt.tolerance * scale + floor
        # `settled`: the last rounds left every object at rest. At a kink they may still expect to fall.
        if objects + response <= enough or (settled and response <= 0.5 * enough):
            return replace(state, converged=True, reason="the expected fall is below the tolerance"), terms
        if taken >= _STALLED_STEPS and state.history[-1 - _STALLED_STEPS] - total <= opt.tolerance * scale:
            return replace(state, converged=True, reason=f"{_STALLED_STEPS} steps gained less than the tolerance"), terms
        if step == most:
            return replace(state, reason=f"{most} steps were allowed"), terms
        if refused >= _REFUSED_STEPS:
            return replace(state, converged=True, reason="no step lowers the objective"), terms

        # -------- a step of objects and response, then objects alone --------
        moves = fitted and response > 0.5 * enough
        moved = _step_everything(px, state, terms, prior, tone, opt, curve_prior, blocks) if moves else None
        if moved is not None:
            state, terms, tone = moved
        elif moves:
            state = replace(state, response_damping=float(_adapt_damping(state.response_damping, False)))
        if moved is None or iterations is None:
            # A round of the objects alone is cheap: it sums only the pixels of the objects that still move.
            rounds = 1 if iterations is not None else _ROUNDS_BETWEEN_STEPS if moved is not None else _ROUNDS_AT_THE_END
            state, settled = _step_objects(px, state, terms, prior, tone, opt, rounds)

        # -------- did the objective fall by more than its rounding? --------
        new_total = total_of(terms.cost, state.affine, state.params)
        fell = new_total < total - 1e-15 * abs(total)
        refused, taken = (0, taken + 1) if fell else (refused + 1, taken)
        total = min(total, new_total)
        state = replace(state, history=(*state.history, total)) if fell else state
    raise AssertionError("unreachable")


def _expected_fall(system: Arrowhead) -> tuple[float, float]:
    """Return the expected fall of the objective with the response held, and what moving the response adds (Eq. M.18)."""
    objects = 0.5 * np.einsum("oi,oij,oj->", system.g, system.inverse, system.g)
    right = system.g_w - np.einsum("oip,oi->p", system.by_response, system.g)
    return float(abs(objects)), float(abs(0.5 * right @ system.schur @ right))


def _step_everything(
    px: Pixels,
    state: DescentState,
    terms: Terms,
    prior: GaussianPrior,
    tone: Tone,
    opt: FitOptions,
    curve_prior: ResponsePrior,
    blocks: Spectrum,
) -> tuple[DescentState, Terms, Tone] | None:
    """Take one step of objects and response; objects whose cost it does not lower stay. None: the objective did not fall."""
    system = eliminate_objects(terms, state, prior, curve_prior, True, blocks)
    # Right side of Eq. M.17. `tone.at` projects the limited step into the range in which the curve is monotone; the objects
    # follow the shift that is left of it.
    right = -system.g_w + np.einsum("oip,oi->p", system.by_response, system.g)
    new_tone = tone.at(state.params + (system.schur @ right).clip(-0.5, 0.5))
    params = new_tone.response.params.ravel()
    shift = params - state.params
    delta = -np.einsum("oij,oj->oi", system.inverse, system.g) - system.by_response @ shift
    tried = state.affine + delta
    go = evaluate(px, tried, new_tone, opt, True, state.free)
    # The cost of staying under the new response is taken to second order; only the choice depends on it.
    stay = terms.cost + terms.g[:, NUMBERS:] @ shift + 0.5 * terms.h[:, NUMBERS:, NUMBERS:] @ shift @ shift
    better = go.cost + prior.cost(tried) < stay + prior.cost(state.affine)
    affine = np.where(better[:, None], tried, state.affine)
    # Objects that stay have another cost and system under the new response.
    left = np.flatnonzero(~better)
    if len(left):
        go.update(evaluate(px, affine, new_tone, opt, True, state.free, left), left)
    gained = (go.cost + prior.cost(affine) - terms.cost - prior.cost(state.affine)).sum() + curve_prior.cost(params)
    # Change of the objective; written so that NaN counts as no fall.
    if not gained < curve_prior.cost(state.params):
        return None
    damping, mu = _adapt_damping(state.damping, better), float(_adapt_damping(state.response_damping, True))
    return replace(state, affine=affine, params=params, damping=damping, response_damping=mu), go, new_tone


def _step_objects(
    px: Pixels, state: DescentState, terms: Terms, prior: GaussianPrior, tone: Tone, opt: FitOptions, rounds: int
) -> tuple[DescentState, bool]:
    """Move the objects alone with the response held, and write objective and system of the result to `terms`.

    An object rests once its expected fall, or the fall of several steps, is below the tolerance; all rest when six rounds
    together gain less than it. Also returns whether all objects rest.
    """
    affine, damping = state.affine.copy(), state.damping.copy()
    idle, gains = np.zeros(px.n_objects, np.int64), list[float]()
    whole = terms.size.sum() + prior.cost(affine).sum()
    active = np.flatnonzero(state.free.any(1))
    for _ in range(rounds):
        # -------- expected fall of each object with the response held; those below the tolerance rest --------
        own, free = prior.only(active), state.free[active]
        keep = free[:, :, None] & free[:, None, :]
        blocks = decompose_objects(terms.h[active], free, own)
        g = np.where(free, terms.g[active, :NUMBERS] + own.gradient(affine[active]), 0.0)
        expected = 0.5 * np.einsum("oi,oij,oj->o", g, np.where(keep, blocks.inverse(), 0.0), g)
        here = own.cost(affine[active])
        little = opt.tolerance * (terms.size[active] + here)
        hopeful = expected > little
        if not hopeful.any():
            return replace(state, affine=affine, damping=damping), True
        delta = np.einsum("oij,oj->oi", np.where(keep, blocks.inverse(damping[active]), 0.0), g)
        # Fall that the quadratic model predicts for the damped step -delta.
        promised = np.einsum("oi,oi->o", g, delta) - 0.5 * blocks.form(delta)
        tried = affine.copy()
        tried[active] -= delta
        active, here, little, promised = active[hopeful], here[hopeful], little[hopeful], promised[hopeful]

        # -------- each object takes or refuses its step --------
        go = evaluate(px, tried, tone, opt, True, state.free, active)
        gained = terms.cost[active] + here - go.cost[active] - prior.only(active).cost(tried[active])
        better = gained > 0
        chosen = active[better]
        affine[chosen] = tried[chosen]
        terms.update(go, chosen)
        kept = better & (gained < _POOR_GAIN * promised)  # at a kink, a longer step would be refused
        damping[active] = np.where(kept, damping[active], _adapt_damping(damping[active], better))
        gains.append(float(gained[better].sum()))
        # Six refused steps in a row, or three that gain little, put an object to rest.
        idle[active] = np.where(gained > little, 0, idle[active] + np.where(better, _REFUSED_STEPS // _STALLED_STEPS, 1))
        active = active[idle[active] < _REFUSED_STEPS]
        if not len(active) or (len(gains) >= _REFUSED_STEPS and sum(gains[-_REFUSED_STEPS:]) <= opt.tolerance * whole):
            return replace(state, affine=affine, damping=damping), True
    return replace(state, affine=affine, damping=damping), False
