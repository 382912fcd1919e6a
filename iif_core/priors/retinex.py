"""Prior `retinex`: albedo from the photographs and the mesh alone, without learned weights (docs/method/priors.md#retinex).

The estimated light is divided out; colour retinex (Horn 1974; Grosse et al. 2009) parts what is left into material and light
(Eq. P.14). Roughness and metallic are not estimated but drawn once per object and hypothesis from a weak prior.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from iif_core.errors import InputError

THRESHOLDS = (0.05, 0.5)
"""Smallest and largest threshold of a material step, in log luminance (Eq. P.13)."""
CHROMATICITY_SHARE = 0.2
"""Threshold of a step in chromaticity, as a share of that in luminance; light is nearly grey (Eq. P.11)."""
NORMAL_TURN = 0.95
"""Cosine between neighbouring normals below which the surface turns."""
DARKEST = 4e-3
"""Linear sensor value below which a pixel is only noise."""
STAY_WEIGHT = 0.005
"""Weight of the image against its gradient; changes over more than 1 / sqrt(STAY_WEIGHT) = 14 pixels are kept."""
ALBEDO = (0.01, 1.0)
"""Range of albedo in rooms; values outside come from gloss, noise or emitters."""
BRIGHT, BRIGHT_SHARE = 0.9, 0.03
"""Albedo is scaled so that at most the share BRIGHT_SHARE of the pixels exceeds BRIGHT (Eq. P.16)."""
ROUGHNESS, METALLIC = (0.65, 0.15), (0.0, 0.1)
"""Mean and standard deviation of the drawn roughness, clamped to [0.2, 1]; range of the drawn metallic."""


def retinex_predictions(
    linear: NDArray,
    samples: int,
    mean_albedo: float = 0.4,
    object_id: NDArray | None = None,
    normals: NDArray | None = None,
    valid: NDArray | None = None,
    light: NDArray | None = None,
    seed: int = 0,
) -> NDArray:
    """Predict K hypotheses of a view.

    Args:
        linear: (H, W, 3) photograph proportional to radiance.
        samples: K >= 1.
        mean_albedo: mean over pixels and channels of each hypothesis, in (0, 1); used without `light` only.
        object_id: (H, W) int, -1 = none; normals: (H, W, 3) unit vectors.
        valid: (H, W) bool; steps at other pixels count as light.
        light: (m, H, W, 3) finite logarithms of the light, used in turn: linear / exp(light) is the albedo. If None, the
            light is constant and the level of the albedo is `mean_albedo`.
        seed: of the drawn roughness and metallic.

    Returns:
        (K, H, W, 5) float32: linear albedo, perceptual roughness, metallic, in [0, 1].

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
    if light is not None and np.shape(light)[1:] != linear.shape:
        raise InputError(f"retinex prior: light of shape {np.shape(light)} for a photograph of {linear.shape}")
    if samples < 1 or not 0 < mean_albedo < 1:
        raise InputError(f"retinex prior: samples {samples} (at least 1), mean_albedo {mean_albedo} (between 0 and 1)")
    # -------- log radiance (H, W, 3); a pixel that does not count has the floor, and its steps are never material --------
    known = np.isfinite(linear).all(-1) & (True if valid is None else np.asarray(valid, bool))
    log = np.log(np.maximum(np.where(known[..., None], linear, DARKEST), DARKEST))
    spread = np.linspace(0, 1, samples) if samples > 1 else np.array([0.5])  # exponent of Eq. P.13
    out = np.empty((samples, *shape, 5), np.float32)
    stay = 0.0 if light is None else STAY_WEIGHT  # without an estimate of the light, slow changes are light
    lights = np.zeros((1, *linear.shape)) if light is None else np.asarray(light, np.float64)
    # -------- prediction k divides by light k mod m; its steps are found once for all thresholds --------
    for number, own in enumerate(lights[:samples]):
        image = log - own
        if light is not None:
            image = np.clip(image, *np.log(ALBEDO))  # Eq. P.10
        steps = [_Steps(image, axis, known, object_id, normals) for axis in (0, 1)]
        for k in range(number, samples, len(lights)):
            threshold = THRESHOLDS[0] * (THRESHOLDS[1] / THRESHOLDS[0]) ** spread[k]
            albedo = np.exp(_integrated([step.material(threshold) for step in steps], image, stay))
            out[k, ..., :3] = _scaled(albedo, known, mean_albedo) if light is None else np.clip(albedo, *ALBEDO)
    out[..., 3:] = _draws(shape, samples, object_id, seed)
    return out


