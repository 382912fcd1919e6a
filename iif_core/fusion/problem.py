"""What every base solver reads and returns: predictions on surface cells in, a texture with its uncertainty out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from iif_core.errors import InputError

CHANNELS = ("albedo_r", "albedo_g", "albedo_b", "roughness", "metallic")
PROPERTIES = ("albedo", "roughness", "metallic")
LOWEST = np.float32([0, 0, 0, 0.02, 0])
"""Smallest value of each channel; the largest is 1."""
NEUTRAL = np.float32([0.5, 0.5, 0.5, 0.9, 0.0])
"""Material of surface that no prediction shows (METHOD H40)."""


Predictions = Callable[[int], NDArray] | Sequence[NDArray]


@dataclass(frozen=True)
class BaseProblem:
    """Predictions on surface cells; what every base solver reads.

    Attributes:
        predictions: view -> (K, N, 5) or (K, H, W, 5) half or float: albedo R G B linear, perceptual roughness,
            metallic, in [0, 1]; a sequence or a callable (then read once a sweep). Not-finite values are dropped.
        cell_of_pixel: per view (N,) or (H, W) int32, -1 = no surface.
        segment_of_pixel: per view, same shape, int32, -1 = none; a segment lies in one view.
        n_cells: number of cells.
        object_of_cell: (n_cells,) int32.
        object_of_segment: (S,) int32.
        weight: per view, same shape, >= 0: how much a pixel counts (low near object borders, 0 = ignore); default 1.
        point: view -> (N, 3) float32 surface points of the pixels in world coordinates, m; textures that are functions of
            space read them, any value where there is no surface.
        neighbours: (m, 2) int32 pairs of neighbouring cells of one object, for closing seams between its parts.
        tangent: view -> (N, 2, 3) float32 how the surface point moves over one pixel to the right and down, m.
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

    @property
    def n_segments(self) -> int:
        return len(self.object_of_segment)

    def view(self, view: int) -> NDArray:
        """Predictions of a view, (K, N, 5)."""
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


@dataclass(frozen=True)
class Dropped:
    """A prediction that was not used, and why; `k` = -1: the whole view."""

    view: int
    k: int
    reason: str


