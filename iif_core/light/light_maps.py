"""Light maps: which emitters share a map, smoothing, the mean of denoised maps, and their storage as half floats
(docs/method/light.md#light-maps).

Tracing them is in `iif_core.light.transport.lightmaps`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from iif_core.errors import InputError

Array = np.ndarray

MOST_LAMPS = 16
"""Light maps at most; the weakest emitters beyond share the last."""

NEIGHBOURS = 32
"""Texels over which `smooth` averages, the texel itself among them."""

NORMAL_REACH = 0.35
"""Difference of unit normals that counts as much as one `reach` of distance (20 degrees)."""

CONTRAST = 0.3
"""Relative difference of the light of a neighbour at which its weight is e^-1/2."""

TEXELS_TRUSTED = 256
"""Texels of a part whose mean counts as much as the mean over all parts in `with_mean_of`."""

GAIN_LIMITS = (0.5, 2.0)

HALF_TOP = 16384.0
"""Largest stored value; the largest half float is 65504, and interpolation needs room."""


def group_lamps(power: ArrayLike, most: int = MOST_LAMPS) -> tuple[Array, int]:
    """Give every emitter its own light map, in the order of the emitters, if there are at most `most` of them.

    Args:
        power: (n,) how much light each emits, >= 0; 0 = none, and it gets no map.
        most: number of maps at most.

    Returns:
        (n,) int32 map of every emitter, -1 = none, and the number of maps. Of more emitters than maps, the `most` - 1 strongest
        have maps of their own and the rest shares the last; of equally strong ones the first counts as the strongest.
    """
    power = np.asarray(power, np.float64)
    shining = np.flatnonzero(power > 0)
    own = shining
    if len(shining) > most:
        own = np.sort(shining[np.argsort(-power[shining], kind="stable")[: most - 1]])
    of_emitter = np.full(len(power), -1, np.int32)
    of_emitter[shining] = len(own)
    of_emitter[own] = np.arange(len(own))
    return of_emitter, min(len(shining), most)


def smooth(points: ArrayLike, normals: ArrayLike, light: Array, reach: float) -> Array:
    """Average light over neighbours on the same surface, with the same weights for all lamps (Eq. L.60).

    Neighbours are near in space and not in the map, so that seams between charts disappear. One counts less the further it is,
    the more its normal differs, and the more the sum of its lamps differs.

    Args:
        points, normals: (n, 3) metres, and unit vectors.
        light: (n, lamps, 3), >= 0.
        reach: standard deviation of the weights over distance, metres.

    Returns:
        (n, lamps, 3) float32.
    """
    from scipy.spatial import cKDTree

    if not len(light):
        return np.zeros(light.shape, np.float32)
    # One space for position and normal, in which distance 1 is one standard deviation of Eq. L.60.
    place = np.concatenate([np.asarray(points, np.float64) / reach, np.asarray(normals, np.float64) / NORMAL_REACH], 1)
    count = min(NEIGHBOURS, len(place))
    distance, near = (found.reshape(len(place), count) for found in cKDTree(place).query(place, k=count))
    level = light.sum((1, 2), dtype=np.float64)
    # Relative to the mean of both texels. Where both are dark the light is equal, and the tiny divisor decides nothing.
    width = CONTRAST * (level[near] + level[:, None]) / 2
    apart = (level[near] - level[:, None]) / np.maximum(width, 1e-300)
    weight = np.exp(-0.5 * (distance**2 + apart**2))
    weight /= weight.sum(1, keepdims=True)
    out = np.zeros(light.shape, np.float64)
    for k in range(count):  # one neighbour at a time, which keeps the memory at the size of the maps
        out += weight[:, k, None, None] * light[near[:, k]]
    return out.astype(np.float32)


def with_mean_of(traced: Array, denoised: Array, part: ArrayLike, area: ArrayLike) -> Array:
    """Scale denoised light maps so that the light of every part is what was traced (Eq. L.61).

    A denoiser takes rare bright texels for noise, and with them the light that they stand for. The factor of lamp and part is the
    ratio R_p of the sums of traced and denoised light on the part, drawn to the ratio R over all parts where the part has few
    texels: (n R_p + TEXELS_TRUSTED R) / (n + TEXELS_TRUSTED), limited to GAIN_LIMITS.

    Args:
        traced, denoised: (n, lamps, 3), >= 0.
        part: (n,) int part of each texel, >= 0.
        area: (n,) of each texel.

    Returns:
        (n, lamps, 3) float32.
    """
    part, area = np.asarray(part), np.asarray(area, np.float64)
    if not len(part):
        return np.zeros(denoised.shape, np.float32)
    count = np.bincount(part)
    out = np.empty(denoised.shape, np.float32)
    for lamp in range(traced.shape[1]):
        sums = [np.bincount(part, area * maps[:, lamp].sum(1, dtype=np.float64)) for maps in (traced, denoised)]
        whole = sums[0].sum() / sums[1].sum() if sums[1].sum() > 0 else 1.0
        # A part without denoised light has the ratio of all parts.
        own = np.divide(sums[0], sums[1], out=np.full(len(count), whole), where=sums[1] > 0)
        gain = np.clip((count * own + TEXELS_TRUSTED * whole) / (count + TEXELS_TRUSTED), *GAIN_LIMITS)
        out[:, lamp] = denoised[:, lamp] * gain[part, None]
    return out


class Halves(NamedTuple):
    """Light maps as half floats: light of lamp l is `scale[l] * value[:, l]`; value (n, lamps, 3) float16, scale (lamps,)."""

    value: Array
    scale: Array


def to_half(maps: ArrayLike) -> Halves:
    """Store light maps (n, lamps, 3), >= 0, as half floats with one power of two for each lamp.

    The largest value of each lamp lies between HALF_TOP / 2 and HALF_TOP, so that nothing overflows and values down to 1e-11 of
    the largest keep some digits; the relative error of those above 4e-9 of it is at most 2^-11. A lamp without light has scale 1.

    Raises:
        InputError: negative or non-finite light.
    """
    maps = np.asarray(maps, np.float64)
    if not np.isfinite(maps).all() or maps.min(initial=0) < 0:
        raise InputError("light maps contain negative or non-finite light; please report it with the scene")
    top = maps.max(axis=(0, 2), initial=0)
    # A power of two changes the exponent alone, so the digits of a half float are kept.
    scale = np.where(top > 0, np.exp2(np.ceil(np.log2(np.where(top > 0, top, 1.0))) - np.log2(HALF_TOP)), 1.0)
    return Halves((maps / scale[:, None]).astype(np.float16), scale)
