"""Separable filters of images."""

from __future__ import annotations

import numpy as np

from iif_core.numerics.compiled import njit

Array = np.ndarray


def correlate(image: Array, vertical: Array, horizontal: Array, border: str = "edge") -> Array:
    """Correlate an image with a separable filter.

    out[y, x] = sum_ij vertical[i] horizontal[j] image[y + i - r, x + j - r]

    Args:
        image: (H, W) float32 or float64; the sums are made in this dtype.
        vertical, horizontal: (2 r + 1,) weights; both filters have the same, odd length.
        border: mode of `numpy.pad` for pixels outside the image.

    Returns:
        (H, W), dtype of the image.
    """
    r = len(vertical) // 2
    padded = np.pad(image, r, mode=border)
    return _correlate(padded, np.asarray(vertical, image.dtype), np.asarray(horizontal, image.dtype))


@njit(fastmath={"contract"})
def _correlate(padded, vertical, horizontal):
    taps = len(vertical)
    height, width = padded.shape[0] - taps + 1, padded.shape[1] - taps + 1
    out = np.zeros((height, width), padded.dtype)
    row = np.empty(padded.shape[1], padded.dtype)
    for i in range(height):
        row[:] = 0
        for k in range(taps):
            weight, source = vertical[k], padded[i + k]
            for j in range(len(row)):
                row[j] += weight * source[j]
        target = out[i]
        for k in range(taps):
            weight = horizontal[k]
            for j in range(width):
                target[j] += weight * row[j + k]
    return out
