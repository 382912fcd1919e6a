"""Random numbers that are hashes of what they are used for (Eq. P.2), and Gaussian random fields in space made of them."""

from __future__ import annotations

import zlib

import numpy as np
from numpy.typing import NDArray

WAVES = 128
"""Waves of a field: its correlation over space is off by about 1 / sqrt(2 WAVES), 0.06."""


class Field:
    """Stationary Gaussian fields over space with one correlation length, by random Fourier features (Rahimi and Recht 2007).

    Each is sqrt(2 / W) sum_w cos(k_w x + u_w) with k_w ~ N(0, I / length^2) and uniform phases u_w. It has mean 0, variance 1 and
    the correlation exp(-d^2 / (2 length^2)) at distance d, and is nearly normal. Its variance over a large scene is 1 as well.

    Args:
        points: (n, 3) places in metres; NaN or infinity = no place, which counts as the origin.
        length: correlation length > 0 in metres; infinity = one value for all points.
        keys: integers that the waves k_w are hashes of. Fields of equal keys share them, but not the phases.
    """

    def __init__(self, points: NDArray, length: float, *keys: int):
        wave = standard_normal(*keys, np.arange(WAVES)[:, None], np.arange(3)[None]) / length
        place = np.where(np.isfinite(points), points, 0).astype(np.float64)
        angle = (place @ wave.T).astype(np.float32)
        self._waves = np.concatenate([np.cos(angle), -np.sin(angle)], 1) * np.float32((2 / WAVES) ** 0.5)

    def __call__(self, *keys: int | NDArray) -> NDArray:
        """Return (n, ...) float32: a field for each element of the keys, integers that broadcast to one shape."""
        broadcast = np.broadcast_arrays(*(np.asarray(key, np.int64) for key in keys))
        phase = 2 * np.pi * unit_interval(*(key.ravel() for key in broadcast), np.arange(WAVES)[:, None])
        weight = np.concatenate([np.cos(phase), np.sin(phase)]).astype(np.float32)
        return (self._waves @ weight).reshape(len(self._waves), *broadcast[0].shape)


def tag(name: str) -> int:
    """Return the number that stands for a name in a hash."""
    return zlib.crc32(name.encode())


def hashed(*keys: int | NDArray) -> NDArray:
    """Hash integers that broadcast to 64 bits, by the finaliser of splitmix64 applied to one key after another."""
    h = np.uint64(0)
    with np.errstate(over="ignore"):
        for key in keys:
            h = h ^ np.asarray(key, np.int64).astype(np.uint64)
            h = h + np.uint64(0x9E3779B97F4A7C15)
            h = (h ^ (h >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
            h = (h ^ (h >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
            h = h ^ (h >> np.uint64(31))
    return h


def unit_interval(*keys: int | NDArray) -> NDArray:
    """Return uniform numbers in (0, 1), hashes of integers that broadcast."""
    return ((hashed(*keys) >> np.uint64(11)).astype(np.float64) + 0.5) * 2.0**-53


def standard_normal(*keys: int | NDArray) -> NDArray:
    """Return normal numbers with mean 0 and variance 1, hashes of integers that broadcast."""
    from scipy.special import ndtri

    return ndtri(unit_interval(*keys))


def pixel_normal(shape: tuple[int, ...], *keys: int) -> NDArray:
    """Return independent normal numbers (float32) of a stream that the hash of the keys starts."""
    return np.random.Generator(np.random.Philox(int(hashed(*keys)))).standard_normal(shape, np.float32)
