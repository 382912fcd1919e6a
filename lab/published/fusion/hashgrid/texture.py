"""The hash-grid texture on the CPU: compiled kernels over one level or one run of sample blocks at a time."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from iif_core.errors import InputError
from lab.published.adam import AdamFactors, adam_factors
from lab.published.fusion.hashgrid.levels import HashGridOptions, initial, layout, packed, widths_of

if TYPE_CHECKING:
    from lab.published.fusion.hashgrid.kernels import Transposed

_MAX_ENTRIES_PER_SAMPLE = 32  # a table of fewer entries per sample is first read in order, which brings it into cache
_BLOCKS = 8  # per task of the network; fixed, because it decides the order of sums


class _Buffers:
    """Arrays of earlier passes for reuse, because fresh memory costs a page fault per 4 kB."""

    def __init__(self) -> None:
        self.free: deque[NDArray] = deque(maxlen=6)

    def take(self, *shape: int) -> NDArray:
        size = math.prod(shape)
        for _ in range(len(self.free)):
            array = self.free.popleft()
            if array.size == size:
                return array.reshape(shape)
            self.free.append(array)
        return np.empty(shape, np.float32)

    def give(self, *arrays: NDArray) -> None:
        self.free.extend(array.reshape(-1) for array in arrays)


class Pass(NamedTuple):
    """Arrays that a forward pass keeps for its backward pass."""

    coordinates: NDArray
    order: NDArray
    encoded: NDArray
    hidden: NDArray


class _Network:
    """Weights (or their gradients or moments) as views of one flat float32 array, widths filled up to TILE."""

    def __init__(self, widths: list[int], flat: NDArray | None = None) -> None:
        from lab.published.fusion.hashgrid.kernels import TILE, Weights

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
        """Return views without the filling, by the names of `levels.initial`."""
        w_in, w_mid, w_out, biases, b_out = self.arrays
        weights, offsets = [w_in, *w_mid, w_out], [*biases, b_out]
        out = {}
        for i, (inputs, outputs) in enumerate(zip(self.widths, self.widths[1:], strict=False)):
            out[f"weight_{i}"] = weights[i][:outputs, :inputs]
            out[f"bias_{i}"] = offsets[i][:outputs]
        return out

    def transposed(self) -> Transposed:
        from lab.published.fusion.hashgrid.kernels import Transposed

        return Transposed(*(np.ascontiguousarray(array.swapaxes(-1, -2)) for array in self.arrays[:3]))


class _TableUpdate(NamedTuple):
    """One Adam update of the table from derivatives that are not yet scattered, applied once to every level in any order."""

    factors: AdamFactors
    coordinates: NDArray
    slopes: NDArray

    def apply(self, texture: HashGridTexture, number: int) -> None:
        rows = texture.rows(number)
        # zeros that stay in cache from level to level, and that `adam` zeroes again
        largest = max(level.entries for level in texture.levels)
        scratch = texture.scratch.pop() if texture.scratch else np.zeros_like(texture.table[:largest])
        gradient = scratch[: texture.levels[number].entries]
        texture._scatter(number, self.coordinates, self.slopes, gradient)
        arrays = (texture.table[rows], texture.first[rows], texture.second[rows], gradient)
        texture.kernels.adam(*(array.reshape(-1) for array in arrays), texture.live[number], self.factors)
        texture.scratch.append(scratch)


class HashGridTexture:
    """Texture f(u): (N, 3) float32 in [0, 1]^3 -> (N, outputs) float32, trained by its own Adam.

    Every level is visited once per iteration: scatter, update, and encode for the next batch, so that it is read from memory
    once. `backward` only stores (coordinates, derivatives), `step` queues the update of the table, and the next forward pass
    applies it. The same input and seed give the same bytes for any number of threads.

    Args:
        options: shape; None = the paper's. seed: of the initial parameters; threads: at least 1.
    """

    def __init__(self, options: HashGridOptions | None = None, seed: int = 0, threads: int = 2) -> None:
        from lab.published.fusion.hashgrid import kernels

        self.kernels = kernels
        self.options = options or HashGridOptions()
        self.levels = layout(self.options)
        self.pool = ThreadPoolExecutor(threads) if threads > 1 else None
        widths = widths_of(self.options, self.levels)
        network = [_Network(widths) for _ in range(4)]
        self.network, self.network_first, self.network_second, self.network_gradient = network
        self.buffers, self.scratch, self.steps = _Buffers(), [], 0
        start = initial(self.options, self.levels, seed)
        self.table = packed(self.levels, start["table"])
        self.first, self.second = np.zeros_like(self.table), np.zeros_like(self.table)
        for name, array in self.network.named().items():
            array[...] = start[name]
        self.live = [np.zeros(-(-2 * level.entries // kernels.SPAN), bool) for level in self.levels]
        self.queued: _TableUpdate | None = None
        self.pending: tuple[NDArray, NDArray] | None = None

    def run(self, task: Callable[..., None], arguments: Iterable) -> None:
        if self.pool is None:
            for argument in arguments:
                task(argument)
        else:
            list(self.pool.map(task, arguments))

    def forward(self, u: NDArray) -> tuple[NDArray, Pass]:
        """Return the raw outputs (N, outputs) float32 at u (N, 3), which is clamped to [0, 1 - 1e-6], and what `backward` needs.

        Raises:
            InputError: coordinates that are not finite.
        """
        blocks = -(-len(u) // self.kernels.BLOCK)
        coordinates = np.empty((3, len(u)), np.float32)
        order, finite = self.kernels.sort_points(np.ascontiguousarray(u), coordinates)
        if not finite:
            raise InputError("hash grid: some coordinates are not finite (NaN or infinite); drop those samples before")
        net = self.network
        encoded = self.buffers.take(blocks, net.inputs, self.kernels.BLOCK)
        hidden = self.buffers.take(blocks, net.layers, net.hidden, self.kernels.BLOCK)
        encoded[:, 2 * len(self.levels) :] = 0
        output = np.empty((len(u), self.options.outputs), np.float32)

        update, self.queued = self.queued, None

        def encode(number: int) -> None:
            level, table = self.levels[number], self.table[self.rows(number)]
            if update is not None:
                update.apply(self, number)
            elif level.entries < _MAX_ENTRIES_PER_SAMPLE * len(u):
                self.kernels.fetch(table)
            self.kernels.encode_level(coordinates, level.resolution, level.hashed, table, encoded, 2 * number)

        def network(low: int) -> None:
            high = min(low + _BLOCKS, blocks)
            self.kernels.network_forward(low, high, order, encoded, net.arrays, hidden, output)

        self.run(encode, reversed(range(len(self.levels))))
        self.run(network, range(0, blocks, _BLOCKS))
        if update is not None:
            self.buffers.give(update.slopes)
        return output, Pass(coordinates, order, encoded, hidden)

    def evaluate(self, u: NDArray, chunk: int = 1 << 17) -> NDArray:
        """Return the raw outputs (N, outputs) float32, computed for `chunk` samples at a time to limit memory."""
        out = np.empty((len(u), self.options.outputs), np.float32)
        for low in range(0, len(u), chunk):
            out[low : low + chunk], kept = self.forward(u[low : low + chunk])
            self.buffers.give(kept.encoded, kept.hidden)
        return out

    def backward(self, kept: Pass, slope: NDArray) -> None:
        """Take in the derivatives (N, outputs) float32 of the loss with respect to the outputs; once before each `step`."""
        blocks = len(kept.encoded)
        transposed = self.network.transposed()
        slopes = self.buffers.take(*kept.encoded.shape)
        tasks = range(0, blocks, _BLOCKS)
        partial = np.zeros((len(tasks), self.network.flat.size), np.float32)

        def network(low: int) -> None:
            high = min(low + _BLOCKS, blocks)
            gradient = _Network(self.network.widths, partial[low // _BLOCKS]).arrays
            self.kernels.network_backward(low, high, kept.order, kept.encoded, kept.hidden, slope, transposed, gradient, slopes)

        self.run(network, tasks)
        self.network_gradient.flat += partial.sum(axis=0)
        self.pending = (kept.coordinates, slopes)
        self.buffers.give(kept.encoded, kept.hidden)

    def rows(self, number: int) -> slice:
        level = self.levels[number]
        return slice(level.start, level.start + level.entries)

    def _scatter(self, number: int, coordinates: NDArray, slopes: NDArray, gradient: NDArray) -> None:
        level = self.levels[number]
        self.kernels.scatter_level(coordinates, level.resolution, level.hashed, slopes, 2 * number, gradient)

    def step(self, lr: float) -> None:
        """Update the network by Adam (Eq. F.55) with the gradient of `backward`, and queue the update of the table."""
        self.steps += 1
        factors = adam_factors(lr, self.steps)
        self.queued, self.pending = _TableUpdate(factors, *self.pending), None
        network = (self.network, self.network_first, self.network_second, self.network_gradient)
        live = np.ones(-(-self.network.flat.size // self.kernels.SPAN), bool)
        self.kernels.adam(*(net.flat for net in network), live, factors)

    def flush(self) -> None:
        """Apply the update of the table that is queued, which the next forward pass would have applied to the same end."""
        update, self.queued = self.queued, None
        if update is not None:
            self.run(lambda number: update.apply(self, number), reversed(range(len(self.levels))))
            self.buffers.give(update.slopes)

    def state(self) -> dict[str, NDArray]:
        """Apply what is queued (`flush`), and return everything that the next steps depend on, as it is in memory, by name."""
        self.flush()
        networks = zip(("network", "network_first", "network_second"), self._networks, strict=True)
        return {
            **{name: getattr(self, name) for name in ("table", "first", "second")},
            **{name: network.flat for name, network in networks},
            "live": np.concatenate(self.live),
            "steps": np.array(self.steps),
        }

    def restore(self, state: Mapping[str, NDArray]) -> None:
        """Go on from `state` of a texture of the same options."""
        for name in ("table", "first", "second"):
            getattr(self, name)[...] = state[name]
        for name, network in zip(("network", "network_first", "network_second"), self._networks, strict=True):
            network.flat[...] = state[name]
        for live, part in zip(self.live, np.split(state["live"], np.cumsum([len(x) for x in self.live])[:-1]), strict=True):
            live[...] = part
        self.steps, self.queued, self.pending = int(state["steps"]), None, None

    @property
    def _networks(self) -> tuple[_Network, _Network, _Network]:
        return self.network, self.network_first, self.network_second