def albedo_level(albedo: NDArray, weight: NDArray, mean_albedo: float) -> float:
    """Compute the gain that gives albedos (n, 3) with weights (n,) the wanted mean (Eq. P.16).

    The gain is smaller where more than BRIGHT_SHARE of the weight would exceed BRIGHT, since clipping at 1 removes texture.
    """
    total = float(np.sum(weight))
    if not total > 0:
        return 1.0
    mean = float(albedo.mean(-1) @ weight) / total
    order = np.argsort(albedo.max(-1), kind="stable")
    # Weighted quantile 1 - BRIGHT_SHARE of the brightest channel.
    place = min(int(np.searchsorted(np.cumsum(weight[order]), (1 - BRIGHT_SHARE) * total)), len(order) - 1)
    return min(mean_albedo / max(mean, 1e-9), BRIGHT / max(float(albedo.max(-1)[order[place]]), 1e-9))


def _draws(shape: tuple[int, int], samples: int, object_id: NDArray | None, seed: int) -> NDArray:
    """Draw roughness and metallic (K, H, W, 2), once per object and hypothesis, equal in all views."""
    ids = np.full(shape, -1) if object_id is None else np.asarray(object_id)
    out = np.empty((samples, *shape, 2), np.float32)
    objects, row = np.unique(ids, return_inverse=True)
    draws = np.empty((len(objects), samples, 2))
    for i, o in enumerate(objects):
        # The object is part of the seed, so an object draws the same in all views. 0x726574 spells "ret" and keeps these draws
        # apart from others with the same seed.
        rng = np.random.default_rng([seed, 0x726574, int(o) + 1])
        draws[i, :, 0] = np.clip(ROUGHNESS[0] + ROUGHNESS[1] * rng.standard_normal(samples), 0.2, 1)
        draws[i, :, 1] = METALLIC[0] + (METALLIC[1] - METALLIC[0]) * rng.random(samples)
    for k in range(samples):
        out[k] = draws[:, k][row.reshape(shape)]
    return out


class _Steps:
    """Differences between neighbouring pixels along one axis, and which of them may be material."""

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
        """Steps (.., 3) of the log reflectance: the whole difference where it is material, 0 where it is light (Eq. P.12)."""
        strong = (np.abs(self.luminance) > threshold) | (self.chromaticity > CHROMATICITY_SHARE * threshold)
        # The limit is that for the largest threshold in every hypothesis: where surface turns, only a clear change of colour is
        # material.
        grey_turn = self.turn & (self.chromaticity <= CHROMATICITY_SHARE * THRESHOLDS[1])
        kept = self.usable & (self.border | (strong & ~grey_turn))
        return np.where(kept[..., None], self.difference, 0.0)


def _integrated(steps: list[NDArray], image: NDArray, stay: float) -> NDArray:
    """Solve Eq. P.14 by the cosine transform (Eq. P.15): (H, W, 3). With weight 0 the result has the mean of `image`.

    `steps` holds the vertical and the horizontal steps, `stay` is the weight of the image.
    """
    from scipy.fft import dctn, idctn

    # -------- right-hand side of the normal equations: h y plus the negative divergence of the steps --------
    # The step s from pixel i to i + 1 adds -s to the equation of i and +s to the equation of i + 1.
    right = stay * image
    right[:-1] -= steps[0]
    right[1:] += steps[0]
    right[:, :-1] -= steps[1]
    right[:, 1:] += steps[1]
    # -------- eigenvalues of the second difference with free borders, in the basis of the cosine transform (Eq. P.15) --------
    y, x = (2 - 2 * np.cos(np.pi * np.arange(n) / n) for n in image.shape[:2])
    eigenvalue = y[:, None] + x[None, :] + stay
    if stay == 0:
        eigenvalue[0, 0] = 1.0  # the mean is free; its right-hand side is 0
    out = idctn(dctn(right, axes=(0, 1)) / eigenvalue[..., None], axes=(0, 1))
    return out if stay > 0 else out + image.mean((0, 1))


def _scaled(reflectance: NDArray, known: NDArray, mean_albedo: float) -> NDArray:
    """Scale to the wanted mean after clipping at 1, by bisection."""
    values = reflectance[known] if known.any() else reflectance.reshape(-1, 3)
    if not values.size:
        return reflectance
    # The mean after clipping grows with the gain. At `high` the darkest value reaches twice the wanted mean, or 1, so the answer
    # lies between.
    low, high = 0.0, 2 * mean_albedo / max(values.min(), 1e-6)
    for _ in range(60):  # more halvings than double precision has bits
        middle = 0.5 * (low + high)
        if np.minimum(values * middle, 1).mean() < mean_albedo:
            low = middle
        else:
            high = middle
    return np.clip(reflectance * high, 0, 1)
