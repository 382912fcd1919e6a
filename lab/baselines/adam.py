"""Free cells fitted by projected Adam on all numbers at once; part means and scale are not differentiated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from iif_core.reflectance.material import LOWEST
from lab.baselines.loss import (
    F0,
    CellFit,
    CellOptions,
    bracket,
    checked_prior,
    data_loss,
    losses,
    part_means,
    prior_scale,
)
from lab.baselines.problem import CellProblem
from lab.published.adam import Moments


@dataclass(frozen=True)
class AdamOptions:
    """Schedule of Adam; the rate falls to a fifth after 60 % and again after 80 % of the steps.

    The publications use the rate 1e-3 on a hash grid, where one step moves thousands of points; a free cell needs a larger one.
    """

    iterations: int = 600
    rate: float = 0.02
    decay: tuple[float, float] = (0.9, 0.99)
    start: tuple[float, ...] = (0.5, 0.5, 0.5, 0.5, 0.5)


def solve_adam(
    problem: CellProblem,
    options: CellOptions | None = None,
    prior: np.ndarray | None = None,
    adam: AdamOptions | None = None,
) -> CellFit:
    """Minimise the loss of `direct.solve_direct` by projected Adam.

    Args:
        problem: the cells; options: weights of the loss; prior: (C, 3) albedo of each cell's object, if the loss has that term.
        adam: schedule.

    Returns:
        The cells after the last step; `history` holds the loss of every fiftieth step.
    """
    options, adam = options or CellOptions(), adam or AdamOptions()
    target = checked_prior(problem, options, prior)
    value = np.tile(np.array(adam.start, np.float64), (len(problem.pixels), 1))
    moments = Moments(value.shape, adam.decay)
    pixels = max(float(problem.pixels[problem.known].sum()), 1e-300)
    scale, history = 1.0, []
    for step in range(adam.iterations):
        if options.prior:
            scale = prior_scale(problem, value, target)
        slope = gradient(problem, value, options, target, scale, part_means(problem, value, options))
        moments.add(slope)
        rate = adam.rate * 0.2 ** ((step >= 0.6 * adam.iterations) + (step >= 0.8 * adam.iterations))
        first, second = moments.bias()
        rate *= np.sqrt(second) / first
        value = np.clip(value - rate * moments.mean / (np.sqrt(moments.square) + 1e-12), LOWEST, 1.0)
        if step % 50 == 0 or step == adam.iterations - 1:
            history.append(float(losses(problem, value, options, target).sum() / pixels))
    if options.prior:
        scale = prior_scale(problem, value, target)
    known = problem.known
    return CellFit(np.where(known[:, None], value, 0.0), known, scale, history)


def gradient(
    problem: CellProblem, value: np.ndarray, options: CellOptions, target: np.ndarray, scale: float, means: np.ndarray
) -> np.ndarray:
    """Return the derivative of the loss of each cell, divided by its pixels.

    Args:
        problem: the cells; value: (C, 5) materials; options: weights of the loss; target: (C, 3) prior albedo.
        scale: s of Eq. M.51; means: (O, 2) mean roughness and metallic of the parts; both are held.

    Returns:
        (C, 5); 0 for unknown cells.
    """
    a, r, m = value[:, :3], value[:, 3], value[:, 4:5]
    j, share = bracket(problem.levels, r)
    cell, t = np.arange(len(j)), share[:, None, None]
    low, high = problem.lobes[cell, j].astype(np.float64), problem.lobes[cell, j + 1].astype(np.float64)
    lobes = (1.0 - t) * low + t * high
    ss, sd, sz, dz, _ = (lobes[:, i] for i in range(5))
    k_d, k_s = (1.0 - m) * a, F0 * (1.0 - m) + m * a
    by_d = 2.0 * (k_d * problem.dd + k_s * sd - dz)
    by_s = 2.0 * (k_s * ss + k_d * sd - sz)
    width = problem.levels[j + 1] - problem.levels[j]
    by_r = (data_loss(problem.dd, high, a, m) - data_loss(problem.dd, low, a, m)).mean(1) / width
    by_a = ((1.0 - m) * by_d + m * by_s) / 3.0
    by_m = (-a * by_d + (a - F0) * by_s).mean(1)
    pixels = np.maximum(problem.pixels, 1e-300)
    of_object = means[problem.object_id]
    by_a = by_a / pixels[:, None] + options.prior * 2.0 / 3.0 * scale * (scale * a - target)
    by_r = by_r / pixels - options.regulariser + options.propagation * np.sign(r - of_object[:, 0])
    by_m = by_m / pixels + options.regulariser + options.propagation * np.sign(value[:, 4] - of_object[:, 1])
    out = np.concatenate([by_a, by_r[:, None], by_m[:, None]], 1)
    return np.where(problem.known[:, None], out, 0.0)
