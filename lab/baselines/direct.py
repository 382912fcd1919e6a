"""Free cells solved by search: albedo in closed form, roughness and metallic from candidates, parts by fixed point (Eq. M.53).

The search over the levels of roughness and the mean of the part is exact, because the minimum over the albedo is concave between.
"""

from __future__ import annotations

import numpy as np

from lab.baselines.loss import (
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
from lab.baselines.problem import CellProblem

METALLIC_GRID = np.linspace(0.0, 1.0, 11)
"""Values of the metallic that are searched."""
STARTS = ((1.0, 0.0), (1.0, 0.2), (0.85, 0.3), (0.8, 0.0), (0.4, 0.0), (0.85, 0.85), (0.4, 1.0), (0.15, 1.0))
"""Starts of the fixed point: mean roughness and metallic of a part. The best is kept for each object, judged on `_START_CELLS` of
its cells."""
_CELLS_AT_ONCE = 1 << 13
_START_CELLS = 400


def solve_direct(
    problem: CellProblem,
    options: CellOptions | None = None,
    prior: np.ndarray | None = None,
    rounds: int = 4,
    scales: int = 2,
) -> CellFit:
    """Minimise the loss of every cell (Eq. M.51).

    Args:
        problem: the cells; options: weights of the loss; prior: (C, 3) albedo of each cell's object, if the loss has that term.
        rounds: fixed-point steps of the part means, from each of `STARTS`.
        scales: alternations with the scale of the prior term.

    Returns:
        The cells, all finite; the loss in `history` never rises.
    """
    options = options or CellOptions()
    target = checked_prior(problem, options, prior)
    problem_pixels = max(float(problem.pixels[problem.known].sum()), 1e-300)
    value, scale = np.zeros((len(problem.pixels), 5)), 1.0
    cost, history = np.full(problem.n_objects, np.inf), []
    if options.prior:  # the scale starts from the albedo of rough dielectrics without a prior
        rough = problem.lobes[:, -1].astype(np.float64)
        alone = best_albedo(problem.dd, rough, np.zeros((len(rough), 1)), 0.0, 0.0)
        scale = prior_scale(problem, alone, target)
    for _ in range(scales if options.prior else 1):
        table = _search(problem, options, target, scale)
        candidate = _solve_parts(problem, options, target, scale, table, rounds)
        # An object keeps its cells if the new fixed point is worse.
        better = losses(problem, candidate, options, target, scale) < cost
        value = np.where(better[problem.object_id, None], candidate, value)
        if options.prior:
            scale = prior_scale(problem, value, target)
        cost = losses(problem, value, options, target, scale)
        history.append(float(cost.sum() / problem_pixels))
    known = problem.known
    return CellFit(np.where(known[:, None], value, 0.0), known, scale, history)


def _prior_term(problem: CellProblem, options: CellOptions, target: np.ndarray, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Return weight (C, 1) and goal (C, 3) of the prior term, weight (a - goal)^2."""
    prior_weight = options.prior * problem.pixels * scale * scale
    return prior_weight[:, None], target / scale if scale > 0 else target


def _search(problem: CellProblem, options: CellOptions, target: np.ndarray, scale: float) -> np.ndarray:
    """Return the loss without propagation at every level and metallic with the best albedo, (C, J, M) float32."""
    table = np.empty((len(problem.pixels), len(problem.levels), len(METALLIC_GRID)), np.float32)
    for start in range(0, len(table), _CELLS_AT_ONCE):
        part = slice(start, start + _CELLS_AT_ONCE)
        few = problem.take(part)
        prior_weight, goal = _prior_term(few, options, target[part], scale)
        for j, level in enumerate(problem.levels):
            lobes = few.lobes[:, j].astype(np.float64)
            for k, metal in enumerate(METALLIC_GRID):
                a = best_albedo(few.dd, lobes, metal, prior_weight, goal)
                cost = (data_loss(few.dd, lobes, a, metal) + prior_weight * (a - goal) ** 2).mean(1)
                table[part, j, k] = cost + few.pixels * options.regulariser * (1.0 - level + metal)
    return table


def _solve_parts(
    problem: CellProblem, options: CellOptions, target: np.ndarray, scale: float, table: np.ndarray, rounds: int
) -> np.ndarray:
    """Return the fixed point of the part means, (C, 5), from the start that is best on some cells of each object."""
    best, cost = np.tile(STARTS[0], (problem.n_objects, 1)), np.full(problem.n_objects, np.inf)
    if not options.propagation:
        return _fixed_point(problem, options, target, scale, table, best, 1)[0]
    some = _choose_cells(problem)
    few, few_target, few_table = problem.take(some), target[some], table[some]
    for start in STARTS:
        means = np.tile(start, (problem.n_objects, 1))
        value, now = _fixed_point(few, options, few_target, scale, few_table, means, rounds)
        better = now < cost
        best = np.where(better[:, None], part_means(few, value, options), best)
        cost = np.where(better, now, cost)
    return _fixed_point(problem, options, target, scale, table, best, rounds)[0]


def _choose_cells(problem: CellProblem) -> np.ndarray:
    """Return the indices of known cells, evenly spread, at most about `_START_CELLS` of each object."""
    known = np.flatnonzero(problem.known)
    owner = problem.object_id[known]
    order = np.argsort(owner, kind="stable")
    count = np.bincount(owner, minlength=problem.n_objects)
    rank = np.arange(len(known)) - np.repeat(np.cumsum(count) - count, count)
    stride = np.maximum(1, count // _START_CELLS)[owner[order]]
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
    """Alternate cells for given means and means of the cells; return the best step of each object, (C, 5), and its loss (O,)."""
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
    """Return the best material of every cell for given part means (O, 2), (C, 5)."""
    value = np.empty((len(problem.pixels), 5))
    for start in range(0, len(value), _CELLS_AT_ONCE):
        part = slice(start, start + _CELLS_AT_ONCE)
        few = problem.take(part)
        mean_r, mean_m = means[few.object_id].T
        weight = (options.propagation * few.pixels)[:, None]
        away_r, away_m = np.abs(problem.levels - mean_r[:, None]), np.abs(METALLIC_GRID - mean_m[:, None])
        total = table[part] + (weight * away_r)[:, :, None] + (weight * away_m)[:, None, :]
        j, k = np.divmod(total.reshape(len(mean_r), -1).argmin(1), len(METALLIC_GRID))
        on_r, on_m = problem.levels[j], METALLIC_GRID[k]
        prior_weight, goal = _prior_term(few, options, target[part], scale)
        cost = np.full(len(mean_r), np.inf)
        for r, m in ((on_r, on_m), (mean_r, on_m), (on_r, mean_m), (mean_r, mean_m)):
            lobes, metal = lobes_at(few, r), m[:, None]
            a = best_albedo(few.dd, lobes, metal, prior_weight, goal)
            away = np.abs(r - mean_r) + np.abs(m - mean_m)
            own = (data_loss(few.dd, lobes, a, metal) + prior_weight * (a - goal) ** 2).mean(1)
            own += few.pixels * (options.regulariser * (1.0 - r + m) + options.propagation * away)
            better = own < cost
            value[part] = np.where(better[:, None], np.concatenate([a, r[:, None], metal], 1), value[part])
            cost = np.where(better, own, cost)
    return value
