"""What every fusion solver reads (predictions on surface cells) and returns (a texture with its uncertainty)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from iif_core.errors import InputError
from iif_core.reflectance import material

LOWEST, NEUTRAL = np.float32(material.LOWEST), np.float32(material.NEUTRAL)
"""Smallest value of each channel, and the material of an object that no prediction shows, in single precision."""


Predictions = Callable[[int], NDArray] | Sequence[NDArray]


@dataclass(frozen=True, kw_only=True)
class FusionProblem:
    """Predictions on surface cells.

    Attributes:
        predictions: view -> (K, N, 5) or (K, H, W, 5) half or float: linear albedo R G B, perceptual roughness and
            metallic, in [0, 1]; a sequence, or a callable that is read once per sweep. Pixels that are not finite are
            left out.
        cell_of_pixel: per view (N,) or (H, W) int32, -1 = no surface.
        segment_of_pixel: per view, same shape, int32, -1 = none; a segment is one object in one view.
        n_cells: number of cells.
        object_of_cell: (n_cells,) int32.
        object_of_segment: (S,) int32.
        weight: per view, same shape, >= 0: weight w_n of a pixel (Eq. F.21), 0 = ignore; default 1.
        point: view -> (N, 3) float32 surface points of the pixels in world coordinates, m, with any value where there is
            no surface; read by textures that are functions of space.
        tangent: view -> (N, 2, 3) float32 displacement of the surface point over one pixel to the right and down, m.
        scale: view -> (N, 3) or (H, W, 3) Laplace scales > 0 that the prior states for its albedo, roughness and metallic at each
            pixel (Eq. F.62); None = it states none.
        neighbours: (m, 2) int32 pairs of neighbouring cells of one object, for closing seams between its parts.
    """

    predictions: Predictions
    cell_of_pixel: Sequence[NDArray]
    segment_of_pixel: Sequence[NDArray]
    n_cells: int
    object_of_cell: NDArray
    object_of_segment: NDArray
    weight: Sequence[NDArray] | None = None
    point: Sequence[NDArray] | Callable[[int], NDArray] | None = None
    tangent: Sequence[NDArray] | Callable[[int], NDArray] | None = None
    neighbours: NDArray | None = None
    scale: Callable[[int], NDArray | None] | None = None

    @property
    def n_segments(self) -> int:
        return len(self.object_of_segment)

    def view(self, view: int) -> NDArray:
        """Return the predictions of a view, (K, N, 5); raises InputError for another shape or an integer type."""
        maps = self.predictions(view) if callable(self.predictions) else self.predictions[view]
        if maps.ndim not in (3, 4) or maps.shape[-1] != 5 or maps.shape[0] == 0:
            raise InputError(f"predictions of view {view} have shape {maps.shape}; (K, H, W, 5) with K >= 1 is needed")
        if not np.issubdtype(maps.dtype, np.floating):
            raise InputError(f"predictions of view {view} are {maps.dtype}; half or float values in [0, 1] are needed")
        maps = maps.reshape(maps.shape[0], -1, 5)
        if maps.shape[1] != np.size(self.cell_of_pixel[view]):
            raise InputError(
                f"predictions of view {view} have {maps.shape[1]} pixels, its cell map has {np.size(self.cell_of_pixel[view])}"
            )
        return maps

    def stated_scale(self, view: int, pixel: NDArray) -> NDArray:
        """Return the scales (3, n) float32 that the prior states for the pixels (n,) of a view, (3, 0) where it states none.

        Raises:
            InputError: another shape.
        """
        scale = None if self.scale is None else self.scale(view)
        if scale is None:
            return np.zeros((3, 0), np.float32)
        if scale.shape[-1] != 3 or scale.size != 3 * np.size(self.cell_of_pixel[view]):
            raise InputError(f"scales of view {view} have shape {scale.shape}; (H, W, 3) of its cell map is needed")
        return np.ascontiguousarray(scale.reshape(-1, 3)[pixel].T, np.float32)


@dataclass(frozen=True)
class Dropped:
    """A prediction that was not used, and the reason; `k` = -1 stands for all predictions of the view."""

    view: int
    k: int
    reason: str


@dataclass(frozen=True, kw_only=True)
class FusionResult:
    """The base texture, the maps and selection that it belongs to, and what is known about its error.

    Attributes:
        value: (n_cells, 5) float32, albedo linear, within [LOWEST, 1]; cells without observations have their object's
            mean, objects without observations have `NEUTRAL`.
        scale: (n_cells, 5) float32 Laplace scale b of the cell's distribution, in units of `value` (Eq. F.31).
        uncertainty: (n_cells, 5) float32 calibrated standard deviation of the error of the location (Eq. F.45).
        observations: (n_cells,) int32 pixels; views: (n_cells,) int32 views that saw the cell.
        coverage: (n_cells,) float32 summed weight of the cell's pixels; 0 = `value` is a fill.
        part_of_cell: (n_cells,) int32 connected part of segments and cells that the cell belongs to (gauge.py), or -1.
        object_value: (O, 5) float32 mean of each object id up to the largest; object_cells: (O,) int32 its seen cells.
        weight: (S, K, 3) float32 selection weights of albedo, roughness, metallic; they sum to 1 over k, or to 0 where
            the segment has no usable pixel.
        probability: (S, K, 3) float32 share of the segment's pixels at which prediction k is the nearest to the texture
            (Eq. F.13 as the temperature goes to 0).
        margin: (S, 3) float32 how clear the selection is, 0 = a tie, 1 = one prediction fits exactly.
        effective: (S, 3) float32 effective number of predictions of the segment, 1 ... K (Eq. F.49).
        affine_albedo: (S, K, 3, 4); affine_roughness, affine_metallic: (S, K, 2) = (gain, bias); float32.
        error: (S, K, 3) float32 mean squared error of each corrected prediction against the texture, which is the one
            before the last update for least squares and the final one otherwise.
        dropped: predictions that were not used.
        history: one entry per sweep: temperature, error of each property, entropy, gain, change.
    """

    value: NDArray
    scale: NDArray
    uncertainty: NDArray
    observations: NDArray
    views: NDArray
    coverage: NDArray
    part_of_cell: NDArray
    object_value: NDArray
    object_cells: NDArray
    weight: NDArray
    probability: NDArray
    margin: NDArray
    effective: NDArray
    affine_albedo: NDArray
    affine_roughness: NDArray
    affine_metallic: NDArray
    error: NDArray
    dropped: list[Dropped]
    history: list[dict[str, float]] = field(default_factory=list)


def check_ids(problem: FusionProblem, view: int) -> None:
    """Raise InputError if a cell or segment id of a view has no row in its table."""
    for name, ids, n in (
        ("cell", problem.cell_of_pixel[view], problem.n_cells),
        ("segment", problem.segment_of_pixel[view], problem.n_segments),
    ):
        highest = int(np.max(ids, initial=-1))
        if highest >= n:
            raise InputError(f"view {view}: {name} id {highest}, but there are {n}; map and table differ")


def prediction_faults(
    maps: NDArray, finite: NDArray | None = None, counted: NDArray | None = None, not_finite_share: float = 0.01
) -> list[str]:
    """Say why each of the K predictions of a view cannot be used.

    A prediction is unusable if more than `not_finite_share` of its pixels are not finite, or if its albedo is constant
    over the picture while the albedo of another prediction is not. Both are signs that a diffusion model overflowed half
    precision (docs/method/numerics.md#half-precision-overflow).

    Args:
        maps: (K, ..., 5) predictions.
        finite: (K, pixels) bool, where all five values are finite; computed if None.
        counted: (pixels,) bool, pixels whose values matter; None = all.
        not_finite_share: largest share of counted pixels that may be not finite.

    Returns:
        K texts, "" for a prediction that can be used.
    """
    maps = maps.reshape(len(maps), -1, 5)
    finite = np.isfinite(maps).all(-1) if finite is None else finite
    relevant = finite if counted is None else finite[:, counted]
    bad_share = 1 - relevant.mean(1) if relevant.shape[1] else np.zeros(len(maps))
    spread = np.zeros(len(maps))
    for k, prediction in enumerate(maps):
        some = slice(None, None, max(1, len(prediction) // 4096))  # enough to tell a picture from a constant
        # Only a prediction that looks constant in the sample is read whole.
        for part in (some, slice(None)):
            good = prediction[part, :3][finite[k, part]].astype(np.float32)
            spread[k] = good.std(0).max() if len(good) else 0.0
            if spread[k] > 1e-2:
                break
    faults = []
    for share, std in zip(bad_share, spread, strict=True):
        if share > not_finite_share:
            faults.append(f"{100 * share:.3g} % of its pixels are not finite")
        elif std < 1e-4 and spread.max() > 1e-2:
            faults.append("albedo is constant over the picture")
        else:
            faults.append("")
    return faults


@dataclass(frozen=True)
class UsablePixels:
    """Pixels of a view with a cell, a segment, weight > 0 and finite predictions, in segment order.

    Attributes:
        pixel: (n,) index into the flattened view; cell, segment: (n,) ids; weight: (n,) float64.
        usable: (K,) bool predictions; dropped: what was left out and the reason.
    """

    pixel: NDArray
    cell: NDArray
    segment: NDArray
    weight: NDArray
    usable: NDArray
    dropped: list[Dropped]


def usable_pixels(problem: FusionProblem, view: int, maps: NDArray | None = None, finite: NDArray | None = None) -> UsablePixels:
    """Find the pixels and predictions of a view that every fusion solver uses.

    Args:
        problem: predictions on cells; view: index of the view.
        maps: `problem.view(view)`, if at hand.
        finite: (K, N) bool, all five values finite, if known.

    Returns:
        Pixels in segment order, the usable predictions and what was left out.

    Raises:
        InputError: shapes that do not match, an id beyond its table.
    """
    maps = problem.view(view) if maps is None else maps
    check_ids(problem, view)
    cell, segment = np.ravel(problem.cell_of_pixel[view]), np.ravel(problem.segment_of_pixel[view])
    weight = np.ones(len(cell)) if problem.weight is None else np.ravel(problem.weight[view]).astype(np.float64)
    good = np.stack([np.isfinite(prediction).all(-1) for prediction in maps]) if finite is None else finite
    keep = (cell >= 0) & (segment >= 0) & (weight.astype(np.float32) > 0)  # the kernels' precision
    # Values that are not finite count against a prediction only at the pixels that are kept.
    faults = prediction_faults(maps, good, keep)
    usable = np.array([not fault for fault in faults])
    dropped = [Dropped(view, k, fault) for k, fault in enumerate(faults) if fault]
    # All usable predictions of a segment are compared over the same pixels, so one bad value excludes the pixel.
    finite = good[usable].all(0)
    lost = int((keep & ~finite).sum())
    if lost and usable.any():
        dropped.append(Dropped(view, -1, f"{lost} pixels are not finite in some prediction and were left out"))
    pixel = np.flatnonzero(keep & finite) if usable.any() else np.zeros(0, np.intp)
    pixel = pixel[np.argsort(segment[pixel], kind="stable")]  # stable: picture order within a segment
    return UsablePixels(pixel, cell[pixel], segment[pixel], weight[pixel], usable, dropped)


def object_means(
    value: NDArray, object_of_cell: NDArray, weight: NDArray | None = None, n_objects: int = 0
) -> tuple[NDArray, NDArray]:
    """Average the value of every object over its cells.

    Args:
        value: (n_cells, 5); object_of_cell: (n_cells,) int >= 0.
        weight: (n_cells,) weight of each cell, 0 = not seen; None = 1.
        n_objects: smallest number of rows to return.

    Returns:
        (O, 5) float32 means and (O,) int32 numbers of cells with weight > 0; O is the largest object id + 1 or
        `n_objects`, whichever is more. Objects without such a cell get `NEUTRAL`.
    """
    weight = np.ones(len(value)) if weight is None else weight
    n_objects = max(n_objects, int(np.max(object_of_cell, initial=-1)) + 1)
    total = np.bincount(object_of_cell, weight, n_objects)
    mean = np.stack([np.bincount(object_of_cell, weight * value[:, c], n_objects) for c in range(5)], 1)
    mean = mean / np.where(total > 0, total, 1.0)[:, None]
    cells = np.bincount(object_of_cell, weight > 0, n_objects)
    return np.where((total > 0)[:, None], mean, NEUTRAL).astype(np.float32), cells.astype(np.int32)


def with_every_object(result: FusionResult, n_objects: int) -> FusionResult:
    """Return the result with `NEUTRAL` rows for objects up to `n_objects` that no prediction shows."""
    missing = max(0, n_objects - len(result.object_value))
    value = np.concatenate([result.object_value, np.tile(NEUTRAL, (missing, 1))])
    return replace(result, object_value=value, object_cells=np.pad(result.object_cells, (0, missing)))
