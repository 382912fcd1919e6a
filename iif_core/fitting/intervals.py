"""95 % intervals of the materials of objects (docs/method/fitting.md#intervals-of-objects).

An interval reaches from g^-1(g(x) - lambda L) to g^-1(g(x) + lambda U), on a scale g that keeps it within [0, 1]. L and U follow
from the errors that the fit states, the kinds that it could not exclude, and errors that were measured in rooms with truth. So
was the factor lambda.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import logit, stdtr, stdtrit

from iif_core.errors import InputError
from iif_core.fitting.problem import Kinds

PROBABILITY = 0.95
"""Of every interval."""
LEAST_SEEN = 0.5
"""Share of the variance of the roughness that the photographs remove (`Kinds.seen`). Below it the roughness is mostly what the
prior says of any object, and its interval is 0 to 1."""
_OUTSIDE = 0.5 * (1.0 - PROBABILITY)
_ONE_SIGMA = 0.8413447460685429
"""Share of a normal distribution below one standard deviation."""
_DEGREES_OF_FREEDOM = 4.0
"""Of Student's t of the errors that the fit states (Eq. M.34, M.56)."""
_SMALLEST, _LARGEST = 1e-6, 30.0
"""Limits of errors, which keep scales finite; an interval is 0 to 1 long before the upper one."""
_RAREST = 1e-12
"""Probabilities closer to 0 or 1 than this count as this."""
_SAME = 1e-3
"""Metallic that differs by no more than this is the same."""
_HALVINGS = 60


@dataclass(frozen=True)
class MeasuredErrors:
    """What rooms with truth say of the intervals.

    Attributes:
        additive: error of an albedo that does not grow with it; border: the same of an object that one pixel shows, by what its
            borders mix into it, which falls with the root of the pixels; hue: error of the logarithm of a channel relative to
            the brightness.
        dielectric, metal: error of the roughness of what is taken for a non-metal, and for any other kind, that the fit does not
            state; that a kind is wrong is part of it. All these are halves of central 68 % intervals.
        albedo, roughness, metallic: the factor lambda of each.
    """

    additive: float
    border: float
    hue: float
    dielectric: float
    metal: float
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
            raise InputError(f"{where}: found {wrong}; needed finite numbers above 0; restore it: git checkout {where}")
        return cls(**values)


# -------------------------------------------------------------------------------------------------------- distributions


def student_width(freedom: ArrayLike) -> NDArray:
    """Return half the central 95 % interval of Student's t, in halves of its central 68 % interval.

    The errors of the fit are halves of 68 % intervals (Eq. M.37, M.39), and their tails are those of Student's t.

    Args:
        freedom: degrees of freedom, > 0.

    Example:
        >>> [round(float(student_width(nu)), 2) for nu in (4.0, float("inf"))]
        [2.43, 1.96]
    """
    return stdtrit(freedom, 1.0 - _OUTSIDE) / stdtrit(freedom, _ONE_SIGMA)


def pooled(variance: ArrayLike, freedom: ArrayLike) -> tuple[NDArray, NDArray]:
    """Return variance and degrees of freedom of sums of independent errors (Welch and Satterthwaite).

    Args:
        variance: (..., k) finite, >= 0; freedom: (k,) > 0, infinite for an error of known variance.

    Returns:
        Sums (...,), and nu = (sum v)^2 / sum(v^2 / nu_i).
    """
    v = np.asarray(variance, np.float64)
    total = v.sum(-1)
    share = v / np.maximum(total, np.finfo(float).tiny)[..., None]
    with np.errstate(divide="ignore", over="ignore"):
        return total, 1.0 / (share**2 / np.asarray(freedom, np.float64)).sum(-1)


