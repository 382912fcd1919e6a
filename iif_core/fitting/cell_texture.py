"""Texture of surface cells from the photographs, once light, response and affine maps are known (Eq. M.47 to M.49).

A prior that uses the photographs alone (retinex) divides them by light that is not known yet. This module repeats the division
with the known light. It leaves out slow changes inside an object, because they cannot be distinguished from errors of the light.
"""

from __future__ import annotations

import numpy as np

from iif_core.surface.cells import pack_keys, voxel_indices

BASE_WEIGHT = 2.0
"""Weight of the corrected base in a cell, in pixels of average sensitivity (a border pixel counts a tenth)."""
SLOW_SCALE = 0.2
"""Metres over which errors of the light change. Only the nearest 16 boxes of the Gaussian count (`slow_part`), so its effective
width is 0.12 m, and 0.03 m for `LIGHT_SMOOTHING`."""
LIGHT_SMOOTHING = 0.05
"""Metres over which diffuse light is averaged (docs/method/numerics.md#dividing-by-noisy-light)."""
_LARGEST_CHANGE = 0.5
"""Largest change of an albedo."""


def textured_albedo(
    albedo: np.ndarray,
    square: np.ndarray,
    cross: np.ndarray,
    pixels: np.ndarray,
    ijk: np.ndarray,
    pairs: np.ndarray,
    points: np.ndarray,
    object_id: np.ndarray,
) -> np.ndarray:
    """Add the texture of the photographs to the albedo of cells (Eq. M.48).

    Args:
        albedo: (C, 3) of the affine fit; square, cross: (C, 3) sums of w G^2 and w G (y - h); pixels: (C,) weight of the pixels.
        ijk: (C, 3) voxels; pairs: (m, 2) rows of cells of one object that touch.
        points: (C, 3) positions, m; object_id: (C,) int.

    Returns:
        (C, 3) linear albedo in [0, 1].
    """
    albedo = np.asarray(albedo, np.float64)
    average = square.sum(0) / max(float(pixels.sum()), 1e-300)
    if not (average > 0).all():
        return np.clip(albedo, 0.0, 1.0)
    weight = np.exp(-0.5 * ((ijk[pairs[:, 0]] - ijk[pairs[:, 1]]) ** 2).sum(1))
    below = _spread(square, pairs, weight)
    shown = _spread(cross - square * albedo, pairs, weight)
    delta = np.clip(np.divide(shown, below, out=np.zeros_like(shown), where=below > 0), -_LARGEST_CHANGE, _LARGEST_CHANGE)
    slow = slow_part(delta, (below / average).mean(1), points, object_id, SLOW_SCALE)
    # Slow changes are removed before cells are drawn to the base, so cells that are hardly seen keep it.
    change = (shown - below * slow) / (below + BASE_WEIGHT * average)
    return np.clip(albedo + np.clip(change, -_LARGEST_CHANGE, _LARGEST_CHANGE), 0.0, 1.0)


def smooth_light(light: np.ndarray, points: np.ndarray, object_id: np.ndarray) -> np.ndarray:
    """Return the geometric mean of diffuse light (C, 3) over `LIGHT_SMOOTHING` inside an object; cells without light are kept."""
    known = (light > 0).all(1)
    out = np.array(light, np.float64)
    ones = np.ones(int(known.sum()))
    out[known] = np.exp(slow_part(np.log(out[known]), ones, points[known], object_id[known], LIGHT_SMOOTHING))
    return out.astype(np.float32)


def _spread(values: np.ndarray, pairs: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Add to each row the weighted rows of its neighbours."""
    out = values.astype(np.float64)
    for c in range(values.shape[1]):
        for here, there in ((0, 1), (1, 0)):
            out[:, c] += np.bincount(pairs[:, here], weight * values[pairs[:, there], c], len(values))
    return out


def slow_part(values: np.ndarray, weight: np.ndarray, points: np.ndarray, object_id: np.ndarray, reach: float) -> np.ndarray:
    """Return the weighted Gaussian mean of values inside each object, from boxes of half its width (Eq. M.49).

    Args:
        values: (n, c); weight: (n,) >= 0.
        points: (n, 3) positions, m; object_id: (n,) int >= 0.
        reach: standard deviation of the Gaussian, m.

    Returns:
        (n, c) float64; 0 where the surroundings have no weight.
    """
    from scipy.spatial import cKDTree

    values, points = np.asarray(values, np.float64), np.asarray(points, np.float64)
    if not len(values):
        return np.zeros_like(values)
    keys = pack_keys(voxel_indices(points, reach / 2, points.min(0) - reach), object_id)
    unique, box = np.unique(keys, return_inverse=True)
    box = box.ravel()

    def mean(rows: np.ndarray, by: np.ndarray) -> np.ndarray:
        sums = np.stack([np.bincount(box, by * rows[:, c], len(unique)) for c in range(rows.shape[1])], 1)
        return sums / np.maximum(np.bincount(box, by, len(unique)), 1e-300)[:, None]

    apart = 1e3 * np.asarray(object_id, np.float64)[:, None]  # far away from other objects
    place = np.concatenate([points / reach, apart], 1)
    total, level = np.bincount(box, weight, len(unique)), mean(values, weight)
    distance, near = cKDTree(mean(place, np.ones(len(place)))).query(place, k=min(16, len(unique)), distance_upper_bound=3.0)
    distance, near = distance.reshape(len(place), -1), near.reshape(len(place), -1)
    found = np.isfinite(distance)
    near = np.where(found, near, 0)
    kernel = np.where(found, np.exp(-0.5 * np.where(found, distance, 0.0) ** 2), 0.0) * total[near]
    below = kernel.sum(1, keepdims=True)
    out = np.zeros_like(values)
    for c in range(values.shape[1]):
        out[:, c] = (kernel * level[near, c]).sum(1)
    return np.where(below > 0, out / np.maximum(below, 1e-300), 0.0)
