"""Predictions of a picture that was made smaller, at the size of the photograph (docs/method/priors.md#learned).

Albedo follows the photograph by the fast guided filter (He and Sun 2015, arXiv:1505.00996); everything else is interpolated
between pixels of the same object and orientation (joint bilateral upsampling, Kopf et al. 2007).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from iif_core.camera.pixels import ViewMaps
from iif_core.priors.features import log_radiance
from iif_core.priors.hypotheses import DARKEST_ALBEDO

RIDGE = 1e-3
"""Variance of log radiance that counts as flat."""
ELSEWHERE = 1e-3
"""Weight of a pixel of another object or orientation, for pixels that have no other neighbour."""
SAME_SIDE = 0.8


def enlarged(maps: NDArray, scale: NDArray, small: ViewMaps, full: ViewMaps, factor: int) -> tuple[NDArray, NDArray]:
    """Enlarge the predictions of a view.

    Args:
        maps: (K, h, w, 5) predictions; scale: (h, w, 3).
        small, full: the view at the size of the maps, and at its own size (H, W).
        factor: pixel (j, i) of `small` shows the surface of pixel (factor j + factor // 2, ...) of `full`.

    Returns:
        (K, H, W, 5) float32 and (H, W, 3) float32.
    """
    # -------- statistics of the guide, log radiance, in 3 x 3 small pixels --------
    near = _Neighbours(small, full, factor)
    out = np.empty((len(maps), *full.depth.shape, 5), np.float32)
    guide, full_guide = log_radiance(small), log_radiance(full)
    mean = _box(guide)
    variance = np.maximum(_box(guide**2) - mean**2, 0)  # a difference, which rounding can make negative
    for k, own in enumerate(maps):
        albedo = np.log(np.maximum(own[..., :3], DARKEST_ALBEDO))
        middle = _box(albedo)
        # log albedo = gain * log photograph + offset, around each pixel: gain 1 where the light is even, 0 where the albedo is.
        gain = ((_box(guide * albedo) - mean * middle) / (variance + RIDGE)).clip(0, 1)
        # -------- interpolate gain and offset, then apply them to the photograph at its own size (Eq. P.28) --------
        # Channels: gain (3), offset (3), roughness, metallic.
        line = near(np.concatenate([gain, middle - gain * mean, own[..., 3:]], -1))
        out[k, ..., :3] = np.exp(line[..., :3] * full_guide + line[..., 3:6])
        out[k, ..., 3:] = line[..., 6:]
    return np.clip(out, (DARKEST_ALBEDO,) * 3 + (0, 0), 1, out=out), near(scale)


def _box(image: NDArray) -> NDArray:
    """(h, w, c) means of 3 x 3 pixels."""
    from scipy.ndimage import uniform_filter

    return uniform_filter(image, (3, 3, 1), mode="nearest")


class _Neighbours:
    """The four small pixels around each full one, and their weights."""

    def __init__(self, small: ViewMaps, full: ViewMaps, factor: int):
        (h, w), (height, width) = small.depth.shape, full.depth.shape
        # Positions in units of small pixels. Small pixel j shows the surface of full pixel factor j + factor // 2, which lies at
        # j.
        y, x = ((np.arange(n) - factor // 2) / factor for n in (height, width))
        self.places: list[tuple[NDArray, NDArray]] = []
        weights = []
        for dy in (0, 1):
            for dx in (0, 1):
                row, column = np.floor(y).astype(int) + dy, np.floor(x).astype(int) + dx
                weight = np.maximum(1 - np.abs(y - row), 0)[:, None] * np.maximum(1 - np.abs(x - column), 0)
                at = row.clip(0, h - 1)[:, None], column.clip(0, w - 1)[None]
                cosine = (small.normals[at] * full.normals).sum(-1)
                # Pixels without surface have no normal.
                same = (small.object_id[at] == full.object_id) & ((cosine > SAME_SIDE) | (full.depth == 0))
                self.places.append(at)
                weights.append((weight + 1e-6) * np.where(same, 1.0, ELSEWHERE))
        total = np.sum(weights, 0)
        self.weights = [(weight / total)[..., None].astype(np.float32) for weight in weights]

    def __call__(self, image: NDArray) -> NDArray:
        """Interpolate (h, w, c) -> (H, W, c) float32."""
        return sum(weight * image[at] for weight, at in zip(self.weights, self.places, strict=True)).astype(np.float32)
