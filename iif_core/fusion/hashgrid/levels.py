"""Levels of the table and shapes of the network: what both backends share."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from iif_core.errors import InputError

UPPER = 1 - 1e-6  # coordinates are clamped to [0, UPPER] (H7)
ROWS = 8  # levels start at multiples of this many entries: a cache line of 64 bytes at two features
FINEST = 1 << 22  # cells beyond this are not resolved by float32 coordinates


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
    widths = widths_of(options, levels)
    return encoding, sum(a * b + b for a, b in zip(widths, widths[1:], strict=False))


def widths_of(options: HashGridOptions, levels: tuple[Level, ...]) -> list[int]:
    return [options.features * len(levels), *[options.hidden] * options.hidden_layers, options.outputs]


def row_count(levels: tuple[Level, ...]) -> int:
    return levels[-1].start + -(-levels[-1].entries // ROWS) * ROWS


def named_zeros(options: HashGridOptions, levels: tuple[Level, ...]) -> dict[str, NDArray]:
    """Zeros of the shape of every parameter, by name (views of one zero: they cost no memory)."""
    shapes = {"table": (sum(level.entries for level in levels), options.features)}
    widths = widths_of(options, levels)
    for i, (inputs, outputs) in enumerate(zip(widths, widths[1:], strict=False)):
        shapes[f"weight_{i}"] = (outputs, inputs)
        shapes[f"bias_{i}"] = (outputs,)
    return {name: np.broadcast_to(np.float32(0), shape) for name, shape in shapes.items()}


def initial(options: HashGridOptions, levels: tuple[Level, ...], seed: int) -> dict[str, NDArray]:
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
    return InputError("hash grid: some coordinates are not finite (NaN or infinite); drop those samples before")


def packed(levels: tuple[Level, ...], table: NDArray) -> NDArray:
    """Table with every level at its start, from levels one after another."""
    out = np.zeros((row_count(levels), table.shape[1]), np.float32)
    low = 0
    for level in levels:
        out[level.start : level.start + level.entries] = table[low : low + level.entries]
        low += level.entries
    return out


def unpacked(levels: tuple[Level, ...], table: NDArray) -> NDArray:
    return np.concatenate([table[level.start : level.start + level.entries] for level in levels])
