"""Which numbers each object can carry, and in which valley its roughness and metalness lie.

The objective has a dielectric and a metallic valley and several in r, so one descent is not enough (METHOD 7b.ii). Roughness
is therefore profiled: for a dielectric, for a metal, for metalness as predicted (where the prediction says both), and for each of
a few r the albedo numbers are fitted, which gives the evidence of every pair. What the objects of the scene have in common (a
histogram over the pairs, by EM) is the prior.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from iif_core.fitting.descent import Pull, State, spectrum
from iif_core.fitting.pixels import BOX, Pixels, Terms, evaluate, in_threads
from iif_core.fitting.problem import BIASES, CROSS, GAINS, IDENTITY, METALLIC, PARAMETERS, ROUGHNESS, FitOptions
from iif_core.fitting.profile_kernels import fit_albedo
from iif_core.fitting.tone import Tone

GRID = np.array([0.05, 0.13, 0.22, 0.32, 0.44, 0.57, 0.7, 0.84, 0.98])
_STEPS = 3  # Gauss-Newton steps of the albedo at each point of the profile, from its neighbour's
_SMOOTHING = np.array([0.25, 0.5, 0.25])  # of the population's histogram: neighbours of what was seen are possible too
_PSEUDO = 0.5  # objects' worth of every pair before any was seen
KINDS = np.array([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0]])
"""(g_m, h_m) of a dielectric, a metal, and of metalness as predicted."""
ROUGHEST_METAL = 0.6
"""A rougher metal and a dielectric of another albedo look alike (METHOD 7b, degeneracy 2), and errors of the light would decide
between them: what could best be a rough metal is taken for a dielectric."""
_SHARES = np.array([[0.85], [0.1], [0.05]])  # of the three before any object was seen
DISCOUNT = 10.0
"""The scatter between clusters shows what varies over an object; the errors of light and geometry that it does not show are as
real. On the built-in kitchen (LDR) the profile's errors are 9 claimed standard deviations without a discount of the evidence, 3.4
with 10 and 1.4 with 30; on Modern Hall (HDR, better light) 6 costs nothing and 16 doubles the error of roughness."""


@dataclass(frozen=True)
class Texture:
    """What the base texture of each object can determine.

    Attributes:
        enough: (O,) bool, has `min_pixels`; rank: (O,) directions of its colours; varied: (O, 2) roughness, metalness vary;
        mean: (O, 5); mixed: (O,) bool, metalness is predicted below 0.25 here and above 0.75 there.
    """

    enough: np.ndarray
    rank: np.ndarray
    varied: np.ndarray
    mean: np.ndarray
    mixed: np.ndarray

    def only(self, objects: np.ndarray) -> Texture:
        """Of some objects."""
        return Texture(*(getattr(self, name)[objects] for name in ("enough", "rank", "varied", "mean", "mixed")))

    def albedo_numbers(self) -> np.ndarray:
        """(O, 16) bool: gains; biases from one direction of colour on; cross terms from two on (METHOD 8)."""
        free = np.zeros((len(self.enough), PARAMETERS), bool)
        free[:, GAINS] = self.enough[:, None]
        free[:, BIASES] = (self.enough & (self.rank >= 1))[:, None]
        free[:, CROSS] = (self.enough & (self.rank >= 2))[:, None]
        return free


def texture_of(px: Pixels, opt: FitOptions) -> Texture:
    """Directions of colour whose standard deviation exceeds `texture_sigma`."""
    base = px.base.astype(np.float64)
    counts = np.maximum(px.counts, 1)[:, None]
    mean = np.stack([px.sum_by_object(base[:, c]) for c in range(5)], 1) / counts
    away = base - mean[px.obj]
    covariance = np.zeros((px.n_objects, 3, 3))
    for i in range(3):
        for j in range(i, 3):
            covariance[:, i, j] = covariance[:, j, i] = px.sum_by_object(away[:, i] * away[:, j])
    rank = (np.linalg.eigvalsh(covariance / counts[:, :, None]) > opt.texture_sigma**2).sum(1)
    spread = np.stack([px.sum_by_object(away[:, c] ** 2) for c in (3, 4)], 1) / counts
    ends = np.stack([px.sum_by_object(base[:, 4] < 0.25), px.sum_by_object(base[:, 4] > 0.75)], 1) / counts
    return Texture(px.counts >= opt.min_pixels, rank, spread > opt.texture_sigma**2, mean, (ends > 0.05).all(1))


def row_noise(terms: Terms, px: Pixels, free: np.ndarray) -> np.ndarray:
    """(O,) effective variance of one row: how much larger the gradient's scatter between clusters is than the curvature says.

    trace(H^-1 J) / k over the k free numbers, J = sum over clusters of the outer product of their scores. With independent
    errors it is their variance; errors that a cluster shares make it larger. Objects without an answer get the median.
    """
    centred, counts = _centred_scores(terms, px)
    out = np.full(px.n_objects, np.nan)
    for o in np.flatnonzero((counts >= 4) & free.any(1)):
        k = free[o]
        own = centred[px.first[o] : px.first[o + 1]][:, :PARAMETERS][:, k]
        block = terms.h[o][:PARAMETERS, :PARAMETERS][np.ix_(k, k)]
        inverse = spectrum(block[None]).inverse(1e-6)[0]
        out[o] = np.einsum("ci,ij,cj->", own, inverse, own) / k.sum() * counts[o] / (counts[o] - 1)
    known = np.isfinite(out) & (out > 0)
    middle = float(np.median(out[known])) if known.any() else 1e-6
    return np.where(known, np.maximum(out, 0.05 * middle), middle)


def _centred_scores(terms: Terms, px: Pixels) -> tuple[np.ndarray, np.ndarray]:
    """Scores of the clusters without their object's mean, and the number of clusters with pixels of each object."""
    filled = np.diff(px.starts) > 0
    owner = np.repeat(np.arange(px.n_objects), np.diff(px.first))
    counts = np.bincount(owner[filled], minlength=px.n_objects)
    mean = terms.g / np.maximum(counts, 1)[:, None]
    return np.where(filled[:, None], terms.scores - mean[owner], 0.0), counts


