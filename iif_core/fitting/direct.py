"""One affine map for each object and the camera response, fitted to the photographs over cached shading (Eq. M.14).

The objective is built on the product of the residuals of two independent halves of the cache (Eq. M.7 and M.8;
docs/method/numerics.md#noise-in-cached-shading).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from iif_core.camera.response import Response
from iif_core.fitting.covariance import sandwich_covariance
from iif_core.fitting.descent import (
    DescentState,
    GaussianPrior,
    Spectrum,
    decompose_objects,
    descend,
    eliminate_objects,
    make_response_prior,
)
from iif_core.fitting.object_levels import UNKNOWN_SCATTER, ObjectLevels, gain_of_the_rest, light_scatter, measure_levels
from iif_core.fitting.pixels import Pixels, choose_evenly, evaluate, prepare_pixels, residuals
from iif_core.fitting.population import (
    Population,
    ProfiledRoughness,
    initial_population,
    population_mean,
    population_prior,
    update_population,
    with_profiled_roughness,
)
from iif_core.fitting.problem import FitOptions, FitProblem, FitResult, Kinds
from iif_core.fitting.selection import (
    EVIDENCE_DISCOUNT,
    KINDS,
    Choice,
    Texture,
    choose_kinds,
    describe_models,
    measure_texture,
    profile_roughness,
    row_variance,
)
from iif_core.fitting.tone import Tone
from iif_core.reflectance.brdf import R_MIN
from iif_core.reflectance.material import GAINS, IDENTITY, MATTE_ROUGHNESS, METALLIC, NUMBERS, ROUGHNESS

SELECTION_PIXELS = 3000
"""Pixels of an object in the selection. With few pixels in each cluster, the errors that its pixels share would go unseen."""
MAX_PIXELS_PER_OBJECT = 12000
"""Pixels of an object in the fit. The error is dominated by what neighbouring pixels have in common, so more do not reduce it."""
POPULATION_PIXELS = 1500
"""Pixels of an object from which the population is learnt."""
WARM_START_STEPS = 10
"""Largest number of steps of the descents whose result is a start."""
LEAST_RESPONSE_WEIGHT = 0.02
"""Smallest weight of an object in the response (Eq. M.25)."""
LEAST_ROUGHNESS_DEVIATION = 0.05
"""Smallest standard deviation of a profiled roughness: half the spacing of the profile's grid (Eq. M.29)."""
LARGEST_BIAS = 0.1
"""Largest shift of a target for the noise of the cache, as a share of its value (Eq. M.13)."""
RIDGE_OF_NUMBER = np.r_[np.where(np.isin(np.arange(12), GAINS), 0.1, 1.0), 2.0, 0.5, 0.1, 0.1]
"""Weight of each number relative to `FitOptions.ridge`, which holds only without population and selection."""


@dataclass(frozen=True)
class FitProgress:
    """State of the fit between its steps.

    Attributes:
        state: numbers and response; prior: of the objects; population: None if it is not used.
        metallic: (O, 2) gain and bias of the metallic.
        profiled: roughness from the profile, once it was made.
        response_weight: (O,) weight q of each object's pixels (Eq. M.25); None: 1.
        levels: both estimates of the level of each object, once they were compared.
        given: (O, 2) roughness and metallic that are known and stay, NaN = fitted; None: all are fitted.
        kinds: what the selection left open; None: nothing was selected.
    """

    state: DescentState
    prior: GaussianPrior
    population: Population | None
    metallic: np.ndarray
    profiled: ProfiledRoughness | None = None
    response_weight: np.ndarray | None = None
    levels: ObjectLevels | None = None
    given: np.ndarray | None = None
    kinds: Kinds | None = None


