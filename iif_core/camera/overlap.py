"""Surface patches that several photographs show: what exposure and camera response are calibrated on.

A patch is a voxel of one object that faces one way. Its pixels in one photograph become one row: the mean of the
middle half of their sensor values, which next to no curve moves (quantiles pass through any rising curve). Patches
that are uneven in a photograph (texture, a shadow's edge, a highlight) are left out there: another photograph sees
another mixture of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from iif_core.errors import InputError
from iif_core.surface.cells import INDEX_LIMIT, pack_keys, voxel_indices

PATCH_FOOTPRINTS = 3.2
"""Edge of a patch in pixel footprints: some ten pixels, small enough to be even."""


@dataclass(frozen=True)
class PatchRows:
    """Patches as photographs show them; n rows, one a (patch, view).

    Attributes:
        patch: (n,) uint64 key of the patch; facing: (n,) int8 dominant axis and sign of its normal, 0 ... 5; the two
            together are the patch.
        block: (n,) int32, patches that may err together (their object).
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
        """Some of the rows."""
        return PatchRows(**{name: None if array is None else array[index] for name, array in self.__dict__.items()})


def patch_edge(footprint: float, extent: float = 0.0) -> float:
    """Edge of a patch in metres for a median pixel footprint (distance / focal length in pixels) in metres; at least what
    the numbers of a scene of `extent` metres hold."""
    if not footprint > 0:
        raise InputError(f"patches: pixel footprint {footprint} m; it must be positive")
    return max(PATCH_FOOTPRINTS * footprint, extent / (INDEX_LIMIT - 8))


def patch_numbers(points: np.ndarray, object_id: np.ndarray, edge: float, origin: np.ndarray) -> np.ndarray:
    """(n,) uint64 patch of each surface point (n, 3) in metres: its voxel and its object."""
    return pack_keys(voxel_indices(points, edge, origin), object_id)


def patch_rows(
    patch: np.ndarray,
    normal: np.ndarray,
    block: np.ndarray,
    value: np.ndarray,
    view: int,
    saturation: float = 0.99,
    min_pixels: int = 4,
    evenness: float = 0.05,
    share: float = 1.0,
    radius2: np.ndarray | None = None,
) -> PatchRows:
    """Rows of one photograph.

    Args:
        patch: (n,) uint64 of each pixel; normal: (n, 3), patches split by its dominant axis and sign.
        block: (n,) int, what a patch belongs to; value: (n, 3) sensor values; non-finite pixels are left out.
        view: number of the photograph.
        saturation: values from here on are bounds; channels between one and three quarters saturated become NaN.
        min_pixels: pixels that a row needs.
        evenness: largest interquartile range / value; one and a half 8-bit steps are always allowed.
        share: of the patches, the same ones in every view, to keep.
        radius2: (n,) squared distance of the pixels from the picture's centre (`camera_gains.radius_squared`); 0 if None.
    """
    value, normal = np.asarray(value, np.float64), np.asarray(normal)
    good = np.isfinite(value).all(1)
    if share < 1.0:
        mixed = np.asarray(patch, np.uint64) * np.uint64(0x9E3779B97F4A7C15)
        good &= (mixed >> np.uint64(40)).astype(np.float64) < share * 2.0**24
    value, patch, block, axis = value[good], np.asarray(patch)[good], np.asarray(block)[good], np.abs(normal[good]).argmax(1)
    facing = (2 * axis + (np.take_along_axis(normal[good], axis[:, None], 1)[:, 0] > 0)).astype(np.int8)
    order = np.lexsort((facing, patch))
    radius2 = (np.zeros(len(good)) if radius2 is None else np.asarray(radius2, np.float64))[good][order]
    value, patch, block, facing = value[order], patch[order], block[order], facing[order]
    fresh = np.ones(len(patch), bool)
    fresh[1:] = (patch[1:] != patch[:-1]) | (facing[1:] != facing[:-1])
    start = np.flatnonzero(fresh)
    count = np.diff(np.r_[start, len(patch)])
    low, high = start + count // 4, start + count - count // 4
    member = np.cumsum(fresh) - 1
    out, clipped = np.full((len(start), 3), np.nan), np.zeros((len(start), 3), bool)
    for c in range(3) if len(start) else ():
        ordered = value[np.lexsort((value[:, c], member)), c]
        total = np.r_[0.0, np.cumsum(ordered)]
        middle = (total[high] - total[low]) / (high - low)
        quarter, three = ordered[low], ordered[high - 1]
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
    """Nothing seen."""
    kinds = (np.uint64, np.int8, np.int32, np.int32)
    empty = [np.zeros(0, kind) for kind in kinds]
    return PatchRows(*empty, np.zeros((0, 3)), np.zeros((0, 3), bool), np.zeros(0, np.int32), np.zeros(0))


def join_rows(parts: Sequence[PatchRows]) -> PatchRows:
    """Rows of all photographs, patches numbered from 0 (`facing` is then in the number)."""
    names = PatchRows.__dataclass_fields__
    rows = PatchRows(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})
    order = np.lexsort((rows.facing, rows.patch))
    fresh = np.zeros(len(order), np.int64)
    patch, facing = rows.patch[order], rows.facing[order]
    fresh[1:] = (patch[1:] != patch[:-1]) | (facing[1:] != facing[:-1])
    number = np.empty(len(order), np.uint64)
    number[order] = np.cumsum(fresh)
    return replace(rows, patch=number)
