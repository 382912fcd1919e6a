"""Arrays between NumPy and the device, checks of their shapes, and work cut into lanes with a random stream each.

How a point is cut depends on the number of samples alone; the lanes of a point are added in a fixed order.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from iif_core.errors import InputError

Array = np.ndarray

ALIGNMENT = 64
"""Bytes; what the widest vector load of a CPU wants."""

_DTYPES = {dr.VarType.Float32: np.float32, dr.VarType.Int32: np.int32, dr.VarType.UInt32: np.uint32}


def chunks(count: int, size: int) -> Iterator[slice]:
    """Consecutive slices of at most `size` that cover range(count)."""
    if size < 1:
        raise InputError(f"chunk size is {size}; it must be at least 1")
    for start in range(0, count, size):
        yield slice(start, min(start + size, count))


def on_device(values: ArrayLike, kind: Any = None) -> Any:
    """Flat device array of type `kind` (None = Float) with the values, row-major.

    Dr.Jit uses the memory of a NumPy array as it is, and kernels depend on whether that memory is aligned. Without this copy,
    every call would compile its own kernel (docs/development/architecture.md#compiled-kernels).
    """
    kind, values = mi.Float if kind is None else kind, np.asarray(values)
    size = 4 * values.size
    memory = np.empty(size + ALIGNMENT, np.uint8)
    start = -memory.ctypes.data % ALIGNMENT
    aligned = memory[start : start + size].view(_DTYPES[dr.type_v(kind)])
    aligned.reshape(values.shape)[...] = values
    return kind(aligned)


def vectors(kind: Any, rows: Array) -> Any:
    """Device vectors of type `kind` from (n, width) rows."""
    return kind(*(on_device(rows[:, axis]) for axis in range(rows.shape[1])))


def to_numpy(value: Any) -> Array:
    """(n,) of a device scalar type, (n, width) of a device vector type."""
    data = value.numpy()
    return data if data.ndim == 1 else np.ascontiguousarray(data.T)


def rows_of(value: ArrayLike, count: int, width: int | None, name: str) -> Array:
    """Convert to float32 and check the shape.

    Args:
        value: array of any type.
        count: rows that are expected.
        width: columns that are expected; None = a plain vector.
        name: what a message calls it.

    Returns:
        (count, width) or (count,) float32, finite.

    Raises:
        InputError: another shape, or non-finite numbers.
    """
    shape = (count,) if width is None else (count, width)
    value = np.asarray(value, np.float32)
    if value.shape != shape:
        raise InputError(f"{name} has shape {value.shape}, expected {shape}")
    if not np.isfinite(value).all():
        raise InputError(f"{name} contains NaN or infinity; remove those rows first")
    return value


def _unit_rows(rows: Array, name: str) -> Array:
    length = np.linalg.norm(rows, axis=1, keepdims=True)
    if not (length > 0).all():
        raise InputError(f"{name} contains a zero vector")
    return rows / length


def checked_points(points: ArrayLike, normals: ArrayLike, wo: ArrayLike) -> tuple[Array, Array, Array]:
    """Check points and directions; return points, unit normals on the viewer's side and unit `wo`, each (n, 3) float32."""
    points = np.asarray(points, np.float32)
    count = len(points)
    points = rows_of(points, count, 3, "points")
    normals = _unit_rows(rows_of(normals, count, 3, "normals"), "normals")
    wo = _unit_rows(rows_of(wo, count, 3, "wo"), "wo")
    away = np.einsum("ij,ij->i", normals, wo) < 0
    return points, np.where(away[:, None], -normals, normals), wo


class TransportError(ArithmeticError):
    """Traced light is NaN or infinite: radiance near the largest float32, or a fault of ours, of a library or of the machine."""


def _finite(light: Array) -> Array:
    wrong = np.count_nonzero(~np.isfinite(light))
    if wrong:
        raise TransportError(
            f"{wrong} of {light.size} traced numbers are not finite; the same command tells whether they are so again"
        )
    return light


SAMPLES_PER_LANE = 8
"""Few enough that one view fills many cores (Dr.Jit gives a thread 16384 lanes), enough to outweigh the start of a lane."""

LANES = 1 << 18
"""Lanes on the device at once, unless their results would need more than DEVICE_FLOATS."""

DEVICE_FLOATS = 1 << 26
"""Entries of one result on the device at once (256 MiB)."""


@dataclass(frozen=True)
class Batch:
    """Points `part` of the caller's arrays; `split` neighbouring lanes work on each, numbered from `first_lane`."""

    part: slice
    split: int
    first_lane: int

    @property
    def lanes(self) -> int:
        return (self.part.stop - self.part.start) * self.split

    def spread(self, kind: Any, rows: Array) -> Any:
        """Device values of the batch's points out of all `rows` ((n,) or (n, width)), repeated for the lanes of a point."""
        rows = rows[self.part].reshape(self.part.stop - self.part.start, -1)
        return kind(*(dr.repeat(on_device(rows[:, axis]), self.split) for axis in range(rows.shape[1])))

    def samples(self, count: int) -> tuple[Any, Any]:
        """(first, end) sample number of every lane, so that the lanes of a point share `count` samples."""
        lane = dr.arange(mi.UInt32, self.lanes) % dr.opaque(mi.UInt32, self.split)
        # The first `left` lanes of a point take one sample more than the others.
        each, left = (dr.opaque(mi.UInt32, value) for value in divmod(count, self.split))
        first = lane * each + dr.minimum(lane, left)
        return first, first + each + dr.select(lane < left, mi.UInt32(1), 0)

    def collect(self, lane_sums: Any) -> Array:
        """Sum over the lanes of every point, (points,) or (points, width); raises TransportError."""
        return _finite(to_numpy(dr.block_sum(lane_sums, self.split) if self.split > 1 else lane_sums))

    def collect_rows(self, rows: Any, *shape: int) -> Array:
        """Sum over the lanes of every point, (points, *shape), of `rows` that hold so many numbers for each lane; the lanes are
        added in a fixed order. Raises TransportError."""
        return _finite(to_numpy(rows).reshape(-1, self.split, *shape).sum(axis=1))

    def streams(self, seed: int, number: Array | None = None) -> Any:
        """One PCG32 stream per lane, hashed from seed (any integer >= 0) and lane number
        (docs/method/numerics.md#correlated-random-streams).

        `number`: (n,) uint32 of the caller's points, by which their lanes are numbered, so that a point has the same random
        numbers whatever other points there are; None = by their place among all points.
        """
        # `SeedSequence` mixes a seed of any size into four words that do not resemble those of the next seed.
        words = np.random.SeedSequence(seed).generate_state(4)
        lane = dr.arange(mi.UInt32, self.lanes)
        if number is None:
            lane += dr.opaque(mi.UInt32, self.first_lane)
        else:
            split = dr.opaque(mi.UInt32, self.split)
            lane = dr.repeat(on_device(number[self.part], mi.UInt32), self.split) * split + lane % split
        # Two hashes of eight rounds: 64 bits of state, and 64 bits that select the sequence.
        a, b = mi.sample_tea_32(lane ^ dr.opaque(mi.UInt32, int(words[0])), dr.opaque(mi.UInt32, int(words[1])), 8)
        c, d = mi.sample_tea_32(lane ^ dr.opaque(mi.UInt32, int(words[2])), dr.opaque(mi.UInt32, int(words[3])), 8)
        return mi.PCG32(1, (mi.UInt64(a) << 32) | mi.UInt64(b), (mi.UInt64(c) << 32) | mi.UInt64(d))


def batches(points: int, samples: int, floats_per_lane: int, lanes: int | None = None) -> Iterator[Batch]:
    """Cut work into batches that fit on the device.

    Args:
        points: number of points.
        samples: paths for each.
        floats_per_lane: entries of the result of a lane.
        lanes: lanes at once; None = `LANES`, fewer where results would exceed `DEVICE_FLOATS`.

    Yields:
        Batches of consecutive points, at least one point each.

    Raises:
        InputError: 2^32 lanes or more (docs/method/numerics.md#more-samples-than-a-launch-can-number).
    """
    split = -(-samples // SAMPLES_PER_LANE)
    if points * split >= 1 << 32:
        raise InputError(f"{points} points with {samples} samples are too many for one call; call with fewer points")
    if lanes is None:
        lanes = min(LANES, DEVICE_FLOATS // max(floats_per_lane, 1))
    for part in chunks(points, max(1, lanes // split)):
        yield Batch(part, split, part.start * split)
