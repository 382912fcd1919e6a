"""Diffuse shading once per piece of surface instead of once per pixel and view: it does not depend on the viewer (METHOD 7d).

A cell is object x voxel x normal direction (rounded to halves per axis). Paths start at a few of the pixels that see it, of all
views, and go on until the measured noise is small enough; two halves stay independent of each other.
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
"""Pixels of a cell from which its paths start."""

_BINS = 125
_MEDIAN_OF_NORMAL = 0.6745  # median |x| of a standard normal


def normal_bin(normals: ArrayLike) -> Array:
    """(n,) int64 in 0 ... 124 of unit normals (n, 3): each coordinate rounded to -1, -1/2, 0, 1/2 or 1."""
    return (np.rint(2 * np.asarray(normals, np.float64)).astype(np.int64) + 2) @ np.array([25, 5, 1])


@dataclass(frozen=True)
class ShadingCells:
    """Cells with representative points; made by `ShadingCellBuilder`.

    object_id (c,) int32; points, normals (c, REPRESENTATIVES, 3) float32, repeated where a cell has fewer pixels;
    pixels (c,) int64.
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

    def find(self, points: ArrayLike, normals: ArrayLike, object_id: ArrayLike) -> Array:
        """(n,) int64 cell of every surface point; raises InputError for one that was never added."""
        voxel = pack_keys(voxel_indices(points, self.edge, self.origin), object_id)
        row = np.minimum(np.searchsorted(self._voxels, voxel), len(self._voxels) - 1)
        cell = row * _BINS + normal_bin(normals)
        found = np.minimum(np.searchsorted(self._cells, cell), len(self._cells) - 1)
        if len(voxel) and not (np.array_equal(self._voxels[row], voxel) and np.array_equal(self._cells[found], cell)):
            raise InputError("a surface point lies in no shading cell; cells must be built from the same pixels")
        return found


class ShadingCellBuilder:
    """Collects pixels view by view; memory grows with the surface, not with the number of views.

    Every pixel draws a random number; a cell keeps the pixels with the smallest ones, a uniform sample of all it ever had.
    """

    def __init__(self, edge: float, origin: ArrayLike):
        self.edge, self.origin = edge, np.asarray(origin, np.float32)
        self._kept: tuple[Array, ...] | None = None

    def add(self, points: ArrayLike, normals: ArrayLike, object_id: ArrayLike, seed: int) -> None:
        """Surface points (n, 3) and unit normals (n, 3) of one view, object_id (n,)."""
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
        old = self._kept
        joined = new if old is None else tuple(np.concatenate(pair) for pair in zip(old, new, strict=True))
        order = np.lexsort((joined[2], joined[1], joined[0]))
        voxel, bins = joined[0][order], joined[1][order]
        first = np.r_[True, (voxel[1:] != voxel[:-1]) | (bins[1:] != bins[:-1])] if len(order) else np.zeros(0, bool)
        start = np.flatnonzero(first)
        cell = np.cumsum(first) - 1
        rank = np.arange(len(order)) - start[cell]
        # The first pixel kept of a cell carries the cell's number of pixels.
        pixels = np.bincount(cell, joined[6][order], len(start)).astype(np.int64)
        keep = rank < REPRESENTATIVES
        count = np.where(first, pixels[cell], 0)[keep]
        self._kept = (*(column[order][keep] for column in joined[:6]), count)

    def finish(self) -> ShadingCells:
        """The cells, sorted by voxel and normal."""
        if self._kept is None:
            raise InputError("no surface point was added: no view sees the mesh")
        voxel, bins, _, points, normals, object_id, count = self._kept
        voxels, row = np.unique(voxel, return_inverse=True)
        cells, start, members = np.unique(row * _BINS + bins, return_index=True, return_counts=True)
        choice = start[:, None] + np.arange(REPRESENTATIVES) % members[:, None]
        return ShadingCells(
            self.edge, self.origin, object_id[start], points[choice], normals[choice], count[start], voxels, cells
        )


