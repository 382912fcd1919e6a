"""Shading at any roughness between the cached levels by the monotone cubic of Fritsch and Butland (Eq. M.4, M.5).

The compiled fit evaluates the same formulae one pixel at a time (docs/method/numerics.md#kinks-at-the-roughness-levels).
"""

from __future__ import annotations

import numpy as np


def interpolate_levels(shading: np.ndarray, levels: np.ndarray, roughness: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return shading (n, J, 3) at any roughness (n,) between increasing levels (J,), and its derivative, (n, 3) float64 each."""
    levels, r = np.asarray(levels, np.float64), np.clip(np.asarray(roughness, np.float64), levels[0], levels[-1])
    j = np.clip(np.searchsorted(levels, r, side="right") - 1, 0, len(levels) - 2)
    k = np.arange(len(r))
    y0, y1 = (shading[k, i].astype(np.float64) for i in (j, j + 1))
    h = (levels[j + 1] - levels[j])[:, None]
    mean = (y1 - y0) / h
    before, after = np.maximum(j - 1, 0), np.minimum(j + 2, len(levels) - 1)
    h_before, h_after = (levels[j] - levels[before])[:, None], (levels[after] - levels[j + 1])[:, None]
    mean_before = (y0 - shading[k, before]) / np.where(h_before > 0, h_before, 1.0)
    mean_after = (shading[k, after] - y1) / np.where(h_after > 0, h_after, 1.0)
    inner0, inner1 = _slope(mean_before, mean, h_before, h), _slope(mean, mean_after, h, h_after)
    d0 = np.where(h_before > 0, inner0, _end(mean, mean_after, h, h_after))
    d1 = np.where(h_after > 0, inner1, _end(mean, mean_before, h, h_before))
    t = (r - levels[j])[:, None] / h
    bend0, bend1 = d0 - mean, d1 - mean
    # Hermite's form has all digits at both ends, also where the two values differ by many orders of magnitude.
    value = (1 - t) ** 2 * ((1 + 2 * t) * y0 + h * t * d0) + t**2 * ((3 - 2 * t) * y1 - h * (1 - t) * d1)
    slope = mean + (1 - t) * (1 - 3 * t) * bend0 + t * (3 * t - 2) * bend1
    return value, slope


def _slope(left: np.ndarray, right: np.ndarray, h_left: np.ndarray, h_right: np.ndarray) -> np.ndarray:
    """Return the slope at a level between two intervals: weighted harmonic mean, 0 at an extremum."""
    w_left, w_right = 2 * h_right + h_left, h_right + 2 * h_left
    alike = left * right > 0
    return np.where(alike, (w_left + w_right) * left * right / np.where(alike, w_left * right + w_right * left, 1.0), 0.0)


def _end(mean: np.ndarray, beyond: np.ndarray, h: np.ndarray, h_beyond: np.ndarray) -> np.ndarray:
    """Return the slope at an outermost level: the slope of a parabola, limited to the monotone range."""
    slope = ((2 * h + h_beyond) * mean - h * beyond) / (h + h_beyond)
    slope = np.where(h_beyond > 0, slope, mean)
    slope = np.where(slope * mean <= 0, 0.0, slope)
    return np.where(np.abs(slope) > 3 * np.abs(mean), 3 * mean, slope)
