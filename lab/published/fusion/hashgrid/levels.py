"""Levels of the table and shape of the network of a hash grid."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

ROWS = 8  # levels start at multiples of this many entries, a cache line of 64 bytes with two features


@dataclass(frozen=True)
class HashGridOptions:
    """Shape of a hash-grid texture; the defaults are the paper's, with 27.95 million + 8,970 parameters.

    Attributes:
        levels: number of levels, each with two features; log2_entries: a level has at most 2^log2_entries entries.
        base_resolution, growth: vertices per side of the levels (Eq. F.57).
        hidden, hidden_layers, outputs: widths and depth of the network (ReLU, biases).
        init_scale: the table starts uniform in +-init_scale.
    """

    levels: int = 32
    log2_entries: int = 19
    base_resolution: int = 16
    growth: float = 1.3
    hidden: int = 64
    hidden_layers: int = 2
    outputs: int = 10
    init_scale: float = 1e-4


@dataclass(frozen=True)
class Level:
    """One level with `resolution` vertices per side and the entries `start` to `start + entries` of the table; it is
    `hashed` if resolution^3 exceeds the entries."""

    resolution: int
    start: int
    entries: int
    hashed: bool


def layout(options: HashGridOptions) -> tuple[Level, ...]:
    """Return the levels of the table (Eqs. F.57, F.59); vertices are 1 / (resolution - 1) apart."""
    levels: list[Level] = []
    start = 0
    for number in range(options.levels):
        resolution = math.ceil(options.base_resolution * options.growth**number - 1) + 1
        hashed = resolution**3 > 1 << options.log2_entries
        entries = 1 << options.log2_entries if hashed else resolution**3
        levels.append(Level(resolution, start, entries, hashed))
        start += -(-entries // ROWS) * ROWS
    return tuple(levels)


def widths_of(options: HashGridOptions, levels: tuple[Level, ...]) -> list[int]:
    """Return the widths of the network from inputs to outputs."""
    return [2 * len(levels), *[options.hidden] * options.hidden_layers, options.outputs]


def initial(options: HashGridOptions, levels: tuple[Level, ...], seed: int) -> dict[str, NDArray]:
    """Draw the initial parameters in float32, "table" and weights uniform, biases 0.

    "table" (entries, 2) holds the levels one after another; "weight_i" is (outputs, inputs), "bias_i" (outputs,).
    """
    shapes = {"table": (sum(level.entries for level in levels), 2)}
    widths = widths_of(options, levels)
    for i, (inputs, outputs) in enumerate(zip(widths, widths[1:], strict=False)):
        shapes[f"weight_{i}"] = (outputs, inputs)
        shapes[f"bias_{i}"] = (outputs,)
    random = np.random.default_rng(seed)
    start = {}
    for name, shape in shapes.items():
        if name.startswith("bias"):
            start[name] = np.zeros(shape, np.float32)
            continue
        bound = options.init_scale if name == "table" else math.sqrt(6 / sum(shape))
        values = random.random(shape, dtype=np.float32)
        values *= np.float32(2 * bound)
        values -= np.float32(bound)
        start[name] = values
    return start


def packed(levels: tuple[Level, ...], table: NDArray) -> NDArray:
    """Place levels that follow one another at their starts in the table."""
    out = np.zeros((levels[-1].start + -(-levels[-1].entries // ROWS) * ROWS, 2), np.float32)
    low = 0
    for level in levels:
        out[level.start : level.start + level.entries] = table[low : low + level.entries]
        low += level.entries
    return out
