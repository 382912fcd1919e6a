"""95 % intervals of the materials of objects (docs/method/fitting.md#intervals-of-objects).

Every interval is [g^-1(g(x) - lambda L), g^-1(g(x) + lambda U)] on a scale g that keeps it within [0, 1]. L and U follow from the
errors that the fit states, from kinds that it could not exclude, and from two errors measured in rooms with truth. The factor
lambda is measured there too, such that the intervals hold.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import expit, logit, stdtr, stdtrit

from iif_core.errors import InputError

PROBABILITY = 0.95
"""Of every interval."""
_ONE_SIGMA = 0.8413447460685429
"""Share of a normal distribution below one standard deviation."""
DEGREES_OF_FREEDOM = 4.0
"""Of Student's t of the errors that the fit states (Eq. M.34, M.56)."""
LEAST_SEEN = 0.5
"""Share of the variance of the roughness that the photographs remove. Below this, what is claimed of the roughness is mostly what the
prior says of objects in general, and nothing was seen of it."""
_NARROWEST = 1e-6
"""Smallest error of a scale; keeps the limits finite."""
_LARGEST = 30.0
"""Largest relative error; an interval is 0 to 1 long before."""
_ROUGHNESS_RANGE = (0.01, 0.99)
"""Estimates outside count as at these ends, because the logit is infinite at 0 and 1."""
_HALVINGS = 60


@dataclass(frozen=True)
class MeasuredErrors:
    """What rooms with truth say of the intervals.

    Attributes:
        additive: standard deviation of the error of an albedo that is not proportional to it; hue: of the logarithm of one channel
            relative to the mean of the channels.
        albedo, roughness, metallic: factor lambda on the half widths.
    """

    additive: float
    hue: float
    albedo: float
    roughness: float
    metallic: float

    @classmethod
    def from_facts(cls, facts: Mapping[str, Any], where: str) -> MeasuredErrors:
        """Read the numbers from a document.

        Raises:
            InputError: a number is missing, or not finite and above 0; `where` names the file.
        """
        values = {f.name: facts.get(f.name) for f in fields(cls)}
        wrong = {name: v for name, v in values.items() if not isinstance(v, float | int) or not 0 < v < np.inf}
        if wrong:
            raise InputError(f"{where}: {wrong}; needed finite numbers above 0; restore the file: git checkout {where}")
        return cls(**values)


@dataclass(frozen=True)
class Spread:
    """Intervals of some numbers, on the scale on which they are made.

    Attributes:
        middle: the numbers on the scale; below, above: half widths of the stated 95 % interval, infinite where nothing is known.
        scale: from values to the scale; value: back. Both increase.
    """

    middle: NDArray
    below: NDArray
    above: NDArray
    scale: Callable[[ArrayLike], NDArray]
    value: Callable[[ArrayLike], NDArray]

    def ends(self, factor: float) -> tuple[NDArray, NDArray]:
        """Return the lower and upper ends with the half widths times `factor` > 0. A failed computation ends at 0 and 1."""
        with np.errstate(over="ignore", invalid="ignore"):
            low, high = self.value(self.middle - factor * self.below), self.value(self.middle + factor * self.above)
        failed = np.isnan(low) | np.isnan(high)
        return np.where(failed, 0.0, np.clip(low, 0.0, 1.0)), np.where(failed, 1.0, np.clip(high, 0.0, 1.0))

    def residual(self, truth: ArrayLike) -> NDArray:
        """Return the normalised error of the numbers: the factor with which the interval just reaches the truth, >= 0."""
        away = self.scale(truth) - self.middle
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(away == 0, 0.0, np.where(away > 0, away / self.above, -away / self.below))


def student_width(freedom: ArrayLike) -> NDArray:
    """Return half the central 95 % interval of Student's t, in halves of its central 68 % interval.

    The errors of the fit are halves of 68 % intervals (Eq. M.37, M.39). The width is 1.96 for infinite degrees of freedom and 2.43
    for four.

    Args:
        freedom: degrees of freedom, > 0.

    Example:
        >>> [round(float(student_width(nu)), 2) for nu in (4.0, float("inf"))]
        [2.43, 1.96]
    """
    nu = np.asarray(freedom, np.float64)
    return stdtrit(nu, 0.5 + 0.5 * PROBABILITY) / stdtrit(nu, _ONE_SIGMA)