def mixture_quantile(below: float, weight: NDArray, middle: NDArray, error: NDArray, freedom: NDArray) -> NDArray:
    """Return quantiles of mixtures of Student's t.

    Args:
        below: probability below the quantile, in (0, 1).
        weight: (..., k) >= 0, their sums are above 0; middle: (..., k); error: (..., k) halves of the central 68 % intervals,
            finite and > 0; freedom: (..., k) degrees of freedom.

    Returns:
        (...,)
    """
    scale = error / stdtrit(freedom, _ONE_SIGMA)
    parts = np.where(weight > 0, middle + scale * stdtrit(freedom, below), np.nan)
    weight = weight / weight.sum(-1, keepdims=True)
    # The quantile of a mixture lies between those of its parts.
    low, high = np.nanmin(parts, -1), np.nanmax(parts, -1)
    for _ in range(_HALVINGS):
        at = 0.5 * (low + high)
        is_below = (weight * stdtr(freedom, (at[..., None] - middle) / scale)).sum(-1) < below
        low, high = np.where(is_below, at, low), np.where(is_below, high, at)
    return 0.5 * (low + high)


def conformal_factor(residual: ArrayLike, room: ArrayLike, until: ArrayLike = np.inf, probability: float = PROBABILITY) -> float:
    """Return the least factor with which claims hold as often as `probability` (Eq. M.62).

    With one room where everything is claimed it is the split-conformal quantile, the ceil((n + 1) probability)-th smallest of n
    errors (Vovk et al. 2005): one more object, which weighs as much as the mean of the others, counts as an error without limit.
    An interval that has grown to all values claims nothing, and counts for nothing; then more may be held with a smaller factor
    than with a larger one, and only rooms left out tell what it holds.

    Args:
        residual: (n,) factors >= 0 with which the intervals just reach the truth.
        room: (n,) integers >= 0, the room of each object; what is claimed in a room weighs 1 together.
        until: factors from which on an interval claims nothing, broadcast to (n,).

    Returns:
        The factor; infinite where there are too few errors for `probability`.
    """
    r, room = np.asarray(residual, np.float64), np.asarray(room, np.int64)
    until = np.broadcast_to(np.asarray(until, np.float64), r.shape)
    claims = np.bincount(room[until > 0], minlength=room.max(initial=-1) + 1).astype(np.float64)
    held = np.zeros_like(claims)
    # What happens as the factor grows: an interval reaches its truth, and later on, or before, it ceases to claim anything.
    reach, end = np.flatnonzero(r < until), np.flatnonzero((until > 0) & np.isfinite(until))
    at = np.concatenate([r[reach], until[end]])
    who, change = np.concatenate([reach, end]), np.repeat([1, -1], [len(reach), len(end)])
    order = np.argsort(at, kind="stable")
    for k, n in enumerate(order):
        own = room[who[n]]
        if change[n] > 0:
            held[own] += 1
        else:
            claims[own] -= 1
            held[own] -= r[who[n]] < until[who[n]]
        if k + 1 < len(order) and at[order[k + 1]] == at[n]:
            continue
        some = claims > 0
        needed = probability * some.sum() * (1.0 + 1.0 / max(claims.sum(), 1.0))
        if some.any() and (held[some] / claims[some]).sum() >= needed * (1.0 - 1e-12):
            return float(at[n])
    return np.inf


def roughness_error(kinds: Kinds, errors: MeasuredErrors) -> NDArray:
    """Return the errors (O, 3) of the roughness of each kind: that of its profile, and what was measured (Eq. M.60)."""
    measured = np.array([errors.dielectric, errors.metal, errors.metal])
    return np.hypot(np.minimum(np.nan_to_num(kinds.deviation), _LARGEST), measured)


# ------------------------------------------------------------------------------------------------------------ intervals


