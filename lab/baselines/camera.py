"""Camera response with a free albedo in every cell: Gauss-Newton on the response, the albedos eliminated.

Roughness and metallic are solved again between the steps.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from iif_core.camera.response import Response
from iif_core.fitting.cell_pixels import BOUND_WEIGHT, PixelRows
from iif_core.fitting.levels import interpolate_levels
from lab.baselines.direct import solve_direct
from lab.baselines.loss import F0, IRIS, CellFit, CellOptions, best_albedo, checked_prior, lobes_at, prior_scale
from lab.baselines.problem import CellProblem, CellSums

RESPONSE_WEIGHT = 1e-3
"""Weight of the mean squared distance of the response parameters from the start; IRIS weighs the parameters themselves."""
_HALVINGS = 6
_SEARCH_EVERY = 5
"""Steps between searches of roughness and metallic, which move little with the response and take most of the time."""


@dataclass(frozen=True)
class CameraFit:
    """Fitted response, and the loss of the pixels before each step (mean over pixels and channels)."""

    response: Response
    history: list[float]


@dataclass(frozen=True)
class _State:
    """Pixels of known cells in the order of their cells, and what the steps need of the cells' materials."""

    rows: PixelRows
    starts: np.ndarray
    cell: np.ndarray
    albedo: np.ndarray  # (c, 3) of the cells that have pixels
    gain: np.ndarray  # (n, 3) dL/da
    rest: np.ndarray  # (n, 3) L at a = 0
    weight: np.ndarray  # (n, 3)
    prior_weight: np.ndarray  # (c, 1)
    goal: np.ndarray  # (c, 3) prior albedo over the scale


def fit_camera(
    rows: PixelRows,
    sums: CellSums,
    response: Response,
    prior: np.ndarray,
    options: CellOptions = IRIS,
    iterations: int = 12,
    dark: float = 0.0,
) -> CameraFit:
    """Fit the response to pixels whose cells have free materials.

    Args:
        rows: pixels; sums: an empty collector of the cells (ids, objects, levels).
        response: start; prior: (C, 3) albedo of each cell's object.
        options: weights of the loss; iterations: largest number of steps; dark: see `PixelRows.usable`.

    Returns:
        The fit; the given response if it has no parameters or no pixel is usable.
    """
    rows = rows.take(np.flatnonzero(rows.usable(dark)))
    rows = rows.take(np.argsort(rows.cell, kind="stable"))
    if not response.params.size or not len(rows.cell):
        return CameraFit(response, [])
    # Cells without pixels do not matter here.
    present, own = np.unique(rows.cell, return_inverse=True)
    rows, prior = replace(rows, cell=own), prior[present]
    sums = CellSums(sums.object_id[present], sums.n_objects, sums.levels)
    begin, history, fit = response.params, [], None
    for step in range(iterations):
        problem = _problem(rows, sums, response)
        if fit is None or step % _SEARCH_EVERY == 0:
            fit = solve_direct(problem, options, prior, rounds=2, scales=2)
        else:
            fit = _albedo_again(problem, fit, checked_prior(problem, options, prior), options)
        state = _state(rows, problem, fit, checked_prior(problem, options, prior), options)
        if not len(state.rows.cell):
            return CameraFit(response, history)
        history.append(_cost(state, state.albedo, response, begin))
        stepped = _step(state, response, begin, history[-1])
        if stepped is None:
            break
        response = stepped
    return CameraFit(response, history)


def _albedo_again(problem: CellProblem, fit: CellFit, prior: np.ndarray, options: CellOptions) -> CellFit:
    """Solve albedo and scale for another response, with roughness and metallic held."""
    prior_weight = options.prior * problem.pixels[:, None] * fit.scale**2
    goal = prior / fit.scale if fit.scale > 0 else prior
    albedo = best_albedo(problem.dd, lobes_at(problem, fit.value[:, 3]), fit.value[:, 4:], prior_weight, goal)
    value = np.where(problem.known[:, None], np.concatenate([albedo, fit.value[:, 3:]], 1), 0.0)
    scale = prior_scale(problem, value, prior) if options.prior else fit.scale
    return replace(fit, value=value, scale=scale, known=problem.known)


def _problem(rows: PixelRows, sums: CellSums, response: Response) -> CellProblem:
    own = CellSums(sums.object_id, sums.n_objects, sums.levels)
    own.add(rows, response)
    return own.problem()