def fit_affines(problem: FitProblem, response: Response, options: FitOptions | None = None) -> FitResult:
    """Fit sixteen numbers for each object, and the response, by Gauss-Newton on all pixels at once.

    The texture determines which numbers are free (Eq. M.19). Objects with too few pixels get the mean of the population. Response
    `identity` means linear radiance (HDR). The given light sets the gauge (`gauge.apply_gauge` sets another).
    """
    opt = options or FitOptions()
    everything, tone = prepare_pixels(problem, response, opt.min_pixels, MAX_PIXELS_PER_OBJECT)
    texture_of_all = measure_texture(everything, opt)
    # Only objects with enough pixels take part, numbered anew; `result_of` puts them back among all objects.
    members = np.flatnonzero(texture_of_all.enough)
    px, texture = everything.only(members), texture_of_all.only(members)
    start_params = response.params.ravel().astype(np.float64) if tone.size else np.zeros(0)
    given = None if problem.given is None else problem.given[members]
    fit = _start(px, texture, start_params, opt, given)
    if len(members):
        scatter = np.full(problem.n_objects, UNKNOWN_SCATTER) if problem.scatter is None else problem.scatter
        fit = _descend_all(px, fit, tone, texture, opt, start_params, scatter[members])
    return result_of(px, fit, tone, texture, opt, start_params, members, everything.usable, problem.given)


def _descend_all(
    px: Pixels,
    fit: FitProgress,
    tone: Tone,
    texture: Texture,
    opt: FitOptions,
    start_params: np.ndarray,
    scatter: np.ndarray,
) -> FitProgress:
    """Select the kinds, learn the population, and descend on all pixels."""
    if opt.select and opt.lobes:
        fit = _select_kinds(px, fit, tone, texture, opt, start_params)

    # -------- population, both estimates of each level, and light: two rounds (Eq. M.26 to M.36) --------
    if opt.population:
        some = px.take(choose_evenly(px.obj, px.offsets, POPULATION_PIXELS))
        # `weigh_by_halves` replaces targets, and the gain of the light is that on the light as it was given. Both rounds
        # therefore start from the measured targets and the given exposure.
        measured, roughness = some.target, texture.mean[:, 3]
        exposure, light_gain = some.exposure, np.ones(some.n_objects)
        for _ in range(2):
            weigh_by_halves(some, measured, fit.state.affine, tone.at(fit.state.params), opt, fit.response_weight)
            state, _ = descend(some, fit.state, fit.prior, tone, opt, WARM_START_STEPS, start_params)
            terms = evaluate(some, state.affine, tone.at(state.params), opt, True, state.free, scores=True)
            noise = row_variance(terms, some, state.free)
            population = update_population(
                fit.population, terms, state.affine, state.free, noise, roughness, fit.metallic, EVIDENCE_DISCOUNT
            )
            curve, base = tone.at(state.params), texture.mean[:, :3]
            levels = measure_levels(some, state.affine, curve, opt, base, scatter, light_gain, _metal(fit))
            light_gain = levels.light_gain
            some = replace(some, exposure=exposure * light_gain[some.obj])
            fit = replace(fit, state=state, population=population, levels=levels)
            prior = _make_prior(fit, noise, roughness)
            # Gains of the population go with offsets, which bounds cannot find.
            bounded = some.unsaturated() < opt.min_pixels
            prior.centre[bounded, :12] = 0.0
            prior.centre[np.ix_(bounded, GAINS)] = gain_of_the_rest(levels, state.affine)[0]
            fit = replace(fit, prior=prior)
        px.exposure = px.exposure * light_gain[px.obj]

    # -------- all pixels --------
    measured = px.target
    if not opt.population:
        # Weights and targets depend on the numbers, so a short descent comes first. With a population, the two rounds have done
        # this.
        weigh_by_halves(px, measured, fit.state.affine, tone.at(fit.state.params), opt, fit.response_weight)
        state, _ = descend(px, fit.state, fit.prior, tone, opt, WARM_START_STEPS, start_params)
        fit = replace(fit, state=state)
    weigh_by_halves(px, measured, fit.state.affine, tone.at(fit.state.params), opt, fit.response_weight)
    state, _ = descend(px, fit.state, fit.prior, tone, opt, None, start_params)
    return replace(fit, state=state)


def _metal(fit: FitProgress) -> np.ndarray | None:
    """Probability (O,) that what is taken for a metal is one, 0 for everything else; None: kinds were not chosen."""
    if fit.kinds is None:
        return None
    return np.where(fit.kinds.probability.argmax(1) == 1, fit.kinds.probability[:, 1], 0.0)


