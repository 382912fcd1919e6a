"""Surface cells: voxel keys, and a hash table from keys to rows that NumPy and Dr.Jit read alike.

A key has 64 bits. It is kept as two 32-bit words, because the kernels use 32-bit integer arithmetic:

    bits  0-15  i     voxel index along x          0 ... 65535
    bits 16-31  j     along y                      0 ... 65535
    bits 32-47  k     along z                      0 ... 65535
    bits 48-63  object id + 1                      -1 (none) ... 65534
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from iif_core.errors import InputError

Array = np.ndarray

INDEX_LIMIT = 1 << 16
"""Voxel indices and object_id + 1 lie in [0, INDEX_LIMIT)."""

COARSE_SHIFT = 2
COARSE = 1 << COARSE_SHIFT
"""Edge of a coarse cell in fine ones."""

MAX_PROBES = 8
EMPTY = np.uint32(0xFFFFFFFF)
_PROBE_STRIDE = 0x9E3779B9


def grid_origin(points: ArrayLike, edge: float) -> Array:
    """Compute the lower corner (3,) float32 of a voxel grid around `points` (n, 3), so that every voxel index is >= 1.

    The corner lies an irrational part of an edge below the minimum, so that walls at round coordinates do not coincide with
    borders of voxels (docs/method/numerics.md#walls-on-voxel-borders).
    """
    points = np.asarray(points, np.float64)
    if points.size == 0 or not np.isfinite(points).all():
        raise InputError("grid_origin: needs at least one point, all finite")
    return (points.min(axis=0) - 1.3819660 * edge).astype(np.float32)


def voxel_indices(points: ArrayLike, edge: float, origin: ArrayLike) -> Array:
    """Compute the voxel floor((x - origin) * (1 / edge)) of each point, (n, 3) int32, in float32; lengths in metres.

    The kernels evaluate the same float32 expression, so both results agree to the last bit.

    Raises:
        InputError: a non-positive edge, points that are not finite, or an edge too small for 32-bit indices.
    """
    if not edge > 0:
        raise InputError(f"voxel edge is {edge}; it must be a positive length in metres")
    points = np.asarray(points, np.float32).reshape(-1, 3)
    if not np.isfinite(points).all():
        raise InputError("voxel_indices: points contain NaN or infinity; drop rays that miss the mesh first")
    scaled = np.floor((points - np.asarray(origin, np.float32)) * inverse_edge(edge))
    # Single precision has steps of 128 below 2^31; the cast to int32 would overflow beyond.
    if scaled.size and np.abs(scaled).max() > 2**31 - 256:
        raise InputError(f"voxel edge {edge} m is too small for points {np.abs(points).max()} m from the origin")
    return scaled.astype(np.int32)


def inverse_edge(edge: float) -> np.float32:
    """Compute 1 / edge as float32, the factor that NumPy and the kernels both use."""
    return np.float32(1.0 / edge)


def pack_keys(ijk: ArrayLike, object_id: ArrayLike = -1) -> Array:
    """Pack voxels (n, 3) and object ids, (n,) or scalar, into 64-bit keys (n,) uint64 (see the module docstring).

    Raises:
        InputError: an index outside [0, 65535] or an object id outside [-1, 65534].
    """
    ijk = np.asarray(ijk).reshape(-1, 3).astype(np.int64)
    objects = np.broadcast_to(np.asarray(object_id, np.int64), (len(ijk),)) + 1
    if ijk.size and (ijk.min() < 0 or ijk.max() >= INDEX_LIMIT):
        raise InputError(
            f"voxel indices span {ijk.min()} ... {ijk.max()}, allowed are 0 ... {INDEX_LIMIT - 1}: "
            "use a larger cell edge or `grid_origin`"
        )
    if objects.size and (objects.min() < 0 or objects.max() >= INDEX_LIMIT):
        raise InputError(f"object ids span {objects.min() - 1} ... {objects.max() - 1}, allowed are -1 ... {INDEX_LIMIT - 2}")
    i, j, k, o = (part.astype(np.uint64) for part in (*ijk.T, objects))
    return i | (j << np.uint64(16)) | (k << np.uint64(32)) | (o << np.uint64(48))


def unpack_keys(keys: ArrayLike) -> tuple[Array, Array]:
    """Invert `pack_keys`: (n, 3) int32 voxel indices and (n,) int32 object ids."""
    keys = np.asarray(keys, np.uint64).reshape(-1)
    parts = [((keys >> np.uint64(shift)) & np.uint64(0xFFFF)).astype(np.int32) for shift in (0, 16, 32, 48)]
    return np.stack(parts[:3], axis=-1), parts[3] - 1


def coarse_cells(ijk: ArrayLike, object_id: ArrayLike, values: ArrayLike) -> tuple[Array, Array, Array]:
    """Average fine cells into cells of `COARSE` times the edge: voxels (m, 3), objects (m,), means (m, C) float32.

    Coarse cells give values to surface between fine cells, which few views leave empty. The coarse index of a point is its
    fine index shifted by two bits, so both grids share one origin.
    """
    ijk, values = np.asarray(ijk).reshape(-1, 3), np.asarray(values)
    keys, row = np.unique(pack_keys(ijk >> COARSE_SHIFT, object_id), return_inverse=True)
    count = np.bincount(row, minlength=len(keys))[:, None]
    sums = np.stack([np.bincount(row, values[:, c], len(keys)) for c in range(values.shape[1])], 1)
    return *unpack_keys(keys), (sums / np.maximum(count, 1)).astype(np.float32)


def neighbour_pairs(keys: ArrayLike) -> Array:
    """Find pairs of cells of one object whose voxels touch by face, edge or corner: (m, 2) int32 rows of `keys`.

    `keys` must be sorted and distinct.
    """
    keys = np.asarray(keys, np.uint64).reshape(-1)
    found = [np.zeros((0, 2), np.int32)]
    half = [(i, j, k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1) if (k, j, i) > (0, 0, 0)]
    for i, j, k in half:  # the other 13 directions give the same pairs again
        step = np.int64(i) + (np.int64(j) << np.int64(16)) + (np.int64(k) << np.int64(32))
        wanted = keys + step.astype(np.uint64)  # indices lie in 1 ... 65534, so no word overflows into the next
        row = np.minimum(np.searchsorted(keys, wanted), max(len(keys) - 1, 0))  # the object is part of the key
        hit = np.flatnonzero(keys[row] == wanted) if len(keys) else np.zeros(0, np.intp)
        found.append(np.stack([hit, row[hit]], 1).astype(np.int32))
    return np.concatenate(found)


def hash_words(low, high):
    """Hash the two words of a key to 32 bits, with operations that NumPy and Dr.Jit uint32 arrays share."""
    # Products carry low bits up and shifts bring high bits down, so neighbouring voxels fall into unrelated slots. All operations
    # wrap at 32 bits.
    h = (low * 0x85EBCA6B) ^ (high * 0xC2B2AE35)
    h = (h ^ (h >> 15)) * 0x2C1B3C6D
    h = (h ^ (h >> 12)) * 0x297A2D39
    return h ^ (h >> 15)


def probe_step(h):
    """Compute the odd step between probes from other bits of the hash, so that colliding keys follow different sequences."""
    return ((h >> 16) ^ (h * _PROBE_STRIDE)) | 1  # odd: with a power of two for a size, the sequence visits every slot


@dataclass(frozen=True)
class CellTable:
    """Open-addressing hash table from 64-bit keys to row indices.

    Probe p of a key looks at the slot (hash + p * step) mod size. An empty slot ends the search, because no later slot can
    hold the key.

    Attributes:
        slots: (size, 4) uint32: low word, high word, row (0xFFFFFFFF = empty), 0; size is a power of two.
        probes: largest number of slots that a lookup reads, <= 8.
    """

    slots: Array
    probes: int

    @classmethod
    def build(cls, keys: ArrayLike) -> CellTable:
        """Build the table that maps key number i to row i; keys must be distinct. The result is deterministic."""
        keys = np.ascontiguousarray(np.asarray(keys, np.uint64).reshape(-1))
        if len(keys) >= 1 << 28:
            raise InputError(f"{len(keys)} cells; the table holds fewer than 2^28: use a larger cell edge")
        ordered = np.sort(keys)  # several times as fast as np.unique, which hashes
        if (ordered[1:] == ordered[:-1]).any():
            raise InputError("CellTable.build: keys repeat; merge the rows of one cell first")
        # At most a quarter of the slots is used, so most lookups end at the first one.
        size = 1 << max(4, int(4 * len(keys) - 1).bit_length() if len(keys) else 4)
        while (table := cls._place(keys, size)) is None:
            size *= 2
        return table

    @classmethod
    def _place(cls, keys: Array, size: int) -> CellTable | None:
        """Place all keys within MAX_PROBES rounds, or return None.

        In each round every unplaced key requests its next slot, and the lowest row that requests a free slot gets it.
        """
        low, high = _words(keys)
        h = hash_words(low, high)
        step = probe_step(h)
        owner = np.full(size, EMPTY, np.uint32)
        waiting = np.arange(len(keys), dtype=np.uint32)
        probes = 0
        while len(waiting):
            if probes == MAX_PROBES:
                return None
            slot = (h[waiting] + np.uint32(probes) * step[waiting]) & np.uint32(size - 1)
            free = np.flatnonzero(owner[slot] == EMPTY)[::-1]  # highest row first
            owner[slot[free]] = waiting[free]  # the last assignment to a slot wins: the lowest row
            waiting = waiting[owner[slot] != waiting]
            probes += 1
        slots = np.zeros((size, 4), np.uint32)
        slots[:, 2] = owner
        used = owner != EMPTY
        slots[used, 0], slots[used, 1] = low[owner[used]], high[owner[used]]
        return cls(slots, max(probes, 1))

    def lookup(self, keys: ArrayLike) -> Array:
        """Return the row of every key, int32; -1 for keys that the table does not hold."""
        low, high = _words(np.asarray(keys, np.uint64).reshape(-1))
        h = hash_words(low, high)
        step = probe_step(h)
        rows = np.full(len(low), -1, np.int32)
        waiting = np.arange(len(low))
        for p in range(self.probes):
            entry = self.slots[(h[waiting] + np.uint32(p) * step[waiting]) & np.uint32(len(self.slots) - 1)]
            full = entry[:, 2] != EMPTY
            match = full & (entry[:, 0] == low[waiting]) & (entry[:, 1] == high[waiting])
            rows[waiting[match]] = entry[match, 2].astype(np.int32)
            waiting = waiting[full & ~match]  # most searches end at the first slot
        return rows


def _words(keys: Array) -> tuple[Array, Array]:
    return (keys & np.uint64(0xFFFFFFFF)).astype(np.uint32), (keys >> np.uint64(32)).astype(np.uint32)
