"""Light maps: which emitters share a map, smoothing that keeps the maps additive, and their storage as half floats
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

NEIGHBOURS = 24
"""Texels over which `smooth` averages, the texel itself among them."""

NORMAL_REACH = 0.35
"""Difference of unit normals that counts as much as one `reach` of distance (20 degrees)."""

CONTRAST = 2.0
"""Standard errors by which the light of a neighbour may differ before its weight falls to e^-1/2."""

HALF_TOP = 16384.0
"""Largest stored value; the largest half float is 65504, and interpolation needs room."""


def group_lamps(power: ArrayLike, most: int = MOST_LAMPS) -> tuple[Array, int]:
    """Give every emitter a light map of its own, in the order of the emitters, as long as there are at most `most`.

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


def smooth(points: ArrayLike, normals: ArrayLike, first: Array, second: Array, reach: float) -> Array:
    """Average light over neighbours on the same surface, with the same weights for all lamps (Eq. L.60).

    Neighbours are near in space and not in the map, so charts do not matter and seams disappear. Both halves are averaged, each
    with the weights that follow from the other, so that noise does not choose what it is averaged with. A neighbour counts less
    the further it is, the more its normal differs, and the more the sum of its lamps differs, compared with the noise.

    Args:
        points, normals: (n, 3) metres, and unit vectors.
        first, second: (n, lamps, 3) two independent estimates.
        reach: standard deviation of the weights over distance, metres.

    Returns:
        (n, lamps, 3) float32, linear in the lamps for given sums over them.
    """
    from scipy.spatial import cKDTree

    place = np.concatenate([np.asarray(points, np.float64) / reach, np.asarray(normals, np.float64) / NORMAL_REACH], 1)
    if not len(place):
        return np.zeros(first.shape, np.float32)
    count = min(NEIGHBOURS, len(place))
    distance, near = cKDTree(place).query(place, k=count)
    distance, near = distance.reshape(len(place), count), near.reshape(len(place), count)
    closeness = np.exp(-0.5 * distance**2)
    halves = [np.asarray(half, np.float32) for half in (first, second)]
    level = [half.sum(1, dtype=np.float64).mean(-1) for half in halves]

    def mean(values: Array, weight: Array) -> Array:
        return np.einsum("nk,nk->n", weight, values[near]) / weight.sum(1)

    # Guides are smoothed by closeness alone; their noise is that of the halves, over as many neighbours as count.
    guide = [mean(one, closeness) for one in level]
    noise = np.sqrt(np.maximum(mean((level[0] - level[1]) ** 2, closeness), 0) / 2)
    effective = closeness.sum(1) ** 2 / (closeness**2).sum(1)
    error = CONTRAST * np.sqrt(2.0) * noise / np.sqrt(effective) + 1e-3 * np.abs(guide[0] + guide[1]) / 2 + 1e-30
    out = np.zeros(halves[0].shape, np.float64)
    for half, other in ((halves[0], guide[1]), (halves[1], guide[0])):
        apart = (other[near] - other[:, None]) / np.maximum(error[:, None], error[near])
        weight = closeness * np.exp(-0.5 * np.minimum(apart**2, 60.0))
        weight /= weight.sum(1, keepdims=True)
        for k in range(count):  # one neighbour at a time, which keeps the memory at the size of the maps
            out += weight[:, k, None, None] * half[near[:, k]]
    return (0.5 * out).astype(np.float32)


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
    scale = np.where(top > 0, np.exp2(np.ceil(np.log2(np.where(top > 0, top, 1.0))) - np.log2(HALF_TOP)), 1.0)
    return Halves((maps / scale[:, None]).astype(np.float16), scale)


def recombine(halves: Halves, factor: ArrayLike) -> Array:
    """Return the light (n, 3) float64 of all lamps, each times its factor (lamps,) or (lamps, 3)."""
    factor = np.broadcast_to(np.asarray(factor, np.float64).reshape(len(halves.scale), -1), (len(halves.scale), 3))
    return np.einsum("nlc,lc->nc", halves.value.astype(np.float64), halves.scale[:, None] * factor)
