"""Levels of the table and shape of the network, which both engines of the hash grid share."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from iif_core.errors import InputError

UPPER = 1 - 1e-6  # coordinates are clamped to [0, UPPER]
ROWS = 8  # levels start at multiples of this many entries, a cache line of 64 bytes with two features
FINEST = 1 << 22  # vertices per side that float32 coordinates resolve


@dataclass(frozen=True)
class HashGridOptions:
    """Shape of a hash-grid texture; the defaults are the paper's, with 27.95 million + 8,970 parameters.

    Attributes:
        levels: number of levels; features: per level (the numba engine supports 2).
        log2_entries: a level has at most 2^log2_entries entries.
        base_resolution, growth: vertices per side of the levels (Eq. F.57).
        hidden, hidden_layers, outputs: widths and depth of the network (ReLU, biases).
        init_scale: the table starts uniform in +-init_scale.
        finest: largest number of vertices per side, None = no limit. Levels beyond the first that reaches it are left out,
            since they would repeat it (docs/method/numerics.md#hash-grid-finer-than-a-pixel).
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
    """One level with `resolution` vertices per side and the entries `start` to `start + entries` of the table; it is
    `hashed` if resolution^3 exceeds the entries."""

    resolution: int
    start: int
    entries: int
    hashed: bool


def layout(options: HashGridOptions) -> tuple[Level, ...]:
    """Return the levels of the table (Eqs. F.57, F.59); vertices are 1 / (resolution - 1) apart.

    Raises:
        InputError: a resolution beyond the accuracy of float32 coordinates.
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
    """Return the numbers of parameters of the encoding and of the network.

    Example:
        >>> parameter_counts(HashGridOptions())
        (27954106, 8970)
    """
    levels = layout(options)
    encoding = options.features * sum(level.entries for level in levels)
    widths = widths_of(options, levels)
    return encoding, sum(a * b + b for a, b in zip(widths, widths[1:], strict=False))


def widths_of(options: HashGridOptions, levels: tuple[Level, ...]) -> list[int]:
    """Return the widths of the network from inputs to outputs."""
    return [options.features * len(levels), *[options.hidden] * options.hidden_layers, options.outputs]


def row_count(levels: tuple[Level, ...]) -> int:
    """Return the rows of the table, with levels at their starts."""
    return levels[-1].start + -(-levels[-1].entries // ROWS) * ROWS


def named_zeros(options: HashGridOptions, levels: tuple[Level, ...]) -> dict[str, NDArray]:
    """Return zeros of the shape of every parameter, by name; they are views of one zero and cost no memory."""
    shapes = {"table": (sum(level.entries for level in levels), options.features)}
    widths = widths_of(options, levels)
    for i, (inputs, outputs) in enumerate(zip(widths, widths[1:], strict=False)):
        shapes[f"weight_{i}"] = (outputs, inputs)
        shapes[f"bias_{i}"] = (outputs,)
    return {name: np.broadcast_to(np.float32(0), shape) for name, shape in shapes.items()}


def initial(options: HashGridOptions, levels: tuple[Level, ...], seed: int) -> dict[str, NDArray]:
    """Draw the initial parameters: table and weights uniform, biases 0."""
    random = np.random.default_rng(seed)
    start = {}
    for name, zeros in named_zeros(options, levels).items():
        if name.startswith("bias"):
            start[name] = np.zeros(zeros.shape, np.float32)
            continue
        bound = options.init_scale if name == "table" else math.sqrt(6 / sum(zeros.shape))
        values = random.random(zeros.shape, dtype=np.float32)
        values *= np.float32(2 * bound)
        values -= np.float32(bound)
        start[name] = values
    return start


def not_finite() -> InputError:
    """Return the error for coordinates that are not finite."""
    return InputError("hash grid: some coordinates are not finite (NaN or infinite); drop those samples before")


def packed(levels: tuple[Level, ...], table: NDArray) -> NDArray:
    """Place levels that follow one another at their starts in the table."""
    out = np.zeros((row_count(levels), table.shape[1]), np.float32)
    low = 0
    for level in levels:
        out[level.start : level.start + level.entries] = table[low : low + level.entries]
        low += level.entries
    return out


def unpacked(levels: tuple[Level, ...], table: NDArray) -> NDArray:
    """Return the levels of a table one after another: the inverse of `packed`."""
    return np.concatenate([table[level.start : level.start + level.entries] for level in levels])
