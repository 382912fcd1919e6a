"""Which numbers each object can carry, and its kind and local minimum of roughness
(docs/method/fitting.md#selection-of-kind-and-roughness).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from iif_core.fitting.descent import DescentState, GaussianPrior, decompose
from iif_core.fitting.pixels import Pixels, Terms, evaluate, penalties_of, run_in_threads
from iif_core.fitting.predictions import DEGREES_OF_FREEDOM, PredictionErrors
from iif_core.fitting.problem import FitOptions, Kinds
from iif_core.fitting.profile_kernels import AlbedoTask, fit_albedo
from iif_core.fitting.tone import Tone
from iif_core.reflectance.material import BIASES, CROSS_TERMS, GAINS, IDENTITY, METALLIC, NUMBERS, ROUGHNESS

ROUGHNESS_GRID = np.array([0.05, 0.13, 0.22, 0.32, 0.44, 0.57, 0.7, 0.84, 0.98])
"""Roughness values of the profile."""
_STEPS_PER_POINT = 3
"""Gauss-Newton steps of the albedo at each point of the profile, from the result of its neighbour."""
_SMOOTHING = (0.25, 0.5)
"""Share of a bin that goes to each neighbour, and that stays, when the histogram is smoothed over roughness (Eq. M.23)."""
_PSEUDO_OBJECTS = 0.5
"""Weight of the first histogram, in objects for each pair."""
KINDS = np.array([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0]])
"""Gain and bias of the metallic of a dielectric, of a metal, and of metallic as predicted."""
ROUGHEST_METAL = 0.6
"""A rougher metal and a dielectric of another albedo look alike, and errors of the light would decide between them. Objects whose
best metal is rougher are taken for dielectrics."""
_PRIOR_OF_KINDS = np.array([[0.85], [0.1], [0.05]])
"""Shares of the kinds before any object was fitted."""
EVIDENCE_DISCOUNT = 20.0
"""Factor on the variance of a row in the evidence (Eq. M.21). The scatter between clusters shows what varies over an object, but
not the errors of light and geometry that the whole object shares."""
METAL_ODDS = (-1.74, 0.38, 0.70, 1.22)
"""Logarithm of the odds of metal where the prior states its errors (Eq. M.56): constant, and what counts of the odds that the
base states, of the evidence of the photographs, and of the brightness that a metal would have relative to the base."""
_BRIGHTER = (-1.0, 1.5)
"""Limits of the logarithm of that brightness."""

FEWEST_OBJECTS = 4
"""Objects from which the brightness relative to the base is compared."""
LEAST_SPREAD = 0.1
"""Least spread over the objects of the logarithm of their brightness relative to the base."""
_NORMAL_MEDIAN = 1.4826  # standard deviation of a normal distribution over its median deviation
_UNRELATED_OBJECTS = 2.0
"""Weight of the assumption that the roughness of the base says nothing, in objects."""
_ROUGHNESS_SPREAD = 0.25
"""Standard deviation of the roughness of those objects."""
_LEAST_BASE_SCATTER = 1e-3
"""Least scatter of the roughness of the base around its line."""
_DARKEST = 0.01  # brightness below which a level counts as this


@dataclass(frozen=True)
class Texture:
    """What the base texture of each object can determine.

    Attributes:
        enough: (O,) bool, has `FitOptions.min_pixels`.
        rank: (O,) number of directions in which its colours vary; varied: (O, 2) bool, roughness and metallic vary.
        mean: (O, 5) mean base material.
        mixed: (O,) bool, the predicted metallic is below 0.25 in 5 % of the pixels and above 0.75 in another 5 %.
    """

    enough: np.ndarray
    rank: np.ndarray
    varied: np.ndarray
    mean: np.ndarray
    mixed: np.ndarray

    def only(self, objects: np.ndarray) -> Texture:
        """Return the rows of some objects."""
        return Texture(*(getattr(self, name)[objects] for name in ("enough", "rank", "varied", "mean", "mixed")))

    def albedo_numbers(self) -> np.ndarray:
        """Return which albedo numbers are free (Eq. M.19), (O, 16) bool."""
        free = np.zeros((len(self.enough), NUMBERS), bool)
        free[:, GAINS] = self.enough[:, None]
        free[:, BIASES] = (self.enough & (self.rank >= 1))[:, None]
        free[:, CROSS_TERMS] = (self.enough & (self.rank >= 2))[:, None]
        return free


def measure_texture(px: Pixels, opt: FitOptions) -> Texture:
    """Measure the base texture of each object; a direction counts if its standard deviation exceeds `opt.texture_sigma`."""
    base = px.base.astype(np.float64)
    counts = np.maximum(px.counts, 1)[:, None]
    mean = np.stack([px.sum_by_object(base[:, c]) for c in range(5)], 1) / counts
    away = base - mean[px.obj]
    # Covariance of the base colours of each object; its eigenvalues are the variances along the directions of colour (Eq. M.19).
    covariance = np.zeros((px.n_objects, 3, 3))
    for i in range(3):
        for j in range(i, 3):
            covariance[:, i, j] = covariance[:, j, i] = px.sum_by_object(away[:, i] * away[:, j])
    rank = (np.linalg.eigvalsh(covariance / counts[:, :, None]) > opt.texture_sigma**2).sum(1)
    spread = np.stack([px.sum_by_object(away[:, c] ** 2) for c in (3, 4)], 1) / counts
    ends = np.stack([px.sum_by_object(base[:, 4] < 0.25), px.sum_by_object(base[:, 4] > 0.75)], 1) / counts
    return Texture(px.counts >= opt.min_pixels, rank, spread > opt.texture_sigma**2, mean, (ends > 0.05).all(1))


def row_variance(terms: Terms, px: Pixels, free: np.ndarray) -> np.ndarray:
    """Return the effective variance of a row of each object, (O,), from the scatter of the gradient between clusters (Eq. M.22).

    With independent errors this is their variance; errors that the pixels of a cluster share make it larger. Objects with fewer
    than four clusters get the median over the others.
    """
    # With independent rows of variance s the score u_k of a cluster has the covariance s H_k, so the sum of u_k' H^-1 u_k is s
    # times the number of free numbers. Errors that the pixels of a cluster share add up in u_k and enlarge it.
    centred, counts = _centred_scores(terms, px)
    out = np.full(px.n_objects, np.nan)
    for o in np.flatnonzero((counts >= 4) & free.any(1)):
        k = free[o]
        own = centred[px.first[o] : px.first[o + 1]][:, :NUMBERS][:, k]
        block = terms.h[o][:NUMBERS, :NUMBERS][np.ix_(k, k)]
        # The damping bounds what directions contribute that the pixels hardly determine.
        inverse = decompose(block[None]).inverse(1e-6)[0]
        out[o] = np.einsum("ci,ij,cj->", own, inverse, own) / k.sum() * counts[o] / (counts[o] - 1)
    known = np.isfinite(out) & (out > 0)
    middle = float(np.median(out[known])) if known.any() else 1e-6
    return np.where(known, np.maximum(out, 0.05 * middle), middle)


def _centred_scores(terms: Terms, px: Pixels) -> tuple[np.ndarray, np.ndarray]:
    """Return the scores of the clusters minus the mean of their object, and each object's number of clusters with pixels."""
    filled = np.diff(px.starts) > 0
    owner = np.repeat(np.arange(px.n_objects), np.diff(px.first))
    counts = np.bincount(owner[filled], minlength=px.n_objects)
    # `terms.g` is the sum of the scores of an object.
    mean = terms.g / np.maximum(counts, 1)[:, None]
    return np.where(filled[:, None], terms.scores - mean[owner], 0.0), counts


