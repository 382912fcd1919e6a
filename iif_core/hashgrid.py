"""Multi-resolution hash-grid texture: 32 levels of trilinear features and a small network (METHOD 2.3.5, H6-H8).

u in [0, 1]^3 -> features of every level -> ReLU network -> raw outputs; what they mean (sigmoids, ranges) is the
solver's matter, in float32 (H6). Two backends give the same numbers up to rounding:

* "numba", CPU: a level belongs to one thread, a batch is visited in Morton order, gradients of the table live only
  from scatter to update of one level, in cache;
* "torch", any device.

Importing this module loads neither torch nor numba.
"""

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

from .errors import InputError

if TYPE_CHECKING:
    import torch

UPPER = 1 - 1e-6  # coordinates are clamped to [0, UPPER] (H7)
ROWS = 8  # levels start at multiples of this many entries: a cache line of 64 bytes at two features
FINEST = 1 << 22  # cells beyond this are not resolved by float32 coordinates
PENDING = 1 << 20  # samples whose table gradient may wait for `step`
FETCHED = 32  # a table of fewer entries than this times the samples is read in order first


@dataclass(frozen=True)
class HashGridOptions:
    """Shape of a hash-grid texture; the defaults are the paper's (METHOD 2.3.5): 27.95 M + 9.0 k parameters.

    levels, features a level (the numba backend knows 2), log2_entries: at most 2^log2_entries entries a level;
    base_resolution, growth: vertices per side, see `layout`; hidden, hidden_layers, outputs: network (ReLU, biases);
    init_scale: the table starts uniform in +-init_scale;
    finest: cap on the vertices per side (H8: about the extent of the scene over the footprint of a pixel). Levels
    beyond the first that reaches it are left out, since they would repeat it. None: no cap.
    """

    levels: int = 32
    features: int = 2
    log2_entries: int = 19
    base_resolution: int = 16
    growth: float = 1.3
    hidden: int = 64
    hidden_layers: int = 2
    outputs: int = 10
    init_scale: float = 1e-4
    finest: int | None = None

    def __post_init__(self) -> None:
        bounds = {
            "levels": (1, 64),
            "features": (1, 16),
            "log2_entries": (3, 24),
            "base_resolution": (2, 4096),
            "growth": (1, 4),
            "hidden": (1, 1024),
            "hidden_layers": (1, 16),
            "outputs": (1, 1024),
            "init_scale": (0, 1),
        }
        if self.finest is not None:
            bounds["finest"] = (2, FINEST)
        for name, (low, high) in bounds.items():
            if not low <= getattr(self, name) <= high:
                raise InputError(f"hash grid: {name} = {getattr(self, name)}; allowed is {low} to {high}")


@dataclass(frozen=True)
class Level:
    """One level: `resolution` vertices per side, entries `start` to `start + entries` of the table; `hashed` where
    resolution^3 exceeds the entries."""

    resolution: int
    start: int
    entries: int
    hashed: bool


