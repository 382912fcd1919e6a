"""All usable pixels in memory, batches of them, the schedules of a run, and start and range of the texture."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iif_core.errors import InputError
from iif_core.fusion.kernels import as_words
from iif_core.fusion.problem import LOWEST, FusionProblem, usable_pixels
from iif_core.reflectance import material
from lab.published.fusion.sgd.kernels import LOCATION, SCALE
from lab.published.fusion.sgd.options import SgdOptions

_FULL_ANNEALS = 81  # multiplications of the temperature in the 8080 steps of the paper's kitchen
_HALVINGS = 4  # of the learning rate
_MIN_TEMPERATURE = 1e-30  # 1 / tau is still a float32
_CHUNK_PIXELS = 65536  # read at a time
IDENTITY = np.float32(material.IDENTITY)
"""The identity map."""


def as_floats(values: NDArray) -> NDArray:
    """Return words (`as_words`) as float32 numbers."""
    return values.view(np.float16).astype(np.float32) if values.dtype == np.uint16 else values


@dataclass(frozen=True)
class Pool:
    """All usable pixels, view by view, in segment order within a view."""

    values: NDArray  # (P, K, 5) words
    cell: NDArray  # (P,) int32
    segment: NDArray  # (P,) int32
    coordinates: NDArray | None  # (P, 3) float32 in [0, 1]
    tangent: NDArray | None  # (P, 2, 3) float32, in units of the coordinates
    box: tuple[float, float]  # world coordinates that are mapped to 0 and 1, for all axes, m
    usable: NDArray  # (S, K) bool
    observations: NDArray  # (n_cells,) int32 pixels

    def __len__(self) -> int:
        return len(self.cell)


def of_view(source: Any, view: int) -> NDArray:
    """Read a view of a sequence or of a callable as float32."""
    return np.asarray(source(view) if callable(source) else source[view], np.float32)


def gather(problem: FusionProblem, options: SgdOptions) -> Pool:
    """Read every view once.

    Raises:
        InputError: shapes or ids that do not match, a segment in two views, too much memory, surface points that are
            missing or not finite.
    """
    spatial = options.texture == "hashgrid"
    jitter = spatial and options.jitter and problem.tangent is not None
    if spatial and problem.point is None:
        raise InputError("base sgd: the hash grid needs the surface points of the pixels (FusionProblem.point), there are none")
    observations = np.zeros(problem.n_cells, np.int32)
    parts: dict[str, list[NDArray]] = {name: [] for name in ("values", "cell", "segment", "point", "tangent")}
    usable, view_of_segment = None, np.full(problem.n_segments, -1)
    size = 0
    for view in range(len(problem.cell_of_pixel)):
        maps = problem.view(view)
        if usable is None:
            usable = np.zeros((problem.n_segments, len(maps)), bool)
        if len(maps) != usable.shape[1]:
            raise InputError(
                f"view {view} has {len(maps)} predictions, view 0 has {usable.shape[1]}; give every view the same number"
            )
        found = usable_pixels(problem, view, maps)
        segments = np.unique(found.segment)
        if (view_of_segment[segments] >= 0).any():
            segment = segments[np.argmax(view_of_segment[segments] >= 0)]
            raise InputError(f"segment {segment} has pixels in two views; a segment is one object in one view")
        view_of_segment[segments] = view
        usable[segments] = found.usable
        words = as_words(maps)
        size += len(found.pixel) * words.shape[0] * 5 * words.itemsize
        if size > options.memory:
            raise InputError(
                f"base sgd: the predictions of {view + 1} of {len(problem.cell_of_pixel)} views take {size >> 20} MiB, allowed "
                f"are {options.memory >> 20}; raise `memory`, use smaller images or half precision, or the direct solver"
            )
        values = np.ascontiguousarray(words[:, found.pixel].swapaxes(0, 1))
        values[:, ~found.usable] = 0
        parts["values"].append(values)
        parts["cell"].append(found.cell.astype(np.int32))
        parts["segment"].append(found.segment.astype(np.int32))
        if spatial:
            parts["point"].append(of_view(problem.point, view).reshape(-1, 3)[found.pixel])
        if jitter:
            parts["tangent"].append(of_view(problem.tangent, view).reshape(-1, 2, 3)[found.pixel])
        observations += np.bincount(found.cell, minlength=problem.n_cells).astype(np.int32)
    if not size:
        raise InputError("base sgd: no pixel has a cell, a segment, weight and finite predictions; check the problem")
    pool = {name: np.concatenate(parts.pop(name)) for name in list(parts) if parts[name]}
    coordinates, tangent, box = None, None, (0.0, 1.0)
    if spatial:
        point = pool["point"]
        if not np.isfinite(point).all():
            raise InputError("base sgd: some surface points of used pixels are not finite; set their cell to -1")
        low, high = float(point.min()), float(point.max())
        pad = max(0.01 * (high - low), 1e-6)  # Eq. F.56
        box = (low - pad, high + pad)
        coordinates = unit_coordinates(point, box)
        tangent = pool["tangent"] / np.float32(box[1] - box[0]) if jitter else None
    return Pool(
        _half_in_range(pool["values"]),
        pool["cell"],
        pool["segment"],
        coordinates,
        tangent,
        box,
        usable,
        observations,
    )


def _half_in_range(values: NDArray) -> NDArray:
    """Half bits as they are if all values are in [0, 1], where the kernel can read them, else float32."""
    if values.dtype == np.uint16:
        values[values == 0x8000] = 0  # minus zero
    if values.dtype == np.uint16 and values.max(initial=0) > 0x3C00:
        return as_floats(values)
    return values


def unit_coordinates(point: NDArray, box: tuple[float, float]) -> NDArray:
    """Map world coordinates (..., 3) to the unit cube (Eq. F.56), float32."""
    return ((point - np.float32(box[0])) / np.float32(box[1] - box[0])).astype(np.float32)


def batches(n: int, batch: int, rng: np.random.Generator) -> Iterator[NDArray]:
    """Yield batches of a new permutation per epoch without the last partial one; sorted, and so in segment order."""
    while True:
        order = rng.permutation(n).astype(np.int32)
        for start in range(0, n - batch + 1, batch):
            yield np.sort(order[start : start + batch])


def runs(segment: NDArray) -> tuple[NDArray, NDArray]:
    """Return start (R + 1,) and segment (R,) of the runs of equal segments."""
    start = np.flatnonzero(np.r_[True, segment[1:] != segment[:-1]])
    return np.append(start, len(segment)), segment[start]


# ---------------------------------------------------------------------------------------------------------- schedules


def temperature_at(options: SgdOptions, step: int, steps: int) -> float:
    """Return the temperature of step number `step` (from 0) of `steps` (Eq. F.17 or F.61)."""
    if options.anneal_schedule == "steps":
        times = -(-step // 100)
    else:
        times = step * _FULL_ANNEALS // steps
    return max(options.temperature * options.anneal**times, options.temperature_floor, _MIN_TEMPERATURE)


def learning_rate_at(options: SgdOptions, step: int, steps: int) -> float:
    """Return the learning rate of a step.

    Args:
        options: schedule; step: number of the step, from 0; steps: their number, which `epochs` divides into equal epochs.

    Returns:
        Rate, halved up to four times.
    """
    if options.lr_schedule == "epochs":
        times = step * options.epochs // (2 * steps)
    else:
        times = step * (_HALVINGS + 1) // steps
    return options.learning_rate * 0.5 ** min(times, _HALVINGS)


# ------------------------------------------------------------------------------------------------------------ textures


def activated(raw: NDArray, options: SgdOptions) -> tuple[NDArray, NDArray]:
    """Return location and Laplace scale (N, 5) float32 of raw outputs (N, 10) (Eqs. F.50, F.51)."""
    sigmoid = 0.5 + 0.5 * np.tanh(0.5 * np.asarray(raw, np.float64))
    value = LOWEST + (1 - LOWEST) * sigmoid[:, LOCATION]
    scale = sigmoid[:, SCALE]
    if options.scale_floor_kind == "smooth":
        scale = np.sqrt(scale**2 + options.scale_floor**2)
    else:
        scale = np.maximum(scale, options.scale_floor)
    return value.astype(np.float32), scale.astype(np.float32)


def start_values(pool: Pool, n_cells: int, options: SgdOptions) -> NDArray:
    """Return the raw outputs (n_cells, 10) float32 of the texture `cells` to start from."""
    raw = np.zeros((n_cells, 10), np.float32)
    if options.init == "paper":
        return raw
    total, square = np.zeros((n_cells, 5)), np.zeros((n_cells, 5))
    for low in range(0, len(pool), _CHUNK_PIXELS):
        rows = slice(low, low + _CHUNK_PIXELS)
        v = np.clip(as_floats(pool.values[rows]), LOWEST, 1)
        use = pool.usable[pool.segment[rows]]
        v, count = v * use[..., None], use.sum(1)[:, None]
        np.add.at(total, pool.cell[rows], v.sum(1) / count)
        np.add.at(square, pool.cell[rows], (v * v).sum(1) / count)
    seen = pool.observations > 0
    count = np.maximum(pool.observations, 1)[:, None]
    mean = total / count
    spread = np.sqrt(np.maximum(square / count - mean**2, 0) / 2)  # of a Laplace distribution: variance 2 b^2
    inside = np.clip((mean - LOWEST) / (1 - LOWEST), 0.005, 0.995)
    spread = np.clip(spread, 2 * options.scale_floor, 0.5)
    raw[:, LOCATION] = np.log(inside / (1 - inside))
    raw[:, SCALE] = np.log(spread / (1 - spread))
    raw[~seen] = 0
    return raw


# ------------------------------------------------------------------------------------------------------------ engines


@dataclass(frozen=True)
class Step:
    """Inputs of a step besides the parameters."""

    pixels: NDArray  # (N,) sorted rows of the pool
    coordinates: NDArray | None  # (N, 3)
    temperature: float
    learning_rate: float


TERMS = ("data", "label", "regulariser", "entropy", "gain")


def softmax(z: NDArray, divisor: float, usable: NDArray) -> tuple[NDArray, NDArray]:
    """Return the softmax of z / divisor over the usable k and its logarithm, (S, K, 3) float32, 0 where not usable."""
    use = usable[..., None]
    lowest = np.where(use, z, -np.inf).max(1, keepdims=True)
    exponent = np.where(use, z - np.where(np.isfinite(lowest), lowest, 0), 0).astype(np.float64) / divisor
    power = np.exp(exponent) * use
    total = power.sum(1, keepdims=True)
    total[total == 0] = 1
    log = np.where(use, exponent - np.log(total), 0)
    return (power / total).astype(np.float32), log.astype(np.float32)
