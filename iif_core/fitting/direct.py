"""One affine correction per object and the camera response, fitted to the photographs over cached shading (METHOD 7b).

Pixel p of object o shows I = f(e L), L = (1 - m) a D + [0.04 (1 - m) + m a] S0(r) + S1(r), with a, r, m corrected by the sixteen
numbers of the object.

Noise in the cached shading flattens the slope of log I over log L: a plain fit overestimates gamma and shrinks gains. With two
independent halves 1, 2 of the cache we minimise sum rho(e1 e2) instead of sum rho(e^2): the expectation of the product of two
residuals with independent noise is the squared noise-free residual, and its Gauss-Newton system is
H = (J1' W J2 + J2' W J1) / 2, g = (J1' W e2 + J2' W e1) / 2.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from iif_core.camera.response import Response
from iif_core.fitting.covariance import sandwich
from iif_core.fitting.descent import Pull, State, arrowhead, descend, object_blocks, response_prior
from iif_core.fitting.pixels import Pixels, evaluate, evenly, prepare, residuals
from iif_core.fitting.population import Population, before, centre_of, lean, learn, pull_of
from iif_core.fitting.problem import GAINS, IDENTITY, MATTE, PARAMETERS, FitOptions, FitProblem, FitResult
from iif_core.fitting.selection import DISCOUNT, KINDS, Choice, Texture, choose, describe, profile, row_noise, texture_of
from iif_core.fitting.tone import Tone
from iif_core.reflectance.brdf import R_MIN

_FEW = 300  # pixels of an object that are enough to choose a valley
_ENOUGH = 12000  # more say no more: what their patches share is what the fit errs by
_MANY = 1500  # that are enough to learn what objects have in common
_LEAST = 0.02  # weight of the pixels of an object that looks like what it is not taken for
_SHARP = 0.05  # half the distance of two points of the profile's grid: how far the profile is to be trusted
_MOST_BIAS = 0.1  # of the sensor value, that noise of the cache may be taken to shift it
_EARLY = 10  # steps of the descents whose end is only a start
_RIDGE = np.r_[np.where(np.isin(np.arange(12), GAINS), 0.1, 1.0), 2.0, 0.5, 0.1, 0.1]
"""Without a population: pull of each number relative to `FitOptions.ridge`. Cross terms are weakly determined (METHOD 7b)."""


@dataclass(frozen=True)
class _Profiled:
    """What the profile said about roughness, and how far it is to be believed.

    Attributes:
        choice: the posterior; error: (O,) standard deviation of its mean, of noise alone (`choice.deviation` is discounted);
            shared: (O,) what a unit of its weight has in common with the gradient of the pixels.
        params: (P,) the response at which it was made; sway: (O, P) how it moves with the response.
    """

    choice: Choice
    error: np.ndarray
    shared: np.ndarray
    params: np.ndarray
    sway: np.ndarray


@dataclass(frozen=True)
class Fit:
    """Where the fit stands between its steps."""

    state: State
    pull: Pull
    population: Population | None
    metallic: np.ndarray
    profiled: _Profiled | None = None
    vote: np.ndarray | None = None


def fit_affines(problem: FitProblem, response: Response, options: FitOptions | None = None) -> FitResult:
    """Sixteen numbers per object and the response, by Gauss-Newton on all pixels at once.

    Which numbers are free follows the texture (METHOD 8): a constant object gets three gains, one with a single direction of
    colour gains and biases, others the full map. Objects with too few pixels take what the others have in common.

    Args:
        problem: pixels, base values, cached shading.
        response: starting response; `identity` means linear radiance (HDR).
        options: see `FitOptions`.

    Returns:
        `FitResult`, always finite. The gauge is that of the given light (`gauge.pin` sets another).
    """
    opt = options or FitOptions()
    everything, tone = prepare(problem, response, opt.min_pixels, _ENOUGH)
    texture_of_all = texture_of(everything, opt)
    members = np.flatnonzero(texture_of_all.enough)
    px, texture = everything.only(members), texture_of_all.only(members)
    start_params = response.params.ravel().astype(np.float64) if tone.size else np.zeros(0)
    fit = _begin(px, texture, start_params, opt)
    if len(members):
        fit = _descend_all(px, fit, tone, texture, opt, start_params)
    return result_of(px, fit, tone, texture, opt, start_params, members, everything.usable)


def _descend_all(px: Pixels, fit: Fit, tone: Tone, texture: Texture, opt: FitOptions, start_params: np.ndarray) -> Fit:
    if opt.select and not opt.matte:
        fit = _select(px, fit, tone, texture, opt, start_params)
    if opt.population:
        index = evenly(px.obj, px.offsets, _MANY)
        some = px.take(index)
        measured = some.target
        for _ in range(2):
            weigh(some, measured, fit.state.affine, tone.at(fit.state.params), opt, fit.vote)
            state, _ = descend(some, fit.state, fit.pull, tone, opt, _EARLY, None, start_params)
            terms = evaluate(some, state.affine, tone.at(state.params), opt, True, state.free, scores=True)
            noise = row_noise(terms, some, state.free)
            mean = texture.mean[:, 3]
            population = learn(fit.population, terms, some, state.affine, state.free, noise, mean, fit.metallic, DISCOUNT)
            fit = replace(fit, state=state, population=population)
            fit = replace(fit, pull=_pull(fit, noise, mean))
    measured = px.target
    if not opt.population:
        weigh(px, measured, fit.state.affine, tone.at(fit.state.params), opt, fit.vote)
        state, _ = descend(px, fit.state, fit.pull, tone, opt, _EARLY, None, start_params)
        fit = replace(fit, state=state)
    weigh(px, measured, fit.state.affine, tone.at(fit.state.params), opt, fit.vote)
    state, _ = descend(px, fit.state, fit.pull, tone, opt, None, None, start_params)
    return replace(fit, state=state)


def weigh(
    px: Pixels, measured: np.ndarray, affine: np.ndarray, tone: Tone, opt: FitOptions, vote: np.ndarray | None = None
) -> None:
    """Weights and bias that follow from the distance between the halves, at `affine`; they are held during a descent.

    Fireflies are three robust widths apart. The mean of a bent curve over noise is not the curve at the mean: each half's f(e L)
    is off by f'' var(e L) / 2 = (f'' / f'^2) d^2 on average, d half the distance; `measured` is moved by as much.

    `vote` (O,): weight of an object's pixels beside those of the others, with which it shares the response.
    """
    own = np.ones(px.n_objects) if vote is None else vote
    if px.diffuse.shape[1] < 2:
        px.trust = np.repeat(own, px.counts)[:, None] * np.ones((1, 3), px.trust.dtype)
        return
    px.target = measured
    errors = residuals(px, affine, tone, opt)
    apart = 0.5 * np.minimum(np.abs(errors[:, 0] - errors[:, 1]), 1e6)
    trust = 1.0 / (1.0 + (apart / (3.0 * opt.robust_width)) ** 2)
    px.trust = np.ascontiguousarray(trust * np.repeat(own, px.counts)[:, None], px.trust.dtype)
    shown = measured + errors.mean(1)
    bias = tone.bend(shown) * np.minimum(apart, opt.robust_width) ** 2
    bias = np.where(px.saturated, 0.0, np.clip(bias, -_MOST_BIAS * np.abs(measured), _MOST_BIAS * np.abs(measured)))
    # A one-sided row takes the low side of the noise for a violation; bounds count below their noise only.
    px.target = np.ascontiguousarray(np.where(px.saturated, measured - 3.0 * apart, measured + bias), measured.dtype)


def _begin(px: Pixels, texture: Texture, params: np.ndarray, opt: FitOptions) -> Fit:
    """The identity, or the population nobody was seen of: a rough dielectric."""
    n = px.n_objects
    free = texture.albedo_numbers()
    if opt.select or opt.population:
        metallic = np.tile(KINDS[0] if opt.select else [1.0, 0.0], (n, 1))
        population = before()
        noise = np.full(n, (0.05 * opt.robust_width + 0.005) ** 2 if len(px.obj) else 1.0)
        pull = pull_of(population, noise, texture.mean[:, 3], metallic)
        affine = pull.centre.copy()
        if not opt.select:
            affine[:, 12:] = IDENTITY[12:]
    else:
        metallic, population = np.tile([1.0, 0.0], (n, 1)), None
        affine = np.tile(IDENTITY, (n, 1))
        weight = np.einsum("o,i,ij->oij", px.counts.astype(np.float64), opt.ridge * _RIDGE, np.eye(PARAMETERS))
        pull = Pull(affine.copy(), weight)
    if not opt.select:
        metal = texture.enough & (texture.mean[:, 4] > opt.metallic_prior)
        free[:, 12], free[:, 13] = texture.enough & texture.varied[:, 0], texture.enough
        free[:, 14], free[:, 15] = metal & texture.varied[:, 1], metal
    if opt.matte:
        affine[:, 12:], free[:, 12:] = MATTE, False
    return Fit(State(affine, free, params.copy(), np.full(n, 1e-2)), pull, population, metallic)


def _select(px: Pixels, fit: Fit, tone: Tone, texture: Texture, opt: FitOptions, start_params: np.ndarray) -> Fit:
    """Kind and valley of every object on a few of its pixels; then all numbers of the chosen kind are free."""
    few = px.take(evenly(px.obj, px.offsets, _FEW))
    weigh(few, few.target, fit.state.affine, tone, opt)
    # Bounds alone cannot tell one valley from another.
    measured = texture.enough & (np.bincount(few.obj, (~few.saturated).any(1), px.n_objects) >= opt.min_pixels)
    state, _ = descend(few, fit.state, fit.pull, tone, opt, _EARLY, None, start_params)
    terms = evaluate(few, state.affine, tone.at(state.params), opt, True, state.free, scores=True)
    noise = row_noise(terms, few, state.free)
    pull = pull_of(before(), noise, texture.mean[:, 3], fit.metallic)
    found = profile(few, state, pull, tone.at(state.params), opt, state.free, measured & texture.mixed)
    choice = choose(found, measured)
    metallic = KINDS[choice.kind]
    affine = found.affine[np.arange(px.n_objects), choice.kind, choice.at].copy()
    affine[:, 12:] = np.concatenate([np.zeros((px.n_objects, 1)), choice.roughness[:, None], metallic], 1)
    affine = np.where(measured[:, None], affine, state.affine)
    free = state.free.copy()
    free[:, 13] = measured
    free[:, 12] = measured & texture.varied[:, 0]
    state = State(affine, free, state.params, np.full(px.n_objects, 1e-3))
    seen = _believed(few, state, pull, tone, opt, found.noise, choice)
    fit = replace(fit, state=state, metallic=metallic, profiled=seen, vote=np.maximum(choice.sure, _LEAST))
    if opt.population:
        fit = replace(fit, population=before(*choice.population))
        return replace(fit, pull=_pull(fit, noise, texture.mean[:, 3]))
    # as weakly as the ridge says
    return replace(fit, pull=Pull(np.concatenate([fit.pull.centre[:, :12], affine[:, 12:]], 1), fit.pull.weight))


def _believed(few: Pixels, state: State, pull: Pull, tone: Tone, opt: FitOptions, noise: np.ndarray, choice: Choice) -> _Profiled:
    """With the curvature H of the objective and its coupling C to the response, the albedo eliminated, and the precision V of the
    profile's prior, the profile's roughness has the error H noise / (H + V)^2 of the pixels, V / (H + V) of the histogram's
    width, and that of its grid; it moves with the response by - C / (H + V)."""
    albedo = state.free & (np.arange(PARAMETERS) < 12)
    terms = evaluate(few, state.affine, tone.at(state.params), opt, True, scores=True)
    inverse = np.where(albedo[:, :, None] & albedo[:, None, :], object_blocks(terms.h, albedo, pull).inverse(), 0.0)
    h, c = terms.h[:, 13, :PARAMETERS], terms.h[:, :, PARAMETERS:]
    row = np.einsum("oi,oij->oj", h, inverse)
    coupling = c[:, 13] - np.einsum("oi,oip->op", row, c[:, :PARAMETERS])
    width = max(choice.population[1], _SHARP)
    prior = DISCOUNT * noise / width**2
    curvature = np.maximum(h[:, 13] - (row * h).sum(1), 0.0)
    total = curvature + prior
    share = 1.0 - prior / total
    clusters = np.diff(few.first)
    owner = np.repeat(np.arange(few.n_objects), clusters)
    own = terms.scores[:, 13] - np.einsum("ki,ki->k", row[owner], terms.scores[:, :PARAMETERS])
    own -= (np.bincount(owner, own, few.n_objects) / np.maximum(clusters, 1))[owner]
    # the variance of a row that matters here: that of the direction of roughness
    squares = np.bincount(owner, own**2, few.n_objects) * clusters / np.maximum(clusters - 1, 1)
    scatter = np.minimum(squares / np.maximum(curvature, 1e-12 * total), noise)
    spacing = 2.0 * _SHARP
    grid = 0.225 * spacing * np.exp(-2.0 * (np.pi * choice.deviation / spacing) ** 2)
    error = np.sqrt(share * scatter / total + ((1.0 - share) * width) ** 2 + grid**2)
    sway = np.where(state.free[:, 13:14], -coupling / total[:, None], 0.0)
    return _Profiled(choice, error, share * scatter, state.params, sway)


def _pull(fit: Fit, noise: np.ndarray, roughness: np.ndarray) -> Pull:
    """Towards the population; roughness towards where the profile saw it (the descent sees one valley and its slope), had it
    known the response of today."""
    assert fit.population is not None
    population, seen = fit.population, fit.profiled
    pull = pull_of(population, noise, roughness, fit.metallic, DISCOUNT)
    if seen is None:
        return pull
    deviation = np.clip(seen.choice.deviation, _SHARP, population.spread[3])
    level = np.clip(seen.choice.roughness + seen.sway @ (fit.state.params - seen.params), R_MIN, 1.0)
    return lean(pull, level, deviation, seen.error, seen.shared, seen.sway, noise, roughness, population.contrast, DISCOUNT)


def result_of(
    px: Pixels,
    fit: Fit,
    tone: Tone,
    texture: Texture,
    opt: FitOptions,
    start_params: np.ndarray,
    members: np.ndarray,
    counts: np.ndarray,
) -> FitResult:
    """The result of all objects; `members`: the objects of `px`, `counts` (O,): usable pixels of every object."""
    state, n_objects = fit.state, len(counts)
    affine, free = np.tile(IDENTITY, (n_objects, 1)), np.zeros((n_objects, PARAMETERS), bool)
    if fit.population is not None and len(members):
        affine[:] = centre_of(fit.population, np.zeros(1), KINDS[:1])
        affine[:, 12] = 0.0
    covariance, residual = np.zeros((n_objects, PARAMETERS, PARAMETERS)), np.zeros(n_objects)
    affine[members], free[members] = state.affine, state.free
    final, of_response = tone.at(state.params), np.zeros((tone.size, tone.size))
    if len(px.obj):
        terms = evaluate(px, state.affine, final, opt, True)
        fitted = bool(opt.free_response and tone.size)
        blocks = object_blocks(terms.h, state.free, fit.pull)
        prior = response_prior(opt, len(px.obj), start_params)
        system = arrowhead(terms, state, fit.pull, prior, fitted, blocks, damped=False)
        covariance[members], of_response = sandwich(px, state, system, fit.pull, prior, final, opt)
        errors = residuals(px, state.affine, final, opt).mean(1)
        errors[px.saturated] = 0.0
        square = px.sum_by_object((np.minimum(np.abs(errors), 1e6) ** 2).sum(1))
        residual[members] = np.sqrt(square / np.maximum(px.sum_by_object((~px.saturated).sum(1)), 1))
    rank = np.zeros(n_objects, np.int64)
    rank[members] = texture.rank
    return FitResult(
        affine,
        covariance,
        free,
        counts.astype(np.int64),
        residual,
        describe(rank, free, affine, counts),
        final.response,
        1.0,
        list(state.history) or [0.0],
        state.converged or not free.any(),
        of_response,
        max(len(state.history) - 1, 0),
        state.reason or "nothing to fit",
        {"population": fit.population.facts()} if fit.population is not None and len(members) else {},
    )