def weigh_by_halves(
    px: Pixels, measured: np.ndarray, affine: np.ndarray, tone: Tone, opt: FitOptions, response_weight: np.ndarray | None = None
) -> None:
    """Set weights and targets from the distance between the halves (Eq. M.12, M.13); they are held during a descent.

    Pixels whose halves are far apart are fireflies and get a smaller weight. The mean of a curved function over noise is not the
    function at the mean, so targets are moved by the difference. Saturated values bound the prediction only below their noise.

    Args:
        px: pixels, whose `trust` and `target` are replaced.
        measured: (n, 3) targets before any shift; affine: (O, 16) numbers at which the halves are compared.
        tone: curve with the current response; opt: options.
        response_weight: (O,) factor on the weights of each object's pixels; None: 1.
    """
    own = np.ones(px.n_objects) if response_weight is None else response_weight
    if px.diffuse.shape[1] < 2:
        px.trust = np.repeat(own, px.counts)[:, None] * np.ones((1, 3), px.trust.dtype)
        return
    px.target = measured
    errors = residuals(px, affine, tone, opt)
    # d of Eq. M.12; the limit keeps the square of a firefly finite (docs/method/numerics.md#fireflies).
    apart = 0.5 * np.minimum(np.abs(errors[:, 0] - errors[:, 1]), 1e6)
    trust = 1.0 / (1.0 + (apart / (3.0 * opt.robust_width)) ** 2)
    px.trust = np.ascontiguousarray(trust * np.repeat(own, px.counts)[:, None], px.trust.dtype)
    # Value of the curve at the mean prediction, where Eq. M.13 takes its ratio.
    shown = measured + errors.mean(1)
    bias = tone.curvature_ratio(shown) * np.minimum(apart, opt.robust_width) ** 2
    # A bound would take the lower side of the noise for a violation, so it is lowered by 3 d and not shifted.
    bias = np.where(px.saturated, 0.0, np.clip(bias, -LARGEST_BIAS * np.abs(measured), LARGEST_BIAS * np.abs(measured)))
    px.target = np.ascontiguousarray(np.where(px.saturated, measured - 3.0 * apart, measured + bias), measured.dtype)


def hold_given(affine: np.ndarray, free: np.ndarray, metallic: np.ndarray, given: np.ndarray | None) -> None:
    """Put known roughness and metallic (O, 2), NaN = not known, into the numbers (O, 16), which are then not free, and into the
    gain and bias of the metallic (O, 2); all in place."""
    if given is None:
        return
    for column, (numbers, value) in enumerate(zip((ROUGHNESS, METALLIC), given.T, strict=True)):
        known = ~np.isnan(value)
        # A known value x is gain 0 and bias x: the same over the whole object.
        held = np.stack([np.zeros(known.sum()), value[known]], 1)
        affine[np.ix_(known, numbers)] = held
        free[np.ix_(known, numbers)] = False
        if column == 1:
            metallic[known] = held


def _start(px: Pixels, texture: Texture, params: np.ndarray, opt: FitOptions, given: np.ndarray | None = None) -> FitProgress:
    """Start at the mean of the first population, a rough dielectric, or without one at the identity; known values stay."""
    n = px.n_objects
    free = texture.albedo_numbers()
    if opt.select or opt.population:
        # Selection starts from dielectrics of the population's roughness; both stay fixed until kinds are chosen.
        metallic = np.tile(KINDS[0] if opt.select else [1.0, 0.0], (n, 1))
        population = initial_population()
        # No scatter was measured yet: a standard deviation of a row of 0.01 at the default robust width.
        noise = np.full(n, (0.05 * opt.robust_width + 0.005) ** 2 if len(px.obj) else 1.0)
        prior = population_prior(population, noise, texture.mean[:, 3], metallic)
        affine = prior.centre.copy()
        if not opt.select:
            affine[:, 12:] = IDENTITY[12:]
    else:
        metallic, population = np.tile([1.0, 0.0], (n, 1)), None
        affine = np.tile(IDENTITY, (n, 1))
        weight = np.einsum("o,i,ij->oij", px.counts.astype(np.float64), opt.ridge * RIDGE_OF_NUMBER, np.eye(NUMBERS))
        prior = GaussianPrior(affine.copy(), weight)
    if not opt.select:
        # Without selection, roughness is free everywhere and metallic where the predictions suggest it.
        metal = texture.enough & (texture.mean[:, 4] > opt.metallic_prior)
        free[:, 12], free[:, 13] = texture.enough & texture.varied[:, 0], texture.enough
        free[:, 14], free[:, 15] = metal & texture.varied[:, 1], metal
    if not opt.lobes:
        affine[:, 12:], free[:, 12:] = 0.0, False
        affine[:, 13] = np.maximum(texture.mean[:, 3], MATTE_ROUGHNESS)
    hold_given(affine, free, metallic, given)
    state = DescentState(affine, free, params.copy(), np.full(n, 1e-2))
    return FitProgress(state, prior, population, metallic, given=given)