@dataclass(frozen=True)
class Profile:
    """Evidence of every kind at each roughness of `ROUGHNESS_GRID`.

    Attributes:
        cost: (O, 3, R) data term plus prior with the albedo fitted; infinite where not tried. The roughest dielectric has the
            lower of two costs: its own, and the cost without a specular lobe.
        affine: (O, 3, R, 16) numbers; noise: (O,) variance of a row.
    """

    cost: np.ndarray
    affine: np.ndarray
    noise: np.ndarray


def profile_roughness(
    px: Pixels,
    state: DescentState,
    prior: GaussianPrior,
    tone: Tone,
    opt: FitOptions,
    free: np.ndarray,
    mixed: np.ndarray,
) -> Profile:
    """Fit the albedo numbers for every kind and roughness, with the response held (Eq. M.20).

    Args:
        px: pixels; state: start; prior: only its diagonal counts; tone: curve with the current response; opt: options.
        free: (O, 16) bool numbers, of which the albedo is fitted; mixed: (O,) bool, metallic as predicted is tried.

    Returns:
        The evidence; roughness is worked through from rough to smooth, each value starting from its neighbour.
    """
    n_objects = px.n_objects
    cost = np.full((n_objects, 3, len(ROUGHNESS_GRID)), np.inf)
    affine = np.zeros((n_objects, 3, len(ROUGHNESS_GRID), NUMBERS))
    everything = np.arange(n_objects)
    for kind in range(3 if opt.metals else 1):
        # Metallic as predicted makes sense only where the predictions show both kinds on one object.
        tried = np.flatnonzero(mixed) if kind == 2 else everything
        current = state.affine[:, :12].copy()
        for at in range(len(ROUGHNESS_GRID) - 1, -1, -1):
            first = at == len(ROUGHNESS_GRID) - 1
            steps = 2 * _STEPS_PER_POINT if first else _STEPS_PER_POINT
            # `current` (O, 12) is overwritten with the fit, so the next, smoother value starts from it. The first one starts from
            # a descent at another roughness and gets twice the steps.
            found = _fit_albedo_at(px, current, prior, tone, opt, free, KINDS[kind], ROUGHNESS_GRID[at], steps, tried)
            if kind == 0 and first:  # without a specular lobe, which a very wide one resembles
                bare = _fit_albedo_at(px, current.copy(), prior, tone, opt, free, KINDS[0], -1.0, steps, tried)
                found = np.minimum(found, bare)
            cost[tried, kind, at] = found[tried]
            affine[:, kind, at, :12] = current
            affine[:, kind, at, 13:] = [ROUGHNESS_GRID[at], *KINDS[kind]]
    # The variance of a row is measured at the best pair, over the albedo numbers alone: those are what the profile fits.
    best = cost.reshape(n_objects, -1).argmin(1)
    where = affine.reshape(n_objects, -1, NUMBERS)[everything, best]
    albedo = free & (np.arange(NUMBERS) < 12)
    terms = evaluate(px, where, tone, opt, True, albedo, scores=True)
    return Profile(cost, affine, row_variance(terms, px, albedo))


