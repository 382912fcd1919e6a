"""The engine for CPUs: compiled kernels over one level or one run of sample blocks at a time."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from iif_core.errors import InputError
from iif_core.fusion.hashgrid.levels import HashGridOptions, Level, not_finite, packed, unpacked, widths_of
from iif_core.numerics.adam import AdamFactors, adam_factors

if TYPE_CHECKING:
    import torch

    from iif_core.fusion.hashgrid.kernels import Transposed

MAX_PENDING_SAMPLES = 1 << 20  # samples whose table gradient may wait for `step`
MAX_ENTRIES_PER_SAMPLE = 32  # a table of fewer entries per sample is first read in order, which brings it into cache


class _Buffers:
    """Arrays of earlier passes for reuse, because fresh memory costs a page fault per 4 kB.

    Uses only atomic operations of the deque, because the garbage collector may give arrays back at any moment.
    """

    def __init__(self, kept: int = 6) -> None:
        self.free: deque[NDArray] = deque(maxlen=kept)

    def take(self, *shape: int) -> NDArray:
        size = math.prod(shape)
        for _ in range(len(self.free)):
            try:
                array = self.free.popleft()
            except IndexError:
                break
            if array.size == size:
                return array.reshape(shape)
            self.free.append(array)
        return np.empty(shape, np.float32)

    def give(self, *arrays: NDArray) -> None:
        self.free.extend(array.reshape(-1) for array in arrays)


class _Pass:
    """Arrays that a forward pass keeps for its backward pass; the large ones are given back when the graph is deleted."""

    def __init__(
        self, buffers: _Buffers, coordinates: NDArray, order: NDArray, encoded: NDArray, hidden: NDArray, version: int
    ) -> None:
        self.buffers, self.coordinates, self.order = buffers, coordinates, order
        self.encoded, self.hidden, self.version = encoded, hidden, version

    def __del__(self) -> None:
        self.buffers.give(self.encoded, self.hidden)


class _Network:
    """Weights (or their gradients or moments) as views of one flat float32 array, widths filled up to TILE."""

    def __init__(self, widths: list[int], flat: NDArray | None = None) -> None:
        from iif_core.fusion.hashgrid.kernels import TILE, Weights

        self.widths = widths
        inputs, hidden, outputs = (-(-width // TILE) * TILE for width in (widths[0], widths[1], widths[-1]))
        layers = len(widths) - 2
        shapes = [(hidden, inputs), (layers - 1, hidden, hidden), (outputs, hidden), (layers, hidden), (outputs,)]
        ends = np.cumsum([math.prod(shape) for shape in shapes])
        self.flat = np.zeros(ends[-1], np.float32) if flat is None else flat
        pieces = np.split(self.flat, ends[:-1])
        self.arrays = Weights(*(piece.reshape(shape) for piece, shape in zip(pieces, shapes, strict=True)))
        self.inputs, self.hidden, self.layers = inputs, hidden, layers

    def named(self) -> dict[str, NDArray]:
        """Return views without the filling, by the names of `HashGridTexture.state`."""
        w_in, w_mid, w_out, biases, b_out = self.arrays
        weights, offsets = [w_in, *w_mid, w_out], [*biases, b_out]
        out = {}
        for i, (inputs, outputs) in enumerate(zip(self.widths, self.widths[1:], strict=False)):
            out[f"weight_{i}"] = weights[i][:outputs, :inputs]
            out[f"bias_{i}"] = offsets[i][:outputs]
        return out

    def transposed(self) -> Transposed:
        from iif_core.fusion.hashgrid.kernels import Transposed

        return Transposed(*(np.ascontiguousarray(array.swapaxes(-1, -2)) for array in self.arrays[:3]))


@dataclass
class _TableUpdate:
    """One Adam update of the table from derivatives that are not yet scattered, applied once to every level in any order."""

    factors: AdamFactors
    pending: list[tuple[NDArray, NDArray]]
    gradient: NDArray | None

    def apply(self, engine: NumbaEngine, number: int) -> None:
        rows, scratch = engine.rows(number), None
        if self.gradient is not None:
            gradient = self.gradient[rows]
        else:  # zeros that stay in cache from level to level, and that `adam` zeroes again
            scratch = engine.scratch.pop() if engine.scratch else np.zeros_like(engine.table[: max(engine.entries)])
            gradient = scratch[: engine.entries[number]]
        engine.scatter(number, self.pending, gradient)
        arrays = (engine.table[rows], engine.first[rows], engine.second[rows], gradient)
        engine.kernels.adam(*(array.reshape(-1) for array in arrays), engine.live[number], self.factors)
        if scratch is not None:
            engine.scratch.append(scratch)

    def release(self, engine: NumbaEngine) -> None:
        engine.buffers.give(*(slopes for _, slopes in self.pending))


class NumbaEngine:
    """Engine that visits every level once per iteration: scatter, update, and encode for the next batch.

    A level is then read from memory once. `backward` only stores (coordinates, derivatives), `step` queues the update of the
    table, and the next forward pass, or the next request for the state, applies it.
    """

    BLOCKS = 8  # per task of the network; fixed, because it decides the order of sums

    def __init__(self, options: HashGridOptions, levels: tuple[Level, ...], start: dict[str, NDArray], threads: int):
        import torch

        from iif_core.fusion.hashgrid import kernels

        self.kernels = kernels
        self.device = torch.device("cpu")
        self.options, self.levels, self.threads = options, levels, threads
        self.pool = ThreadPoolExecutor(threads) if threads > 1 else None
        self.token = torch.zeros((), requires_grad=True)  # makes autograd call `backward`
        widths = widths_of(options, levels)
        network = [_Network(widths) for _ in range(4)]
        self.network, self.network_first, self.network_second, self.network_gradient = network
        self.buffers = _Buffers()
        self.version = 0  # of the parameters
        self.scratch: list[NDArray] = []
        self.load_state({**start, "steps": 0})

    def run(self, task: Callable[..., None], arguments: Iterable) -> None:
        if self.pool is None:
            for argument in arguments:
                task(argument)
        else:
            list(self.pool.map(task, arguments))

    def apply(self, u: torch.Tensor) -> torch.Tensor:
        import torch

        if torch.is_grad_enabled():
            return _numba_function().apply(self.token, u, self)
        return torch.from_numpy(self.forward(u.numpy())[0])

    def forward(self, u: NDArray) -> tuple[NDArray, _Pass]:
        blocks = -(-len(u) // self.kernels.BLOCK)
        coordinates = np.empty((3, len(u)), np.float32)
        order, finite = self.kernels.sort_points(np.ascontiguousarray(u), coordinates)
        if not finite:
            raise not_finite()
        net = self.network
        encoded = self.buffers.take(blocks, net.inputs, self.kernels.BLOCK)
        hidden = self.buffers.take(blocks, net.layers, net.hidden, self.kernels.BLOCK)
        encoded[:, 2 * len(self.levels) :] = 0
        kept = _Pass(self.buffers, coordinates, order, encoded, hidden, self.version)
        output = np.empty((len(u), self.options.outputs), np.float32)

        update, self.queued = self.queued, None

        def encode(number: int) -> None:
            level, table = self.levels[number], self.table[self.rows(number)]
            if update is not None:
                update.apply(self, number)
            elif level.entries < MAX_ENTRIES_PER_SAMPLE * len(u):
                self.kernels.fetch(table)
            self.kernels.encode_level(coordinates, level.resolution, level.hashed, table, encoded, 2 * number)

        def network(low: int) -> None:
            high = min(low + self.BLOCKS, blocks)
            self.kernels.network_forward(low, high, order, encoded, net.arrays, hidden, output)

        self.run(encode, reversed(range(len(self.levels))))
        self.run(network, range(0, blocks, self.BLOCKS))
        if update is not None:
            update.release(self)
        return output, kept

    def backward(self, kept: _Pass, slope: NDArray) -> None:
        if kept.version != self.version:
            raise InputError("hash grid: step or load_state came between a forward pass and its backward pass; swap them")
        blocks = len(kept.encoded)
        if not blocks:
            return
        transposed = self.network.transposed()
        slopes = self.buffers.take(*kept.encoded.shape)
        tasks = range(0, blocks, self.BLOCKS)
        partial = np.zeros((len(tasks), self.network.flat.size), np.float32)

        def network(low: int) -> None:
            high = min(low + self.BLOCKS, blocks)
            gradient = _Network(self.network.widths, partial[low // self.BLOCKS]).arrays
            self.kernels.network_backward(low, high, kept.order, kept.encoded, kept.hidden, slope, transposed, gradient, slopes)

        self.run(network, tasks)
        self.network_gradient.flat += partial.sum(axis=0)
        self.pending.append((kept.coordinates, slopes))
        if sum(coordinates.shape[1] for coordinates, _ in self.pending) > MAX_PENDING_SAMPLES:
            self.flush()

    def flush(self) -> None:
        """Scatter all pending derivatives into a gradient of the whole table, which frees their memory."""
        if self.gradient is None:
            self.gradient = np.zeros_like(self.table)
        self.run(lambda number: self.scatter(number, self.pending, self.gradient[self.rows(number)]), range(len(self.levels)))
        self.forget()

    def forget(self) -> None:
        self.buffers.give(*(slopes for _, slopes in self.pending))
        self.pending = []

    def rows(self, number: int) -> slice:
        level = self.levels[number]
        return slice(level.start, level.start + level.entries)

    def scatter(self, number: int, pending: list[tuple[NDArray, NDArray]], gradient: NDArray) -> None:
        level = self.levels[number]
        for coordinates, slopes in pending:
            self.kernels.scatter_level(coordinates, level.resolution, level.hashed, slopes, 2 * number, gradient)

    def step(self, lr: float, beta1: float, beta2: float, eps: float) -> None:
        """Update the network and queue the update of the table; Args: as in `HashGridTexture.step`."""
        self.settle()
        self.steps += 1
        self.version += 1
        factors = adam_factors(lr, self.steps, beta1, beta2, eps)
        self.queued = _TableUpdate(factors, self.pending, self.gradient)
        self.pending, self.gradient = [], None
        network = (self.network, self.network_first, self.network_second, self.network_gradient)
        live = np.ones(-(-self.network.flat.size // self.kernels.SPAN), bool)
        self.kernels.adam(*(net.flat for net in network), live, factors)

    def settle(self) -> None:
        """Apply the queued update of the table now."""
        update, self.queued = self.queued, None
        if update is not None:
            self.run(lambda number: update.apply(self, number), reversed(range(len(self.levels))))
            update.release(self)

    def zero_grad(self) -> None:
        self.forget()
        self.gradient = None
        self.network_gradient.flat[:] = 0

    def gradients(self) -> dict[str, NDArray]:
        self.flush()
        named = {name: array.copy() for name, array in self.network_gradient.named().items()}
        return {"table": unpacked(self.levels, self.gradient), **named}

    def state(self) -> dict[str, NDArray]:
        self.settle()
        out: dict[str, NDArray] = {"steps": np.int64(self.steps)}
        tables = (("", self.table), ("first.", self.first), ("second.", self.second))
        networks = (self.network, self.network_first, self.network_second)
        for (prefix, table), network in zip(tables, networks, strict=True):
            out[prefix + "table"] = unpacked(self.levels, table)
            out |= {prefix + name: array.copy() for name, array in network.named().items()}
        return out

    def load_state(self, state: dict[str, NDArray]) -> None:
        def table(name: str) -> NDArray:
            return packed(self.levels, np.asarray(state[name], np.float32)) if name in state else np.zeros_like(self.table)

        self.steps = int(state["steps"])
        self.version += 1
        self.entries = [level.entries for level in self.levels]
        self.table = table("table")
        self.first, self.second = table("first.table"), table("second.table")
        networks = (("", self.network), ("first.", self.network_first), ("second.", self.network_second))
        for prefix, network in networks:
            for name, array in network.named().items():
                array[...] = state.get(prefix + name, 0)
        self.live = []
        for number in range(len(self.levels)):
            rows = self.rows(number)
            moved = ((self.first[rows] != 0) | (self.second[rows] != 0)).reshape(-1)
            starts = np.arange(0, moved.size, self.kernels.SPAN)
            self.live.append(np.logical_or.reduceat(moved, starts))
        self.queued: _TableUpdate | None = None
        self.gradient: NDArray | None = None
        self.pending: list[tuple[NDArray, NDArray]] = []
        self.network_gradient.flat[:] = 0


@cache
def _numba_function():
    import torch

    class Texture(torch.autograd.Function):
        @staticmethod
        def forward(ctx, token, u, engine):
            output, ctx.kept = engine.forward(u.numpy())
            ctx.engine = engine
            return torch.from_numpy(output)

        @staticmethod
        @torch.autograd.function.once_differentiable
        def backward(ctx, slope):
            ctx.engine.backward(ctx.kept, slope.to(torch.float32).contiguous().numpy())
            return None, None, None

    return Texture
