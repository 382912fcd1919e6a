"""Texture of surface cells from the photographs, once light, response and the objects' affines are known.

A prior that was made from the photographs alone (retinex) had to divide by a light that was not known yet. With the light that
was found, the last step is done again: what the photographs show beyond the corrected base,

    r_i = sum w G (y - h - a_i G),      b_i = sum w G^2,      L = a G + h,

over the pixels of cell i and of the cells that touch it (a pixel is wider than a cell), G and h from cached shading. What of
r / b changes slowly inside an object cannot be told from an error of the light and is left to
it, so levels and slow changes stay those of the affine fit:

    a_i + (r_i - b_i slow(r / b)_i) / (b_i + SHRINK g),      slow: mean over the surroundings inside the object (`REACH`),

g the mean of w G^2 over the pixels.
"""

from __future__ import annotations

import numpy as np

from iif_core.surface.cells import pack_keys, voxel_indices

SHRINK = 2.0
"""Pull of a cell to the corrected base, in pixels of average sensitivity (a border pixel counts a tenth). With 0.1 Red Kitchen's
held-out photographs gain 0.13 dB and the built-in kitchen's albedo, same prior, loses 1 dB."""
REACH = 0.2
"""Metres over which errors of the light change. Of the Gaussian of that width only the nearest 16 boxes count (`slow_part`): in
effect its width is 0.12 m, and that of BLUR 0.03 m."""
BLUR = 0.05
"""Metres over which diffuse light is averaged: cached light is noisy, and dividing by noise makes it texture."""
_LARGEST = 0.5
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
    """(C, 3) albedo in [0, 1].

    Args:
        albedo: (C, 3) of the affine fit; square, cross: (C, 3) sums of w G^2 and w G (y - h); pixels: (C,) their weight.
        ijk: (C, 3) voxels; pairs: (m, 2) rows of cells of one object that touch; points: (C, 3) metres; object_id: (C,).
    """
    albedo = np.asarray(albedo, np.float64)
    average = square.sum(0) / max(float(pixels.sum()), 1e-300)
    if not (average > 0).all():
        return np.clip(albedo, 0.0, 1.0)
    weight = np.exp(-0.5 * ((ijk[pairs[:, 0]] - ijk[pairs[:, 1]]) ** 2).sum(1))
    below = _spread(square, pairs, weight)
    shown = _spread(cross - square * albedo, pairs, weight)
    delta = np.clip(np.divide(shown, below, out=np.zeros_like(shown), where=below > 0), -_LARGEST, _LARGEST)
    slow = slow_part(delta, (below / average).mean(1), points, object_id, REACH)
    # Slow changes go before the pull: a cell that is hardly seen keeps its base instead of losing what its neighbours show.
    change = (shown - below * slow) / (below + SHRINK * average)
    return np.clip(albedo + np.clip(change, -_LARGEST, _LARGEST), 0.0, 1.0)


def smooth_light(light: np.ndarray, points: np.ndarray, object_id: np.ndarray) -> np.ndarray:
    """(C, 3) geometric mean of diffuse light (C, 3) over `BLUR` inside an object; cells without light stay as they are."""
    known = (light > 0).all(1)
    out = np.array(light, np.float64)
    out[known] = np.exp(slow_part(np.log(out[known]), np.ones(int(known.sum())), points[known], object_id[known], BLUR))
    return out.astype(np.float32)


def _spread(values: np.ndarray, pairs: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Each row and what its neighbours add to it."""
    out = values.astype(np.float64)
    for c in range(values.shape[1]):
        for here, there in ((0, 1), (1, 0)):
            out[:, c] += np.bincount(pairs[:, here], weight * values[pairs[:, there], c], len(values))
    return out


def slow_part(values: np.ndarray, weight: np.ndarray, points: np.ndarray, object_id: np.ndarray, reach: float) -> np.ndarray:
    """(n, c) weighted Gaussian mean of values (n, c) over `reach` metres inside an object, from boxes of half of that.

    weight: (n,) >= 0; points: (n, 3); object_id: (n,) int >= 0. A point whose surroundings have no weight gets 0.
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
