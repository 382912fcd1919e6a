"""Cells solved exactly: albedo in closed form, roughness and metalness by search, parts by fixed point.

For given r and m a cell's albedo is one ratio per channel. Between two levels the loss is linear in r, so its minimum
over the albedo is concave there and the best r is a level or the part's mean, where |r - r_o| has its kink: a search over
the levels and that mean misses nothing. Metalness is searched on a grid and at the part's mean.
"""

from __future__ import annotations

import numpy as np

from iif_core.fitting.baselines.loss import (
    CellFit,
    CellOptions,
    best_albedo,
    checked_prior,
    data_loss,
    lobes_at,
    losses,
    part_means,
    prior_scale,
)
from iif_core.fitting.baselines.problem import CellProblem

METALNESS = np.linspace(0.0, 1.0, 11)
STARTS = ((1.0, 0.0), (1.0, 0.2), (0.85, 0.3), (0.8, 0.0), (0.4, 0.0), (0.85, 0.85), (0.4, 1.0), (0.15, 1.0))
"""Means of the parts to start the fixed point from, rough to glossy, dielectric to metal. The best is kept per object, judged on
`_FEW` of its cells."""
_CELLS = 1 << 13
_FEW = 400


def solve_direct(
    problem: CellProblem,
    options: CellOptions | None = None,
    prior: np.ndarray | None = None,
    rounds: int = 4,
    scales: int = 2,
) -> CellFit:
    """Minimise the loss of every cell.

    Args:
        problem: see `CellProblem`; options: weights; prior: (C, 3) albedo that `options.prior` pulls to.
        rounds: fixed-point steps of the part means, from each of `STARTS`.
        scales: alternations with the scale of the prior term.

    Returns:
        `CellFit`, finite; the loss in `history` falls or stays.
    """
    options = options or CellOptions()
    target = checked_prior(problem, options, prior)
    problem_pixels = max(float(problem.pixels[problem.known].sum()), 1e-300)
    value, scale = np.zeros((len(problem.pixels), 5)), 1.0
    cost, history = np.full(problem.n_objects, np.inf), []
    if options.prior:  # the scale starts where the light alone puts the albedo of rough dielectrics
        rough = problem.lobes[:, -1].astype(np.float64)
        alone = best_albedo(problem.dd, rough, np.zeros((len(rough), 1)), 0.0, 0.0)
        scale = prior_scale(problem, alone, target)
    for _ in range(scales if options.prior else 1):
        table = _search(problem, options, target, scale)
        candidate = _parts(problem, options, target, scale, table, rounds)
        # An object keeps what it has where the other fixed point is worse.
        better = losses(problem, candidate, options, target, scale) < cost
        value = np.where(better[problem.object_id, None], candidate, value)
        if options.prior:
            scale = prior_scale(problem, value, target)
        cost = losses(problem, value, options, target, scale)
        history.append(float(cost.sum() / problem_pixels))
    known = problem.known
    return CellFit(np.where(known[:, None], value, 0.0), known, scale, history)


