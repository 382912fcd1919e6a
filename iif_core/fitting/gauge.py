"""The factor between light and albedo (docs/method/fitting.md#level-of-all-albedos).

This is the only place where another scale, a convention or something known, enters.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from iif_core.errors import InputError
from iif_core.fitting.problem import FitProblem, FitResult
from iif_core.light.emission.gains import PRIOR_LEVEL_ERROR
from iif_core.reflectance.material import unclamped_material

KINDS = ("found", "prior", "mean_albedo", "white_patch", "lamp")
_DARKEST = 1e-3
_DARKEST_PIXEL = 0.01  # brightness below which a ratio counts as at this


@dataclass(frozen=True)
class Gauge:
    """What fixes the scale.

    Attributes:
        kind: `found`: the weighted mean of the given light and of `prior`; `prior`: the mean albedo of the base texture stays;
            `mean_albedo`: the mean albedo of the fitted pixels is `albedo`; `white_patch`: the mean albedo of the fitted pixels
            in `patch` is `albedo`; `lamp`: the light is multiplied by `factor`.
        albedo: mean over the channels, in (0, 1]; patch: (n,) bool, pixels of the problem; factor: > 0.
        error: standard error of the logarithm of the level of the found light; infinite: not known.
        prior_error: the same of the level that the base texture implies.
    """

    kind: str
    albedo: float = 0.0
    patch: np.ndarray | None = None
    factor: float = 1.0
    error: float = 0.0
    prior_error: float = PRIOR_LEVEL_ERROR

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise InputError(f"scale {self.kind!r}; allowed: {', '.join(KINDS)}")
        if self.kind in ("mean_albedo", "white_patch") and not 0 < self.albedo <= 1:
            raise InputError(f"scale {self.kind}: albedo {self.albedo}; it lies above 0 and at most at 1")
        if self.kind == "white_patch" and (self.patch is None or not np.any(self.patch)):
            raise InputError("scale white_patch: no fitted pixel shows the patch; choose an object or pixels that the views see")
        if self.kind == "lamp" and not (np.isfinite(self.factor) and self.factor > 0):
            raise InputError(f"scale lamp: the light would be multiplied by {self.factor}; name a lamp that was found to shine")


def apply_gauge(problem: FitProblem, fit: FitResult, gauge: Gauge) -> FitResult:
    """Divide the albedo numbers of a fit by the factor of the gauge and multiply `light_scale` by it (Eq. M.42).

    `facts["scale"]` records `kind`, `factor` and `relative_error`. For a convention the error covers the fitted numbers alone
    (Eq. M.44), not the convention itself.
    """
    factor, error = _factor(problem, fit, gauge)
    facts: dict[str, Any] = {**fit.facts, "scale": {"kind": gauge.kind, "factor": factor, "relative_error": error}}
    if factor == 1.0:
        return replace(fit, facts=facts)
    fitted = is_divided(fit)
    affine, covariance = fit.affine.copy(), fit.covariance.copy()
    affine[fitted, :12] /= factor
    covariance[:, :12, :] /= factor
    covariance[:, :, :12] /= factor
    return replace(fit, affine=affine, covariance=covariance, light_scale=fit.light_scale * factor, facts=facts)


def is_divided(fit: FitResult) -> np.ndarray:
    """Return (O,) bool: the gauge divides the albedo of the object. One that was not fitted keeps its base, which is in the gauge
    of the prior already."""
    return ~np.array([model.startswith("identity") for model in fit.model], bool)


def kept_brightness(before: np.ndarray, after: np.ndarray) -> float:
    """Return the factor on all light with which a room is as bright after a gauge as it was before.

    Args:
        before, after: (n, 3) radiance of the same pixels.

    Returns:
        exp median ln (before / after) over the pixels that are lit in both; 1.0 without such pixels.
    """
    old, new = before.mean(1, dtype=np.float64), after.mean(1, dtype=np.float64)
    lit = (old > 0) & (new > 0) & np.isfinite(old) & np.isfinite(new)
    return float(np.exp(np.median(np.log(old[lit] / new[lit])))) if lit.any() else 1.0


def _weigh_levels(problem: FitProblem, fit: FitResult, error: float, prior_error: float) -> tuple[float, float]:
    """Return factor and error of the weighted mean of found level and prior's level (Eq. M.43)."""
    if error <= 0:
        return 1.0, 0.0
    share = 1.0 / (1.0 + (prior_error / error) ** 2) if np.isfinite(error) else 1.0
    return _median_factor(problem, fit) ** share, prior_error * float(np.sqrt(share))


def _median_factor(problem: FitProblem, fit: FitResult) -> float:
    """Return the median over the fitted pixels of the fitted over the base brightness. A mean would follow the few objects whose
    base is wrong by a large factor, such as metals that were predicted as dielectrics."""
    use = _fitted_pixels(problem, fit)
    if not use.any():
        return 1.0
    base = problem.base[use].astype(np.float64)
    fitted = np.maximum(unclamped_material(fit.affine[problem.object_id[use]], base)[:, :3], 0.0).mean(1)
    return float(np.exp(np.median(np.log(np.maximum(fitted, _DARKEST_PIXEL) / np.maximum(base[:, :3].mean(1), _DARKEST_PIXEL)))))


def _fitted_pixels(problem: FitProblem, fit: FitResult) -> np.ndarray:
    """(n,) bool: the pixel belongs to an object of which something was fitted."""
    use = (problem.object_id >= 0) & (problem.object_id < problem.n_objects) & np.isfinite(problem.base).all(1)
    return use & fit.free.any(1)[np.where(use, problem.object_id, 0)] if len(fit.free) else np.zeros(len(use), bool)


def _factor(problem: FitProblem, fit: FitResult, gauge: Gauge) -> tuple[float, float]:
    """Return the factor on the light and its relative standard error."""
    if gauge.kind == "found":
        return _weigh_levels(problem, fit, gauge.error, gauge.prior_error)
    if gauge.kind == "lamp":
        return float(gauge.factor), 0.0
    use = _fitted_pixels(problem, fit)
    if gauge.kind == "white_patch":
        use = use & gauge.patch
    if not use.any():
        if gauge.kind == "white_patch":
            raise InputError("scale white_patch: the patch has too few pixels to be fitted; choose a larger one")
        return 1.0, 0.0
    object_id, base = problem.object_id[use], problem.base[use].astype(np.float64)
    # Not clamped to 1: in the gauge of the light an albedo may be larger.
    mean = float(np.maximum(unclamped_material(fit.affine[object_id], base)[:, :3], 0.0).mean())
    wanted = float(base[:, :3].mean()) if gauge.kind == "prior" else gauge.albedo
    return max(mean, _DARKEST) / max(wanted, _DARKEST), _mean_error(fit, object_id, base) / max(mean, _DARKEST)


def _mean_error(fit: FitResult, object_id: np.ndarray, base: np.ndarray) -> float:
    """Return the standard deviation of the mean fitted albedo, objects taken as independent (Eq. M.44)."""
    n_objects = len(fit.affine)
    slope = np.zeros((n_objects, 16))
    one = np.concatenate([base[:, :3], np.ones((len(base), 1))], 1)
    for i in range(4):
        summed = np.bincount(object_id, one[:, i], n_objects) / (3 * len(base))
        slope[:, [i, 4 + i, 8 + i]] = summed[:, None]
    return float(np.sqrt(max(np.einsum("oi,oij,oj->", slope, fit.covariance, slope), 0.0)))