def _select_kinds(
    px: Pixels, fit: FitProgress, tone: Tone, texture: Texture, opt: FitOptions, start_params: np.ndarray
) -> FitProgress:
    """Choose kind and roughness of every object on a few of its pixels; then free the numbers of that kind."""
    # -------- a first descent, which gives response and variance of a row --------
    few = px.take(choose_evenly(px.obj, px.offsets, SELECTION_PIXELS))
    weigh_by_halves(few, few.target, fit.state.affine, tone, opt)
    # Bounds alone cannot tell one local minimum from another.
    measured = texture.enough & (few.unsaturated() >= opt.min_pixels)
    state, _ = descend(few, fit.state, fit.prior, tone, opt, WARM_START_STEPS, start_params)
    terms = evaluate(few, state.affine, tone.at(state.params), opt, True, state.free, scores=True)
    noise = row_variance(terms, few, state.free)

    # -------- profile and choice --------
    prior = population_prior(initial_population(), noise, texture.mean[:, 3], fit.metallic)
    found = profile_roughness(few, state, prior, tone.at(state.params), opt, state.free, measured & texture.mixed)
    choice = choose_kinds(found, measured, texture.mean, px.usable, fit.given, opt.prediction_errors)

    # -------- numbers, free ones and prior of the chosen kind --------
    metallic = KINDS[choice.kind].copy()
    affine = found.affine[np.arange(px.n_objects), choice.kind, choice.at].copy()
    affine[:, 12:] = np.concatenate([np.zeros((px.n_objects, 1)), choice.roughness[:, None], metallic], 1)
    # Objects without evidence stay where the first descent left them.
    affine = np.where(measured[:, None], affine, state.affine)
    free = state.free.copy()
    free[:, 13] = measured
    free[:, 12] = measured & texture.varied[:, 0]
    hold_given(affine, free, metallic, fit.given)
    state = DescentState(affine, free, state.params, np.full(px.n_objects, 1e-3))
    profiled = _profile_errors(few, state, prior, tone, opt, found.noise, choice)
    weight = np.maximum(choice.allowed_share, LEAST_RESPONSE_WEIGHT)
    fit = replace(fit, state=state, metallic=metallic, profiled=profiled, response_weight=weight, kinds=choice.kinds)
    if opt.population:
        fit = replace(fit, population=initial_population(*choice.population))
        return replace(fit, prior=_make_prior(fit, noise, texture.mean[:, 3]))
    # Without a population the roughness keeps the weight of the first prior, around the selected value.
    return replace(fit, prior=GaussianPrior(np.concatenate([fit.prior.centre[:, :12], affine[:, 12:]], 1), fit.prior.weight))


