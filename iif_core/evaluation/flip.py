"""LDR-FLIP, the difference that an observer sees when two images alternate (Andersson et al. 2020, HPG; Eq. E.5, E.6)."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from iif_core.numerics.color import lab_from_relative, linear_from_srgb
from iif_core.numerics.filters import correlate

Array = np.ndarray

PIXELS_PER_DEGREE = 67.0
"""Resolution for the observer: a screen of 0.7 m and 3840 pixels seen from 0.7 m, as in the publication."""

_CHROMATICITIES = ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06))  # sRGB
_WHITE = (0.3127, 0.3290)
# Contrast sensitivity: for each opponent channel sums of a sqrt(pi / b) exp(-pi^2 x^2 / b), x in degrees.
_SENSITIVITY = (((1.0, 0.0047),), ((1.0, 0.0053),), ((34.1, 0.04), (13.5, 0.025)))
_FEATURE_WIDTH = 0.082  # degrees
_COLOUR_POWER, _FEATURE_POWER = 0.7, 0.5
_KNEE, _AT_KNEE = 0.4, 0.95  # colour differences up to 0.4 of the largest take 95 % of the range


@lru_cache(None)
def _matrices() -> tuple[Array, Array]:
    """Linear sRGB -> XYZ relative to white, and its inverse."""
    x, y = np.array([*_CHROMATICITIES, _WHITE]).T
    xyz = np.stack([x / y, np.ones(4), (1 - x - y) / y])
    white = xyz[:, 3]
    to_xyz = xyz[:, :3] * np.linalg.solve(xyz[:, :3], white) / white[:, None]
    return to_xyz, np.linalg.inv(to_xyz)


@lru_cache(None)
def _sensitivity_filters() -> tuple[tuple[Array, ...], ...]:
    """For each opponent channel the 1-D weights whose outer products with themselves sum to the filter."""
    widest = max(b for terms in _SENSITIVITY for _, b in terms)
    radius = int(np.ceil(3 * np.sqrt(widest / (2 * np.pi**2)) * PIXELS_PER_DEGREE))
    x = np.arange(-radius, radius + 1) / PIXELS_PER_DEGREE
    out = []
    for terms in _SENSITIVITY:
        parts = [np.sqrt(a * np.sqrt(np.pi / b)) * np.exp(-(np.pi**2) * x * x / b) for a, b in terms]
        total = sum(part.sum() ** 2 for part in parts)
        out.append(tuple(part / np.sqrt(total) for part in parts))
    return tuple(out)


@lru_cache(None)
def _feature_filters() -> tuple[Array, Array, Array]:
    """1-D Gaussian and its first two derivatives; their positive and negative weights sum to 1 and -1."""
    deviation = 0.5 * _FEATURE_WIDTH * PIXELS_PER_DEGREE
    radius = int(np.ceil(3 * deviation))
    x = np.arange(-radius, radius + 1, dtype=np.float64)
    gauss = np.exp(-x * x / (2 * deviation**2))
    edge, point = -x * gauss, (x * x / deviation**2 - 1) * gauss
    edge, point = (np.where(w > 0, w / w[w > 0].sum(), w / -w[w < 0].sum()) for w in (edge, point))
    return gauss / gauss.sum(), edge, point


class Seen:
    """An image as the observer sees it.

    Args:
        image: (H, W, 3) in [0, 1]; encoded: sRGB-encoded instead of linear.

    Attributes:
        lab: (3, H, W) float32, Hunt-adjusted L*a*b* of the filtered image.
        edges, points: (H, W) float32, strength of the features.
    """

    def __init__(self, image: Array, encoded: bool):
        planes = np.ascontiguousarray(np.moveaxis(np.asarray(image, np.float32), -1, 0))
        linear = linear_from_srgb(planes).astype(np.float32) if encoded else planes
        to_xyz, to_rgb = (m.astype(np.float32) for m in _matrices())
        x, y, z = np.tensordot(to_xyz, linear, 1)
        self.edges, self.points = self._features(y)
        opponent = (116 * y - 16, 500 * (x - y), 200 * (y - z))
        luma, cx, cz = (
            sum(correlate(channel, part, part) for part in parts)
            for channel, parts in zip(opponent, _sensitivity_filters(), strict=True)
        )
        y = (luma + 16) / 116
        xyz = np.stack([y + cx / 500, y, y - cz / 200])
        self.lab = _hunt_lab(np.clip(np.tensordot(to_rgb, xyz, 1), 0, 1))

    @staticmethod
    def _features(luminance: Array) -> tuple[Array, Array]:
        gauss, edge, point = _feature_filters()
        return tuple(np.hypot(correlate(luminance, gauss, w), correlate(luminance, w, gauss)) for w in (edge, point))


def _hunt_lab(linear: Array) -> Array:
    """(3, ...) linear sRGB -> L* and Hunt-adjusted a*, b*."""
    lightness, a, b = lab_from_relative(np.tensordot(_matrices()[0].astype(linear.dtype), linear, 1))
    return np.stack([lightness, 0.01 * lightness * a, 0.01 * lightness * b])


def _colour_distance(p: Array, q: Array) -> Array:
    d = p - q
    return (np.abs(d[0]) + np.hypot(d[1], d[2])) ** _COLOUR_POWER


@lru_cache(None)
def _largest_distance() -> float:
    """Distance between green and blue."""
    green, blue = _hunt_lab(np.eye(3)[:, 1]), _hunt_lab(np.eye(3)[:, 2])
    return float(_colour_distance(green, blue))


def difference(prediction: Seen, truth: Seen) -> Array:
    """Compute the FLIP of every pixel, (H, W) float32: 0 = same, 1 = the largest difference."""
    largest = _largest_distance()
    distance = _colour_distance(prediction.lab, truth.lab) / np.float32(largest)
    colour = np.where(
        distance < _KNEE, distance * (_AT_KNEE / _KNEE), _AT_KNEE + (distance - _KNEE) * ((1 - _AT_KNEE) / (1 - _KNEE))
    )
    feature = np.maximum(np.abs(prediction.edges - truth.edges), np.abs(prediction.points - truth.points))
    return colour ** (1 - (feature / np.sqrt(np.float32(2))) ** _FEATURE_POWER)