@dataclass(frozen=True)
class Profile:
    """Evidence of every kind at each roughness of `GRID`.

    Attributes:
        cost: (O, 3, R) data term with the albedo fitted, infinite where not tried; that of the roughest dielectric is the better
            one of its own and of none with no lobe; affine: (O, 3, R, 16); noise: (O,) variance
            of a row.
    """

    cost: np.ndarray
    affine: np.ndarray
    noise: np.ndarray


def profile(px: Pixels, state: State, pull: Pull, tone: Tone, opt: FitOptions, free: np.ndarray, mixed: np.ndarray) -> Profile:
    """Fit the albedo numbers at every pair; the response is held. `mixed` (O,) bool: metalness as predicted is possible."""
    n_objects = px.n_objects
    cost = np.full((n_objects, 3, len(GRID)), np.inf)
    affine = np.zeros((n_objects, 3, len(GRID), PARAMETERS))
    everything = np.arange(n_objects)
    for kind in range(3):
        tried = np.flatnonzero(mixed) if kind == 2 else everything
        current = state.affine[:, :12].copy()
        for at in range(len(GRID) - 1, -1, -1):
            first = at == len(GRID) - 1
            steps = 2 * _STEPS if first else _STEPS
            found = _fitted(px, current, pull, tone, opt, free, KINDS[kind], GRID[at], steps, tried)
            if kind == 0 and first:  # no lobe, or one so wide that it looks like none
                found = np.minimum(found, _fitted(px, current.copy(), pull, tone, opt, free, KINDS[0], -1.0, steps, tried))
            cost[tried, kind, at] = found[tried]
            affine[:, kind, at, :12] = current
            affine[:, kind, at, 13:] = [GRID[at], *KINDS[kind]]
    best = cost.reshape(n_objects, -1).argmin(1)
    where = affine.reshape(n_objects, -1, PARAMETERS)[everything, best]
    albedo = free & (np.arange(PARAMETERS) < 12)
    terms = evaluate(px, where, tone, opt, True, albedo, scores=True)
    return Profile(cost, affine, row_noise(terms, px, albedo))


