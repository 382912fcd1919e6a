"""Surface patches that several photographs show, for calibrating exposure and response (docs/method/camera.md#patches).

A row is the mean of the middle half of a patch's sensor values in one photograph, since quantiles commute with any response.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from iif_core.camera.response import SATURATION
from iif_core.errors import InputError
from iif_core.numerics.frames import dominant_side
from iif_core.surface.cells import INDEX_LIMIT, pack_keys, voxel_indices

PATCH_FOOTPRINTS = 3.2
"""Edge of a patch in pixel footprints; a patch then covers about ten pixels."""


@dataclass(frozen=True)
class PatchRows:
    """Patches in photographs; n rows, one per (patch, view).

    Attributes:
        patch: (n,) uint64 key of voxel and object; facing: (n,) int8 side of the normal, 0 ... 5
            (`frames.dominant_side`). Both together identify the patch.
        block: (n,) int32, patches whose errors may be correlated (their object).
        view: (n,) int32.
        value: (n, 3) float64 sensor value; NaN where a channel cannot be used.
        clipped: (n, 3) bool: at least three quarters of the pixels are saturated; `value` is a bound.
        count: (n,) int32 pixels.
        radius2: (n,) mean squared distance of the pixels from the picture's centre, 1 in its corners; None = unknown.
    """

    patch: np.ndarray
    facing: np.ndarray
    block: np.ndarray
    view: np.ndarray
    value: np.ndarray
    clipped: np.ndarray
    count: np.ndarray
    radius2: np.ndarray | None = None

    def take(self, index: np.ndarray) -> PatchRows:
        """Select rows."""
        return PatchRows(**{name: None if array is None else array[index] for name, array in self.__dict__.items()})


def patch_edge(footprint: float, extent: float = 0.0) -> float:
    """Compute the edge of a patch in metres from the median pixel footprint (distance / focal length in pixels) in metres.

    It is at least as large as the voxel indices of a scene of `extent` metres require.
    """
    if not footprint > 0:
        raise InputError(f"patches: pixel footprint {footprint} m; it must be positive")
    return max(PATCH_FOOTPRINTS * footprint, extent / (INDEX_LIMIT - 8))


def patch_numbers(points: np.ndarray, object_id: np.ndarray, edge: float, origin: np.ndarray) -> np.ndarray:
    """Number surface points by voxel and object.

    Args:
        points: (n, 3) in metres; object_id: (n,) int.
        edge, origin: voxel grid, in metres.

    Returns:
        (n,) uint64.
    """
    return pack_keys(voxel_indices(points, edge, origin), object_id)


def patch_rows(
    patch: np.ndarray,
    normal: np.ndarray,
    block: np.ndarray,
    value: np.ndarray,
    view: int,
    saturation: float = SATURATION,
    min_pixels: int = 4,
    evenness: float = 0.05,
    share: float = 1.0,
    radius2: np.ndarray | None = None,
) -> PatchRows:
    """Collect the rows of one photograph.

    Args:
        patch: (n,) uint64 of each pixel; normal: (n, 3), whose side divides patches.
        block: (n,) int, block of each pixel.
        value: (n, 3) sensor values; pixels that are not finite are ignored.
        view: number of the photograph.
        saturation: sensor values from here on are bounds; a channel with one to three quarters of saturated pixels is NaN.
        min_pixels: pixels that a row needs.
        evenness: largest interquartile range relative to the value; 1.5 8-bit steps are always allowed.
        share: share of the patches to keep; every view keeps the same patches.
        radius2: (n,) squared distance from the picture's centre (`gains.radius_squared`); 0 if None.

    Returns:
        Rows with at least one usable channel.
    """
    value, normal = np.asarray(value, np.float64), np.asarray(normal)
    good = np.isfinite(value).all(1)
    if share < 1.0:
        # A hash of the patch decides, so every view keeps the same patches.
        mixed = np.asarray(patch, np.uint64) * np.uint64(0x9E3779B97F4A7C15)
        good &= (mixed >> np.uint64(40)).astype(np.float64) < share * 2.0**24
    value, patch, block = value[good], np.asarray(patch)[good], np.asarray(block)[good]

    # -------- pixels in order of patch and side --------
    facing = dominant_side(normal[good]).astype(np.int8)
    order = np.lexsort((facing, patch))
    radius2 = (np.zeros(len(good)) if radius2 is None else np.asarray(radius2, np.float64))[good][order]
    value, patch, block, facing = value[order], patch[order], block[order], facing[order]
    fresh = np.ones(len(patch), bool)
    fresh[1:] = (patch[1:] != patch[:-1]) | (facing[1:] != facing[:-1])
    start = np.flatnonzero(fresh)
    count = np.diff(np.r_[start, len(patch)])
    # Places of the middle half of each run, once its values are sorted.
    low, high = start + count // 4, start + count - count // 4
    member = np.cumsum(fresh) - 1

    # -------- mean of the middle half, a channel at a time --------
    out, clipped = np.full((len(start), 3), np.nan), np.zeros((len(start), 3), bool)
    for c in range(3) if len(start) else ():
        # Values sorted within each patch; differences of running sums are sums over runs.
        ordered = value[np.lexsort((value[:, c], member)), c]
        total = np.r_[0.0, np.cumsum(ordered)]
        middle = (total[high] - total[low]) / (high - low)
        quarter, three = ordered[low], ordered[high - 1]
        # A saturated lower quartile means at least three quarters of the pixels, an unsaturated upper one fewer than a quarter.
        clipped[:, c] = quarter >= saturation
        even = three - quarter <= np.maximum(evenness * middle, 1.5 / 255.0)
        out[:, c] = np.where(clipped[:, c] | (even & (three < saturation)), middle, np.nan)
    use = (count >= min_pixels) & np.isfinite(out).any(1)
    first = start[use]
    return PatchRows(
        patch[first],
        facing[first],
        block[first].astype(np.int32),
        np.full(len(first), view, np.int32),
        out[use],
        clipped[use],
        count[use].astype(np.int32),
        (np.bincount(member, radius2, len(start)) / np.maximum(count, 1))[use],
    )


def no_rows() -> PatchRows:
    """Return an empty set of rows."""
    kinds = (np.uint64, np.int8, np.int32, np.int32)
    empty = [np.zeros(0, kind) for kind in kinds]
    return PatchRows(*empty, np.zeros((0, 3)), np.zeros((0, 3), bool), np.zeros(0, np.int32), np.zeros(0))


def join_rows(parts: Sequence[PatchRows]) -> PatchRows:
    """Join the rows of all photographs; `patch` becomes a number from 0 that includes `facing`."""
    names = PatchRows.__dataclass_fields__
    rows = PatchRows(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})
    order = np.lexsort((rows.facing, rows.patch))
    fresh = np.zeros(len(order), np.int64)
    patch, facing = rows.patch[order], rows.facing[order]
    fresh[1:] = (patch[1:] != patch[:-1]) | (facing[1:] != facing[:-1])
    number = np.empty(len(order), np.uint64)
    number[order] = np.cumsum(fresh)
    return replace(rows, patch=number)
