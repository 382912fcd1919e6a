"""Size, weight and displacement of the pixels of a photograph on the surface."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

FOOTPRINT_WEIGHTS = (0.05, 4.0)
"""Smallest and largest factor of the footprint on the weight of a pixel (Eq. F.21)."""
MAX_STEP = 5.0
"""Longest displacement on the surface over one pixel, in displacements perpendicular to the line of sight."""


def relative_footprints(views: Iterable[tuple[NDArray, NDArray, NDArray, float]]) -> list[NDArray]:
    """Return per view the size (H, W) of each pixel on the surface relative to the median of all; 1 without surface (Eq. F.20).

    A view is z-depth (H, W) in m (0 = none), viewing directions and unit normals (H, W, 3), and the focal length in pixels.
    """
    sizes = []
    for depth, direction, normal, focal in views:
        # `direction` is not of unit length; the normals are.
        cosine = np.abs(np.einsum("hwi,hwi->hw", direction, normal)) / np.linalg.norm(direction, axis=-1)
        # The footprint of a slanted pixel is 1 / cos times as large, so its mean side grows with the root. The floor keeps
        # surface that is seen edge-on finite. NaN leaves the median to pixels with surface.
        sizes.append(np.where(depth > 0, depth, np.nan) / focal / np.sqrt(np.maximum(cosine, 1e-3)))
    median = np.nanmedian(np.concatenate([size.ravel() for size in sizes]))
    return [np.nan_to_num(size / median, nan=1.0) for size in sizes]


def pixel_weights(
    interior: NDArray, valid: NDArray, border_weight: float, footprint: NDArray | None = None, power: float = 0.0
) -> NDArray:
    """Return the weights of the pixels of a view (Eq. F.21).

    Args:
        interior: (H, W) bool, pixels that do not touch another object; valid: (H, W) bool, pixels that the photograph shows.
        border_weight: weight of the other pixels, in (0, 1].
        footprint: (H, W) relative footprints, None = do not weigh by them; power: exponent on their inverse.

    Returns:
        (H, W) float32.

    Example:
        >>> pixel_weights(np.array([[True, False]]), np.array([[True, True]]), 0.25).tolist()
        [[1.0, 0.25]]
    """
    weight = np.where(interior, 1.0, border_weight) * valid
    if footprint is not None:
        weight *= np.clip(footprint**-power, *FOOTPRINT_WEIGHTS)
    return weight.astype(np.float32)


def surface_tangents(depth: NDArray, direction: NDArray, normal: NDArray) -> NDArray:
    """Return the displacement (H, W, 2, 3) float32 in m of the surface point over one pixel right and down, in its plane (Eq.
    F.60).

    With point = camera + depth * direction; at grazing angles limited to `MAX_STEP` times that across the line of sight, 0 where
    there is no surface.
    """
    direction = direction.astype(np.float64)
    across = np.einsum("hwi,hwi->hw", normal, direction)
    out = np.empty((*depth.shape, 2, 3), np.float32)
    for axis in range(2):
        # Directions of a pinhole camera are affine in the pixel, so these differences are exact: (H, W, 3) for one pixel.
        change = np.gradient(direction, axis=1 - axis)
        # Moving along the ray by this much brings the displaced point back into the plane of the face.
        slide = np.einsum("hwi,hwi->hw", normal, change) / np.where(across == 0, 1e-12, across)
        moved = change - direction * slide[..., None]
        # Edge-on, `slide` has no bound, and the displacement would leave the face.
        length, limit = np.linalg.norm(moved, axis=-1), MAX_STEP * np.linalg.norm(change, axis=-1)
        moved *= np.minimum(1, limit / np.maximum(length, 1e-20))[..., None]
        out[..., axis, :] = np.where(depth > 0, depth, 0)[..., None] * moved
    return out