@dataclass(frozen=True)
class DiffuseShading:
    """diffuse (2, c, 3) float32: two independent estimates a cell; samples (c,) paths of both together; noise: median relative
    standard error of their mean over cells, at first and at last; noisy_objects: objects that stopped at the most paths."""

    diffuse: Array
    samples: Array
    noise_first: float
    noise_last: float
    noisy_objects: int


Tracer = Callable[[Array, Array, int, int], Array]


def diffuse_of_cells(cells: ShadingCells, trace: Tracer, samples: int, noise: float, most: int, seed: int) -> DiffuseShading:
    """Diffuse shading of all cells: `samples` paths each, then twice as many for objects that are noisier than `noise`.

    noise: relative standard error of the mean of the halves, the median over the cells of an object; the halves' difference
    is twice that error, and the median of its size 0.67 of its standard deviation. most: paths a cell, both halves together.
    trace(points, normals, paths, seed) -> (n, 3) mean over `paths` of the diffuse lobe.
    """
    count = len(cells)
    sums, paths = np.zeros((2, count, 3)), np.zeros(count, np.int64)  # paths of one half
    each, first, work = max(1, samples // 2), None, np.arange(count)
    owner = cells.object_id.astype(np.int64) + 1
    turn = 0
    while True:
        starts = min(REPRESENTATIVES, each)
        a_start = -(-each // starts)
        for half in range(2):
            points = cells.points[work, :starts].reshape(-1, 3)
            traced = trace(points, cells.normals[work, :starts].reshape(-1, 3), a_start, (seed * 2 + half) * 64 + turn)
            sums[half, work] += a_start * traced.reshape(len(work), starts, 3).sum(1, dtype=np.float64)
        paths[work] += starts * a_start
        diffuse = sums / paths[:, None]
        error = relative_error(diffuse)
        last = float(np.median(error)) if count else 0.0
        first = last if first is None else first
        noisy = _median_by(owner, error) > noise
        room = (paths * 4 <= most) & noisy[owner]
        if not room.any() or turn == 60:
            break
        work, turn = np.flatnonzero(room), turn + 1
        each = int(paths[work].min())
    left = int(np.count_nonzero(noisy[np.unique(owner)]))
    return DiffuseShading(diffuse.astype(np.float32), 2 * paths, first, last, left)


def joined(cell: Array, cell_noise: float, own: Array) -> Array:
    """(2, n, 3) float32 halves of pixels: their cells' estimate (2, n, 3) of relative error `cell_noise` and their own
    (2, n, 3), each weighted with the other's variance. One weight for all pixels, so that it depends on no pixel's value."""
    own_noise = float(np.median(relative_error(own))) if own.shape[1] else 0.0
    total = own_noise**2 + cell_noise**2
    weight = own_noise**2 / total if total > 0 else 1.0
    return (weight * cell + (1 - weight) * own).astype(np.float32)


def relative_error(halves: Array) -> Array:
    """(c,) relative standard error of the mean of two estimates (2, c, 3), from how far they are apart; dark ones (below 1 % of
    the median) relative to that 1 %."""
    value = np.asarray(halves, np.float64).mean(-1)
    mean = value.mean(0)
    floor = max(1e-2 * float(np.median(mean)), 1e-12) if mean.size else 1.0
    return np.abs(value[0] - value[1]) / 2 / _MEDIAN_OF_NORMAL / np.maximum(mean, floor)


def _median_by(owner: Array, values: Array) -> Array:
    """Median of `values` for each owner 0 ... max, 0 for one without any."""
    out = np.zeros(int(owner.max(initial=0)) + 1)
    order = np.lexsort((values, owner))
    ids, start, count = np.unique(owner[order], return_index=True, return_counts=True)
    out[ids] = values[order][start + (count - 1) // 2]
    return out