def layout(options: HashGridOptions) -> tuple[Level, ...]:
    """Levels of the table: resolution_l = ceil(base growth^l - 1) + 1 up to `finest` (METHOD 2.3.5); the spacing of
    vertices is 1 / (resolution - 1).

    Level l is indexed directly, x + r (y + r z), while r^3 <= 2^log2_entries, then hashed,
    (x ^ 2654435761 y ^ 805459861 z) mod 2^log2_entries. Raises InputError beyond the accuracy of float32 coordinates.
    """
    levels: list[Level] = []
    start = 0
    for number in range(options.levels):
        resolution = math.ceil(options.base_resolution * options.growth**number - 1) + 1
        if options.finest is not None and resolution > options.finest:
            if levels and levels[-1].resolution >= options.finest:
                break
            resolution = options.finest
        if resolution > FINEST:
            raise InputError(
                f"hash grid: level {number} has {resolution} vertices per side; float32 coordinates resolve {FINEST}. "
                "Lower levels or growth, or set finest"
            )
        hashed = resolution**3 > 1 << options.log2_entries
        entries = 1 << options.log2_entries if hashed else resolution**3
        levels.append(Level(resolution, start, entries, hashed))
        start += -(-entries // ROWS) * ROWS
    return tuple(levels)


def parameter_counts(options: HashGridOptions) -> tuple[int, int]:
    """Parameters of the encoding and of the network."""
    levels = layout(options)
    encoding = options.features * sum(level.entries for level in levels)
    widths = _widths(options, levels)
    return encoding, sum(a * b + b for a, b in zip(widths, widths[1:], strict=False))


class HashGridTexture:
    """Texture f(u): (N, 3) float32 in [0, 1]^3 -> (N, outputs) float32, trained by its own Adam.

    The outputs compose with any torch graph; `backward` of that graph adds to gradients kept here (not to `.grad` of
    the coordinates, which are constants), `step` uses and zeroes them. Same input and seed give the same bytes on the
    CPU for any number of threads (CUDA adds table gradients in no fixed order).

    `backend`: "numba" (CPU), "torch" (any device), or None: numba on the CPU if `features` is 2, else torch.
    Network weights start uniform in +-sqrt(6 / (inputs + outputs)) of the layer, biases at 0. Raises InputError.
    """

    def __init__(
        self,
        options: HashGridOptions | None = None,
        seed: int = 0,
        device: str = "cpu",
        threads: int = 2,
        backend: str | None = None,
    ) -> None:
        self.options = options or HashGridOptions()
        self.levels = layout(self.options)
        on_cpu = str(device).startswith("cpu")
        if backend is None:
            backend = "numba" if on_cpu and self.options.features == 2 else "torch"
        if threads < 1:
            raise InputError(f"hash grid: {threads} threads; at least 1")
        start = _initial(self.options, self.levels, seed)
        if backend == "numba":
            if not on_cpu or self.options.features != 2:
                raise InputError(
                    f"hash grid: the numba backend runs on the CPU with 2 features; asked for device {device}, "
                    f"{self.options.features} features. Use backend='torch'"
                )
            self._engine: _NumbaEngine | _TorchEngine = _NumbaEngine(self.options, self.levels, start, threads)
        elif backend == "torch":
            self._engine = _TorchEngine(self.options, self.levels, start, device)
        else:
            raise InputError(f"hash grid: backend {backend!r}; known are 'numba', 'torch'")
        self.backend = backend

    def __call__(self, u: torch.Tensor) -> torch.Tensor:
        """Raw outputs (N, outputs) float32 at u (N, 3), clamped to [0, 1 - 1e-6]; N may be 0.

        Raises InputError for another shape, an integer type, coordinates that ask for a gradient or are not finite.
        """
        return self._engine.apply(self._checked(u))

    def evaluate(self, u: torch.Tensor, chunk: int = 1 << 17) -> torch.Tensor:
        """The same without a graph, `chunk` samples at a time: memory beyond the result does not grow with N."""
        import torch

        if chunk < 1:
            raise InputError(f"hash grid: chunk of {chunk} samples; at least 1")
        u = self._checked(u)
        out = torch.empty((len(u), self.options.outputs), dtype=torch.float32, device=u.device)
        with torch.no_grad():
            for low in range(0, len(u), chunk):
                out[low : low + chunk] = self._engine.apply(u[low : low + chunk])
        return out

    def step(self, lr: float, beta1: float = 0.9, beta2: float = 0.999, eps: float = 1e-8) -> None:
        """One Adam update of table and network with the gradients gathered since the last one, then zeroes them.

        As torch.optim.Adam on dense gradients: entries without a gradient go on by their momentum.
        """
        if not (0 < lr < math.inf and 0 <= beta1 < 1 and 0 <= beta2 < 1 and eps > 0):
            raise InputError(f"hash grid: lr {lr}, beta {beta1}, {beta2}, eps {eps}; need lr, eps > 0 and 0 <= beta < 1")
        self._engine.step(lr, beta1, beta2, eps)

    def gradients(self) -> dict[str, NDArray]:
        """Copies of the gradients gathered since the last step, by the names of `state`; for tests and diagnosis."""
        return self._engine.gradients()

    def zero_grad(self) -> None:
        """Forgets the gradients gathered since the last step."""
        self._engine.zero_grad()

    def state(self) -> dict[str, NDArray]:
        """Copies of parameters and Adam moments, float32, the same for both backends.

        "table" (entries, features), levels one after another; "weight_i" (outputs, inputs), "bias_i"; each also as
        "first.<name>", "second.<name>"; "steps": number of updates so far. Gradients are not part of it.
        """
        return self._engine.state()

    def load_state(self, state: dict[str, NDArray]) -> None:
        """Takes over what `state` gave, of any backend, and forgets gathered gradients. Raises InputError."""
        expected = {name: value.shape for name, value in _named(self.options, self.levels).items()}
        expected = {prefix + name: shape for name, shape in expected.items() for prefix in ("", "first.", "second.")}
        expected["steps"] = ()
        found = {name: np.shape(value) for name, value in state.items()}
        if found != expected:
            wrong = sorted(name for name in {*found, *expected} if found.get(name) != expected.get(name))
            raise InputError(
                f"hash grid: state does not fit the options at {', '.join(wrong)}: "
                f"found {[found.get(name) for name in wrong]}, needed {[expected.get(name) for name in wrong]}"
            )
        self._engine.load_state(state)

    def _checked(self, u: torch.Tensor) -> torch.Tensor:
        import torch

        if not isinstance(u, torch.Tensor) or u.ndim != 2 or u.shape[1] != 3 or not u.is_floating_point():
            found = f"{u.dtype} {tuple(u.shape)}" if isinstance(u, torch.Tensor) else type(u).__name__
            raise InputError(f"hash grid: coordinates are {found}; needed is a floating tensor (N, 3)")
        if u.requires_grad:
            raise InputError("hash grid: coordinates ask for a gradient, which is not computed; pass u.detach()")
        if u.device.type != self._engine.device.type:
            raise InputError(f"hash grid: coordinates are on {u.device}, the texture is on {self._engine.device}")
        return u.to(torch.float32)


def _widths(options: HashGridOptions, levels: tuple[Level, ...]) -> list[int]:
    return [options.features * len(levels), *[options.hidden] * options.hidden_layers, options.outputs]


def _rows(levels: tuple[Level, ...]) -> int:
    return levels[-1].start + -(-levels[-1].entries // ROWS) * ROWS


def _named(options: HashGridOptions, levels: tuple[Level, ...]) -> dict[str, NDArray]:
    """Zeros of the shape of every parameter, by name (views of one zero: they cost no memory)."""
    shapes = {"table": (sum(level.entries for level in levels), options.features)}
    widths = _widths(options, levels)
    for i, (inputs, outputs) in enumerate(zip(widths, widths[1:], strict=False)):
        shapes[f"weight_{i}"] = (outputs, inputs)
        shapes[f"bias_{i}"] = (outputs,)
    return {name: np.broadcast_to(np.float32(0), shape) for name, shape in shapes.items()}


def _initial(options: HashGridOptions, levels: tuple[Level, ...], seed: int) -> dict[str, NDArray]:
    random = np.random.default_rng(seed)
    start = {}
    for name, zeros in _named(options, levels).items():
        if name.startswith("bias"):
            start[name] = np.zeros(zeros.shape, np.float32)
            continue
        bound = options.init_scale if name == "table" else math.sqrt(6 / sum(zeros.shape))
        values = random.random(zeros.shape, dtype=np.float32)
        values *= np.float32(2 * bound)
        values -= np.float32(bound)
        start[name] = values
    return start


def _not_finite() -> InputError:
    return InputError("hash grid: some coordinates are not finite (NaN or infinite); drop those samples before")


def _packed(levels: tuple[Level, ...], table: NDArray) -> NDArray:
    """Table with every level at its start, from levels one after another."""
    out = np.zeros((_rows(levels), table.shape[1]), np.float32)
    low = 0
    for level in levels:
        out[level.start : level.start + level.entries] = table[low : low + level.entries]
        low += level.entries
    return out


def _unpacked(levels: tuple[Level, ...], table: NDArray) -> NDArray:
    return np.concatenate([table[level.start : level.start + level.entries] for level in levels])


# ---- numba ----------------------------------------------------------------------------------------------------------


class _Buffers:
    """Arrays of a pass to be used again: fresh memory costs a page fault per 4 kB.

    Only atomic operations of the deque: the garbage collector may give arrays back at any moment.
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
    """What a forward pass keeps for its backward pass; the large arrays go back when the graph goes."""

    def __init__(
        self, buffers: _Buffers, coordinates: NDArray, order: NDArray, encoded: NDArray, hidden: NDArray, version: int
    ) -> None:
        self.buffers, self.coordinates, self.order = buffers, coordinates, order
        self.encoded, self.hidden, self.version = encoded, hidden, version

    def __del__(self) -> None:
        self.buffers.give(self.encoded, self.hidden)


class _Network:
    """Weights (or their gradients, or moments) as views of one flat float32 array, widths filled up to TILE."""

    def __init__(self, widths: list[int], tile: int, flat: NDArray | None = None) -> None:
        self.widths = widths
        inputs, hidden, outputs = (-(-width // tile) * tile for width in (widths[0], widths[1], widths[-1]))
        layers = len(widths) - 2
        shapes = [(hidden, inputs), (layers - 1, hidden, hidden), (outputs, hidden), (layers, hidden), (outputs,)]
        ends = np.cumsum([math.prod(shape) for shape in shapes])
        self.flat = np.zeros(ends[-1], np.float32) if flat is None else flat
        pieces = np.split(self.flat, ends[:-1])
        self.arrays = tuple(piece.reshape(shape) for piece, shape in zip(pieces, shapes, strict=True))
        self.inputs, self.hidden, self.layers = inputs, hidden, layers

    def named(self) -> dict[str, NDArray]:
        """Views without the filling, by the names of `HashGridTexture.state`."""
        w_in, w_mid, w_out, biases, b_out = self.arrays
        weights, offsets = [w_in, *w_mid, w_out], [*biases, b_out]
        out = {}
        for i, (inputs, outputs) in enumerate(zip(self.widths, self.widths[1:], strict=False)):
            out[f"weight_{i}"] = weights[i][:outputs, :inputs]
            out[f"bias_{i}"] = offsets[i][:outputs]
        return out

    def transposed(self) -> tuple[NDArray, NDArray, NDArray]:
        w_in, w_mid, w_out = self.arrays[:3]
        return np.ascontiguousarray(w_in.T), np.ascontiguousarray(w_mid.transpose(0, 2, 1)), np.ascontiguousarray(w_out.T)


@dataclass
class _TableUpdate:
    """One Adam update of the table, from slopes not yet scattered: per level, in any order, each level once."""

    numbers: tuple[np.float32, ...]
    pending: list[tuple[NDArray, NDArray]]
    gradient: NDArray | None

    def apply(self, engine: _NumbaEngine, number: int) -> None:
        rows, scratch = engine.rows(number), None
        if self.gradient is not None:
            gradient = self.gradient[rows]
        else:  # a few MB of zeros that stay in cache from level to level; adam leaves them zero
            scratch = engine.scratch.pop() if engine.scratch else np.zeros_like(engine.table[: max(engine.entries)])
            gradient = scratch[: engine.entries[number]]
        engine.scatter(number, self.pending, gradient)
        arrays = (engine.table[rows], engine.first[rows], engine.second[rows], gradient)
        engine.kernels.adam(*(array.reshape(-1) for array in arrays), engine.live[number], *self.numbers)
        if scratch is not None:
            engine.scratch.append(scratch)

    def release(self, engine: _NumbaEngine) -> None:
        engine.buffers.give(*(slopes for _, slopes in self.pending))


class _NumbaEngine:
    """Every level is visited once per iteration, while it is in cache: scatter, update, and encode for the next batch.

    So `backward` leaves (coordinates, slopes), `step` queues the update of the table, and the next forward pass (or
    whoever asks for the state) does it.
    """

    BLOCKS = 8  # per task of the network; fixed, because it decides the order of sums

    def __init__(self, options: HashGridOptions, levels: tuple[Level, ...], start: dict[str, NDArray], threads: int):
        import torch

        from . import hashgrid_kernels

        self.kernels = hashgrid_kernels
        self.device = torch.device("cpu")
        self.options, self.levels, self.threads = options, levels, threads
        self.pool = ThreadPoolExecutor(threads) if threads > 1 else None
        self.token = torch.zeros((), requires_grad=True)  # what makes autograd come back here
        widths = _widths(options, levels)
        network = [_Network(widths, hashgrid_kernels.TILE) for _ in range(4)]
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
            raise _not_finite()
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
            elif level.entries < FETCHED * len(u):
                self.kernels.fetch(table)
            self.kernels.encode_level(coordinates, level.resolution, level.hashed, table, encoded, 2 * number)

        def network(low: int) -> None:
            high = min(low + self.BLOCKS, blocks)
            self.kernels.network_forward(low, high, order, encoded, *net.arrays, hidden, output)

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
        tile = self.kernels.TILE
        transposed = self.network.transposed()
        slopes = self.buffers.take(*kept.encoded.shape)
        tasks = range(0, blocks, self.BLOCKS)
        partial = np.zeros((len(tasks), self.network.flat.size), np.float32)

        def network(low: int) -> None:
            high = min(low + self.BLOCKS, blocks)
            gradient = _Network(self.network.widths, tile, partial[low // self.BLOCKS]).arrays
            self.kernels.network_backward(low, high, kept.order, kept.encoded, kept.hidden, slope, *transposed, *gradient, slopes)

        self.run(network, tasks)
        self.network_gradient.flat += partial.sum(axis=0)
        self.pending.append((kept.coordinates, slopes))
        if sum(coordinates.shape[1] for coordinates, _ in self.pending) > PENDING:
            self.flush()

    def flush(self) -> None:
        """Scatters all pending slopes into a gradient of the whole table, so that their memory is free again."""
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
        self.settle()
        self.steps += 1
        self.version += 1
        rate = lr / (1 - beta1**self.steps)
        root = 1 / math.sqrt(1 - beta2**self.steps)
        numbers = tuple(np.float32(value) for value in (beta1, beta2, rate, root, eps))
        self.queued = _TableUpdate(numbers, self.pending, self.gradient)
        self.pending, self.gradient = [], None
        network = (self.network, self.network_first, self.network_second, self.network_gradient)
        live = np.ones(-(-self.network.flat.size // self.kernels.SPAN), bool)
        self.kernels.adam(*(net.flat for net in network), live, *numbers)

    def settle(self) -> None:
        """Applies the queued update of the table now."""
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
        return {"table": _unpacked(self.levels, self.gradient), **named}

    def state(self) -> dict[str, NDArray]:
        self.settle()
        out: dict[str, NDArray] = {"steps": np.int64(self.steps)}
        tables = (("", self.table), ("first.", self.first), ("second.", self.second))
        networks = (self.network, self.network_first, self.network_second)
        for (prefix, table), network in zip(tables, networks, strict=True):
            out[prefix + "table"] = _unpacked(self.levels, table)
            out |= {prefix + name: array.copy() for name, array in network.named().items()}
        return out

    def load_state(self, state: dict[str, NDArray]) -> None:
        def table(name: str) -> NDArray:
            return _packed(self.levels, np.asarray(state[name], np.float32)) if name in state else np.zeros_like(self.table)

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


# ---- torch ----------------------------------------------------------------------------------------------------------


class _TorchEngine:
    """The same in torch operations; indices are int32, whose products wrap as the hash needs, up to the look-up."""

    PRIMES = (1, 2654435761 - (1 << 32), 805459861)

    def __init__(self, options: HashGridOptions, levels: tuple[Level, ...], start: dict[str, NDArray], device: str):
        import torch

        self.device = torch.device(device)
        self.options, self.levels = options, levels
        if _rows(levels) * options.features >= 1 << 31:
            raise InputError(f"hash grid: {_rows(levels)} entries; int32 indices reach {(1 << 31) // options.features}")
        direct = [level for level in levels if not level.hashed]
        hashed = [level for level in levels if level.hashed]
        # a GPU wants few large operations, a CPU small ones that stay in cache; direct levels come first anyway
        together = [group for group in (direct, hashed) if group] if self.device.type != "cpu" else [[x] for x in levels]
        self.groups = [
            (
                group[0].hashed,
                torch.tensor([level.resolution for level in group], dtype=torch.int32, device=self.device),
                torch.tensor([level.start for level in group], dtype=torch.int32, device=self.device),
            )
            for group in together
        ]
        self.load_state({**start, "steps": 0})

    def apply(self, u: torch.Tensor) -> torch.Tensor:
        import torch

        if not bool(torch.isfinite(u).all()):
            raise _not_finite()
        x = _torch_function().apply(self.parameters["table"], u.clamp(0, UPPER), self)
        for i in range(self.options.hidden_layers):
            x = torch.relu(torch.nn.functional.linear(x, self.parameters[f"weight_{i}"], self.parameters[f"bias_{i}"]))
        last = self.options.hidden_layers
        return torch.nn.functional.linear(x, self.parameters[f"weight_{last}"], self.parameters[f"bias_{last}"])

    def corners(self, u: torch.Tensor, group: tuple) -> tuple[torch.Tensor, torch.Tensor]:
        """Table rows (8 * levels * N,) int32 and weights (8, levels, N) of the corners."""
        import torch

        hashed, resolution, start = group
        resolution = resolution[:, None]
        shape = (2, 2, 2, len(resolution), len(u))  # z, y, x
        rows, weights = [], []
        for axis in range(3):
            scaled = u[:, axis] * (resolution - 1).to(torch.float32)
            cell = torch.minimum(scaled.to(torch.int32), resolution - 2)
            upper = scaled - cell
            stride = self.PRIMES[axis] if hashed else resolution**axis
            cell = cell * stride
            place = [1, 1, 1, *shape[3:]]
            place[2 - axis] = 2
            rows.append(torch.stack([cell, cell + stride]).view(place))
            weights.append(torch.stack([1 - upper, upper]).view(place))
        if hashed:
            row = (rows[2] ^ rows[1] ^ rows[0]) & ((1 << self.options.log2_entries) - 1)
        else:
            row = rows[2] + rows[1] + rows[0]
        row += start[:, None]
        return row.view(-1), (weights[2] * weights[1] * weights[0]).view(8, *shape[3:])

    def encode(self, table: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        import torch

        parts = []
        for group in self.groups:
            row, weight = self.corners(u, group)
            value = table.index_select(0, row.long()).view(*weight.shape, self.options.features)
            parts.append((value * weight[..., None]).sum(0).transpose(0, 1).flatten(1))
        return torch.cat(parts, dim=1)

    def scatter(self, slope: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        import torch

        gradient = torch.zeros_like(self.parameters["table"])
        flat, features = gradient.view(-1), self.options.features
        slope = slope.t().contiguous()
        low = 0
        for group in self.groups:
            levels = len(group[1])
            part = slope[low : low + levels * features].view(levels, features, len(u))
            row, weight = self.corners(u, group)
            place = row.long() * features
            for feature in range(features):  # many times faster on a CPU than whole rows
                flat.index_add_(0, place + feature, (weight * part[:, feature]).view(-1))
            low += levels * features
        return gradient

    def step(self, lr: float, beta1: float, beta2: float, eps: float) -> None:
        import torch

        for parameter in self.parameters.values():
            if parameter.grad is None:
                parameter.grad = torch.zeros_like(parameter)
        self.optimiser.param_groups[0].update(lr=lr, betas=(beta1, beta2), eps=eps)
        self.optimiser.step()
        self.steps += 1
        self.zero_grad()

    def zero_grad(self) -> None:
        for parameter in self.parameters.values():
            parameter.grad = None

    def gradients(self) -> dict[str, NDArray]:
        import torch

        return self._numpy({name: torch.zeros_like(p) if p.grad is None else p.grad for name, p in self.parameters.items()})

    def _numpy(self, tensors: dict[str, torch.Tensor]) -> dict[str, NDArray]:
        arrays = {name: tensor.detach().cpu().numpy() for name, tensor in tensors.items()}
        return {name: _unpacked(self.levels, a) if name == "table" else a.copy() for name, a in arrays.items()}

    def state(self) -> dict[str, NDArray]:
        out = {"steps": np.int64(self.steps), **self._numpy(self.parameters)}
        for prefix, key in (("first.", "exp_avg"), ("second.", "exp_avg_sq")):
            moments = {name: self.optimiser.state[p][key] for name, p in self.parameters.items()}
            out |= {prefix + name: array for name, array in self._numpy(moments).items()}
        return out

    def load_state(self, state: dict[str, NDArray]) -> None:
        import torch

        def tensor(name: str) -> torch.Tensor:
            array = np.array(state[name], np.float32)
            if name.endswith("table"):
                array = _packed(self.levels, array)
            return torch.from_numpy(array).to(self.device)

        self.steps = int(state["steps"])
        self.parameters = {name: tensor(name).requires_grad_() for name in _named(self.options, self.levels)}
        self.optimiser = torch.optim.Adam(self.parameters.values(), fused=True)
        for name, parameter in self.parameters.items():
            first, second = (
                tensor(key) if (key := prefix + name) in state else torch.zeros_like(parameter, requires_grad=False)
                for prefix in ("first.", "second.")
            )
            step = torch.tensor(float(self.steps), dtype=torch.float32, device=self.device)
            self.optimiser.state[parameter] = {"step": step, "exp_avg": first, "exp_avg_sq": second}


@cache
def _torch_function():
    import torch

    class Encoding(torch.autograd.Function):
        @staticmethod
        def forward(ctx, table, u, engine):
            ctx.save_for_backward(u)
            ctx.engine = engine
            return engine.encode(table, u)

        @staticmethod
        @torch.autograd.function.once_differentiable
        def backward(ctx, slope):
            return ctx.engine.scatter(slope, *ctx.saved_tensors), None, None

    return Encoding