def _fit_albedo_at(
    px: Pixels,
    affine: np.ndarray,
    prior: GaussianPrior,
    tone: Tone,
    opt: FitOptions,
    free: np.ndarray,
    metallic: np.ndarray,
    roughness: float,
    steps: int,
    objects: np.ndarray,
) -> np.ndarray:
    """Fit the albedo numbers `affine` (O, 12) of some objects in place, at one roughness (negative: no lobe) and one metallic.
    Returns data term plus prior of the objects, (O,)."""
    cost = np.zeros(px.n_objects)
    weight = np.diagonal(prior.weight, axis1=1, axis2=2)[:, :12]  # the first prior has no correlations
    task = AlbedoTask(free, prior.centre, weight, metallic, roughness, steps, opt.tolerance)

    def work(part: np.ndarray) -> None:
        fit_albedo(px.arrays, tone.tables, penalties_of(opt), task, part, affine, cost)

    run_in_threads(work, px, objects, opt.threads)
    return cost


@dataclass(frozen=True)
class Choice:
    """Posterior of the profile (Eq. M.24).

    Attributes:
        kind: (O,) int, row of `KINDS`; kinds: posterior of all of them.
        roughness, deviation: (O,) posterior mean and standard deviation given the kind; at: (O,) nearest index in
            `ROUGHNESS_GRID`.
        population: mean and standard deviation of the roughness over the objects.
        allowed_share: (O,) share of the evidence for pairs that are not excluded by `ROUGHEST_METAL` (Eq. M.25).
    """

    kind: np.ndarray
    kinds: Kinds
    roughness: np.ndarray
    deviation: np.ndarray
    at: np.ndarray
    population: tuple[float, float]
    allowed_share: np.ndarray


