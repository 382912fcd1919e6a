"""What the objects of a scene have in common, and how strongly each leans on it (empirical Bayes).

Numbers of an object are draws from the scene's population: gains around one value a channel (which carries the open scale of
light x albedo: nothing pulls towards 1), biases and cross terms around 0, the level and the contrast of roughness around their
means. Means and spreads are those that the objects' own answers support, by EM on the quadratic model of the objective around
where the fit stands; two objects' worth of the default keeps a scene of one object finite. Student's weights keep odd objects
from deciding. The pull of an object is (variance of its rows) / (spread of the population)^2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from iif_core.fitting.descent import Pull, spectrum
from iif_core.fitting.pixels import Pixels, Terms
from iif_core.fitting.problem import BIASES, CROSS, GAINS, PARAMETERS, ROUGHNESS

_GROUPS = ("gain", "bias", "cross", "level", "contrast")
_DEFAULT = np.array([0.3, 0.05, 0.1, 0.25, 0.1])  # spreads before any object was seen
_FLOOR = np.array([0.02, 0.004, 0.01, 0.03, 0.03])
_CEILING = np.array([0.4, 0.1, 0.2, 0.3, 0.15])  # beyond, gain and bias of nearly constant textures trade without limit
_PSEUDO = 2.0  # objects' worth of the default
_FREEDOM = 4.0  # of Student's t
_ROUNDS = 12


@dataclass(frozen=True)
class Population:
    """Attributes:
    gain: (3,) mean gains; level, contrast: mean roughness and gain of its texture; spread: (5,) standard deviations of
        gain, bias, cross term, level, contrast.
    """

    gain: np.ndarray
    level: float
    contrast: float
    spread: np.ndarray

    def facts(self) -> dict[str, object]:
        """For `affines.json`."""
        return {
            "gain": [float(x) for x in self.gain],
            "roughness": float(self.level),
            "roughness_contrast": float(self.contrast),
            "spread": dict(zip(_GROUPS, map(float, self.spread), strict=True)),
        }


def before(level: float = 0.6, width: float = 0.25) -> Population:
    """Nothing seen yet but, perhaps, the histogram of roughness."""
    spread = _DEFAULT.copy()
    spread[3] = np.clip(width, _FLOOR[3], _CEILING[3])
    return Population(np.ones(3), level, 0.0, spread)


def centre_of(population: Population, roughness: np.ndarray, metallic: np.ndarray) -> np.ndarray:
    """(O, 16) numbers of an object that says nothing itself.

    Args:
        roughness: (O,) mean r~ of the objects; metallic: (O, 2) their (g_m, h_m), which is chosen and not pulled.
    """
    out = np.zeros((len(roughness), PARAMETERS))
    out[:, GAINS] = population.gain
    out[:, 12] = population.contrast
    out[:, 13] = population.level - population.contrast * roughness
    out[:, 14:] = metallic
    return out


def pull_of(
    population: Population, noise: np.ndarray, roughness: np.ndarray, metallic: np.ndarray, discount: float = 1.0
) -> Pull:
    """Weight noise / spread^2 on each number; on roughness, on its level at the object's mean and on its contrast.

    Args:
        noise: (O,) variance of a row; roughness: (O,) mean r~; metallic: (O, 2) chosen (g_m, h_m); discount: by which the
            evidence of roughness is too confident.
    """
    precision = 1.0 / population.spread**2
    diagonal = np.zeros(PARAMETERS)
    diagonal[GAINS], diagonal[BIASES], diagonal[CROSS] = precision[:3]
    diagonal[14:] = 1.0 / 0.3**2  # metalness: only if someone freed it
    inverse = np.zeros((len(noise), PARAMETERS, PARAMETERS))
    inverse[:] = np.diag(diagonal)
    level = np.stack([roughness, np.ones_like(roughness)], 1)
    inverse[:, 12:14, 12:14] = precision[3] * level[:, :, None] * level[:, None, :]
    inverse[:, 12, 12] += precision[4]
    return Pull(centre_of(population, roughness, metallic), *_weighted(inverse, noise, discount))


def _row_variance(noise: np.ndarray, discount: float) -> np.ndarray:
    """(O, 16): that of what each number is fitted to."""
    return np.where(np.isin(np.arange(PARAMETERS), ROUGHNESS), discount, 1.0) * noise[:, None]


def _weighted(inverse: np.ndarray, noise: np.ndarray, discount: float) -> tuple[np.ndarray, np.ndarray]:
    """Weight and scatter of a pull with the inverse covariance `inverse`: noise S^-1 and W S W."""
    size = _row_variance(noise, discount)
    weight = inverse * size[:, :, None]  # roughness and albedo do not meet in `inverse`
    return weight, weight * size[:, :, None]


def lean(
    pull: Pull,
    level: np.ndarray,
    deviation: np.ndarray,
    error: np.ndarray,
    shared: np.ndarray,
    sway: np.ndarray,
    noise: np.ndarray,
    roughness: np.ndarray,
    contrast: float,
    discount: float,
) -> Pull:
    """The pull with each object's own level of roughness (O,) +- `deviation` (O,) in place of the population's.

    `error` (O,) is the standard deviation of that level: with w the weight, its scatter is w^2 error^2. The pixels that it was
    made of pull again by themselves: 2 w `shared` (O,) is what both have in common. `sway` (O, P): how the level moves with the
    response.
    """
    own = np.stack([roughness, np.ones_like(roughness)], 1)
    outer = own[:, :, None] * own[:, None, :]
    size = discount * noise
    strength = size / deviation**2
    weight, scatter = pull.weight.copy(), pull.scatter.copy() if pull.scatter is not None else np.zeros_like(pull.weight)
    weight[:, 12:14, 12:14] = strength[:, None, None] * outer
    scatter[:, 12:14, 12:14] = (strength**2 * error**2 + 2.0 * strength * shared)[:, None, None] * outer
    weight[:, 12, 12] += size / _DEFAULT[4] ** 2
    scatter[:, 12, 12] += size**2 / _DEFAULT[4] ** 2
    centre = pull.centre.copy()
    centre[:, 13] = level - contrast * roughness
    drift = np.zeros((*centre.shape, sway.shape[1]))
    drift[:, 12:14] = strength[:, None, None] * own[:, :, None] * sway[:, None]
    return Pull(centre, weight, scatter, drift)


def learn(
    population: Population,
    terms: Terms,
    px: Pixels,
    affine: np.ndarray,
    free: np.ndarray,
    noise: np.ndarray,
    roughness: np.ndarray,
    metallic: np.ndarray,
    discount: float,
) -> Population:
    """EM for means and spreads; the data of an object are the quadratic model of its objective at `affine`."""
    use = free.any(1)
    if not use.any():
        return population
    g = np.where(free, terms.g[:, :PARAMETERS], 0.0)[use]
    keep = (free[:, :, None] & free[:, None, :])[use]
    h = np.where(keep, terms.h[use][:, :PARAMETERS, :PARAMETERS], 0.0)
    here, own_free, own_noise = affine[use], free[use], noise[use]
    r, m = roughness[use], metallic[use]
    fixed = ~own_free
    size = np.sqrt(_row_variance(own_noise, discount))
    i = np.arange(PARAMETERS)
    for _ in range(_ROUNDS):
        pull = pull_of(population, own_noise, r, m, discount)
        block = np.where(keep, h + pull.weight, 0.0)
        block[:, i, i] += fixed
        inverse = np.where(keep, spectrum(block).inverse(), 0.0)
        right = np.where(own_free, g + pull.gradient(here), 0.0)
        theta = here - np.einsum("oij,oj->oi", inverse, right)
        covariance = inverse * size[:, :, None] * size[:, None, :]
        population = _moments(population, theta, covariance, own_free, r)
    return population


def _moments(
    population: Population, theta: np.ndarray, covariance: np.ndarray, free: np.ndarray, roughness: np.ndarray
) -> Population:
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    level = theta[:, 12] * roughness + theta[:, 13]
    jacobian = np.stack([roughness, np.ones_like(roughness)], 1)
    level_variance = np.einsum("oi,oij,oj->o", jacobian, covariance[:, 12:14, 12:14], jacobian)
    spread = population.spread.copy()
    gain = population.gain.copy()

    def group(k: int, value: np.ndarray, own: np.ndarray, centre: np.ndarray | float, moves: bool) -> np.ndarray | float:
        """New spread of one group and, if it has one, its new centre; value, own (variance): (objects, columns)."""
        away = value - centre
        weight = (_FREEDOM + 1) / (_FREEDOM + away**2 / spread[k] ** 2)
        if moves:
            closeness = weight / (spread[k] ** 2 + own)
            centre = (closeness * value).sum(0) / closeness.sum(0)
            away = value - centre
        squares = (weight * away**2 + own).sum() + _PSEUDO * _DEFAULT[k] ** 2
        spread[k] = np.clip(np.sqrt(squares / (value.size + _PSEUDO)), _FLOOR[k], _CEILING[k])
        return centre

    seen = free[:, GAINS].all(1)
    if seen.any():
        gain = np.asarray(group(0, theta[seen][:, GAINS], variance[seen][:, GAINS], gain, True))
    for k, columns in ((1, BIASES), (2, CROSS)):
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