@dataclass(frozen=True)
class AlbedoIntervals:
    """Intervals of albedos (Eq. M.57 to M.59).

    Attributes:
        middle: (O, 3) on the scale; below, above: (O, 3) half widths, infinite where the albedo is not known.
        relative, additive: (O, 1) errors that grow with the albedo and that do not, which bend the scale.
    """

    middle: NDArray
    below: NDArray
    above: NDArray
    relative: NDArray
    additive: NDArray

    @classmethod
    def of(
        cls, albedo: ArrayLike, level: ArrayLike, pixels: ArrayLike, room: float, kinds: Kinds, errors: MeasuredErrors
    ) -> AlbedoIntervals:
        """Combine the errors of the mean albedo of objects.

        Args:
            albedo: (O, 3) linear; outside [0, 1] it counts as at the ends.
            level: (O,) error of the logarithm of an object's brightness within the room; 0 or not finite: not known.
            pixels: (O,) that show the object; less than 1 counts as 1.
            room: error of the logarithm of the level of the room; not finite: not known.
            kinds: what the fit left open; errors: measured.
        """
        a, level = np.asarray(albedo, np.float64), np.asarray(level, np.float64)
        known = (level > 0) & np.isfinite(level) & np.isfinite(room) & np.isfinite(a).all(1)
        a = np.where(known[:, None], np.clip(a, 0.0, 1.0), 0.5)
        parts = np.stack(np.broadcast_arrays(np.where(known, level, 1.0), room, errors.hue), 1)
        parts = np.minimum(np.nan_to_num(parts), _LARGEST) ** 2
        relative = np.clip(np.sqrt(parts.sum(1)), _SMALLEST, _LARGEST)[:, None]
        border = errors.border / np.sqrt(np.fmax(np.asarray(pixels, np.float64), 1.0))
        additive = np.maximum(np.hypot(errors.additive, border), _SMALLEST)[:, None]
        every = np.concatenate([parts[:, None] * a[..., None] ** 2, np.broadcast_to(additive**2, a.shape)[..., None]], -1)
        freedom = pooled(every, [_DEGREES_OF_FREEDOM, *[np.inf] * 3])[1][..., None]
        weight, shift = _mixture(kinds, kinds.brightness)
        own = cls(np.zeros_like(a), np.zeros_like(a), np.zeros_like(a), relative, additive)
        middle = own.scale(a)
        of_kinds = np.stack([own.scale(a * np.exp(shift[:, k : k + 1])) for k in range(weight.shape[1])], -1)
        weight, error = np.broadcast_to(weight[:, None], of_kinds.shape), np.ones_like(of_kinds)
        low, high = (mixture_quantile(p, weight, of_kinds, error, freedom) for p in (_OUTSIDE, 1.0 - _OUTSIDE))
        return cls(middle, *_half_widths(middle, low, high, known[:, None]), relative, additive)

    @property
    def until(self) -> NDArray:
        """(O, 3) factors from which on nothing is claimed: 0 where the albedo is not known, infinite elsewhere."""
        return np.where(np.isfinite(self.above), np.inf, 0.0)

    def scale(self, albedo: ArrayLike) -> NDArray:
        """Return albedos (O, 3) on the scale on which each has the error 1: asinh(s a / delta) / s (Eq. M.58)."""
        return np.arcsinh(self.relative * np.asarray(albedo, np.float64) / self.additive) / self.relative

    def ends(self, factor: float) -> tuple[NDArray, NDArray]:
        """Return the lower and upper ends (O, 3) in [0, 1], half widths times `factor` > 0."""
        return self._value(self.middle - factor * self.below), self._value(self.middle + factor * self.above)

    def _value(self, on_scale: NDArray) -> NDArray:
        """Inverse of `scale`, within [0, 1]."""
        value = np.sinh(np.clip(self.relative * on_scale, -700.0, 700.0)) * self.additive / self.relative
        return np.clip(value, 0.0, 1.0)

    def residual(self, truth: ArrayLike) -> NDArray:
        """Return the factors (O, 3) with which the intervals just reach true albedos; 0 where nothing is claimed."""
        return _normalised(self.scale(truth) - self.middle, self.below, self.above)