def _pull(problem: CellProblem, options: CellOptions, target: np.ndarray, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """The prior term as pull (a - target)^2: (C, 1), (C, 3)."""
    pull = options.prior * problem.pixels * scale * scale
    return pull[:, None], target / scale if scale > 0 else target


def _search(problem: CellProblem, options: CellOptions, target: np.ndarray, scale: float) -> np.ndarray:
    """(C, J, M) float32: loss without propagation at every level and metalness, albedo at its best."""
    table = np.empty((len(problem.pixels), len(problem.levels), len(METALNESS)), np.float32)
    for start in range(0, len(table), _CELLS):
        part = slice(start, start + _CELLS)
        few = problem.take(part)
        pull, goal = _pull(few, options, target[part], scale)
        for j, level in enumerate(problem.levels):
            lobes = few.lobes[:, j].astype(np.float64)
            for k, metal in enumerate(METALNESS):
                a = best_albedo(few.dd, lobes, metal, pull, goal)
                cost = (data_loss(few.dd, lobes, a, metal) + pull * (a - goal) ** 2).mean(1)
                table[part, j, k] = cost + few.pixels * options.regulariser * (1.0 - level + metal)
    return table


def _parts(
    problem: CellProblem, options: CellOptions, target: np.ndarray, scale: float, table: np.ndarray, rounds: int
) -> np.ndarray:
    """(C, 5): fixed point of the part means, from the start of each object that is best on some of its cells."""
    best, cost = np.tile(STARTS[0], (problem.n_objects, 1)), np.full(problem.n_objects, np.inf)
    if not options.propagation:
        return _fixed_point(problem, options, target, scale, table, best, 1)[0]
    some = _some(problem)
    few, few_target, few_table = problem.take(some), target[some], table[some]
    for start in STARTS:
        means = np.tile(start, (problem.n_objects, 1))
        value, now = _fixed_point(few, options, few_target, scale, few_table, means, rounds)
        better = now < cost
        best = np.where(better[:, None], part_means(few, value, options), best)
        cost = np.where(better, now, cost)
    return _fixed_point(problem, options, target, scale, table, best, rounds)[0]


def _some(problem: CellProblem) -> np.ndarray:
    """Indices of known cells, at most about `_FEW` an object, evenly spread."""
    known = np.flatnonzero(problem.known)
    owner = problem.object_id[known]
    order = np.argsort(owner, kind="stable")
    count = np.bincount(owner, minlength=problem.n_objects)
    rank = np.arange(len(known)) - np.repeat(np.cumsum(count) - count, count)
    stride = np.maximum(1, count // _FEW)[owner[order]]
    return np.sort(known[order][rank % stride == 0])


def _fixed_point(
    problem: CellProblem,
    options: CellOptions,
    target: np.ndarray,
    scale: float,
    table: np.ndarray,
    means: np.ndarray,
    rounds: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Cells for given means and means of the cells, in turn: the best step of each object, (C, 5), and its loss (O,)."""
    best, cost = np.zeros((len(problem.pixels), 5)), np.full(problem.n_objects, np.inf)
    for _ in range(rounds):
        value = _cells_at(problem, options, target, scale, table, means)
        now = losses(problem, value, options, target, scale)
        better = now < cost
        best = np.where(better[problem.object_id, None], value, best)
        cost = np.where(better, now, cost)
        moved = part_means(problem, value, options)
        if np.allclose(moved, means, rtol=0, atol=1e-4):
            break
        means = moved
    return best, cost


def _cells_at(
    problem: CellProblem, options: CellOptions, target: np.ndarray, scale: float, table: np.ndarray, means: np.ndarray
) -> np.ndarray:
    """(C, 5): the best of every cell for given part means (O, 2)."""
    value = np.empty((len(problem.pixels), 5))
    for start in range(0, len(value), _CELLS):
        part = slice(start, start + _CELLS)
        few = problem.take(part)
        mean_r, mean_m = means[few.object_id].T
        weight = (options.propagation * few.pixels)[:, None]
        away_r, away_m = np.abs(problem.levels - mean_r[:, None]), np.abs(METALNESS - mean_m[:, None])
        total = table[part] + (weight * away_r)[:, :, None] + (weight * away_m)[:, None, :]
        j, k = np.divmod(total.reshape(len(mean_r), -1).argmin(1), len(METALNESS))
        on_r, on_m = problem.levels[j], METALNESS[k]
        pull, goal = _pull(few, options, target[part], scale)
        cost = np.full(len(mean_r), np.inf)
        for r, m in ((on_r, on_m), (mean_r, on_m), (on_r, mean_m), (mean_r, mean_m)):
            lobes, metal = lobes_at(few, r), m[:, None]
            a = best_albedo(few.dd, lobes, metal, pull, goal)
            away = np.abs(r - mean_r) + np.abs(m - mean_m)
            own = (data_loss(few.dd, lobes, a, metal) + pull * (a - goal) ** 2).mean(1)
            own += few.pixels * (options.regulariser * (1.0 - r + m) + options.propagation * away)
            better = own < cost
            value[part] = np.where(better[:, None], np.concatenate([a, r[:, None], metal], 1), value[part])
            cost = np.where(better, own, cost)
    return value
