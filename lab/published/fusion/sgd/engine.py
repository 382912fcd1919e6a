"""The optimiser's step, with loss and gradient as closed forms in one compiled pass (kernels.py)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lab.published.adam import adam_factors
from lab.published.fusion.hashgrid.texture import HashGridTexture
from lab.published.fusion.sgd.options import SgdOptions
from lab.published.fusion.sgd.pool import IDENTITY, Pool, Step, runs, softmax, start_values

if TYPE_CHECKING:
    from lab.published.fusion.sgd.kernels import LossSettings

_CHUNK_PIXELS = 4096  # of a task; results do not depend on it


class Adam:
    """Dense Adam of a float32 array with the constants of Kingma and Ba, by the kernel of the hash grid (Eq. F.55)."""

    def __init__(self, parameter: NDArray):
        from lab.published.fusion.hashgrid.kernels import SPAN

        self.parameter = parameter.reshape(-1)
        self.gradient, self.first, self.second = (np.zeros_like(self.parameter) for _ in range(3))
        self.span = SPAN
        self.live = np.zeros(-(-self.parameter.size // SPAN), bool)
        self.steps = 0

    def step(self, lr: float, run: Callable = lambda task, arguments: [task(a) for a in arguments]) -> None:
        """Update the array once and zero the gradient; `run` may spread pieces over threads."""
        from lab.published.fusion.hashgrid.kernels import adam

        self.steps += 1
        factors = adam_factors(lr, self.steps)
        piece = 4096

        def update(low: int) -> None:
            rows, spans = slice(low * self.span, (low + piece) * self.span), slice(low, low + piece)
            adam(self.parameter[rows], self.first[rows], self.second[rows], self.gradient[rows], self.live[spans], factors)

        run(update, range(0, len(self.live), piece))

    def state(self, name: str) -> dict[str, NDArray]:
        """Return everything that the next steps depend on, as it is in memory; keys begin with `name`."""
        arrays = {part: getattr(self, part) for part in _OF_ADAM}
        return {f"{name}.{part}": array for part, array in (*arrays.items(), ("steps", np.array(self.steps)))}

    def restore(self, name: str, state: Mapping[str, NDArray]) -> None:
        """Go on from a `state`."""
        for part in _OF_ADAM:
            getattr(self, part)[...] = state[f"{name}.{part}"]
        self.steps = int(state[f"{name}.steps"])


_OF_ADAM = ("parameter", "first", "second", "live")


class Engine:
    """Parameters, optimisers and closed-form gradients; the selection is fixed from a call of `fix` on."""

    def __init__(self, pool: Pool, options: SgdOptions, n_cells: int, threads: int):
        from lab.published.fusion.sgd import kernels

        self.kernels, self.pool, self.options = kernels, pool, options
        self.threads = ThreadPoolExecutor(threads) if threads > 1 else None
        s, k = pool.usable.shape
        self.affine = np.tile(IDENTITY, (s, k, 1))
        self.z = np.zeros((s, k, 3), np.float32)
        self.fixed: NDArray | None = None
        self.networks = kernels.selection_networks(k)
        self.adam_affine, self.adam_z = Adam(self.affine), Adam(self.z)
        self.d_alpha, self.votes = np.zeros((s, k, 3), np.float32), np.zeros((s, k, 3), np.float32)
        self.grid = HashGridTexture(options.grid, options.seed, threads) if options.texture == "hashgrid" else None
        if self.grid is None:
            self.table = start_values(pool, n_cells, options)
            self.adam_table = Adam(self.table)

    def close(self) -> None:
        if self.threads is not None:
            self.threads.shutdown()

    def run(self, task: Callable[[Any], None], arguments: Iterable) -> None:
        if self.threads is None:
            for argument in arguments:
                task(argument)
        else:
            list(self.threads.map(task, arguments))

    def weights(self, temperature: float) -> tuple[NDArray, NDArray]:
        """Return alpha and log alpha (S, K, 3) float32."""
        if self.fixed is not None:
            return self.fixed, np.log(self.fixed, out=np.zeros_like(self.fixed), where=self.fixed > 0)
        return softmax(self.z, temperature, self.pool.usable)

    def losses(self, step: Step, raw: NDArray, share: NDArray, error: NDArray) -> tuple[NDArray, NDArray]:
        """Add gradients to the optimisers' arrays, `d_alpha` and `votes`; return d_raw (N, 10) and the sums (SUMS,).

        Args:
            step: pixels and temperature; raw: (N, 10) float32 raw outputs at the pixels.
            share: (N,) float32 weights of the pixels; error: (S, K, 3) float64, is added to.

        Returns:
            (N, 10) float32 derivatives with respect to the raw outputs, and (SUMS,) float64 sums of the loss.
        """
        pool, options = self.pool, self.options
        start, segment = runs(pool.segment[step.pixels])
        alpha, log_alpha = self.weights(step.temperature)
        self.d_alpha[segment], self.votes[segment] = 0, 0
        d_raw = np.empty_like(raw)
        sums = np.zeros((len(segment), self.kernels.SUMS))
        gradient = self.adam_affine.gradient.reshape(self.affine.shape)
        batch = self.kernels.Batch(start, segment, pool.values, step.pixels, share, raw)
        tables = self.kernels.SegmentTables(self.affine, alpha, log_alpha, pool.usable, *self.networks)
        settings = loss_settings(options, step.temperature, np.float32)
        out = self.kernels.Gradients(d_raw, gradient, self.d_alpha, self.votes, error, sums)
        edges = np.unique(
            np.searchsorted(start, np.arange(0, len(step.pixels) + _CHUNK_PIXELS, _CHUNK_PIXELS)).clip(0, len(segment))
        )

        def work(piece: tuple[int, int]) -> None:
            self.kernels.batch_loss(*piece, batch, tables, settings, out)

        self.run(work, list(zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)))
        if self.fixed is None and pool.usable.shape[1] > 1:
            parts = alpha[segment], self.d_alpha[segment], self.votes[segment]
            slope = logit_slope(*parts, options.label_weight, step.temperature)
            self.adam_z.gradient.reshape(self.z.shape)[segment] = slope
        else:
            sums[:, 1] = 0  # a fixed selection has no label loss
        return d_raw, sums.sum(0)

    def step(self, step: Step) -> NDArray:
        """Update texture, maps and logits once; return the sums (SUMS,)."""
        share = np.full(len(step.pixels), 1 / len(step.pixels), np.float32)
        error = np.zeros((*self.pool.usable.shape, 3))
        rows = self.pool.cell[step.pixels]
        raw, kept = (self.table[rows], None) if self.grid is None else self.grid.forward(step.coordinates)
        d_raw, sums = self.losses(step, raw, share, error)
        if np.isfinite(sums).all():
            if self.grid is None:
                self.kernels.add_rows(self.adam_table.gradient.reshape(self.table.shape), rows, d_raw)
                self.adam_table.step(step.learning_rate, self.run)
            else:
                self.grid.backward(kept, d_raw)
                self.grid.step(step.learning_rate)
            self.adam_affine.step(step.learning_rate, self.run)
            if self.fixed is None:
                self.adam_z.step(step.learning_rate)
        return sums

    def errors(self, temperature: float) -> NDArray:
        """Return the L1 error of every corrected prediction against the texture, summed over all pixels, (S, K, 3)."""
        total = np.zeros((*self.pool.usable.shape, 3))
        for low in range(0, len(self.pool), self.options.batch):
            pixels = np.arange(low, min(low + self.options.batch, len(self.pool)), dtype=np.int32)
            raw = self.raw(pixels)
            self.losses(Step(pixels, None, temperature, 0.0), raw, np.ones(len(pixels), np.float32), total)
        self.adam_affine.gradient[:] = 0
        self.adam_z.gradient[:] = 0
        return total

    def raw(self, pixels: NDArray) -> NDArray:
        """Return the raw outputs at pixels of the pool, without jitter."""
        if self.grid is None:
            return self.table[self.pool.cell[pixels]]
        return self.grid.evaluate(self.pool.coordinates[pixels])

    def state(self) -> dict[str, NDArray]:
        """Return everything that the next steps depend on, as it is in memory, by name."""
        texture = self.adam_table.state("table") if self.grid is None else self.grid.state()
        fixed = {} if self.fixed is None else {"fixed": self.fixed}
        return self.adam_affine.state("affine") | self.adam_z.state("z") | fixed | texture

    def restore(self, state: Mapping[str, NDArray]) -> None:
        """Go on from a `state` of the same problem and options."""
        self.adam_affine.restore("affine", state)
        self.adam_z.restore("z", state)
        self.fixed = np.array(state["fixed"]) if "fixed" in state else None
        if self.grid is None:
            self.adam_table.restore("table", state)
        else:
            self.grid.restore(state)

    def fix(self, alpha: NDArray) -> None:
        self.fixed = np.ascontiguousarray(alpha, np.float32)


def loss_settings(options: SgdOptions, temperature: float, real: type[np.floating]) -> LossSettings:
    """Return the numbers and choices of the loss for the compiled kernel, the numbers of type `real`."""
    from lab.published.fusion.sgd.kernels import LossSettings

    numbers = (real(x) for x in (temperature, options.scale_floor, options.data_weight, options.regulariser))
    smooth, inward = options.scale_floor_kind == "smooth", options.clamp_gradient == "inward"
    return LossSettings(*numbers, smooth, options.median_gradient, inward)


def logit_slope(alpha: NDArray, d_alpha: NDArray, votes: NDArray, label_weight: float, divisor: float) -> NDArray:
    """Return the derivative of the loss with respect to the logits of alpha = softmax_k(z / divisor) (Eq. F.54).

    Args:
        alpha: (S, K, 3) selection weights; d_alpha: (S, K, 3) derivative of the data term with respect to them.
        votes: (S, K, 3) summed votes of the label loss; label_weight: its weight; divisor: of the logits.

    Returns:
        (S, K, 3).
    """
    slope = alpha * (d_alpha - (alpha * d_alpha).sum(1, keepdims=True))
    slope += (alpha * votes.sum(1, keepdims=True) - votes) * alpha.dtype.type(label_weight / 3)
    return slope / alpha.dtype.type(divisor)