@dataclass(frozen=True)
class RoughnessIntervals:
    """Intervals of roughness, cut off at 0 and 1 (Eq. M.60).

    Attributes:
        middle: (O,); below, above: (O,) half widths, infinite where the photographs do not show it.
    """

    middle: NDArray
    below: NDArray
    above: NDArray

    @classmethod
    def of(cls, roughness: ArrayLike, kinds: Kinds, errors: MeasuredErrors) -> RoughnessIntervals:
        """Combine the errors of the mean roughness (O,) of objects with what the fit left open."""
        r = np.asarray(roughness, np.float64)
        known = np.isfinite(r) & (kinds.seen >= LEAST_SEEN)
        middle = np.where(known, np.clip(r, 0.0, 1.0), 0.5)
        weight, of_kind = _mixture(kinds, kinds.roughness)
        chosen = weight.argmax(1)[:, None] == np.arange(weight.shape[1])
        of_kind = np.where(chosen, middle[:, None], np.clip(of_kind, 0.0, 1.0))
        error = roughness_error(kinds, errors)
        freedom = np.full_like(error, _DEGREES_OF_FREEDOM)
        low, high = (mixture_quantile(p, weight, of_kind, error, freedom) for p in (_OUTSIDE, 1.0 - _OUTSIDE))
        return cls(middle, *_half_widths(middle, low, high, known))

    @property
    def until(self) -> NDArray:
        """(O,) factors from which on the interval is 0 to 1; 0 where nothing is claimed with any."""
        return np.maximum(self.middle / self.below, (1.0 - self.middle) / self.above)

    def ends(self, factor: float) -> tuple[NDArray, NDArray]:
        """Return the lower and upper ends (O,) in [0, 1], half widths times `factor` > 0."""
        return np.clip(self.middle - factor * self.below, 0.0, 1.0), np.clip(self.middle + factor * self.above, 0.0, 1.0)

    def residual(self, truth: ArrayLike) -> NDArray:
        """Return the factors (O,) with which the intervals just reach true roughness; 0 where nothing is claimed."""
        return _normalised(np.asarray(truth, np.float64) - self.middle, self.below, self.above)


@dataclass(frozen=True)
class MetallicIntervals:
    """Intervals of metallic, which is near 0 or near 1: an end moves there where that kind is not excluded (Eq. M.61).

    Attributes:
        middle: (O,) estimates; to_dielectric, to_metal: (O,) factors from which on the kind is not excluded; at most 0 where it
            is more likely than not.
    """

    middle: NDArray
    to_dielectric: NDArray
    to_metal: NDArray

    @classmethod
    def of(cls, metallic: ArrayLike, kinds: Kinds) -> MetallicIntervals:
        """Return the intervals of the mean metallic (O,) of objects. Metallic as predicted excludes neither kind."""
        m = np.asarray(metallic, np.float64)
        weight, _ = _mixture(kinds, kinds.brightness)
        unknown = ~np.isfinite(m) | ~(np.nan_to_num(kinds.probability).sum(1) > 0)
        ends = []
        for columns in ([0, 2], [1, 2]):
            share = np.clip(weight[:, columns].sum(1) / weight.sum(1), _RAREST, 1.0 - _RAREST)
            ends.append(np.where(unknown, 0.0, logit(share) / logit(1.0 - PROBABILITY)))
        return cls(np.where(np.isfinite(m), np.clip(m, 0.0, 1.0), 0.5), *ends)

    def ends(self, factor: float) -> tuple[NDArray, NDArray]:
        """Return the lower and upper ends (O,) in [0, 1], with log odds of kinds divided by `factor` > 0."""
        low = np.where(self.to_dielectric <= factor, 0.0, self.middle)
        return low, np.where(self.to_metal <= factor, 1.0, self.middle)

    def residual(self, truth: ArrayLike) -> NDArray:
        """Return the factors (O,) with which the intervals just reach true metallic."""
        away = np.asarray(truth, np.float64) - self.middle
        needed = np.where(away > 0, self.to_metal, self.to_dielectric)
        return np.where(np.abs(away) <= _SAME, 0.0, np.maximum(needed, 0.0))


def _mixture(kinds: Kinds, value: NDArray) -> tuple[NDArray, NDArray]:
    """Return weights (O, 3) of the kinds and a finite value of each; the first kind alone where nothing is known of them."""
    weight = np.nan_to_num(np.asarray(kinds.probability, np.float64))
    nothing = ~(weight.sum(1, keepdims=True) > 0)
    return np.where(nothing, [1.0, 0.0, 0.0], weight), np.where(nothing, 0.0, np.nan_to_num(value))


def _half_widths(middle: NDArray, low: NDArray, high: NDArray, known: NDArray) -> tuple[NDArray, NDArray]:
    return np.where(known, middle - low, np.inf), np.where(known, high - middle, np.inf)


def _normalised(away: NDArray, below: NDArray, above: NDArray) -> NDArray:
    return np.maximum(away, 0.0) / above + np.maximum(-away, 0.0) / below
