"""The paper's optimiser: stochastic gradient descent on texture, affine maps and selection together (Eq. F.16).

Every choice of the published behaviour that is numerically fragile is an option: lab/docs/published.md#schedules compares the
presets `safe` and `paper`. The same problem, options and seed give the same bytes for any number of threads. All predictions stay
in memory (in half precision if they come so), since a batch draws from every view.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iif_core.errors import InputError
from iif_core.fusion.problem import FusionProblem, object_means
from iif_core.fusion.selection import selection_weights
from lab.published.fusion.sgd.engine import Engine
from lab.published.fusion.sgd.options import SgdOptions
from lab.published.fusion.sgd.pool import (
    TERMS,
    Pool,
    Step,
    activated,
    batches,
    gather,
    learning_rate_at,
    temperature_at,
)


@dataclass(frozen=True)
class SgdFit:
    """What the optimiser found.

    Attributes:
        value, scale: (n_cells, 5) float32 location and learnt Laplace scale; a hash grid is read at the mean point of each
            cell. Cells without observations take the mean of their object and the 0.9 quantile of the scales.
        corrections: (S, K, 16) float32 affine maps: albedo 3 x 4 (row = output), roughness 2, metallic 2 (gain, bias).
        alpha: (S, K, 3) float32 selection weights; 0 where the segment has no usable pixel.
        history: step; data, label, regulariser (without weights), label_part (with its weight) and total, as means over the
            steps since the last entry; temperature, learning_rate, entropy (nats), gain (mean of tr(A) / 3). The label
            loss is 0 once the selection is fixed, and for K = 1.
    """

    value: NDArray
    scale: NDArray
    corrections: NDArray
    alpha: NDArray
    history: list[dict[str, float]]

    @property
    def affine_albedo(self) -> NDArray:
        """(S, K, 3, 4)."""
        return self.corrections[..., :12].reshape(*self.corrections.shape[:2], 3, 4)

    @property
    def affine_roughness(self) -> NDArray:
        """(S, K, 2) = (gain, bias)."""
        return self.corrections[..., 12:14]

    @property
    def affine_metallic(self) -> NDArray:
        """(S, K, 2) = (gain, bias)."""
        return self.corrections[..., 14:]

    @property
    def weight(self) -> NDArray:
        """Selection weights, by the name of `FusionResult`."""
        return self.alpha


@dataclass(frozen=True)
class SgdState:
    """Where a descent is at the end of an epoch.

    Attributes:
        arrays: parameters and moments by name, as they are in memory: they change with the next step.
        facts: plain numbers and lists: `step`, `rng` (state of the random numbers), `history`, and `sums` of `since` steps.
    """

    arrays: Mapping[str, NDArray]
    facts: Mapping[str, Any]


def converged(history: list[dict[str, float]], tolerance: float = 0.01) -> bool:
    """Return whether the loss changes by less than the share `tolerance` over the last fifth of the history.

    Compares the means of data + 100 regulariser over the first and the last third of that fifth. The label loss is left
    out, because it grows with 1 / temperature and does not settle while the temperature falls. False for fewer than 15
    entries.
    """
    if len(history) < 15:
        return False
    last = np.array([h["total"] - h["label_part"] for h in history[-max(3, len(history) // 5) :]])
    third = len(last) // 3
    before, after = last[:third].mean(), last[-third:].mean()
    return bool(abs(after - before) <= tolerance * max(abs(before), 1e-12))


def solve_sgd(
    problem: FusionProblem,
    options: SgdOptions | None = None,
    progress: Callable[[int, int], None] | None = None,
    threads: int = 2,
    load: Callable[[], SgdState | None] | None = None,
    keep: Callable[[Callable[[], SgdState]], None] | None = None,
) -> SgdFit:
    """Solve a problem by the paper's optimiser.

    An interrupted descent continues from the end of any epoch and gives the same bytes.

    Args:
        problem: predictions on cells, with surface points for a hash grid.
        options: how to solve; None = the safe preset.
        progress: called as progress(done, total) with numbers of steps.
        threads: at least 1.
        load: returns where to go on, None = from the start; called once, so that the state is held no longer than it is needed.
        keep: called at the end of each epoch but the last with a function that returns the state, to write it down or not.

    Returns:
        Texture, affine maps, selection and history.

    Raises:
        InputError: shapes that do not match, ids out of range, a segment in two views, no usable pixel, too much memory,
            a hash grid without surface points, a loss that is not finite.
    """
    options = options or SgdOptions()
    pool = gather(problem, options)
    engine = Engine(pool, options, problem.n_cells, threads)
    try:
        return _solve(problem, options, pool, engine, progress, load, keep)
    finally:
        engine.close()


def _solve(
    problem: FusionProblem,
    options: SgdOptions,
    pool: Pool,
    engine: Engine,
    progress: Callable[[int, int], None] | None,
    load: Callable[[], SgdState | None] | None,
    keep: Callable[[Callable[[], SgdState]], None] | None,
) -> SgdFit:
    batch = min(options.batch, len(pool))
    per_epoch = max(1, len(pool) // batch)
    steps = options.iterations or options.epochs * per_epoch
    rng = np.random.default_rng(options.seed)
    stream = batches(len(pool), batch, rng)
    single = pool.usable.shape[1] == 1
    if single:
        engine.fix(pool.usable[..., None] * np.ones(3))
    choose = options.choice == "argmin" and not single
    choose_at = round(options.choose_at * steps)
    history: list[dict[str, float]] = []
    every = max(1, steps // options.records)
    sums, since, first = np.zeros(len(TERMS)), 0, 0
    if load is not None and (state := load()) is not None:
        engine.restore(state.arrays)
        rng.bit_generator.state = state.facts["rng"]
        first, history = state.facts["step"], list(state.facts["history"])
        sums, since = np.array(state.facts["sums"], np.float64), state.facts["since"]
        del state

    def state_now() -> SgdState:
        facts = {"rng": rng.bit_generator.state, "history": list(history), "sums": sums.tolist(), "since": since}
        return SgdState(engine.state(), {"step": step, **facts})

    for step in range(first, steps):
        if keep is not None and step > first and step % per_epoch == 0:
            keep(state_now)
        temperature = temperature_at(options, step, steps)
        if choose and step == choose_at:
            engine.fix(_chosen(engine.errors(temperature), pool))
        lr = learning_rate_at(options, step, steps)
        pixels = next(stream)
        coordinates = None
        if pool.coordinates is not None:
            coordinates = pool.coordinates[pixels]
            if pool.tangent is not None:
                offset = rng.random((len(pixels), 2, 1), np.float32) - np.float32(0.5)
                coordinates = coordinates + (offset * pool.tangent[pixels]).sum(1)
        found = engine.step(Step(pixels, coordinates, temperature, lr))
        if not np.isfinite(found).all():
            terms = ", ".join(f"{name} {x:.3g}" for name, x in zip(TERMS, found, strict=True))
            raise InputError(f"base sgd: the loss is not finite at step {step} ({terms}); lower learning_rate or regulariser")
        sums, since = sums + found, since + 1
        if since == every or step == steps - 1:
            history.append(_entry(step + 1, sums / since, options, temperature, lr))
            sums, since = np.zeros(len(TERMS)), 0
            if progress is not None:
                progress(step + 1, steps)
    temperature = temperature_at(options, steps - 1, steps)
    if choose and choose_at >= steps:
        engine.fix(_chosen(engine.errors(temperature), pool))
    return _fit(problem, options, pool, engine, temperature, history)


def _chosen(error: NDArray, pool: Pool) -> NDArray:
    """(S, K, 3) weights that choose the smallest error; equal ones share, so the order of predictions does not matter."""
    use = np.broadcast_to(pool.usable[:, None, :], (len(error), 3, error.shape[1]))
    count = np.maximum(np.bincount(pool.segment, minlength=len(error)), 1)
    return selection_weights((error / count[:, None, None]).swapaxes(1, 2), 0.0, use).swapaxes(1, 2)


def _entry(step: int, means: NDArray, options: SgdOptions, temperature: float, lr: float) -> dict[str, float]:
    data, label, regulariser, entropy, gain = (float(x) for x in means)
    label_part = options.label_weight * label
    return {
        "step": float(step),
        "data": data,
        "label": label,
        "regulariser": regulariser,
        "label_part": label_part,
        "total": options.data_weight * data + label_part + options.regulariser * regulariser,
        "temperature": temperature,
        "learning_rate": lr,
        "entropy": entropy,
        "gain": gain,
    }


def _fit(
    problem: FusionProblem,
    options: SgdOptions,
    pool: Pool,
    engine: Engine,
    temperature: float,
    history: list[dict[str, float]],
) -> SgdFit:
    n_cells, seen = problem.n_cells, pool.observations > 0
    if pool.coordinates is None:
        raw = engine.table
    else:
        centre = np.stack([np.bincount(pool.cell, pool.coordinates[:, a], n_cells) for a in range(3)], 1)
        centre /= np.maximum(pool.observations, 1)[:, None]
        raw = engine.grid.evaluate(centre.astype(np.float32))
    value, scale = activated(raw, options)
    object_value, _ = object_means(value, problem.object_of_cell, pool.observations)
    value[~seen] = object_value[problem.object_of_cell[~seen]]
    scale[~seen] = np.quantile(scale[seen], 0.9, axis=0)
    alpha, _ = engine.weights(temperature)
    count = np.bincount(pool.segment, minlength=problem.n_segments)[:, None, None]
    return SgdFit(
        value=value,
        scale=scale,
        corrections=engine.affine.copy(),
        alpha=np.where(count > 0, alpha, 0).astype(np.float32),
        history=history,
    )
