"""Moving arrays between NumPy and the device, in chunks, and the random stream of a lane."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from ..errors import InputError

Array = np.ndarray


def chunks(count: int, size: int) -> Iterator[slice]:
    """Consecutive slices of at most `size` that cover range(count)."""
    if size < 1:
        raise InputError(f"chunk size is {size}; it must be at least 1")
    for start in range(0, count, size):
        yield slice(start, min(start + size, count))


def table(rows: ArrayLike) -> Any:
    """Flat device float32 table of a NumPy array, row-major."""
    return mi.Float(np.ascontiguousarray(rows, np.float32).ravel())


def vectors(kind: Any, rows: Array) -> Any:
    """Device vectors of type `kind` from (n, width) rows."""
    return kind(*(mi.Float(np.ascontiguousarray(rows[:, axis], np.float32)) for axis in range(rows.shape[1])))


def to_numpy(value: Any) -> Array:
    """(n,) of a device scalar type, (n, width) of a device vector type."""
    data = np.array(value)
    return data if data.ndim == 1 else np.ascontiguousarray(data.T)


def rows_of(value: ArrayLike, count: int, width: int | None, name: str) -> Array:
    """`value` as float32 of shape (count, width) (or (count,) for width None), checked to be finite."""
    shape = (count,) if width is None else (count, width)
    value = np.asarray(value, np.float32)
    if value.shape != shape:
        raise InputError(f"{name} has shape {value.shape}, expected {shape}")
    if not np.isfinite(value).all():
        raise InputError(f"{name} contains NaN or infinity; remove those rows first")
    return value


def lane_streams(seed: int, first: int, count: int) -> Any:
    """One PCG32 stream for each of the lanes first ... first + count - 1, a function of (seed, lane) alone.

    The seed may be any integer >= 0 of any size; two lanes or two seeds share no state.
    """
    words = np.random.SeedSequence(seed).generate_state(4)
    lane = dr.arange(mi.UInt32, count) + dr.opaque(mi.UInt32, first)
    a, b = mi.sample_tea_32(lane ^ dr.opaque(mi.UInt32, int(words[0])), dr.opaque(mi.UInt32, int(words[1])), 8)
    c, d = mi.sample_tea_32(lane ^ dr.opaque(mi.UInt32, int(words[2])), dr.opaque(mi.UInt32, int(words[3])), 8)
    return mi.PCG32(1, (mi.UInt64(a) << 32) | mi.UInt64(b), (mi.UInt64(c) << 32) | mi.UInt64(d))
