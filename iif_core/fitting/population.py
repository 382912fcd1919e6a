"""What the objects of a scene have in common, as a prior of each of them (empirical Bayes; docs/method/fitting.md#population).

Means and spreads of the numbers are learnt by EM on the quadratic model of the objective.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from iif_core.fitting.descent import GaussianPrior, decompose
from iif_core.fitting.pixels import Terms
from iif_core.reflectance.material import BIASES, CROSS_TERMS, GAINS, NUMBERS, ROUGHNESS

_GROUPS = ("gain", "bias", "cross", "level", "contrast")
_FIRST_SPREADS = np.array([0.3, 0.05, 0.1, 0.25, 0.1])
"""Spreads of the groups before any object was fitted."""
_LEAST_SPREADS = np.array([0.02, 0.004, 0.01, 0.03, 0.03])
_LARGEST_SPREADS = np.array([0.4, 0.1, 0.2, 0.3, 0.15])
"""Beyond these, gain and bias of nearly constant textures would trade without limit."""
_PSEUDO_OBJECTS = 2.0
"""Weight of the first spread, in values."""
_DEGREES_OF_FREEDOM = 4.0
"""Of Student's t."""
_EM_ROUNDS = 12


@dataclass(frozen=True)
class Population:
    """Means and spreads of the numbers over the objects.

    Attributes:
        gain: (3,) mean gains; level, contrast: mean roughness and mean gain of its texture.
        spread: (5,) standard deviations of gain, bias, cross term, level, contrast.
    """

    gain: np.ndarray
    level: float
    contrast: float
    spread: np.ndarray

    def facts(self) -> dict[str, object]:
        """Return the population for `affines.json`."""
        return {
            "gain": [float(x) for x in self.gain],
            "roughness": float(self.level),
            "roughness_contrast": float(self.contrast),
            "spread": dict(zip(_GROUPS, map(float, self.spread), strict=True)),
        }


def initial_population(level: float = 0.6, width: float = 0.25) -> Population:
    """Return the population before any object has been fitted, optionally with mean and width of the roughness histogram."""
    spread = _FIRST_SPREADS.copy()
    spread[3] = np.clip(width, _LEAST_SPREADS[3], _LARGEST_SPREADS[3])
    return Population(np.ones(3), level, 0.0, spread)


def population_mean(population: Population, roughness: np.ndarray, metallic: np.ndarray) -> np.ndarray:
    """Return the mean (O, 16) of the numbers of each object under the population, given its mean base roughness and its metallic
    map.
    """
    out = np.zeros((len(roughness), NUMBERS))
    out[:, GAINS] = population.gain
    out[:, 12] = population.contrast
    # h_r = level - g_r r: the roughness at the object's mean base roughness r is then the level, whatever the contrast g_r.
    out[:, 13] = population.level - population.contrast * roughness
    out[:, 14:] = metallic
    return out


def population_prior(
    population: Population, noise: np.ndarray, roughness: np.ndarray, metallic: np.ndarray, discount: float = 1.0
) -> GaussianPrior:
    """Make the prior of the objects (Eq. M.26): weight noise / spread^2 on each number.

    For roughness the weight is on its level at the mean base roughness of the object, and on its contrast.

    Args:
        population: means and spreads; noise: (O,) variance of a row; roughness: (O,) mean base roughness.
        metallic: (O, 2) gain and bias of the metallic; discount: factor by which the evidence of roughness is too confident.

    Returns:
        The prior; its scatter is W S W with S the covariance of the population.
    """
    precision = 1.0 / population.spread**2
    diagonal = np.zeros(NUMBERS)
    diagonal[GAINS], diagonal[BIASES], diagonal[CROSS_TERMS] = precision[:3]
    diagonal[14:] = 1.0 / 0.3**2  # counts only where metallic is free
    inverse = np.zeros((len(noise), NUMBERS, NUMBERS))
    inverse[:] = np.diag(diagonal)
    # Row (r, 1) takes (g_r, h_r) to the level. Its outer product has rank one; the precision of the contrast completes it.
    level = np.stack([roughness, np.ones_like(roughness)], 1)
    inverse[:, 12:14, 12:14] = precision[3] * level[:, :, None] * level[:, None, :]
    inverse[:, 12, 12] += precision[4]
    return GaussianPrior(population_mean(population, roughness, metallic), *_weight_and_scatter(inverse, noise, discount))


