"""The loss of the paper's material stage, by which all solvers are judged (Eq. M.45, M.9; docs/method/numerics.md#clamped-loss).

The terms of the paper's own response basis have no counterpart. For HDR, the error is measured in the curve of Eq. M.3.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from iif_core.camera.response import Response
from iif_core.fitting.pixels import Tone, _brightness, _finite, make_tone, prepare_pixels, residuals
from iif_core.fitting.problem import FitOptions, FitProblem
from iif_core.reflectance.material import apply_affines

CLAMP = 0.9
ROUGHNESS_WEIGHT = 1e-3
METALLIC_WEIGHT = 5e-3


@dataclass(frozen=True)
class ReferenceLoss:
    """The loss and its parts; total = data + roughness + metallic."""

    total: float
    data: float
    roughness: float
    metallic: float


def merged(problem: FitProblem) -> FitProblem:
    """Return a problem with the mean of the halves as the only one, as the paper's loss has it."""
    if len(problem.diffuse) == 1:
        return problem
    # Python's 0.5 keeps the dtype of the cache.
    means = {name: (0.5 * (getattr(problem, name)[0] + getattr(problem, name)[1]),) for name in ("diffuse", "s0", "s1")}
    return replace(problem, **means)


def reference_problem(problem: FitProblem, response: Response) -> FitProblem:
    """Return the problem of the paper's loss: mean of the halves, values from 0.9 on as bounds."""
    mean = merged(problem)
    if response.family == "identity":
        return mean
    with np.errstate(invalid="ignore"):
        return replace(mean, saturated=problem.saturated | (problem.value >= CLAMP), value=np.minimum(problem.value, CLAMP))


def darkest_and_tone(problem: FitProblem, response: Response, chunk: int) -> tuple[float, Tone]:
    """Return what `prepare_pixels` finds from all pixels, looking at `chunk` of them together.

    These are the light below which pixels are left out (docs/method/numerics.md#pixels-without-light), a thousandth of the median
    of exposure times diffuse light over pixels that are finite, exposed, and of an object; and the curve that residuals are
    measured in.
    """
    parts = [problem.take(slice(first, first + chunk)) for first in range(0, len(problem.object_id), chunk)]
    # The parts are views. Looking at one after another keeps the temporary arrays small.
    use = np.concatenate([_finite(part) for part in parts] or [np.zeros(0, bool)])
    brightness = np.concatenate([_brightness(part) for part in parts] or [np.zeros(0)])
    darkest = 1e-3 * float(np.median(brightness[use])) if use.any() else 0.0
    return darkest, make_tone(response, problem.value[use & (brightness > darkest)])


def reference_options(**changes: object) -> FitOptions:
    """Return options with which the direct solver minimises this loss and nothing else."""
    own = FitOptions(
        robust_width=1e6,
        roughness_weight=ROUGHNESS_WEIGHT,
        metallic_weight=METALLIC_WEIGHT,
        population=False,
        select=False,
        metallic_prior=-1.0,
        ridge=1e-9,
        response_ridge=1e-9,
    )
    return replace(own, **changes)


def reference_loss(problem: FitProblem, affine: np.ndarray, response: Response, chunk: int = 1 << 20) -> ReferenceLoss:
    """Return the loss of a solution affine (O, 16) in the gauge of the cached light; `chunk` pixels are looked at together."""
    whole = reference_problem(problem, response)
    of_all, sums = darkest_and_tone(whole, response, chunk), np.zeros(4)  # squares, 1 - roughness, metallic, pixels
    for first in range(0, len(whole.object_id), chunk):
        px, tone = prepare_pixels(whole.take(slice(first, first + chunk)), response, of_all=of_all)
        if len(px.obj):
            squares = np.mean(residuals(px, affine, tone, FitOptions()) ** 2)
            value = apply_affines(affine, px.obj, px.base)
            sums += len(px.obj) * np.array([squares, np.mean(1.0 - value[:, 3]), np.mean(value[:, 4]), 1.0])
    if not sums[3]:
        return ReferenceLoss(0.0, 0.0, 0.0, 0.0)
    data, roughness, metallic = (float(part) for part in sums[:3] / sums[3] * [1.0, ROUGHNESS_WEIGHT, METALLIC_WEIGHT])
    return ReferenceLoss(data + roughness + metallic, data, roughness, metallic)