def choose_kinds(
    found: Profile,
    counts: np.ndarray,
    mean_base: np.ndarray,
    pixels: np.ndarray,
    given: np.ndarray | None = None,
    stated: PredictionErrors | None = None,
) -> Choice:
    """Learn the histogram of kind and roughness by EM (Eq. M.21, M.23) and return the posterior of each object.

    Which of two objects has the rougher base counts as an observation of their roughness, and a metal must agree with the
    brightness of its base at least as well as a dielectric does. Where the prior of the predictions states its errors, the
    roughness of the base takes the place of the histogram's, and the odds of metal are those of rooms with truth (Eq. M.56;
    docs/method/fitting.md#selection-of-kind-and-roughness).

    Args:
        found: the evidence; counts: (O,) bool, objects that enter the histogram.
        mean_base: (O, 5) mean base material; pixels: (O,) usable pixels.
        given: (O, 2) roughness and metallic that are known, NaN = chosen here; None: all are chosen.
        stated: errors of the predictions; None: not known.
    """
    # -------- evidence (Eq. M.21), and the pairs that are allowed --------
    # `everything` is the evidence of all pairs, `cost` is infinite where a pair is excluded. Exponents stay above -700
    # (docs/method/numerics.md#exponentials-of-evidence).
    cost = found.cost.copy()
    scale = EVIDENCE_DISCOUNT * found.noise[:, None, None]
    everything = np.exp(np.maximum((cost.min((1, 2), keepdims=True) - cost) / scale, -700.0)) * _PRIOR_OF_KINDS
    if stated is None:  # an object whose best metal is too rough loses all its metals, not only the rough ones
        cost[ROUGHNESS_GRID[cost[:, 1].argmin(1)] > ROUGHEST_METAL, 1] = np.inf
    cost[:, 1, ROUGHNESS_GRID > ROUGHEST_METAL] = np.inf
    if given is not None:
        cost = _within_given(cost, found.cost, given)
    allowed_share = np.where(np.isfinite(cost), everything, 0.0).sum((1, 2)) / everything.sum((1, 2))

    # -------- what enters the EM: photographs, base, and the first histogram --------
    log_likelihood = (cost.min((1, 2), keepdims=True) - cost) / scale
    likelihood = np.where(counts[:, None, None], np.exp(np.maximum(log_likelihood, -700.0)), 1.0)
    flat = _PRIOR_OF_KINDS / len(ROUGHNESS_GRID) * np.ones(len(ROUGHNESS_GRID))
    prior, brightness = flat, _log_brightness(found, mean_base[:, :3])
    # (O, R) likelihood of the base's roughness at each roughness of the grid; 1 = the base says nothing.
    of_base = np.ones((len(counts), len(ROUGHNESS_GRID)))
    witnesses = np.zeros((len(counts), 3))
    if stated is not None:
        of_base = stated.roughness_prior(mean_base[:, 3], ROUGHNESS_GRID)
        of_photographs = log_likelihood + np.log(of_base)[:, None]
        told = counts & np.isfinite(cost[:, :2]).any(2).all(1)
        kinds = _metal_against_dielectric(of_photographs, brightness, told)
        witnesses = np.column_stack([stated.metal_log_odds(mean_base[:, 4]), kinds])
    metal = metal_log_odds(witnesses)

    # -------- EM: posteriors of the objects, then the histogram they share (Eq. M.23) --------
    for _ in range(50):
        posterior = likelihood * prior * of_base[:, None]
        if stated is not None:
            posterior = _with_metal_odds(posterior, metal, np.isfinite(cost).any(2))
        elif counts.sum() >= FEWEST_OBJECTS:
            posterior *= _agreement_with_base(posterior, brightness, counts)[:, :, None]
        posterior /= posterior.sum((1, 2), keepdims=True)
        histogram = _smoothed(posterior[counts].sum(0)) + _PSEUDO_OBJECTS * flat * flat.size
        histogram /= histogram.sum()
        # A stated roughness is its own prior; the histogram then gives the kinds alone.
        prior = histogram if stated is None else np.broadcast_to(histogram.mean(1, keepdims=True), histogram.shape)
        if stated is None and counts.sum() >= FEWEST_OBJECTS:
            of_base[counts] = _likelihood_of_base(posterior[counts].sum(1), mean_base[counts, 3], pixels[counts])

    # -------- kind of each object, and its roughness given that kind (Eq. M.24) --------
    probability = posterior.sum(2)
    kind, each = probability.argmax(1), np.arange(len(counts))
    mean, deviation = _moments(posterior)
    _, unseen = _moments(prior * of_base[:, None])
    log_ratio = (posterior * brightness).sum(2) / np.maximum(probability, 1e-300)
    informed = 1.0 - (deviation / np.maximum(unseen, 1e-6))[each, kind] ** 2
    kinds = Kinds(probability, log_ratio - log_ratio[each, kind][:, None], mean, deviation, np.maximum(informed, 0.0), witnesses)
    mean, deviation = mean[each, kind], deviation[each, kind]
    at = np.abs(ROUGHNESS_GRID[None] - mean[:, None]).argmin(1)
    level = float(histogram.sum(0) @ ROUGHNESS_GRID)
    width = float(np.sqrt(max(histogram.sum(0) @ ROUGHNESS_GRID**2 - level**2, 0.0)))
    return Choice(kind, kinds, mean, deviation, at, (level, width), np.where(counts, allowed_share, 1.0))