@dataclass(frozen=True)
class BaseResult:
    """The base texture and how it came about.

    Attributes:
        value: (n_cells, 5) float32, albedo linear, within [LOWEST, 1]; cells nobody saw have their object's mean,
            objects nobody saw `NEUTRAL`.
        scale: (n_cells, 5) float32 Laplace scale b of the cell's distribution, same units (METHOD 2.3.4).
        uncertainty: (n_cells, 5) float32 standard deviation of the location's error, calibrated (uncertainty.py).
        observations: (n_cells,) int32 pixels; views: (n_cells,) int32 views that saw the cell.
        coverage: (n_cells,) float32 pixels weighted by how well they see the cell; 0 = `value` is a fill.
        part_of_cell: (n_cells,) int32 part that the cell hangs together with through shared cells (gauge.py), or -1.
        object_value: (O, 5) float32 mean of each object id up to the largest; object_cells: (O,) int32 cells behind it.
        weight: (S, K, 3) float32 selection weights of albedo, roughness, metallic; sum over k is 1 (0 where the
            segment has no usable pixel).
        probability: (S, K, 3) float32 share of the segment's pixels at which prediction k is the nearest to the texture:
            the stationary point of the paper's label loss as its temperature goes to 0 (METHOD 2.3.8).
        margin: (S, 3) float32 how clear the selection is, 0 = a tie, 1 = one prediction fits exactly.
        effective: (S, 3) float32 exp(entropy of `probability`): how many predictions share the segment, 1 ... K.
        affine_albedo: (S, K, 3, 4); affine_roughness, affine_metallic: (S, K, 2) = (gain, bias); float32.
        error: (S, K, 3) float32 mean squared error of each corrected prediction against the texture before the last
            update.
        dropped: predictions that were not used.
        history: one entry a sweep: temperature, error of each property, entropy, gain, change.
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


def one_segment_per_view(problem: BaseProblem) -> BaseProblem:
    """The same predictions with one correction an image instead of one an object and image (the paper's ablation)."""
    segments = [
        np.where(np.asarray(segment) >= 0, view, -1).astype(np.int32) for view, segment in enumerate(problem.segment_of_pixel)
    ]
    return replace(problem, segment_of_pixel=segments, object_of_segment=np.full(len(segments), -1, np.int32))


def check_ids(problem: BaseProblem, view: int) -> None:
    """Raise InputError where a cell or segment id of a view has no row in its table."""
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
    """Why each of the K predictions of a view cannot be used; "" for those that can.

    `maps` (K, ..., 5); `finite` (K, pixels) bool where it is known already; `counted` (pixels,) bool: pixels whose values
    matter (default all). Faults (METHOD H51, half-precision overflow
    of a diffusion model): more than `not_finite_share` of the pixels not finite; albedo constant over the picture while
    that of another prediction is not.
    """
    maps = maps.reshape(len(maps), -1, 5)
    finite = np.isfinite(maps).all(-1) if finite is None else finite
    relevant = finite if counted is None else finite[:, counted]
    bad_share = 1 - relevant.mean(1) if relevant.shape[1] else np.zeros(len(maps))
    spread = np.zeros(len(maps))
    for k, prediction in enumerate(maps):
        some = slice(None, None, max(1, len(prediction) // 4096))  # enough to tell a picture from a constant
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

    pixel: (n,) index into the flattened view; cell, segment (n,); weight (n,) float64; usable (K,) predictions;
    dropped: what was left out and why.
    """

    pixel: NDArray
    cell: NDArray
    segment: NDArray
    weight: NDArray
    usable: NDArray
    dropped: list[Dropped]


def usable_pixels(problem: BaseProblem, view: int, maps: NDArray | None = None, finite: NDArray | None = None) -> UsablePixels:
    """The pixels and predictions of a view that every base solver uses.

    `maps`: problem.view(view), if at hand; `finite` (K, N) bool, all five values finite, if known.

    Raises:
        InputError: shapes that do not match, an id beyond its table.
    """
    maps = problem.view(view) if maps is None else maps
    check_ids(problem, view)
    cell, segment = np.ravel(problem.cell_of_pixel[view]), np.ravel(problem.segment_of_pixel[view])
    weight = np.ones(len(cell)) if problem.weight is None else np.ravel(problem.weight[view]).astype(np.float64)
    good = np.stack([np.isfinite(prediction).all(-1) for prediction in maps]) if finite is None else finite
    keep = (cell >= 0) & (segment >= 0) & (weight.astype(np.float32) > 0)  # the kernels' precision
    faults = prediction_faults(maps, good, keep)
    usable = np.array([not fault for fault in faults])
    dropped = [Dropped(view, k, fault) for k, fault in enumerate(faults) if fault]
    finite = good[usable].all(0)
    lost = int((keep & ~finite).sum())
    if lost and usable.any():
        dropped.append(Dropped(view, -1, f"{lost} pixels are not finite in some prediction and were left out"))
    pixel = np.flatnonzero(keep & finite) if usable.any() else np.zeros(0, np.intp)
    pixel = pixel[np.argsort(segment[pixel], kind="stable")]
    return UsablePixels(pixel, cell[pixel], segment[pixel], weight[pixel], usable, dropped)


def object_means(
    value: NDArray, object_of_cell: NDArray, weight: NDArray | None = None, n_objects: int = 0
) -> tuple[NDArray, NDArray]:
    """Mean value of every object and the cells behind it: (O, 5) float32, (O,) int32.

    O is the largest object id + 1, or `n_objects` if that is more. `weight` (n_cells,): pixels (0 = not seen, does not
    count). Objects without a cell that counts get `NEUTRAL`: albedo 0.5, roughness 0.9, metallic 0.
    """
    weight = np.ones(len(value)) if weight is None else weight
    n_objects = max(n_objects, int(np.max(object_of_cell, initial=-1)) + 1)
    total = np.bincount(object_of_cell, weight, n_objects)
    mean = np.stack([np.bincount(object_of_cell, weight * value[:, c], n_objects) for c in range(5)], 1)
    mean = mean / np.where(total > 0, total, 1.0)[:, None]
    cells = np.bincount(object_of_cell, weight > 0, n_objects)
    return np.where((total > 0)[:, None], mean, NEUTRAL).astype(np.float32), cells.astype(np.int32)
