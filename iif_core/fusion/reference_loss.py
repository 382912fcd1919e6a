"""The published loss over all pixels, which judges every solver (docs/method/fusion.md#judge).

Plain NumPy in float64, one view at a time. Solvers that minimise something else (the direct one) or draw batches (the
paper's optimiser) are compared by this number.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from iif_core.errors import InputError
from iif_core.fusion.matching import REGULARISER, identity_penalty
from iif_core.fusion.problem import LOWEST, FusionProblem, FusionResult, usable_pixels
from iif_core.numerics import laplace

if TYPE_CHECKING:
    from iif_core.fusion.sgd.solve import SgdFit


_PROPERTY_OF_CHANNEL = [0, 0, 0, 1, 2]
_LOWEST = LOWEST.astype(np.float64)
_ENTRIES = 1 << 17  # (pixel, prediction) pairs in float64 at a time: about 20 MB

Corrections = tuple[NDArray, NDArray, NDArray]
"""Affine maps of albedo (S, K, 3, 4), roughness (S, K, 2) and metallic (S, K, 2); the last column is the bias."""
Texture = NDArray | Callable[[int], NDArray]
"""(n_cells, 5), or a callable view -> (N, 5) for textures that are not one value per cell."""


@dataclass(frozen=True)
class ReferenceLoss:
    """Terms of the loss (Eq. F.16).

    Attributes:
        data: mean divergence over pixels and channels (Eq. F.10).
        label: cross entropy of the selection (Eq. F.12), None if it was not asked for.
        regulariser_albedo, regulariser_roughness, regulariser_metallic: mean over pixels and predictions of the distance
            of the maps from the identity (Eq. F.15), without the factor 100.
        total: data + label + 100 regularisers; n_pixels: number of pixels.
    """

    data: float
    label: float | None
    regulariser_albedo: float
    regulariser_roughness: float
    regulariser_metallic: float
    total: float
    n_pixels: int


def identity_regulariser(corrections: Corrections) -> NDArray:
    """Return the distance of every affine map from the identity, (S, K, 3) float64 (Eq. F.14)."""
    albedo, roughness, metallic = (np.asarray(c, np.float64) for c in corrections)
    return np.stack([identity_penalty(albedo), *(((c - [1.0, 0.0]) ** 2).sum(-1) for c in (roughness, metallic))], -1)


def reference_loss(
    problem: FusionProblem,
    value: Texture,
    scale: Texture,
    corrections: Corrections,
    weight: NDArray,
    *,
    weighted: bool = False,
    log_weight: NDArray | None = None,
    temperature: float | None = None,
    regulariser: float = REGULARISER,
    floor: float = laplace.SCALE_FLOOR,
) -> ReferenceLoss:
    """Evaluate the published loss of a texture, affine maps and selection over every usable pixel (Eqs. F.1 to F.16).

    Args:
        problem: predictions on cells.
        value, scale: location and Laplace scale of the texture, (n_cells, 5) or view -> (N, 5).
        corrections: affine maps (albedo (S, K, 3, 4), roughness (S, K, 2), metallic (S, K, 2)).
        weight: (S, K, 3) selection weights alpha, one-hot or soft; rows of segments without pixels are not read.
        weighted: pixels count by `problem.weight` instead of 1 each, as they do in the paper.
        log_weight: (S, K, 3) log alpha, for the label loss, which is infinite where alpha is 0 and q of Eq. F.11 is not
            (docs/method/numerics.md#cold-temperatures); None = no label loss.
        temperature: of the errors in the label loss, together with `log_weight`.
        floor: smallest Laplace scale; regulariser: factor on the regulariser.

    Returns:
        The terms and their sum.

    Raises:
        InputError: arrays that do not fit the problem; no usable pixel.
    """
    corrections = tuple(np.asarray(c, np.float64) for c in corrections)
    weight = np.asarray(weight, np.float64)
    _check(problem, value, scale, corrections, weight, log_weight, temperature)
    distance = identity_regulariser(corrections)
    data = label = total_weight = 0.0
    penalty = np.zeros(3)
    n_pixels = 0
    for view in range(len(problem.cell_of_pixel)):
        maps = problem.view(view)
        if len(maps) != weight.shape[1]:
            raise InputError(f"view {view} has {len(maps)} predictions, the selection weights {weight.shape[1]}; give the same")
        found = usable_pixels(problem, view, maps)
        if not len(found.pixel):
            continue
        mu_view, b_view = (texture(view) if callable(texture) else None for texture in (value, scale))
        k = np.flatnonzero(found.usable)
        step = max(1, _ENTRIES // len(k))
        for start in range(0, len(found.pixel), step):
            rows = slice(start, start + step)
            pixel, cell, segment = found.pixel[rows], found.cell[rows], found.segment[rows]
            count = found.weight[rows] if weighted else np.ones(len(pixel))
            mu, b = (
                np.asarray(whole[cell] if at is None else at[pixel], np.float64)
                for whole, at in ((value, mu_view), (scale, b_view))
            )
            corrected = _corrected(maps[k][:, pixel].astype(np.float64), corrections, segment, k)  # (k, n, 5)
            alpha = weight[segment][:, k].swapaxes(0, 1)  # (k, n, 3)
            mu_ref = (alpha[..., _PROPERTY_OF_CHANNEL] * corrected).sum(0)
            b_ref = laplace.reference_scale(mu_ref, corrected, floor)
            data += float(count @ laplace.kl(mu_ref - mu, b_ref, b, floor).mean(1))
            penalty += count @ distance[segment][:, k].mean(1)
            if log_weight is not None:
                label += _label(np.abs(corrected - mu), np.asarray(log_weight)[segment][:, k], temperature, count)
            total_weight += float(count.sum())
            n_pixels += len(pixel)
    if not n_pixels:
        raise InputError("reference loss: no pixel has a cell, a segment, weight and finite predictions; check the problem")
    data, penalty = data / total_weight, penalty / total_weight
    label = label / total_weight if log_weight is not None else None
    total = data + (label or 0.0) + regulariser * float(penalty.sum())
    return ReferenceLoss(data, label, *(float(p) for p in penalty), total, n_pixels)


def loss_of_result(problem: FusionProblem, result: FusionResult | SgdFit, *, weighted: bool = False) -> ReferenceLoss:
    """Evaluate `reference_loss` of what a solver returned, with one value per cell."""
    corrections = (result.affine_albedo, result.affine_roughness, result.affine_metallic)
    return reference_loss(problem, result.value, result.scale, corrections, result.weight, weighted=weighted)


def _check(
    problem: FusionProblem,
    value: Texture,
    scale: Texture,
    corrections: Corrections,
    weight: NDArray,
    log_weight: NDArray | None,
    temperature: float | None,
) -> None:
    for name, texture in (("value", value), ("scale", scale)):
        if not callable(texture) and np.shape(texture) != (problem.n_cells, 5):
            raise InputError(f"{name} of the texture has shape {np.shape(texture)}; needed is ({problem.n_cells}, 5)")
    if weight.ndim != 3 or weight.shape[::2] != (problem.n_segments, 3):
        raise InputError(f"selection weights have shape {weight.shape}; needed is ({problem.n_segments}, K, 3)")
    for name, array, shape in zip(("albedo", "roughness", "metallic"), corrections, ((3, 4), (2,), (2,)), strict=True):
        if array.shape != (*weight.shape[:2], *shape):
            raise InputError(f"corrections of {name} have shape {array.shape}; needed is {(*weight.shape[:2], *shape)}")
    if (log_weight is None) != (temperature is None):
        raise InputError("the label loss needs log_weight and temperature, both or neither")
    if log_weight is not None and (np.shape(log_weight) != weight.shape or not temperature > 0):
        raise InputError(
            f"label loss: log_weight {np.shape(log_weight)}, temperature {temperature}; needed are {weight.shape} and > 0"
        )


def _corrected(values: NDArray, corrections: Corrections, segment: NDArray, k: NDArray) -> NDArray:
    """Corrected predictions (k, n, 5), clamped to [LOWEST, 1] (Eq. F.1)."""
    albedo, roughness, metallic = (c[segment][:, k].swapaxes(0, 1) for c in corrections)
    out = np.empty_like(values)
    out[..., :3] = np.einsum("knij,knj->kni", albedo[..., :3], values[..., :3]) + albedo[..., 3]
    out[..., 3] = roughness[..., 0] * values[..., 3] + roughness[..., 1]
    out[..., 4] = metallic[..., 0] * values[..., 4] + metallic[..., 1]
    return np.clip(out, _LOWEST, 1.0, out=out)


def _label(error: NDArray, log_weight: NDArray, temperature: float, count: NDArray) -> float:
    """Label loss summed over pixels; `error` (k, n, 5), `log_weight` (n, k, 3)."""
    e = np.stack([error[..., :3].mean(-1), error[..., 3], error[..., 4]], -1)
    q = np.exp(-(e - e.min(0)) / temperature)
    q /= q.sum(0)
    part = np.where(q > 0, q * log_weight.swapaxes(0, 1), 0.0)  # 0 log 0 = 0
    return float(-(count @ part.sum((0, 2))) / 3)