def _moments(weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and standard deviation of the roughness under weights (..., R) of `ROUGHNESS_GRID`."""
    weight = weight / np.maximum(weight.sum(-1, keepdims=True), 1e-300)
    mean = weight @ ROUGHNESS_GRID
    return mean, np.sqrt(np.maximum(weight @ ROUGHNESS_GRID**2 - mean**2, 0.0))


def _within_given(cost: np.ndarray, tried: np.ndarray, given: np.ndarray) -> np.ndarray:
    """Leave only what agrees with the known values (O, 2) of each object: the nearest roughness of the grid, and the kind whose
    metallic is nearest. What is known holds against `ROUGHEST_METAL` too, and where nothing that agrees was tried."""
    roughness, metallic = given.T
    # (O, R) and (O, 3): which roughnesses and kinds agree with what is known; everything agrees where nothing is.
    nearest = np.abs(ROUGHNESS_GRID - np.where(np.isnan(roughness), 0.0, roughness)[:, None]).argmin(1)
    at = np.isnan(roughness)[:, None] | (np.arange(len(ROUGHNESS_GRID)) == nearest[:, None])
    metal = np.where(np.isnan(metallic), 0.0, metallic) >= 0.5
    kind = np.isnan(metallic)[:, None] | (np.arange(len(KINDS)) == metal[:, None])
    agrees = kind[:, :, None] & at[:, None, :]
    known = ~np.isnan(given).all(1)
    # A known kind lifts the bound on rough metals, so its costs are those before the exclusion (`tried`).
    left = np.where(agrees, np.where(np.isnan(metallic)[:, None, None], cost, tried), np.inf)
    # Where nothing is left, costs before the exclusion count, and after that all pairs that agree count alike.
    barren = ~np.isfinite(left).any((1, 2), keepdims=True)
    left = np.where(barren & agrees & np.isfinite(tried), tried, left)
    left = np.where(~np.isfinite(left).any((1, 2), keepdims=True) & agrees, 0.0, left)
    return np.where(known[:, None, None], left, cost)


def _smoothed(histogram: np.ndarray) -> np.ndarray:
    """Smooth a histogram (..., R) over roughness. What would fall off an end stays in the last bin there, so that sums stay."""
    padded = np.pad(histogram, [(0, 0)] * (histogram.ndim - 1) + [(1, 1)], "edge")
    return _SMOOTHING[0] * (padded[..., :-2] + padded[..., 2:]) + _SMOOTHING[1] * padded[..., 1:-1]


def _likelihood_of_base(posterior: np.ndarray, roughness: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Fit the line that the roughness of the base follows over the objects and return its likelihood at each roughness.

    Args:
        posterior: (O, R) of `ROUGHNESS_GRID`, rows sum to 1; roughness: (O,) of the base; pixels: (O,) by which objects count.

    Returns:
        (O, R), at most 1; all 1 where a rougher base does not go with a rougher object.
    """
    # `share` and `count` are w_o and N of Eq. M.35; the slope is held at 0 or above, because a smoother base is no sign of a
    # rougher object.
    share = pixels / pixels.sum()
    count = 1.0 / float((share**2).sum())
    expected = posterior @ ROUGHNESS_GRID
    middle, usual = share @ expected, share @ roughness
    spread = count * (share @ (posterior @ (ROUGHNESS_GRID - middle) ** 2)) + _UNRELATED_OBJECTS * _ROUGHNESS_SPREAD**2
    # Regression of the base on the expected roughness. Its square in the denominator is an expectation over the posterior, so
    # what is not known about the roughness flattens the line.
    slope = max(count * float(share @ ((roughness - usual) * (expected - middle))) / spread, 0.0)
    away = (roughness - usual)[:, None] - slope * (ROUGHNESS_GRID - middle)
    square = count * (share @ (posterior * away**2).sum(1)) + _UNRELATED_OBJECTS * (share @ (roughness - usual) ** 2)
    scatter = max(float(np.sqrt(square / (count + _UNRELATED_OBJECTS))), _LEAST_BASE_SCATTER)
    likelihood = (1.0 + (away / scatter) ** 2 / DEGREES_OF_FREEDOM) ** (-0.5 * (DEGREES_OF_FREEDOM + 1.0))
    return likelihood / likelihood.max(1, keepdims=True)


def _metal_against_dielectric(log_likelihood: np.ndarray, brightness: np.ndarray, told: np.ndarray) -> np.ndarray:
    """Logarithms (O, 2) of the evidence for a metal over that for a dielectric, and of the brightness that a metal would have
    over that of the base; 0 for objects of which nothing is `told`, (O,) bool.

    log_likelihood: (O, 3, R) of photographs and base, minus infinity = excluded; brightness: (O, 3, R) relative to the base.
    """
    # Relative to the largest of each kind, which may be far below that of the other.
    own = np.where(told[:, None, None], log_likelihood[:, :2], 0.0)
    largest = own.max(2)
    share = np.exp(own - largest[:, :, None])
    total = share.sum(2)
    evidence = largest[:, 1] - largest[:, 0] + np.log(total[:, 1] / total[:, 0])
    brighter = (share[:, 1] * brightness[:, 1]).sum(1) / total[:, 1]
    return np.where(told[:, None], np.column_stack([evidence, brighter]), 0.0)


def metal_log_odds(witnesses: np.ndarray, numbers: tuple[float, float, float, float] = METAL_ODDS) -> np.ndarray:
    """Return the logarithm of the odds of metal (O,) (Eq. M.56).

    Args:
        witnesses: (O, 3) logarithms of the odds that the base states, of the evidence of the photographs for a metal over that
            for a dielectric, and of the brightness of a metal over that of the base.
        numbers: what they count, after a constant.
    """
    constant, *counts = numbers
    return constant + metal_witnesses(witnesses) @ np.array(counts)


def metal_witnesses(witnesses: np.ndarray) -> np.ndarray:
    """Return the witnesses (O, 3) as they count. Errors of light and geometry are rare and then large, so a hundred times the
    evidence is not a hundred times as sure."""
    stated, evidence, brighter = np.asarray(witnesses, np.float64).T
    return np.column_stack([stated, np.sign(evidence) * np.log1p(np.abs(evidence)), np.clip(brighter, *_BRIGHTER)])


def _with_metal_odds(posterior: np.ndarray, log_odds: np.ndarray, allowed: np.ndarray) -> np.ndarray:
    """Posterior (O, 3, R), up to a factor, with the given logarithm of the odds of metal (O,) where both a metal and another of
    the kinds `allowed` (O, 3) may be."""
    own, others = posterior[:, 1].sum(1), posterior[:, ::2].sum((1, 2))
    is_open = allowed[:, 1] & allowed[:, ::2].any(1) & (own > 0)
    # Shares first: the sums may be as small as e^-700.
    metal = posterior[:, 1] / np.where(is_open, own, 1.0)[:, None] * np.where(is_open, others * np.exp(log_odds), 1.0)[:, None]
    return np.stack([posterior[:, 0], metal, posterior[:, 2]], 1)


def _log_brightness(found: Profile, mean_base: np.ndarray) -> np.ndarray:
    """Logarithm of the fitted brightness over the brightness of the base, (O, 3, R); 0 where nothing was tried."""
    base = np.maximum(np.asarray(mean_base, np.float64), _DARKEST)
    numbers = found.affine[..., :12].reshape(*found.cost.shape, 3, 4)
    fitted = np.einsum("okrci,oi->okr", numbers[..., :3], base) + numbers[..., 3].sum(-1)
    log_ratio = np.log(np.maximum(fitted, _DARKEST) / base.sum(1)[:, None, None])
    return np.where(np.isfinite(found.cost), log_ratio, 0.0)


def _agreement_with_base(posterior: np.ndarray, brightness: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """(O, 3) at most 1, by how much less likely each kind is than a dielectric for being too bright or too dark.

    posterior: (O, 3, R) up to a factor; brightness: (O, 3, R) relative to the base; counts: (O,) objects that tell what is usual.
    """
    # Posterior means of the log brightness: of each object over all kinds, and of each kind.
    total = np.maximum(posterior.sum((1, 2)), 1e-300)
    of_object = ((posterior * brightness).sum((1, 2)) / total)[counts]
    of_kind = (posterior * brightness).sum(2) / np.maximum(posterior.sum(2), 1e-300)
    usual = np.median(of_object)
    width = max(_NORMAL_MEDIAN * float(np.median(np.abs(of_object - usual))), LEAST_SPREAD)
    agreement = (1.0 + ((of_kind - usual) / width) ** 2 / DEGREES_OF_FREEDOM) ** (-0.5 * (DEGREES_OF_FREEDOM + 1.0))
    # At most 1: agreement never speaks for a metal, or dielectrics whose base is wrong would become metals.
    return np.where(counts[:, None], np.minimum(agreement / agreement[:, :1], 1.0), 1.0)


def describe_models(
    rank: np.ndarray, free: np.ndarray, affine: np.ndarray, pixels: np.ndarray, given: np.ndarray | None = None
) -> list[str]:
    """Describe what was fitted for each object.

    Args:
        rank: (O,) directions of colour; free: (O, 16) bool; affine: (O, 16); pixels: (O,) usable pixels.
        given: (O, 2) known roughness and metallic, NaN = not known; None: nothing is.

    Returns:
        E.g. `full, roughness, metal`, or `population (12 pixels)` where nothing was free.
    """
    out = []
    known = np.zeros((len(pixels), 2), bool) if given is None else ~np.isnan(given)
    for o in range(len(pixels)):
        told = [f"{name} given" for name, is_known in zip(("roughness", "metallic"), known[o], strict=True) if is_known]
        if not free[o].any():
            out.append(
                f"population ({int(pixels[o])} pixels)"
                if np.any(affine[o] != IDENTITY)
                else f"identity ({int(pixels[o])} pixels)"
            )
            out[-1] = ", ".join([out[-1], *told])
            continue
        parts = [("gain", "gain+bias", "full", "full")[int(rank[o])]]
        if free[o, ROUGHNESS].any():
            parts.append("roughness")
        if free[o, METALLIC].any():
            parts.append("metallic")
        elif not known[o, 1]:
            g, h = affine[o, METALLIC]
            parts += ["metal"] if h == 1 else ["metallic as predicted"] if g else []
        out.append(", ".join([*parts, *told]))
    return out