def pooled(variance: ArrayLike, freedom: ArrayLike) -> tuple[NDArray, NDArray]:
    """Return variance and degrees of freedom of a sum of independent errors (Welch and Satterthwaite).

    Args:
        variance: (..., k) >= 0; freedom: (k,) > 0, infinite for an error of known variance.

    Returns:
        The sum (...,), and nu = (sum v)^2 / sum(v^2 / nu_i); infinite where nothing has finitely many.
    """
    v = np.asarray(variance, np.float64)
    total = v.sum(-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.where(total[..., None] > 0, v / total[..., None], 0.0)
        return total, 1.0 / (share**2 / np.asarray(freedom, np.float64)).sum(-1)


def mixture_quantile(share: float, weight: NDArray, middle: NDArray, deviation: NDArray, freedom: NDArray) -> NDArray:
    """Return the quantile of mixtures of Student's t.

    Args:
        share: probability below the quantile, in (0, 1).
        weight: (..., k) >= 0, their sum is above 0; middle, deviation: (..., k) of each part, `deviation` half of its central 68 %
            interval, finite and > 0; freedom: (..., k).

    Returns:
        (...,)
    """
    scale = deviation / stdtrit(freedom, _ONE_SIGMA)
    own = np.where(weight > 0, middle + scale * stdtrit(freedom, share), np.nan)
    weight = weight / weight.sum(-1, keepdims=True)
    # The quantile of a mixture lies between those of its parts.
    low, high = np.nanmin(own, -1), np.nanmax(own, -1)
    for _ in range(_HALVINGS):
        at = 0.5 * (low + high)
        below = (weight * stdtr(freedom, (at[..., None] - middle) / scale)).sum(-1) < share
        low, high = np.where(below, at, low), np.where(below, high, at)
    return 0.5 * (low + high)


def conformal_factor(residual: ArrayLike, weight: ArrayLike, probability: float = PROBABILITY) -> float:
    """Return the split-conformal quantile of normalised errors: the smallest factor with which intervals hold a further object.

    With equal weights it is the ceil((n + 1) probability)-th smallest error (Vovk et al. 2005; Lei et al. 2018); the further
    object weighs as much as the mean of the others. Errors of one room are not independent, so a room's weights should add up to
    the same in each.

    Args:
        residual: (n,) >= 0; weight: (n,) > 0.

    Returns:
        The factor; infinite where there are too few errors for `probability`.
    """
    r, w = np.asarray(residual, np.float64), np.asarray(weight, np.float64)
    order = np.argsort(r)
    needed = probability * (w.sum() + (w.mean() if len(w) else 1.0))
    enough = np.flatnonzero(np.cumsum(w[order]) >= needed * (1.0 - 1e-12))
    return float(r[order][enough[0]]) if len(enough) else np.inf


def albedo_spread(
    albedo: NDArray, level: NDArray, room: float, probability: NDArray, brightness: NDArray, errors: MeasuredErrors
) -> Spread:
    """Spread of the mean albedo of objects (Eq. M.57 to M.59).

    Args:
        albedo: (O, 3) linear, >= 0.
        level: (O,) error of the logarithm of an object's brightness within its room; <= 0 or not finite: not known.
        room: error of the logarithm of the level of the room; not finite: not known.
        probability, brightness: (O, 3) of the kinds (`problem.Kinds`); a probability of 0 in all says nothing of kinds.
        errors: measured.

    Returns:
        (O, 3)
    """
    albedo, level = np.asarray(albedo, np.float64), np.asarray(level, np.float64)
    known = (level > 0) & np.isfinite(level) & np.isfinite(room) & np.isfinite(albedo).all(-1)
    own = np.where(known, np.minimum(level, _LARGEST), 1.0)
    parts = np.stack([own**2, np.full_like(own, room**2 if np.isfinite(room) else 0.0), np.full_like(own, errors.hue**2)], -1)
    relative = np.sqrt(np.minimum(parts.sum(-1), _LARGEST**2))[:, None]
    additive = max(errors.additive, _NARROWEST)

    # g(a) = asinh(s a / delta) / s has the slope 1 / sqrt((s a)^2 + delta^2), so that every albedo has the error 1 on it.
    def scale(value: ArrayLike) -> NDArray:
        return np.arcsinh(relative * np.asarray(value, np.float64) / additive) / relative

    def value(on_scale: ArrayLike) -> NDArray:
        return np.sinh(np.minimum(relative * on_scale, 300.0)) * additive / relative

    with np.errstate(invalid="ignore", divide="ignore"):
        around = np.concatenate([np.broadcast_to(parts[:, None], (*albedo.shape, 3)), (additive / albedo[..., None]) ** 2], -1)
        _, freedom = pooled(np.where(np.isfinite(around), around, 1e30), [DEGREES_OF_FREEDOM, np.inf, np.inf, np.inf])
    weight, shift = _of_kinds(probability, brightness)
    middle = scale(np.maximum(albedo, 0.0))
    at = np.stack([scale(np.maximum(albedo, 0.0) * np.exp(shift[:, k : k + 1])) for k in range(3)], -1)
    ends = _ends(np.broadcast_to(weight[:, None], at.shape), at, np.ones_like(at), np.repeat(freedom[..., None], 3, -1))
    return _spread(middle, *ends, known[:, None], scale, value)


def roughness_spread(
    roughness: NDArray, deviation: NDArray, seen: NDArray, probability: NDArray, of_kind: NDArray, deviation_of_kind: NDArray
) -> Spread:
    """Spread of the mean roughness of objects, on the logit of it (Eq. M.60).

    Args:
        roughness: (O,); deviation: (O,) error of it; <= 0 or not finite: not known.
        seen: (O,) what the photographs say of it (`problem.Kinds`); below `LEAST_SEEN` it is not known.
        probability, of_kind, deviation_of_kind: (O, 3) of the kinds, their roughness and its deviation.

    Returns:
        (O,)
    """
    r, deviation = np.asarray(roughness, np.float64), np.asarray(deviation, np.float64)
    known = (deviation > 0) & np.isfinite(deviation) & np.isfinite(r) & (np.asarray(seen) >= LEAST_SEEN)
    chosen = np.asarray(probability).argmax(-1)[:, None] == np.arange(3)
    inside = np.clip(np.where(chosen, r[:, None], of_kind), *_ROUGHNESS_RANGE)
    spread = np.where(chosen, np.where(known, deviation, 1.0)[:, None], deviation_of_kind)
    # To first order the logit of r has the error of r over r (1 - r).
    spread = np.maximum(spread / (inside * (1.0 - inside)), _NARROWEST)
    middle = logit(np.clip(np.where(np.isfinite(r), r, 0.5), *_ROUGHNESS_RANGE))
    weight, _ = _of_kinds(probability, np.zeros_like(inside))
    ends = _ends(weight, logit(inside), spread, np.full_like(inside, DEGREES_OF_FREEDOM))

    def scale(value: ArrayLike) -> NDArray:
        return logit(np.clip(value, *_ROUGHNESS_RANGE))

    return _spread(middle, *ends, known, scale, expit)


def _of_kinds(probability: NDArray, shift: NDArray) -> tuple[NDArray, NDArray]:
    """Return weights (O, 3) above 0 in sum, and shifts that are 0 where nothing is known of kinds."""
    weight = np.nan_to_num(np.asarray(probability, np.float64), nan=0.0)
    unknown = ~(weight.sum(-1, keepdims=True) > 0)
    return np.where(unknown, [1.0, 0.0, 0.0], weight), np.where(unknown, 0.0, np.nan_to_num(shift))


def _ends(weight: NDArray, middle: NDArray, deviation: NDArray, freedom: NDArray) -> tuple[NDArray, NDArray]:
    below, above = (mixture_quantile(share, weight, middle, deviation, freedom) for share in (_OUTSIDE, 1.0 - _OUTSIDE))
    return below, above


_OUTSIDE = 0.5 * (1.0 - PROBABILITY)


def _spread(
    middle: NDArray,
    low: NDArray,
    high: NDArray,
    known: NDArray,
    scale: Callable[[ArrayLike], NDArray],
    value: Callable[[ArrayLike], NDArray],
) -> Spread:
    return Spread(middle, np.where(known, middle - low, np.inf), np.where(known, high - middle, np.inf), scale, value)
