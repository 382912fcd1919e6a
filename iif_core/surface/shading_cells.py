"""Diffuse shading per surface cell, computed once for all views because it does not depend on the viewer (Eq. S.17).

Paths are added until the measured noise is small enough; two independent halves are kept (docs/method/shading.md#surface-cells).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from iif_core.errors import InputError
from iif_core.surface.cells import pack_keys, voxel_indices

Array = np.ndarray

REPRESENTATIVES = 8
"""Largest number of pixels of a cell at which its paths start."""

MERGE_ROWS = 1 << 20
"""Pixels of further views that wait at least until they are joined with those of the views before."""

_BINS = 125
_MEDIAN_OF_NORMAL = 0.6745  # median |x| of a standard normal


def normal_bin(normals: ArrayLike) -> Array:
    """Number the directions of unit normals (n, 3), each coordinate rounded to -1, -1/2, 0, 1/2 or 1: (n,) int64 in 0 ... 124."""
    return (np.rint(2 * np.asarray(normals, np.float64)).astype(np.int64) + 2) @ np.array([25, 5, 1])


@dataclass(frozen=True)
class ShadingCells:
    """Cells with representative points, made by `ShadingCellBuilder`.

    Attributes:
        edge, origin: voxel grid, in metres.
        object_id: (c,) int32.
        points, normals: (c, REPRESENTATIVES, 3) float32; repeated where a cell has fewer pixels.
        pixels: (c,) int64 pixels of all views that see the cell.
    """

    edge: float
    origin: Array
    object_id: Array
    points: Array
    normals: Array
    pixels: Array
    _voxels: Array
    _cells: Array

    def __len__(self) -> int:
        return len(self.object_id)

    @property
    def number(self) -> Array:
        """(c,) uint32 hash of place, object and normal: what a cell draws does not depend on the other cells
        (docs/method/numerics.md#random-numbers-that-shift)."""
        row, side = np.divmod(self._cells, _BINS)
        # The side has 125 values and goes into the 7 highest bits of the key, which object ids below 511 leave free.
        mixed = (self._voxels[row] ^ (side.astype(np.uint64) << np.uint64(57))) * np.uint64(0x9E3779B97F4A7C15)
        mixed = (mixed ^ (mixed >> np.uint64(29))) * np.uint64(0xBF58476D1CE4E5B9)
        return (mixed >> np.uint64(32)).astype(np.uint32)

    def find(self, points: ArrayLike, normals: ArrayLike, object_id: ArrayLike) -> Array:
        """Return the cell (n,) int64 of every surface point; raise InputError for a point whose cell does not exist."""
        voxel = pack_keys(voxel_indices(points, self.edge, self.origin), object_id)
        # A key of voxel and object leaves no room for the side, so the search has two steps.
        row = np.minimum(np.searchsorted(self._voxels, voxel), len(self._voxels) - 1)
        cell = row * _BINS + normal_bin(normals)
        found = np.minimum(np.searchsorted(self._cells, cell), len(self._cells) - 1)
        if len(voxel) and not (np.array_equal(self._voxels[row], voxel) and np.array_equal(self._cells[found], cell)):
            raise InputError("a surface point lies in no shading cell; cells must be built from the same pixels")
        return found


class ShadingCellBuilder:
    """Collects the pixels of all views; memory grows with the surface, not with the number of views.

    Every pixel draws a random number, and a cell keeps the pixels with the smallest numbers, which is a uniform sample of all
    pixels added to it.
    """

    def __init__(self, edge: float, origin: ArrayLike):
        self.edge, self.origin = edge, np.asarray(origin, np.float32)
        self._parts: list[tuple[Array, ...]] = []

    def add(self, points: ArrayLike, normals: ArrayLike, object_id: ArrayLike, seed: int) -> None:
        """Add the pixels of one view.

        Args:
            points, normals: (n, 3) surface points in metres and unit normals.
            object_id: (n,) int.
            seed: seed of the random numbers of the view.
        """
        points, normals = np.asarray(points, np.float32), np.asarray(normals, np.float32)
        new = (
            pack_keys(voxel_indices(points, self.edge, self.origin), object_id),
            normal_bin(normals),
            np.random.default_rng(seed).random(len(points)),
            points,
            normals,
            np.asarray(object_id, np.int32),
            np.ones(len(points), np.int64),
        )
        self._parts.append(_smallest(new))
        # Views are joined when they have become as much as what they are joined with, so that a pixel is sorted a few times only.
        waiting = sum(len(part[0]) for part in self._parts[1:])
        if waiting > max(len(self._parts[0][0]), MERGE_ROWS):
            self._join()

    def _join(self) -> None:
        if len(self._parts) > 1:
            self._parts = [_smallest(tuple(np.concatenate(columns) for columns in zip(*self._parts, strict=True)))]

    def finish(self) -> ShadingCells:
        """Return the cells, sorted by voxel and normal."""
        self._join()
        if not self._parts:
            raise InputError("no surface point was added: no view sees the mesh")
        voxel, bins, _, points, normals, object_id, count = self._parts[0]
        # Rows are sorted by cell, so those of a cell stand together and the first one has its number of pixels.
        voxels, row = np.unique(voxel, return_inverse=True)
        cells, start, members = np.unique(row * _BINS + bins, return_index=True, return_counts=True)
        choice = start[:, None] + np.arange(REPRESENTATIVES) % members[:, None]  # a cell of few pixels repeats them in turn
        return ShadingCells(
            self.edge, self.origin, object_id[start], points[choice], normals[choice], count[start], voxels, cells
        )


def _smallest(columns: tuple[Array, ...]) -> tuple[Array, ...]:
    """Keep the rows of each cell with the smallest random numbers, in the order of voxel, bin and random number.

    columns: (n,) voxel, bin and random number, (n, 3) points and normals, (n,) object and number of pixels; the first row of a
    cell gets the number of pixels of all its rows, the others 0.
    """
    order = np.lexsort((columns[2], columns[1], columns[0]))
    voxel, bins = columns[0][order], columns[1][order]
    first = np.r_[True, (voxel[1:] != voxel[:-1]) | (bins[1:] != bins[:-1])] if len(order) else np.zeros(0, bool)
    start = np.flatnonzero(first)
    cell = np.cumsum(first) - 1
    pixels = np.bincount(cell, columns[6][order], len(start)).astype(np.int64)
    # The smallest of a union are among the smallest of its parts, so views can be joined in any order.
    keep = np.arange(len(order)) - start[cell] < REPRESENTATIVES
    count = np.where(first, pixels[cell], 0)[keep]
    order = order[keep]
    return (*(column[order] for column in columns[:6]), count)


@dataclass(frozen=True)
class DiffuseShading:
    """Result of `diffuse_of_cells`.

    Attributes:
        diffuse: (2, c, 3) float32, two independent estimates per cell.
        samples: (c,) paths of both estimates together.
        noise_first, noise_last: median over the cells of the relative standard error, after the first and after the last paths.
        noisy_objects: number of objects that reached the largest number of paths and are still too noisy.
    """

    diffuse: Array
    samples: Array
    noise_first: float
    noise_last: float
    noisy_objects: int


Tracer = Callable[[Array, Array, int, int, Array], Array]


def diffuse_of_cells(
    cells: ShadingCells, trace: Tracer, samples: int, noise: float, max_samples: int, seed: int
) -> DiffuseShading:
    """Estimate the diffuse shading of all cells (Eq. S.18).

    Every cell gets `samples` paths. The cells of an object whose median relative error exceeds `noise` get as many paths
    again, until the error is small enough or the number would exceed `max_samples`.

    Args:
        cells: of `ShadingCellBuilder`.
        trace: function (points (n, 3), normals (n, 3), paths, seed, number (n,)) that returns (n, 3), the mean over `paths`
            paths; a point draws by its number (uint32).
        samples: first number of paths per cell, both halves together.
        noise: relative standard error of the mean of the halves that an object may have.
        max_samples: largest number of paths per cell, both halves together.
        seed: the streams of all calls of `trace` are derived from it.

    Returns:
        Two independent estimates per cell, and their noise.
    """
    count, number = len(cells), cells.number
    sums, paths = np.zeros((2, count, 3)), np.zeros(count, np.int64)  # paths of one half
    # each: paths of one half to add; work: cells that get them.
    each, first, work = max(1, samples // 2), None, np.arange(count)
    owner = cells.object_id.astype(np.int64) + 1  # object -1 is row 0
    turn = 0
    while True:
        # -------- paths of both halves, from the same points with independent streams --------
        starts = min(REPRESENTATIVES, each)
        a_start = -(-each // starts)
        for half in range(2):
            points, normals = (of[work, :starts].reshape(-1, 3) for of in (cells.points, cells.normals))
            # A point draws by cell and place in the cell; wraps at 32 bits.
            own = (number[work, None] * np.uint32(REPRESENTATIVES) + np.arange(starts, dtype=np.uint32)).ravel()
            # Fewer than 64 turns, so no two calls have the same seed.
            traced = trace(points, normals, a_start, (seed * 2 + half) * 64 + turn, own)
            sums[half, work] += a_start * traced.reshape(len(work), starts, 3).sum(1, dtype=np.float64)  # `trace` gives means
        paths[work] += starts * a_start
        # -------- noise of each object (Eq. S.18); those above the limit get as many paths again --------
        diffuse = sums / paths[:, None]
        error = relative_error(diffuse)
        last = float(np.median(error)) if count else 0.0
        first = last if first is None else first
        noisy = _median_by(owner, error) > noise
        room = (paths * 4 <= max_samples) & noisy[owner]  # paths of both halves after doubling
        if not room.any() or turn == 60:
            break
        work, turn = np.flatnonzero(room), turn + 1
        # The floor in `relative_error` depends on all cells, so an object can return with fewer paths than others.
        each = int(paths[work].min())
    left = int(np.count_nonzero(noisy[np.unique(owner)]))
    return DiffuseShading(diffuse.astype(np.float32), 2 * paths, first, last, left)


def combine_estimates(cell: Array, cell_noise: float, own: Array) -> Array:
    """Combine the estimates of the cells and of the pixels' own paths, weighted with each other's variance (Eq. S.19).

    `cell` and `own` are (2, n, 3) halves, `cell_noise` is the relative error of the cells; result (2, n, 3) float32. One weight
    serves all pixels, so it does not depend on the value of any single pixel.
    """
    own_noise = float(np.median(relative_error(own))) if own.shape[1] else 0.0
    total = own_noise**2 + cell_noise**2
    weight = own_noise**2 / total if total > 0 else 1.0
    return (weight * cell + (1 - weight) * own).astype(np.float32)


def relative_error(halves: Array) -> Array:
    """Estimate the relative standard error of the mean of two estimates (2, c, 3) from their difference, (c,) (Eq. S.18)."""
    value = np.asarray(halves, np.float64).mean(-1)
    mean = value.mean(0)
    floor = max(1e-2 * float(np.median(mean)), 1e-12) if mean.size else 1.0
    return np.abs(value[0] - value[1]) / 2 / _MEDIAN_OF_NORMAL / np.maximum(mean, floor)


def _median_by(owner: Array, values: Array) -> Array:
    """Lower median of `values` for each owner 0 ... max; 0 for an owner without values."""
    out = np.zeros(int(owner.max(initial=0)) + 1)
    order = np.lexsort((values, owner))
    ids, start, count = np.unique(owner[order], return_index=True, return_counts=True)
    out[ids] = values[order][start + (count - 1) // 2]
    return out