def _variance_by_number(noise: np.ndarray, discount: float) -> np.ndarray:
    """Return the variance of the rows that each number is fitted to, (O, 16)."""
    return np.where(np.isin(np.arange(NUMBERS), ROUGHNESS), discount, 1.0) * noise[:, None]


def _weight_and_scatter(inverse: np.ndarray, noise: np.ndarray, discount: float) -> tuple[np.ndarray, np.ndarray]:
    """Return weight noise S^-1 and scatter W S W of a prior with the inverse covariance S^-1 = `inverse`."""
    size = _variance_by_number(noise, discount)
    weight = inverse * size[:, :, None]  # `inverse` does not couple roughness and albedo
    # `size` is constant within each block that S^-1 couples, so W S W = size^2 S^-1.
    return weight, weight * size[:, :, None]


@dataclass(frozen=True)
class ProfiledRoughness:
    """Roughness of each object from its profile, and the error of it.

    Attributes:
        level: (O,) posterior mean; deviation: (O,) its posterior standard deviation, from discounted evidence.
        error: (O,) standard deviation of `level` from noise alone (Eq. M.31).
        gradient_covariance: (O,) covariance of `level`, for a unit of its weight, with the gradient of the pixels.
        params: (P,) response at which the profile was made; d_level_d_response: (O, P) derivative of `level` (Eq. M.30).
    """

    level: np.ndarray
    deviation: np.ndarray
    error: np.ndarray
    gradient_covariance: np.ndarray
    params: np.ndarray
    d_level_d_response: np.ndarray


def with_profiled_roughness(
    prior: GaussianPrior, profiled: ProfiledRoughness, noise: np.ndarray, roughness: np.ndarray, contrast: float, discount: float
) -> GaussianPrior:
    """Replace the population's level of roughness by the profiled one of each object (Eq. M.29).

    The pixels that made the profile also enter the descent. With w the weight of the level, the scatter of the prior is therefore
    w^2 error^2 + 2 w `gradient_covariance`.

    Args:
        prior: of the population; profiled: levels at the current response.
        noise: (O,) variance of a row; roughness: (O,) mean base roughness.
        contrast: mean gain of the roughness texture; discount: factor by which the evidence of roughness is too confident.

    Returns:
        The prior, which moves with the response.
    """
    # As in `population_prior`: row (r, 1) takes (g_r, h_r) to the level. `strength` is the precision of Eq. M.29.
    own = np.stack([roughness, np.ones_like(roughness)], 1)
    outer = own[:, :, None] * own[:, None, :]
    size = discount * noise
    strength = size / profiled.deviation**2
    weight, scatter = prior.weight.copy(), prior.scatter.copy() if prior.scatter is not None else np.zeros_like(prior.weight)
    weight[:, 12:14, 12:14] = strength[:, None, None] * outer
    # Pixels of the profile move the centre and the gradient of the descent together; the second term is twice that covariance.
    both = strength**2 * profiled.error**2 + 2.0 * strength * profiled.gradient_covariance
    scatter[:, 12:14, 12:14] = both[:, None, None] * outer
    weight[:, 12, 12] += size / _FIRST_SPREADS[4] ** 2
    scatter[:, 12, 12] += size**2 / _FIRST_SPREADS[4] ** 2
    centre = prior.centre.copy()
    centre[:, 13] = profiled.level - contrast * roughness
    # W d(centre)/d(response): the centre moves in h_r alone, so this is strength (r, 1) d(level)/d(response).
    drift = np.zeros((*centre.shape, profiled.d_level_d_response.shape[1]))
    drift[:, 12:14] = strength[:, None, None] * own[:, :, None] * profiled.d_level_d_response[:, None]
    return GaussianPrior(centre, weight, scatter, drift)