def _profile_errors(
    few: Pixels, state: DescentState, prior: GaussianPrior, tone: Tone, opt: FitOptions, noise: np.ndarray, choice: Choice
) -> ProfiledRoughness:
    """Find error and derivative by the response of each profiled roughness, albedo numbers eliminated (Eq. M.30, M.31)."""
    # -------- curvature in r and coupling to the response, albedo eliminated (Eq. M.30) --------
    # Number 13 is h_r, the bias of the roughness; a change of it is a change of r at every pixel. `row` is H_ra B_aa.
    albedo = state.free & (np.arange(NUMBERS) < 12)
    terms = evaluate(few, state.affine, tone.at(state.params), opt, True, scores=True)
    inverse = np.where(albedo[:, :, None] & albedo[:, None, :], decompose_objects(terms.h, albedo, prior).inverse(), 0.0)
    h, c = terms.h[:, 13, :NUMBERS], terms.h[:, :, NUMBERS:]
    row = np.einsum("oi,oij->oj", h, inverse)
    coupling = c[:, 13] - np.einsum("oi,oip->op", row, c[:, :NUMBERS])
    # `precision` is V of Eq. M.30, `total` is h + V, `share` the part h / (h + V) that the pixels have in the profiled roughness.
    width = max(choice.population[1], LEAST_ROUGHNESS_DEVIATION)
    precision = EVIDENCE_DISCOUNT * noise / width**2
    curvature = np.maximum(h[:, 13] - (row * h).sum(1), 0.0)
    total = curvature + precision
    share = 1.0 - precision / total

    # -------- error of the profiled roughness (Eq. M.31) --------
    clusters = np.diff(few.first)
    owner = np.repeat(np.arange(few.n_objects), clusters)
    # Score of each cluster in r with the albedo eliminated, around the mean of its object.
    own = terms.scores[:, 13] - np.einsum("ki,ki->k", row[owner], terms.scores[:, :NUMBERS])
    own -= (np.bincount(owner, own, few.n_objects) / np.maximum(clusters, 1))[owner]
    # Variance of a row in the direction of roughness, which the profiled roughness depends on; at most the variance of all.
    squares = np.bincount(owner, own**2, few.n_objects) * clusters / np.maximum(clusters - 1, 1)
    scatter = np.minimum(squares / np.maximum(curvature, 1e-12 * total), noise)
    spacing = 2.0 * LEAST_ROUGHNESS_DEVIATION
    # Rounding to a grid is a sawtooth. Its first harmonic has the amplitude spacing / pi, 0.225 spacing in the root mean square.
    # Averaging over a posterior of the width `deviation` damps it by the exponential.
    grid = 0.225 * spacing * np.exp(-2.0 * (np.pi * choice.deviation / spacing) ** 2)
    error = np.sqrt(share * scatter / total + ((1.0 - share) * width) ** 2 + grid**2)
    d_level_d_response = np.where(state.free[:, 13:14], -coupling / total[:, None], 0.0)
    return ProfiledRoughness(choice.roughness, choice.deviation, error, share * scatter, state.params, d_level_d_response)


def _make_prior(fit: FitProgress, noise: np.ndarray, roughness: np.ndarray) -> GaussianPrior:
    """Make the prior of the population; the roughness of profiled objects is moved to the current response (Eq. M.29).

    A descent sees one local minimum and its slope, the profile saw all of them."""
    assert fit.population is not None
    population, seen = fit.population, fit.profiled
    prior = population_prior(population, noise, roughness, fit.metallic, EVIDENCE_DISCOUNT)
    if seen is None:
        return prior
    deviation = np.clip(seen.deviation, LEAST_ROUGHNESS_DEVIATION, population.spread[3])
    # The stored level belongs to the response of the profile; Eq. M.29 carries it to the current one.
    level = np.clip(seen.level + seen.d_level_d_response @ (fit.state.params - seen.params), R_MIN, 1.0)
    seen = replace(seen, level=level, deviation=deviation, params=fit.state.params)
    return with_profiled_roughness(prior, seen, noise, roughness, population.contrast, EVIDENCE_DISCOUNT)


