"""Emission by stochastic gradient descent on traced pixels, the paper's kind of optimiser, as a twin of `direct`
(lab/docs/published.md#emission-by-descent, Eq. L.49, L.50).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from iif_core.errors import InputError
from iif_core.light.emission.direct import EmissionSolution
from iif_core.light.emission.rows import EmissionRows

START = 0.01  # radiance of every group at first
PAPER_RATE = 100.0


@dataclass(frozen=True)
class SgdOptions:
    """How to descend.

    Attributes:
        preset: `safe` scales steps by the diagonal of the normal matrix (Eq. L.49), `paper` descends at rate 100 (Eq. L.50).
        steps: batches.
        batch: rows of a batch.
        prune: ((step, share), ...): after that step groups whose sum of channels is at most `share` of the largest are switched
            off, unless none would remain (docs/method/numerics.md#pruning-everything).
        seed: of the draws.
    """

    preset: Literal["safe", "paper"] = "safe"
    steps: int = 10_000
    batch: int = 1024
    prune: tuple[tuple[int, float], ...] = ((1000, 0.05),)
    seed: int = 0


def solve_emission_sgd(rows: EmissionRows, initial: np.ndarray, options: SgdOptions | None = None) -> EmissionSolution:
    """Solve for the radiance of every group by projected stochastic gradient descent.

    Args:
        rows: as in `solve_emission`.
        initial: (G, 3) radiance of groups to which no row responds; the descent starts at 0.01.
        options: None = defaults.

    Returns:
        The solution; `error` and `determined` are 0, since there is no covariance; `converged` is False when the descent left
        the finite numbers (the radiance then comes from the step before) or ended worse than it began.

    Raises:
        InputError: `initial` of the wrong shape.
    """
    options = options or SgdOptions()
    groups, count = rows.groups, len(rows.observed)
    if np.shape(initial) != (groups, 3):
        raise InputError(f"emission: initial radiance of shape {np.shape(initial)}, needed ({groups}, 3)")
    radiance = np.full((groups, 3), START)
    zeros, none = np.zeros((groups, 3)), np.zeros(groups)
    if not groups or not count:
        return EmissionSolution(np.array(initial, np.float64), zeros, none, 1.0, 0.0, 0, 0, True)
    rng = np.random.default_rng(options.seed)
    first, second, targets = *rows.matrices, rows.targets
    mean_weight = np.maximum(rows.weight.mean(0), 1e-300)
    diagonal = np.maximum(np.einsum("nc,ngc->gc", rows.weight, np.square(first, dtype=np.float64)) / count, 1e-300)
    kept, schedule, finite = np.ones(groups, bool), dict(options.prune), True
    average = np.zeros((groups, 3))
    for step in range(1, options.steps + 1):
        pick = rng.integers(0, count, min(options.batch, count))
        half = rng.random(len(pick)) < 0.5
        a = np.where(half[:, None, None], first[pick], second[pick])
        t = np.where(half[:, None], *targets[:, pick])
        residual = np.einsum("ngc,gc->nc", a, radiance) - t
        if options.preset == "safe":
            residual = np.where(rows.lower_bound[pick], np.minimum(residual, 0.0), residual)
        gradient = np.einsum("ngc,nc->gc", a, rows.weight[pick] * residual) / len(pick)
        if options.preset == "safe":
            # The largest eigenvalue of a matrix of unit diagonal is at most its size.
            move = gradient / (diagonal * max(1.0, 0.25 * groups)) * min(1.0, 0.3 * options.steps / step)
        else:
            move = PAPER_RATE * 2.0 / 3.0 * gradient / mean_weight
        new = np.maximum(radiance - move, 0.0) * kept[:, None]
        if not np.isfinite(new).all():
            finite = False
            break
        radiance = new
        if step in schedule:
            total = radiance.sum(1)
            strong = kept & (total > schedule[step] * total.max())
            kept = strong if strong.any() else kept
        if step > options.steps // 2:
            average += radiance
    if finite and options.preset == "safe" and options.steps > 1:  # the mean of the second half (Polyak and Juditsky 1992)
        radiance = average / (options.steps - options.steps // 2) * kept[:, None]
    blind = np.einsum("nc,ngc->gc", rows.weight, np.abs(first)) <= 0
    radiance = np.where(blind, initial, radiance)
    square, norm, violated = _misfit(rows, radiance)
    # Steps that are too long end in 0, clamped, rather than in infinity, and so worse than where the descent began.
    finite &= square <= _misfit(rows, np.full((groups, 3), START))[0] * (1 + 1e-6)
    residual = float(np.sqrt(square / norm)) if norm > 0 else 0.0
    return EmissionSolution(radiance, zeros, none, 1.0, residual, violated, step, bool(finite))


def _misfit(rows: EmissionRows, radiance: np.ndarray) -> tuple[float, float, int]:
    """Weighted sums of squares of the residual and of the target, and number of bounds that are not reached."""
    target = rows.mean_target
    difference = target - np.einsum("ngc,gc->nc", rows.matrices.mean(0), radiance)
    counted = np.where(rows.lower_bound & (difference < 0), 0.0, rows.weight)
    square, norm = float((counted * difference**2).sum()), float((counted * target**2).sum())
    return square, norm, int((rows.lower_bound & (difference > 0)).sum())
