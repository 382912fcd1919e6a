"""The published loss over all pixels, which judges every solver (lab/docs/published.md#judge): float64, one view at a time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from iif_core.errors import InputError
from iif_core.fusion.problem import LOWEST, FusionProblem, FusionResult, usable_pixels
from lab.published.fusion import divergence
from lab.published.fusion.matching import REGULARISER, identity_penalty

if TYPE_CHECKING:
    from lab.published.fusion.sgd.solve import SgdFit


_PROPERTY_OF_CHANNEL = [0, 0, 0, 1, 2]
_LOWEST = LOWEST.astype(np.float64)
_ENTRIES = 1 << 17  # (pixel, prediction) pairs in float64 at a time: about 20 MB

Corrections = tuple[NDArray, NDArray, NDArray]
"""Affine maps of albedo (S, K, 3, 4), roughness (S, K, 2) and metallic (S, K, 2); the last column is the bias."""


@dataclass(frozen=True)
class ReferenceLoss:
    """Terms of the loss (Eq. F.16), without the cross entropy of the selection (Eq. F.12).

    Attributes:
        data: mean divergence over pixels and channels (Eq. F.10).
        regulariser_albedo, regulariser_roughness, regulariser_metallic: mean over pixels and predictions of the distance
            of the maps from the identity (Eq. F.15), without the factor 100.
        total: data + 100 regularisers.
    """

    data: float
    regulariser_albedo: float
    regulariser_roughness: float
    regulariser_metallic: float
    total: float


def identity_regulariser(corrections: Corrections) -> NDArray:
    """Return the distance of every affine map from the identity, (S, K, 3) float64 (Eq. F.14)."""
    albedo, roughness, metallic = (np.asarray(c, np.float64) for c in corrections)
    return np.stack([identity_penalty(albedo), *(((c - [1.0, 0.0]) ** 2).sum(-1) for c in (roughness, metallic))], -1)


def reference_loss(
    problem: FusionProblem,
    value: NDArray,
    scale: NDArray,
    corrections: Corrections,
    weight: NDArray,
) -> ReferenceLoss:
    """Evaluate the published loss of a texture, affine maps and selection over every usable pixel (Eqs. F.1 to F.16).

    Args:
        problem: predictions on cells.
        value, scale: (n_cells, 5) location and Laplace scale of the texture.
        corrections: affine maps (albedo (S, K, 3, 4), roughness (S, K, 2), metallic (S, K, 2)).
        weight: (S, K, 3) selection weights alpha, one-hot or soft; rows of segments without pixels are not read.

    Returns:
        The terms and their sum.

    Raises:
        InputError: no usable pixel.
    """
    corrections = tuple(np.asarray(c, np.float64) for c in corrections)
    weight = np.asarray(weight, np.float64)
    distance = identity_regulariser(corrections)
    data = 0.0
    penalty = np.zeros(3)
    n_pixels = 0
    for view in range(len(problem.cell_of_pixel)):
        maps = problem.view(view)
        found = usable_pixels(problem, view, maps)
        if not len(found.pixel):
            continue
        k = np.flatnonzero(found.usable)
        step = max(1, _ENTRIES // len(k))
        for start in range(0, len(found.pixel), step):
            rows = slice(start, start + step)
            pixel, cell, segment = found.pixel[rows], found.cell[rows], found.segment[rows]
            count = np.ones(len(pixel))
            mu, b = (np.asarray(texture[cell], np.float64) for texture in (value, scale))
            corrected = _corrected(maps[k][:, pixel].astype(np.float64), corrections, segment, k)  # (k, n, 5)
            alpha = weight[segment][:, k].swapaxes(0, 1)  # (k, n, 3)
            mu_ref = (alpha[..., _PROPERTY_OF_CHANNEL] * corrected).sum(0)
            b_ref = divergence.reference_scale(mu_ref, corrected)
            data += float(count @ divergence.kl(mu_ref - mu, b_ref, b).mean(1))
            penalty += count @ distance[segment][:, k].mean(1)
            n_pixels += len(pixel)
    if not n_pixels:
        raise InputError("reference loss: no pixel has a cell, a segment, weight and finite predictions; check the problem")
    data, penalty = data / n_pixels, penalty / n_pixels
    return ReferenceLoss(data, *(float(p) for p in penalty), data + REGULARISER * float(penalty.sum()))


def loss_of_result(problem: FusionProblem, result: FusionResult | SgdFit) -> ReferenceLoss:
    """Evaluate `reference_loss` of what a solver returned, with one value per cell."""
    corrections = (result.affine_albedo, result.affine_roughness, result.affine_metallic)
    return reference_loss(problem, result.value, result.scale, corrections, result.weight)


def _corrected(values: NDArray, corrections: Corrections, segment: NDArray, k: NDArray) -> NDArray:
    """Corrected predictions (k, n, 5), clamped to [LOWEST, 1] (Eq. F.1)."""
    albedo, roughness, metallic = (c[segment][:, k].swapaxes(0, 1) for c in corrections)
    out = np.empty_like(values)
    out[..., :3] = np.einsum("knij,knj->kni", albedo[..., :3], values[..., :3]) + albedo[..., 3]
    out[..., 3] = roughness[..., 0] * values[..., 3] + roughness[..., 1]
    out[..., 4] = metallic[..., 0] * values[..., 4] + metallic[..., 1]
    return np.clip(out, _LOWEST, 1.0, out=out)
