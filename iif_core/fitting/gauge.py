"""The scale between light and albedo (METHOD 7a, degeneracy 3).

A fit returns albedos that go with the light that it was given. Multiplying the light by s and dividing every albedo by s leaves
the light of the first bounce as it is, so from direct light alone only the product is known. Indirect light tells them apart:
what surfaces send to each other was photographed, in the same units as everything else, and is a part of what a pixel reflects.
In pixels with much of it and pixels with little, albedo x (direct + photographed indirect light) fits for one direct light only.
Stage emission solves for that light (its radiance cache) and says how sure its level is. By default it is weighed against the
other witness, the mean albedo of the base texture, by their variances; this is the only place where another scale - a
convention, or something that is known - enters.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from iif_core.errors import InputError
from iif_core.fitting.problem import FitProblem, FitResult, raw_values
from iif_core.light.emission.gains import LEVEL_OF_PRIOR

KINDS = ("found", "prior", "mean_albedo", "white_patch", "lamp")
_DARKEST = 1e-3


@dataclass(frozen=True)
class Gauge:
    """What fixes the scale.

    Attributes:
        kind: `found`: the light as given, leaning on `prior` where its level is not sure; `prior`: the mean albedo of the base
            texture stays; `mean_albedo`: the mean albedo of the fitted pixels is `albedo`; `white_patch`: that of `patch` is;
            `lamp`: the light is multiplied by `factor`.
        albedo: mean over the channels, in (0, 1]; patch: (n,) bool, pixels of the problem; factor: > 0;
            error: standard error of the logarithm of the level of the found light; infinite: not known.
    """

    kind: str
    albedo: float = 0.0
    patch: np.ndarray | None = None
    factor: float = 1.0
    error: float = 0.0

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise InputError(f"scale {self.kind!r}; allowed: {', '.join(KINDS)}")
        if self.kind in ("mean_albedo", "white_patch") and not 0 < self.albedo <= 1:
            raise InputError(f"scale {self.kind}: albedo {self.albedo}; it lies above 0 and at most at 1")
        if self.kind == "white_patch" and (self.patch is None or not np.any(self.patch)):
            raise InputError("scale white_patch: no fitted pixel shows the patch; choose an object or pixels that the views see")
        if self.kind == "lamp" and not (np.isfinite(self.factor) and self.factor > 0):
            raise InputError(f"scale lamp: the light would be multiplied by {self.factor}; name a lamp that was found to shine")


def pin(problem: FitProblem, fit: FitResult, gauge: Gauge) -> FitResult:
    """The same fit in the gauge: albedo numbers divided by one factor, `light_scale` multiplied by it.

    `facts["scale"]` says how: `kind`, `factor`, and `relative_error`, the standard deviation of the factor that comes from the
    fitted numbers (not from how true the convention is).
    """
    factor, error = _factor(problem, fit, gauge)
    facts: dict[str, Any] = {**fit.facts, "scale": {"kind": gauge.kind, "factor": factor, "relative_error": error}}
    if factor == 1.0:
        return replace(fit, facts=facts)
    # Objects that nobody fitted kept their base: it is in the prior's gauge already.
    fitted = ~np.array([model.startswith("identity") for model in fit.model], bool)
    affine, covariance = fit.affine.copy(), fit.covariance.copy()
    affine[fitted, :12] /= factor
    covariance[:, :12, :] /= factor
    covariance[:, :, :12] /= factor
    return replace(fit, affine=affine, covariance=covariance, light_scale=fit.light_scale * factor, facts=facts)


def _weighed(problem: FitProblem, fit: FitResult, error: float) -> tuple[float, float]:
    """log factor = log of the prior's x e^2 / (e^2 + p^2), e and p the standard errors of found level and prior's level."""
    if error <= 0:
        return 1.0, 0.0
    share = 1.0 / (1.0 + (LEVEL_OF_PRIOR / error) ** 2) if np.isfinite(error) else 1.0
    factor, _ = _factor(problem, fit, Gauge("prior"))
    return factor**share, LEVEL_OF_PRIOR * float(np.sqrt(share))


def _factor(problem: FitProblem, fit: FitResult, gauge: Gauge) -> tuple[float, float]:
    if gauge.kind == "found":
        return _weighed(problem, fit, gauge.error)
    if gauge.kind == "lamp":
        return float(gauge.factor), 0.0
    use = (problem.object_id >= 0) & (problem.object_id < problem.n_objects) & np.isfinite(problem.base).all(1)
    if gauge.kind == "white_patch":
        use = use & gauge.patch
    use &= fit.free.any(1)[np.where(use, problem.object_id, 0)] if len(fit.free) else False
    if not use.any():
        if gauge.kind == "white_patch":
            raise InputError("scale white_patch: the patch has too few pixels to be fitted; choose a larger one")
        return 1.0, 0.0
    object_id, base = problem.object_id[use], problem.base[use].astype(np.float64)
    # Not clamped to 1: in the light's own gauge an albedo may be larger.
    mean = float(np.maximum(raw_values(fit.affine[object_id], base)[:, :3], 0.0).mean())
    wanted = float(base[:, :3].mean()) if gauge.kind == "prior" else gauge.albedo
    return max(mean, _DARKEST) / max(wanted, _DARKEST), _mean_error(fit, object_id, base) / max(mean, _DARKEST)


def _mean_error(fit: FitResult, object_id: np.ndarray, base: np.ndarray) -> float:
    """Standard deviation of the mean fitted albedo, objects taken as independent."""
    n_objects = len(fit.affine)
    slope = np.zeros((n_objects, 16))
    one = np.concatenate([base[:, :3], np.ones((len(base), 1))], 1)
    for i in range(4):
        summed = np.bincount(object_id, one[:, i], n_objects) / (3 * len(base))
        slope[:, [i, 4 + i, 8 + i]] = summed[:, None]
    return float(np.sqrt(max(np.einsum("oi,oij,oj->", slope, fit.covariance, slope), 0.0)))
