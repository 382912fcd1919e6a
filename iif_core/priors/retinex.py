"""Prior `retinex`: albedo without any learned weights. A baseline, and called one.

Two steps. The light that arrives at every piece of surface is gathered from what all photographs show of everything that the
surface sees (iif_core.light.irradiance), and divided out. What it leaves (fine shadows, gloss, errors of the mesh) is judged by
colour retinex (Horn 1974; Grosse et al. 2009): in the log of the image strong steps are material and weak ones are light.
Each hypothesis keeps the steps above its threshold, drops the others, and finds the image whose gradient is nearest to what
is left, held weakly at the image it came from (a screened Poisson equation with free borders, solved exactly by cosine
transform):

    min_a  sum |grad a - kept steps|^2 + HOLD sum |a - log(L / light)|^2.

The K hypotheses are K thresholds, from "almost everything is material" to "only strong steps are", in turn with the light
resolved finely and coarsely.

What is known of the mesh helps: across a border of objects every step is material, and inside an object a step where the
normal turns is light. Roughness and metallic are not estimated at all: they are draws, one an object and hypothesis, of a
weak prior (most things in rooms are rough and none a metal).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from iif_core.errors import InputError

THRESHOLDS = (0.05, 0.5)
"""Smallest and largest step in log luminance that counts as material."""
CHROMATICITY_SHARE = 0.2
"""A step in chromaticity counts as material from this share of the luminance threshold on: light is nearly grey."""
NORMAL_TURN = 0.95
"""Cosine below which neighbouring normals make an edge."""
DARKEST = 4e-3
"""Linear sensor values below this are noise."""
HOLD = 0.005
"""Weight of the image beside its gradient: slow changes over more than some 1 / sqrt(HOLD) = 14 pixels are kept."""
ALBEDO = (0.01, 1.0)
"""Range of albedo in rooms; what lies outside is gloss, noise or an emitter."""
BRIGHT, BRIGHT_SHARE = 0.9, 0.03
"""Few things in rooms are whiter than snow: albedo is scaled down until no more than this share of pixels is above."""
ROUGHNESS, METALLIC = (0.65, 0.15), (0.0, 0.1)
"""Mean and standard deviation of the draws of roughness, cut at [0.2, 1]; range of those of metallic."""


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
    """K hypotheses of a view, (K, H, W, 5) float32: albedo R G B linear, perceptual roughness, metallic, in [0, 1].

    Args:
        linear: (H, W, 3) photograph proportional to radiance (sensor values through the inverse response).
        samples: K >= 1.
        mean_albedo: without `light`, mean over pixels and channels that each hypothesis is scaled to, in (0, 1).
        object_id: (H, W) int, -1 = none; normals: (H, W, 3) unit; both optional.
        valid: (H, W) bool; steps to other pixels (also saturated or not-finite ones) count as light.
        light: (m, H, W, 3) finite log of what `linear` is divided by, used in turn: linear / e^light is albedo as it is.
            Without it, light is constant and the level of the albedo is set to `mean_albedo`.
        seed: of the draws of roughness and metallic.

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
    known = np.isfinite(linear).all(-1) & (True if valid is None else np.asarray(valid, bool))
    log = np.log(np.maximum(np.where(known[..., None], linear, DARKEST), DARKEST))
    spread = np.linspace(0, 1, samples) if samples > 1 else np.array([0.5])
    out = np.empty((samples, *shape, 5), np.float32)
    hold = 0.0 if light is None else HOLD  # of a photograph with its light in it, slow changes are to go
    lights = np.zeros((1, *linear.shape)) if light is None else np.asarray(light, np.float64)
    for number, own in enumerate(lights[:samples]):
        image = log - own
        if light is not None:
            image = np.clip(image, *np.log(ALBEDO))
        steps = [_Steps(image, axis, known, object_id, normals) for axis in (0, 1)]
        for k in range(number, samples, len(lights)):
            threshold = THRESHOLDS[0] * (THRESHOLDS[1] / THRESHOLDS[0]) ** spread[k]
            albedo = np.exp(_integrated([step.material(threshold) for step in steps], image, hold))
            out[k, ..., :3] = _scaled(albedo, known, mean_albedo) if light is None else np.clip(albedo, *ALBEDO)
    out[..., 3:] = _draws(shape, samples, object_id, seed)
    return out


def albedo_level(albedo: NDArray, weight: NDArray, mean_albedo: float) -> float:
    """Gain that gives albedos (n, 3) of weight (n,) the wanted mean, less where more than BRIGHT_SHARE would be above BRIGHT.

    White paper must not clip because the rest of a room is dark: what is cut at 1 has lost its texture for good.
    """
    total = float(np.sum(weight))
    if not total > 0:
        return 1.0
    mean = float(albedo.mean(-1) @ weight) / total
    order = np.argsort(albedo.max(-1), kind="stable")
    place = min(int(np.searchsorted(np.cumsum(weight[order]), (1 - BRIGHT_SHARE) * total)), len(order) - 1)
    return min(mean_albedo / max(mean, 1e-9), BRIGHT / max(float(albedo.max(-1)[order[place]]), 1e-9))


def _draws(shape: tuple[int, int], samples: int, object_id: NDArray | None, seed: int) -> NDArray:
    """(K, H, W, 2) roughness and metallic: one draw an object and hypothesis, the same in every view."""
    ids = np.full(shape, -1) if object_id is None else np.asarray(object_id)
    out = np.empty((samples, *shape, 2), np.float32)
    objects, row = np.unique(ids, return_inverse=True)
    draws = np.empty((len(objects), samples, 2))
    for i, o in enumerate(objects):
        rng = np.random.default_rng([seed, 0x726574, int(o) + 1])
        draws[i, :, 0] = np.clip(ROUGHNESS[0] + ROUGHNESS[1] * rng.standard_normal(samples), 0.2, 1)
        draws[i, :, 1] = METALLIC[0] + (METALLIC[1] - METALLIC[0]) * rng.random(samples)
    for k in range(samples):
        out[k] = draws[:, k][row.reshape(shape)]
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


def _integrated(steps: list[NDArray], image: NDArray, hold: float) -> NDArray:
    """(H, W, 3) image whose differences are nearest to `steps` = [vertical, horizontal] and which is near `image` (least
    squares, the second with weight `hold` >= 0; with 0 the mean is that of `image`).

    The normal equations are a screened Poisson equation with Neumann borders; the cosine transform makes them diagonal.
    """
    from scipy.fft import dctn, idctn

    right = hold * image
    right[:-1] -= steps[0]
    right[1:] += steps[0]
    right[:, :-1] -= steps[1]
    right[:, 1:] += steps[1]
    y, x = (2 - 2 * np.cos(np.pi * np.arange(n) / n) for n in image.shape[:2])
    eigenvalue = y[:, None] + x[None, :] + hold
    if hold == 0:
        eigenvalue[0, 0] = 1.0  # the mean is free; its right-hand side is 0
    out = idctn(dctn(right, axes=(0, 1)) / eigenvalue[..., None], axes=(0, 1))
    return out if hold > 0 else out + image.mean((0, 1))


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