def _fitted(
    px: Pixels,
    affine: np.ndarray,
    pull: Pull,
    tone: Tone,
    opt: FitOptions,
    free: np.ndarray,
    metallic: np.ndarray,
    roughness: float,
    steps: int,
    objects: np.ndarray,
) -> np.ndarray:
    """Move the albedo numbers `affine` (O, 12) of some objects to where they fit at one roughness (negative: no lobe) and one
    metalness; (O,) data term and pull there."""
    cost = np.zeros(px.n_objects)
    curve, ends, _ = tone.tables
    weight = np.diagonal(pull.weight, axis1=1, axis2=2)[:, :12]  # before anything is known, numbers lean one by one

    def work(part: np.ndarray) -> None:
        fit_albedo(
            px.base,
            px.diffuse,
            px.lobes,
            px.levels,
            px.target,
            px.exposure,
            px.saturated,
            px.trust,
            px.offsets,
            tone.knee,
            tone.gain,
            curve,
            ends,
            opt.robust_width,
            opt.brightest,
            BOX,
            free,
            pull.centre,
            weight,
            metallic,
            roughness,
            steps,
            opt.tolerance,
            part,
            affine,
            cost,
        )

    in_threads(work, px, objects, opt.threads)
    return cost


@dataclass(frozen=True)
class Choice:
    """Posterior of the profile.

    Attributes:
        kind: (O,) int, row of `KINDS`; probability: (O, 3); roughness, deviation: (O,) posterior mean and standard deviation
            given the kind; at: (O,) nearest point of `GRID`; population: mean and standard deviation of r over the objects;
            sure: (O,) share of the evidence that speaks for what was not ruled out (`ROUGHEST_METAL`).
    """

    kind: np.ndarray
    probability: np.ndarray
    roughness: np.ndarray
    deviation: np.ndarray
    at: np.ndarray
    population: tuple[float, float]
    sure: np.ndarray


def choose(found: Profile, counts: np.ndarray) -> Choice:
    """EM for the population's histogram, then the posterior of each object; `counts` (O,) bool, objects that have a say."""
    cost = found.cost.copy()
    scale = DISCOUNT * found.noise[:, None, None]
    everything = np.exp(np.maximum((cost.min((1, 2), keepdims=True) - cost) / scale, -700.0)) * _SHARES
    cost[GRID[cost[:, 1].argmin(1)] > ROUGHEST_METAL, 1] = np.inf
    cost[:, 1, GRID > ROUGHEST_METAL] = np.inf
    sure = np.where(np.isfinite(cost), everything, 0.0).sum((1, 2)) / everything.sum((1, 2))
    log_likelihood = (cost.min((1, 2), keepdims=True) - cost) / scale
    likelihood = np.where(counts[:, None, None], np.exp(np.maximum(log_likelihood, -700.0)), 1.0)
    flat = _SHARES / len(GRID) * np.ones(len(GRID))
    prior = flat
    for _ in range(50):
        posterior = likelihood * prior
        posterior /= posterior.sum((1, 2), keepdims=True)
        seen = np.stack([np.convolve(row, _SMOOTHING, "same") for row in posterior[counts].sum(0)])
        prior = seen + _PSEUDO * flat * flat.size
        prior /= prior.sum()
    probability = posterior.sum(2)
    kind = probability.argmax(1)
    given = posterior[np.arange(len(kind)), kind]
    given = given / np.maximum(given.sum(1, keepdims=True), 1e-300)
    mean = given @ GRID
    deviation = np.sqrt(np.maximum(given @ GRID**2 - mean**2, 0.0))
    at = np.abs(GRID[None] - mean[:, None]).argmin(1)
    level = float(prior.sum(0) @ GRID)
    width = float(np.sqrt(max(prior.sum(0) @ GRID**2 - level**2, 0.0)))
    return Choice(kind, probability, mean, deviation, at, (level, width), np.where(counts, sure, 1.0))


def describe(rank: np.ndarray, free: np.ndarray, affine: np.ndarray, pixels: np.ndarray) -> list[str]:
    """One line an object: `full, roughness, metal`; `population (12 pixels)`: what the other objects have in common."""
    out = []
    for o in range(len(pixels)):
        if not free[o].any():
            out.append(
                f"population ({int(pixels[o])} pixels)"
                if np.any(affine[o] != IDENTITY)
                else f"identity ({int(pixels[o])} pixels)"
            )
            continue
        parts = [("gain", "gain+bias", "full", "full")[int(rank[o])]]
        if free[o, ROUGHNESS].any():
            parts.append("roughness")
        if free[o, METALLIC].any():
            parts.append("metallic")
        else:
            g, h = affine[o, METALLIC]
            parts += ["metal"] if h == 1 else ["metallic as predicted"] if g else []
        out.append(", ".join(parts))
    return out