def result_of(
    px: Pixels,
    fit: FitProgress,
    tone: Tone,
    texture: Texture,
    opt: FitOptions,
    start_params: np.ndarray,
    members: np.ndarray,
    counts: np.ndarray,
    given: np.ndarray | None = None,
) -> FitResult:
    """Collect the result of all objects, with covariances.

    Args:
        px: pixels of the fitted objects; fit: where the fit ended; tone: curve at the start; texture: of the fitted objects.
        opt: options; start_params: (P,) response at the start.
        members: indices of the fitted objects; counts: (O,) usable pixels of every object.
        given: (O, 2) roughness and metallic that are known, NaN = not known; None: nothing is.

    Returns:
        Numbers of all objects; known ones have no variance. Objects that were not fitted get the mean of the population, or the
        identity without one. Their albedo is the base albedo at the level that the fitted objects have relative to their base.
    """
    state, n_objects = fit.state, len(counts)

    # -------- objects that were not fitted --------
    affine, free = np.tile(IDENTITY, (n_objects, 1)), np.zeros((n_objects, NUMBERS), bool)
    covariance, residual = np.zeros((n_objects, NUMBERS, NUMBERS)), np.zeros(n_objects)
    if fit.population is not None and len(members):
        affine[:] = population_mean(fit.population, np.zeros(1), KINDS[:1])
        # A dielectric of one roughness, the population's mean.
        affine[:, 12] = 0.0
        affine[:, 13] = affine[:, 13] if opt.lobes else np.maximum(affine[:, 13], MATTE_ROUGHNESS)
        spread = fit.population.spread[0]
        if fit.levels is not None:
            affine[:, GAINS], spread = gain_of_the_rest(fit.levels, state.affine)
        # The three gains err together, by one factor: a covariance of rank one.
        albedo = np.where(np.isin(np.arange(NUMBERS), GAINS), affine, 0.0)
        covariance[:] = (spread * albedo)[:, :, None] * (spread * albedo)[:, None, :]

    # -------- fitted objects: covariance (Eq. M.37 to M.40) and residual --------
    affine[members], free[members] = state.affine, state.free
    final, of_response = tone.at(state.params), np.zeros((tone.size, tone.size))
    spectrum: Spectrum | None = None
    if len(px.obj):
        terms = evaluate(px, state.affine, final, opt, True)
        fitted = bool(opt.free_response and tone.size)
        prior = fit.prior
        if fit.levels is not None:
            # The error of the light acts on the gradient like an error of the prior's centre does.
            by_light = light_scatter(fit.levels, terms.h[:, :NUMBERS, :NUMBERS], state.affine)
            prior = replace(prior, scatter=by_light if prior.scatter is None else prior.scatter + by_light)
        blocks = spectrum = decompose_objects(terms.h, state.free, fit.prior)
        curve_prior = make_response_prior(opt, len(px.obj), start_params)
        # Undamped: the covariance is a matter of the curvature alone.
        system = eliminate_objects(terms, state, fit.prior, curve_prior, fitted, blocks, damped=False)
        covariance[members], of_response = sandwich_covariance(px, state, system, prior, curve_prior, final, opt)
        errors = residuals(px, state.affine, final, opt).mean(1)
        # Bounds are no measurements, so they are in neither sum.
        errors[px.saturated] = 0.0
        square = px.sum_by_object((np.minimum(np.abs(errors), 1e6) ** 2).sum(1))
        residual[members] = np.sqrt(square / np.maximum(px.sum_by_object((~px.saturated).sum(1)), 1))
    kinds = None if fit.kinds is None else fit.kinds.among(members, n_objects)
    light_gain = np.ones(n_objects)
    if fit.levels is not None:
        light_gain[members] = fit.levels.light_gain
    facts = {**_facts(fit), "numerics": _numerics(px, fit, spectrum)} if len(members) else {}
    rank = np.zeros(n_objects, np.int64)
    rank[members] = texture.rank
    models = describe_models(rank, free, affine, counts, given)
    hold_given(affine, free, np.zeros((n_objects, 2)), given)
    return FitResult(
        affine=affine,
        covariance=covariance,
        free=free,
        pixels=counts.astype(np.int64),
        residual=residual,
        model=models,
        response=final.response,
        light_scale=1.0,
        history=list(state.history) or [0.0],
        converged=state.converged or not free.any(),
        response_covariance=of_response,
        iterations=max(len(state.history) - 1, 0),
        reason=state.reason or "nothing to fit",
        facts=facts,
        light_gain=light_gain,
        kinds=kinds,
    )


def _numerics(px: Pixels, fit: FitProgress, blocks: Spectrum | None) -> dict[str, float]:
    """Return the largest condition of an object's block, and the share of pixels with less than half of their weight."""
    own = np.ones(px.n_objects) if fit.response_weight is None else fit.response_weight
    weight = px.trust.mean(1) / np.repeat(own, px.counts)
    size = np.abs(blocks.values) if blocks is not None else np.ones((1, 1))
    condition = size.max(1) / np.maximum(size.min(1), 1e-300)
    return {"condition": float(condition.max()), "downweighted": float((weight < 0.5).mean()) if len(weight) else 0.0}


def _facts(fit: FitProgress) -> dict[str, object]:
    """Return what was learnt from the scene, for `affines.json`."""
    facts: dict[str, object] = {}
    if fit.population is not None:
        facts["population"] = fit.population.facts()
    if fit.levels is not None:
        facts["level_errors"] = fit.levels.facts()
    return facts
