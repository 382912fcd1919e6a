"""Prior `retinex`: albedo from one photograph without any learned weights. A baseline, and called one.

Colour retinex (Horn 1974; Grosse et al. 2009): in the log of a linear photograph, strong steps are material and weak
ones are light. Each hypothesis keeps the steps above its threshold, drops the others, and finds the image whose
gradient is nearest to what is left (a Poisson equation with free borders, solved exactly by cosine transform). The K
hypotheses are K thresholds, from "almost everything is material" to "only strong steps are".

What is known of the mesh helps: across a border of objects every step is material, and inside an object a step where
the normal turns is light. The level of the albedo cannot be known from one photograph; it is set to a plausible mean.
Roughness and metallic are not estimated at all: they are neutral values with a small spread over the hypotheses.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .errors import InputError

THRESHOLDS = (0.02, 0.5)
"""Smallest and largest step in log luminance that counts as material."""
CHROMATICITY_SHARE = 0.2
"""A step in chromaticity counts as material from this share of the luminance threshold on: light is nearly grey."""
NORMAL_TURN = 0.95
"""Cosine below which neighbouring normals make an edge."""
DARKEST = 1e-3
"""Linear values below this are noise."""
ROUGHNESS = (0.5, 0.9)
METALLIC = (0.0, 0.1)
"""Range of the neutral values over the hypotheses."""


def retinex_predictions(
    linear: NDArray,
    samples: int,
    mean_albedo: float = 0.4,
    object_id: NDArray | None = None,
    normals: NDArray | None = None,
    valid: NDArray | None = None,
) -> NDArray:
    """K hypotheses of a view, (K, H, W, 5) float32: albedo R G B linear, perceptual roughness, metallic, in [0, 1].

    Args:
        linear: (H, W, 3) photograph proportional to radiance (sensor values through the inverse response).
        samples: K >= 1.
        mean_albedo: mean over pixels and channels that each hypothesis is scaled to, in (0, 1).
        object_id: (H, W) int, -1 = none; normals: (H, W, 3) unit; both optional.
        valid: (H, W) bool; steps to other pixels (also saturated or not-finite ones) count as light.

    Raises:
        InputError: shapes that do not match, samples < 1, mean_albedo outside (0, 1).
    """
    linear = np.asarray(linear, np.float64)
    if linear.ndim != 3 or linear.shape[-1] != 3:
        raise InputError(f"retinex prior: photograph of shape {linear.shape}; (H, W, 3) is needed")
    shape = linear.shape[:2]
    for name, array in (("object ids", object_id), ("normals", normals), ("valid", valid)):
        if array is not None and np.shape(array)[:2] != shape:
            raise InputError(f"retinex prior: {name} of shape {np.shape(array)} for a photograph of {shape}")
    if samples < 1 or not 0 < mean_albedo < 1:
        raise InputError(f"retinex prior: samples {samples} (at least 1), mean_albedo {mean_albedo} (between 0 and 1)")
    known = np.isfinite(linear).all(-1) & (True if valid is None else np.asarray(valid, bool))
    log = np.log(np.maximum(np.where(known[..., None], linear, DARKEST), DARKEST))
    steps = [_Steps(log, axis, known, object_id, normals) for axis in (0, 1)]
    spread = np.linspace(0, 1, samples) if samples > 1 else np.array([0.5])
    out = np.empty((samples, *shape, 5), np.float32)
    for k, s in enumerate(spread):
        threshold = THRESHOLDS[0] * (THRESHOLDS[1] / THRESHOLDS[0]) ** s
        reflectance = _integrated([step.material(threshold) for step in steps], shape)
        out[k, ..., :3] = _scaled(np.exp(reflectance), known, mean_albedo)
        out[k, ..., 3] = ROUGHNESS[0] + (ROUGHNESS[1] - ROUGHNESS[0]) * s
        out[k, ..., 4] = METALLIC[0] + (METALLIC[1] - METALLIC[0]) * s
    return out


class _Steps:
    """Differences between neighbours along one axis, and what is known about them."""

    def __init__(self, log: NDArray, axis: int, known: NDArray, object_id: NDArray | None, normals: NDArray | None):
        self.difference = np.diff(log, axis=axis)
        self.luminance = self.difference.mean(-1)
        self.chromaticity = np.abs(self.difference - self.luminance[..., None]).max(-1)
        first, second = (np.take(np.arange(log.shape[axis]), np.arange(n, log.shape[axis] - 1 + n)) for n in (0, 1))

        def pair(array: NDArray) -> tuple[NDArray, NDArray]:
            return np.take(array, first, axis), np.take(array, second, axis)

        a, b = pair(known)
        self.usable = a & b
        self.border = np.zeros(self.luminance.shape, bool)
        self.turn = np.zeros(self.luminance.shape, bool)
        if object_id is not None:
            a, b = pair(np.asarray(object_id))
            self.border = a != b
        if normals is not None:
            a, b = pair(np.asarray(normals, np.float64))
            self.turn = (a * b).sum(-1) < NORMAL_TURN

    def material(self, threshold: float) -> NDArray:
        """(.., 3) steps of the log reflectance: all channels where it is material, none where it is light."""
        strong = (np.abs(self.luminance) > threshold) | (self.chromaticity > CHROMATICITY_SHARE * threshold)
        grey_turn = self.turn & (self.chromaticity <= CHROMATICITY_SHARE * THRESHOLDS[1])
        kept = self.usable & (self.border | (strong & ~grey_turn))
        return np.where(kept[..., None], self.difference, 0.0)


def _integrated(steps: list[NDArray], shape: tuple[int, ...]) -> NDArray:
    """(H, W, 3) image of mean 0 whose differences are nearest to `steps` = [vertical, horizontal] (least squares).

    The normal equations are a Poisson equation with Neumann borders; the cosine transform makes them diagonal.
    """
    from scipy.fft import dctn, idctn

    divergence = np.zeros((*shape, 3))
    divergence[:-1] -= steps[0]
    divergence[1:] += steps[0]
    divergence[:, :-1] -= steps[1]
    divergence[:, 1:] += steps[1]
    y, x = (2 - 2 * np.cos(np.pi * np.arange(n) / n) for n in shape)
    eigenvalue = y[:, None] + x[None, :]
    eigenvalue[0, 0] = 1.0  # the mean is free; its right-hand side is 0
    return idctn(dctn(divergence, axes=(0, 1)) / eigenvalue[..., None], axes=(0, 1))


def _scaled(reflectance: NDArray, known: NDArray, mean_albedo: float) -> NDArray:
    """Gain that gives the wanted mean after clipping at 1, by bisection (the mean grows with the gain)."""
    values = reflectance[known] if known.any() else reflectance.reshape(-1, 3)
    if not values.size:
        return reflectance
    low, high = 0.0, 2 * mean_albedo / max(values.min(), 1e-6)
    for _ in range(60):
        middle = 0.5 * (low + high)
        if np.minimum(values * middle, 1).mean() < mean_albedo:
            low = middle
        else:
            high = middle
    return np.clip(reflectance * high, 0, 1)
