"""The material of a surface point and the affine map that corrects it: order, limits and special values, defined once.

A material is the five linear numbers of `CHANNELS`. An affine map is sixteen numbers theta (Eq. R.14, R.15): A and b of the
albedo row by row (A00 A01 A02 b0 A10 ...), then gain and bias of roughness and of metallic. Constants are float64.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iif_core.reflectance.brdf import R_MIN

CHANNELS = ("albedo_r", "albedo_g", "albedo_b", "roughness", "metallic")
PROPERTIES = ("albedo", "roughness", "metallic")
LOWEST = np.array([0.0, 0.0, 0.0, R_MIN, 0.0])
"""Smallest value of each channel; the largest is 1."""
NEUTRAL = np.array([0.5, 0.5, 0.5, 0.9, 0.0])
"""Material of surface that nobody saw (docs/method/numerics.md#surface-that-nobody-saw)."""
MATTE_ROUGHNESS = 0.85
"""Roughness from which surface counts as matte: its lobe is so wide that photographs of a room do not show it."""
BLACK = np.array([0.0, 0.0, 0.0, 1.0, 0.0])
"""Material of emitters that were kept: what is seen of them is their emission."""

NUMBERS = 16
"""Numbers of an affine map."""
IDENTITY = np.r_[np.eye(3, 4).ravel(), 1.0, 0.0, 1.0, 0.0]
NUMBERS_OF = {"albedo": slice(0, 12), "roughness": slice(12, 14), "metallic": slice(14, 16)}
"""Property -> its numbers."""
GAINS = np.array([0, 5, 10])
BIASES = np.array([3, 7, 11])
CROSS_TERMS = np.array([1, 2, 4, 6, 8, 9])
ROUGHNESS = np.array([12, 13])
METALLIC = np.array([14, 15])


def unclamped_material(affine: NDArray, base: NDArray) -> NDArray:
    """Apply one affine map to each base value without clamping: affine (n, 16), base (n, 5) -> (n, 5)."""
    a = np.einsum("nci,ni->nc", affine[:, :12].reshape(-1, 3, 4)[:, :, :3], base[:, :3]) + affine[:, BIASES]
    r = affine[:, 12] * base[:, 3] + affine[:, 13]
    m = affine[:, 14] * base[:, 4] + affine[:, 15]
    return np.concatenate([a, r[:, None], m[:, None]], 1)


def apply_affines(affine: NDArray, object_id: NDArray, base: ArrayLike) -> NDArray:
    """Apply the (O, 16) affine maps of the objects to materials (n, 5) of the base texture (Eq. R.14); object -1 keeps the base.

    Returns (n, 5) float64: albedo and metallic within [0, 1], roughness within [0.02, 1].

    Example:
        >>> double = 2 * IDENTITY
        >>> apply_affines(double[None], np.array([0, -1]), np.array([[0.2, 0.3, 0.6, 0.3, 0.0]] * 2)).tolist()
        [[0.4, 0.6, 1.0, 0.6, 0.0], [0.2, 0.3, 0.6, 0.3, 0.0]]
    """
    own = np.broadcast_to(IDENTITY, (len(object_id), NUMBERS))
    if len(affine):
        # Object -1 reads the last row, which the condition replaces.
        own = np.where((object_id >= 0)[:, None], affine[object_id], IDENTITY)
    return np.clip(unclamped_material(own, np.asarray(base, np.float64)), LOWEST, 1.0)
