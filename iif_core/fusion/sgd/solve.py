"""The paper's optimiser: stochastic gradient descent on texture, corrections and selection together (METHOD 2.3).

The twin of the direct solver: it reads the same problem, its result is described the same way, and
`reference_loss.reference_loss` judges both. The loss of a batch of pixels is

    L = mean KL(Laplace(mu_ref, b_ref) || Laplace(mu, b)) + label loss + 100 identity regulariser     (2.3.4 - 2.3.8)

with mu_ref = sum_k softmax_k(z / tau) clamp(T_k v_k), b_ref the lower median over k of |mu_ref - clamp(T_k v_k)|, and one
Adam over texture, T and z. On the CPU, loss and gradient are closed forms in one compiled pass (kernels.py); the
torch backend leaves them to automatic differentiation, runs on any device and is the check of the former.

Every choice where the published behaviour is fragile is an option of its own (METHOD 5); `sgd_options("paper")` are the
published ones, `sgd_options("safe")` = `SgdOptions()` the others.

Reproducible: same problem, options and seed give the same bytes on the CPU, for any number of threads (numba backend)
or for a fixed number of torch threads (torch backend); on CUDA gradients of the texture are added in no fixed order.
The order of the predictions matters to rounding alone.

Memory: all predictions (in half precision if they come so), since a batch draws from every view; four textures.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from iif_core.errors import InputError
from iif_core.fusion.problem import BaseProblem, Dropped, object_means
from iif_core.fusion.selection import selection_weights
from iif_core.fusion.sgd.numba_engine import NumbaEngine
from iif_core.fusion.sgd.options import SgdOptions
from iif_core.fusion.sgd.pool import (
    TERMS,
    Pool,
    Step,
    activated,
    batches,
    gather,
    learning_rate_at,
    of_view,
    temperature_at,
    unit_coordinates,
)
from iif_core.fusion.sgd.torch_engine import TorchEngine


@dataclass(frozen=True)
class SgdFit:
    """What the optimiser found.

    Attributes:
        value, scale: (n_cells, 5) float32 location and Laplace scale (the learnt one); a hash grid is read at the mean
            point of each cell. Cells nobody saw: their object's mean, and a scale as of the least sure tenth.
        corrections: (S, K, 16) float32, packed: albedo 3 x 4 (row = output), roughness 2, metallic 2 (gain, bias).
        alpha: (S, K, 3) float32 selection weights; 0 where the segment has no usable pixel.
        log_alpha, temperature: (S, K, 3) float32 log softmax and the temperature of the last step, for the label loss.
        error: (S, K, 3) float32 mean L1 error of each corrected prediction against the texture, at the end.
        observations, views: (n_cells,) int32 pixels and views that saw the cell.
        dropped: predictions that were not used.
        history: step; data, label, regulariser (without weights), label_part (with its weight), total: means over the
            steps since the last entry; label is 0 once the selection is kept, and for K = 1; temperature,
            learning_rate, entropy (nats), gain (mean of trace A / 3, METHOD H14).
        at_pixels: view -> (location, scale) of the texture at its pixels, (N, 5) float32 each; without meaning where a
            pixel is not used.
    """

    value: NDArray
    scale: NDArray
    corrections: NDArray
    alpha: NDArray
    log_alpha: NDArray
    temperature: float
    error: NDArray
    observations: NDArray
    views: NDArray
    dropped: list[Dropped]
    history: list[dict[str, float]]
    at_pixels: Callable[[int], tuple[NDArray, NDArray]] = field(repr=False)

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
    def affine(self) -> NDArray:
        """(S, K, 6, 5): [albedo, roughness, metallic, 1] @ affine = corrected values."""
        out = np.zeros((*self.corrections.shape[:2], 6, 5), np.float32)
        out[..., [0, 1, 2, 5], :3] = self.affine_albedo.swapaxes(-1, -2)
        out[..., [3, 5], 3] = self.affine_roughness
        out[..., [4, 5], 4] = self.affine_metallic
        return out

    @property
    def weight(self) -> NDArray:
        """Selection weights by the name that BaseResult gives them."""
        return self.alpha


def converged(history: list[dict[str, float]], tolerance: float = 0.01) -> bool:
    """Whether the loss is flat: over the last fifth of the history it changes by less than `tolerance`, relatively.

    Compares the means of the first and the last third of that fifth, of data + 100 regulariser: the label loss goes with
    1 / temperature and never settles while that falls. Fewer than 15 entries do not tell: False.
    """
    if len(history) < 15:
        return False
    last = np.array([h["total"] - h["label_part"] for h in history[-max(3, len(history) // 5) :]])
    third = len(last) // 3
    before, after = last[:third].mean(), last[-third:].mean()
    return bool(abs(after - before) <= tolerance * max(abs(before), 1e-12))


def solve_base_sgd(
    problem: BaseProblem,
    options: SgdOptions | None = None,
    progress: Callable[[int, int], None] | None = None,
    threads: int = 2,
    device: str = "cpu",
    weight: NDArray | None = None,
    backend: str | None = None,
) -> SgdFit:
    """Texture, corrections and selection of a problem by the paper's optimiser.

    `progress(done, total)` counts steps. `weight` (S, K, 3): selection weights to keep instead of learning them, for
    comparing solvers at the same selection. `backend`: "numba" (CPU), "torch", or None: numba on the CPU, else torch.

    Raises:
        InputError: shapes that do not match, ids out of range, a segment in two views, no usable pixel, too much memory,
            a hash grid without surface points, a loss that is not finite.
    """
    options = options or SgdOptions()
    on_cpu = str(device).startswith("cpu")
    backend = backend or ("numba" if on_cpu else "torch")
    if backend not in ("numba", "torch") or (backend == "numba" and not on_cpu):
        raise InputError(f"base sgd: backend {backend!r} on device {device}; numba runs on the cpu, torch anywhere")
    if threads < 1:
        raise InputError(f"base sgd: {threads} threads; at least 1")
    pool = gather(problem, options)
    n_segments, k = pool.usable.shape
    if weight is not None and np.shape(weight) != (n_segments, k, 3):
        raise InputError(f"base sgd: weight has shape {np.shape(weight)}; needed is {(n_segments, k, 3)}")
    batch = min(options.batch, len(pool))
    per_epoch = max(1, len(pool) // batch)
    steps = options.iterations or options.epochs * per_epoch
    if backend == "numba":
        engine: NumbaEngine | TorchEngine = NumbaEngine(pool, options, problem.n_cells, threads)
    else:
        engine = TorchEngine(pool, options, problem.n_cells, threads, device)
    try:
        return _solve(problem, options, pool, engine, steps, batch, per_epoch, weight, progress)
    finally:
        engine.close()


def _solve(
    problem: BaseProblem,
    options: SgdOptions,
    pool: Pool,
    engine: NumbaEngine | TorchEngine,
    steps: int,
    batch: int,
    per_epoch: int,
    weight: NDArray | None,
    progress: Callable[[int, int], None] | None,
) -> SgdFit:
    rng = np.random.default_rng(options.seed)
    stream = batches(len(pool), batch, rng)
    single = pool.usable.shape[1] == 1
    if weight is not None or single:
        engine.fix(weight if weight is not None else pool.usable[..., None] * np.ones(3))
    choose = options.choice == "argmin" and weight is None and not single
    choose_at = round(options.choose_at * steps)
    history: list[dict[str, float]] = []
    every = max(1, steps // options.records)
    sums, since = np.zeros(len(TERMS)), 0
    for step in range(steps):
        temperature = temperature_at(options, step, steps)
        if choose and step == choose_at:
            engine.fix(_chosen(engine.errors(temperature), pool))
        lr = learning_rate_at(options, step, steps, per_epoch)
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
    total = engine.errors(temperature)
    if choose and choose_at >= steps:
        engine.fix(_chosen(total, pool))
    return _fit(problem, options, pool, engine, total, temperature, history)


def _chosen(error: NDArray, pool: Pool) -> NDArray:
    """(S, K, 3) weights of the least error; equal ones share, so that the order of the predictions does not matter."""
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
    problem: BaseProblem,
    options: SgdOptions,
    pool: Pool,
    engine: NumbaEngine | TorchEngine,
    total: NDArray,
    temperature: float,
    history: list[dict[str, float]],
) -> SgdFit:
    n_cells, seen = problem.n_cells, pool.observations > 0
    if pool.coordinates is None:
        raw = engine.cells()
    else:
        centre = np.stack([np.bincount(pool.cell, pool.coordinates[:, a], n_cells) for a in range(3)], 1)
        centre /= np.maximum(pool.observations, 1)[:, None]
        raw = engine.at(centre.astype(np.float32))
    value, scale = activated(raw, options)
    object_value, _ = object_means(value, problem.object_of_cell, pool.observations)
    value[~seen] = object_value[problem.object_of_cell[~seen]]
    scale[~seen] = np.quantile(scale[seen], 0.9, axis=0)
    alpha, log_alpha = engine.weights(temperature)
    count = np.bincount(pool.segment, minlength=problem.n_segments)[:, None, None]

    def at_pixels(view: int) -> tuple[NDArray, NDArray]:
        if pool.coordinates is None:
            cell = np.maximum(np.ravel(problem.cell_of_pixel[view]), 0)
            return value[cell], scale[cell]
        point = of_view(problem.point, view).reshape(-1, 3)
        point = np.where(np.isfinite(point), point, np.float32(pool.box[0]))
        return activated(engine.at(unit_coordinates(point, pool.box)), options)

    return SgdFit(
        value=value,
        scale=scale,
        corrections=engine.state().copy(),
        alpha=np.where(count > 0, alpha, 0).astype(np.float32),
        log_alpha=log_alpha,
        temperature=temperature,
        error=(total / np.maximum(count, 1)).astype(np.float32),
        observations=pool.observations,
        views=pool.views,
        dropped=pool.dropped,
        history=history,
        at_pixels=at_pixels,
    )