def _state(rows: PixelRows, problem: CellProblem, fit: CellFit, prior: np.ndarray, options: CellOptions) -> _State:
    rows = rows.take(np.flatnonzero(fit.known[rows.cell]))
    starts = np.flatnonzero(np.r_[True, np.diff(rows.cell) != 0]) if len(rows.cell) else np.zeros(0, int)
    cell = rows.cell[starts]
    r, m = fit.value[rows.cell, 3], fit.value[rows.cell, 4:5]
    s0, s1 = (interpolate_levels(s, problem.levels, r)[0] for s in (rows.s0, rows.s1))
    gain = (1.0 - m) * rows.diffuse + m * s0
    weight = rows.weight[:, None] * np.where(rows.saturated, BOUND_WEIGHT, 1.0)
    prior_weight = options.prior * problem.pixels[cell, None] * fit.scale**2
    goal = prior[cell] / fit.scale if fit.scale > 0 else prior[cell]
    return _State(rows, starts, cell, fit.value[cell, :3], gain, F0 * (1.0 - m) * s0 + s1, weight, prior_weight, goal)


def _spread(state: _State, of_cell: np.ndarray) -> np.ndarray:
    """Repeat values of cells (c, ...) for their pixels (n, ...)."""
    return np.repeat(of_cell, np.diff(np.r_[state.starts, len(state.rows.cell)]), axis=0)


def _exposed(state: _State, albedo: np.ndarray) -> np.ndarray:
    return state.rows.exposure[:, None] * (_spread(state, albedo) * state.gain + state.rest)


def _cost(state: _State, albedo: np.ndarray, response: Response, begin: np.ndarray) -> float:
    error = response(_exposed(state, albedo)) - state.rows.value
    error = np.where(state.rows.saturated, np.minimum(error, 0.0), error)
    pixels = float(state.rows.weight.sum())
    data = float((state.weight * error**2).sum() + (state.prior_weight * (albedo - state.goal) ** 2).sum())
    return data / (3.0 * pixels) + RESPONSE_WEIGHT * float(np.mean((response.params - begin) ** 2))


def _step(state: _State, response: Response, begin: np.ndarray, cost: float) -> Response | None:
    """Return the response after the first of the halved steps that lowers the cost, or None."""
    f, slope, by_parameter = response.evaluate(_exposed(state, state.albedo))
    error = f - state.rows.value
    idle = state.rows.saturated & (error > 0)
    weight = np.where(idle, 0.0, state.weight)
    by_albedo = slope * state.rows.exposure[:, None] * state.gain
    h_aa = np.add.reduceat(weight * by_albedo**2, state.starts) + state.prior_weight
    g_a = np.add.reduceat(weight * by_albedo * error, state.starts) + state.prior_weight * (state.albedo - state.goal)
    h_aw = np.add.reduceat((weight * by_albedo)[..., None] * by_parameter, state.starts)  # (c, 3, P)
    free = (h_aa > 0) & ~((state.albedo <= 0) & (g_a > 0)) & ~((state.albedo >= 1) & (g_a < 0))
    inverse = np.where(free, 1.0 / np.where(free, h_aa, 1.0), 0.0)
    h = np.einsum("nc,ncp,ncq->cpq", weight, by_parameter, by_parameter)
    h -= np.einsum("xc,xcp,xcq->cpq", inverse, h_aw, h_aw)
    g = np.einsum("nc,ncp,nc->cp", weight, by_parameter, error) - np.einsum("xc,xcp,xc->cp", inverse, h_aw, g_a)
    shared = response.params.ndim == 1
    if shared:
        h, g = h.sum(0, keepdims=True), g.sum(0, keepdims=True)
    ridge = RESPONSE_WEIGHT * 3.0 * float(state.rows.weight.sum()) / response.params.size
    away = np.atleast_2d(response.params - begin)
    full = h + ridge * np.eye(h.shape[1])
    move = -np.linalg.solve(full, (g + ridge * away)[..., None])[..., 0]
    for halving in range(_HALVINGS):
        trial = response.with_params((np.atleast_2d(response.params) + move * 0.5**halving).reshape(response.params.shape))
        moved = np.atleast_2d(trial.params - response.params)
        moved = np.broadcast_to(moved, (3, moved.shape[1]))
        albedo = state.albedo - inverse * (g_a + np.einsum("xcp,cp->xc", h_aw, moved))
        if _cost(state, np.clip(albedo, 0.0, 1.0), trial, begin) < cost * (1 - 1e-6):
            return trial
    return None