def update_population(
    population: Population,
    terms: Terms,
    affine: np.ndarray,
    free: np.ndarray,
    noise: np.ndarray,
    roughness: np.ndarray,
    metallic: np.ndarray,
    discount: float,
) -> Population:
    """Learn means and spreads by EM (Eq. M.27, M.28); the data of an object are the quadratic model of its objective.

    Args:
        population: start; terms: objective and system at `affine`; affine: (O, 16); free: (O, 16) bool.
        noise: (O,) variance of a row; roughness: (O,) mean base roughness; metallic: (O, 2) gain and bias of the metallic.
        discount: factor by which the evidence of roughness is too confident.

    Returns:
        The population; `population` itself if nothing is free.
    """
    use = free.any(1)
    if not use.any():
        return population

    # -------- the quadratic model of each object's data, around its current numbers --------
    g = np.where(free, terms.g[:, :NUMBERS], 0.0)[use]
    keep = (free[:, :, None] & free[:, None, :])[use]
    h = np.where(keep, terms.h[use][:, :NUMBERS, :NUMBERS], 0.0)
    here, own_free, own_noise = affine[use], free[use], noise[use]
    r, m = roughness[use], metallic[use]
    fixed = ~own_free
    size = np.sqrt(_variance_by_number(own_noise, discount))
    i = np.arange(NUMBERS)

    # -------- EM: numbers given the population (Eq. M.27), then the population given the numbers (Eq. M.28) --------
    for _ in range(_EM_ROUNDS):
        prior = population_prior(population, own_noise, r, m, discount)
        block = np.where(keep, h + prior.weight, 0.0)
        # Rows of the identity keep the blocks of fixed numbers invertible; `keep` removes them again.
        block[:, i, i] += fixed
        inverse = np.where(keep, decompose(block).inverse(), 0.0)
        right = np.where(own_free, g + prior.gradient(here), 0.0)
        theta = here - np.einsum("oij,oj->oi", inverse, right)
        # The objective counts in squares of residuals; the variance of a row turns its inverse curvature into a covariance.
        covariance = inverse * size[:, :, None] * size[:, None, :]
        population = _update_moments(population, theta, covariance, own_free, r)
    return population


def _update_moments(
    population: Population, theta: np.ndarray, covariance: np.ndarray, free: np.ndarray, roughness: np.ndarray
) -> Population:
    """Return the population given numbers theta (O, 16) and covariances (O, 16, 16) of the objects (Eq. M.28)."""
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    # g_r and h_r trade against each other where the base roughness hardly varies, so the group is their level, with its variance.
    level = theta[:, 12] * roughness + theta[:, 13]
    jacobian = np.stack([roughness, np.ones_like(roughness)], 1)
    level_variance = np.einsum("oi,oij,oj->o", jacobian, covariance[:, 12:14, 12:14], jacobian)
    spread = population.spread.copy()
    gain = population.gain.copy()

    def group(k: int, value: np.ndarray, own: np.ndarray, centre: np.ndarray | float, moves: bool) -> np.ndarray | float:
        """Set the spread of group k and return its centre, which moves if asked; value and variance `own`: (objects, columns)."""
        away = value - centre
        # Student's weights: a value far from the centre counts little, so odd objects do not decide.
        weight = (_DEGREES_OF_FREEDOM + 1) / (_DEGREES_OF_FREEDOM + away**2 / spread[k] ** 2)
        if moves:
            closeness = weight / (spread[k] ** 2 + own)
            centre = (closeness * value).sum(0) / closeness.sum(0)
            away = value - centre
        # The first spread counts as `_PSEUDO_OBJECTS` values, so that a scene of one object has a spread.
        squares = (weight * away**2 + own).sum() + _PSEUDO_OBJECTS * _FIRST_SPREADS[k] ** 2
        spread[k] = np.clip(np.sqrt(squares / (value.size + _PSEUDO_OBJECTS)), _LEAST_SPREADS[k], _LARGEST_SPREADS[k])
        return centre

    # A group learns from the objects in which all its numbers are free.
    seen = free[:, GAINS].all(1)
    if seen.any():
        gain = np.asarray(group(0, theta[seen][:, GAINS], variance[seen][:, GAINS], gain, True))
    for k, columns in ((1, BIASES), (2, CROSS_TERMS)):
        seen = free[:, columns].all(1)
        if seen.any():
            group(k, theta[seen][:, columns], variance[seen][:, columns], 0.0, False)
    mean, contrast = population.level, population.contrast
    seen = free[:, 13]
    if seen.any():
        mean = float(np.ravel(group(3, level[seen][:, None], level_variance[seen][:, None], mean, True))[0])
    seen = free[:, 12]
    if seen.any():
        contrast = float(np.ravel(group(4, theta[seen][:, 12:13], variance[seen][:, 12:13], contrast, True))[0])
    return Population(gain, mean, contrast, spread)
