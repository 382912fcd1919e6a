"""Depth of surface without texture: a region of one colour is mostly flat, and its edges tell where its plane lies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

SEED = 0
TRIES = 64
"""Planes through three pixels, of which the one that most others lie on is taken (RANSAC, Fischler and Bolles 1981)."""
COMPARED = 400
"""Pixels on which they are tried."""
SAME_WINDOW = 49
"""Pixels whose depth errs alike, because the windows of the sweep overlap: 7 x 7."""
LEAST_TEXTURE = 0.005
"""Standard deviation of grey values over 3 x 3 pixels from which a pixel has texture."""
OWN_TEXTURE = 0.2
"""The same, over that of the window of the sweep: below, what is matched is the outline of something beside the pixel."""
LEAST_ERROR = 0.003
"""Relative error of depth below which no region counts."""


@dataclass(frozen=True)
class FlatOptions:
    """Which regions count as flat.

    Attributes:
        scale, blur, smallest: of the regions (Felzenszwalb and Huttenlocher 2004): preference of large ones, standard deviation
            of the smoothing before in pixels, and least size in pixels.
        tolerance: relative difference of depth up to which a pixel lies on a plane.
        share: of the pixels of a region whose depth is known, those that must lie on its plane; others may be of what stands
            in front of it, whose outline the sweep widens.
        least: how many pixels must lie on it.
        plain: share of the pixels of a region that must have no texture; where they have, they tell their depth themselves.
        error: largest relative standard error of the depth of a pixel by the plane.
    """

    scale: float = 100.0
    blur: float = 0.6
    smallest: int = 60
    tolerance: float = 0.015
    share: float = 0.4
    least: int = 40
    plain: float = 0.25
    error: float = 0.01


def textured(grey: NDArray) -> NDArray:
    """Return (H, W) bool: the pixels of a photograph (H, W) that have texture themselves. Without it a window is matched by what
    else is in it, and its depth is that of the nearest outline."""
    grey = np.asarray(grey, np.float64)
    own, window = (np.sqrt(np.maximum(uniform_filter(grey**2, size) - uniform_filter(grey, size) ** 2, 0.0)) for size in (3, 7))
    return (own >= LEAST_TEXTURE) & (own >= OWN_TEXTURE * window)


def flat_depth(grey: NDArray, depth: NDArray, options: FlatOptions = FlatOptions()) -> NDArray:
    """Return the z-depth (H, W) float32 of the planes of regions of one grey value, NaN where there is none (Eq. D.4).

    The inverse depth of a plane is linear in the pixel. Of each region, the coefficients minimise

        sum over pixels on the plane of ( (a u + b v + c) / w - 1 )^2,        w = 1 / depth

    whose covariance gives the standard error of every pixel, with `SAME_WINDOW` pixels as one observation.

    Args:
        grey: (H, W) in [0, 1].
        depth: (H, W) z-depth that is trusted, NaN = unknown.
        options: which regions count.
    """
    from skimage.segmentation import felzenszwalb

    height, width = depth.shape
    region = felzenszwalb(grey, scale=options.scale, sigma=options.blur, min_size=options.smallest, channel_axis=None).ravel()
    by_region, ends = np.argsort(region, kind="stable"), np.cumsum(np.bincount(region))
    v, u = np.divmod(np.arange(height * width), width)
    pixels = np.stack([(u - width / 2) / width, (v - height / 2) / width, np.ones(height * width)], 1)
    with np.errstate(divide="ignore"):
        inverse = 1.0 / depth.ravel().astype(np.float64)
    known = np.isfinite(inverse)
    plain = ~textured(grey).ravel()
    out = np.full(height * width, np.nan, np.float32)
    for own in np.split(by_region, ends[:-1]):
        trusted = own[known[own]]
        if len(trusted) < options.least or plain[own].mean() < options.plain:
            continue
        found = _plane(pixels[trusted] / inverse[trusted, None], options)
        if found is None:
            continue
        plane, covariance = found
        fitted = pixels[own] @ plane
        variance = np.einsum("ni,ij,nj->n", pixels[own], covariance, pixels[own])
        sure = (fitted > 0) & (variance <= np.square(options.error * fitted))
        out[own[sure]] = 1.0 / fitted[sure]
    return out.reshape(height, width)


def _plane(rows: NDArray, options: FlatOptions) -> tuple[NDArray, NDArray] | None:
    """Return a (3,) with rows a = 1 for as many rows (n, 3) as possible and its covariance (3, 3); None if these are too few."""
    rng = np.random.default_rng(SEED)
    triples = rows[rng.integers(len(rows), size=(TRIES, 3))]
    planes = np.linalg.solve(triples[np.abs(np.linalg.det(triples)) > 1e-12], np.ones((3, 1)))[..., 0]
    if not len(planes):
        return None
    some = rows[rng.permutation(len(rows))[:COMPARED]]
    plane = planes[np.argmax((np.abs(some @ planes.T - 1) < options.tolerance).sum(0))]
    for _ in range(3):
        on = np.abs(rows @ plane - 1) < options.tolerance
        if on.sum() < max(options.least, options.share * len(rows)):
            return None
        normal = rows[on].T @ rows[on]
        if np.linalg.cond(normal) > 1e10:  # along a line: it turns about it
            return None
        plane = np.linalg.solve(normal, rows[on].sum(0))
    error = max(float(np.std(rows[on] @ plane - 1)), LEAST_ERROR)
    return plane, np.linalg.inv(normal) * error**2 * min(SAME_WINDOW, int(on.sum()))
