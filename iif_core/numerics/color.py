"""Colour at the border of the project: the sRGB transfer curve, luminance, and colours of pictures for people.

All colour inside the project is linear; as a camera response, sRGB is `response("srgb")` of `iif_core.camera.response`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from iif_core.errors import InputError

Array = np.ndarray

REC709_LUMINANCE = (0.2126, 0.7152, 0.0722)
"""Weights of linear R, G, B in luminance (ITU-R BT.709)."""

REC709_PRIMARIES = ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06), (0.3127, 0.3290))
"""CIE x, y of red, green, blue and white of linear Rec. 709, the primaries of sRGB, which every colour here is taken to have."""

_BRADFORD = ((0.8951, 0.2664, -0.1614), (-0.7502, 1.7135, 0.0367), (0.0389, -0.0685, 1.0296))
"""Cone responses of CIE XYZ, in which one white is turned into another (Lindbloom, after Lam 1985)."""

SRGB_KNEE = 0.0031308
"""Linear value below which the sRGB curve is a straight line, 12.92 x (IEC 61966-2-1)."""

GOLDEN_RATIO = 0.6180339887498949
NO_ID_COLOUR = (0.08, 0.08, 0.08)


def srgb_from_linear(x: ArrayLike) -> Array:
    """Encode linear values with the sRGB curve (IEC 61966-2-1), continued as an odd function.

    12.92 x up to 0.0031308, then 1.055 x^(1/2.4) - 0.055. Any shape; float32 stays float32, other dtypes become float64.

    Example:
        >>> round(float(srgb_from_linear(0.5)), 5)
        0.73536
    """
    x = _floating(x)
    size = np.abs(x)
    high = 1.055 * np.maximum(size, SRGB_KNEE) ** (1 / 2.4) - 0.055
    return np.copysign(np.where(size <= SRGB_KNEE, 12.92 * size, high), x).astype(x.dtype)


def linear_from_srgb(y: ArrayLike) -> Array:
    """Decode sRGB values: the inverse of `srgb_from_linear`. Example: 0.5 -> 0.21404."""
    y = _floating(y)
    size = np.abs(y)
    high = ((np.maximum(size, 0.04045) + 0.055) / 1.055) ** 2.4
    return np.copysign(np.where(size <= 0.04045, size / 12.92, high), y).astype(y.dtype)


def rec709_from_primaries(primaries: ArrayLike) -> Array:
    """Compute the matrix from linear colours of other primaries to linear Rec. 709.

    XYZ = P diag(P^-1 w) rgb, where the columns of P are XYZ of the primaries at luminance 1 and w is XYZ of white. Bradford's
    cone responses adapt white (SMPTE RP 177; Lindbloom).

    Args:
        primaries: (4, 2) CIE x, y of red, green, blue and white.

    Returns:
        (3, 3) float64; rows sum to 1, so that white stays white.

    Raises:
        InputError: primaries on one line, or y = 0.
    """
    to_xyz, white = _xyz_of(primaries)
    of_rec709, target = _xyz_of(REC709_PRIMARIES)
    cones = np.asarray(_BRADFORD)
    adapt = np.linalg.inv(cones) @ np.diag((cones @ target) / (cones @ white)) @ cones
    return np.linalg.inv(of_rec709) @ adapt @ to_xyz


def _xyz_of(primaries: ArrayLike) -> tuple[Array, Array]:
    """Return XYZ of linear red, green and blue as columns (3, 3), and that of white (3,), at luminance 1."""
    xy = np.asarray(primaries, np.float64)
    if xy.shape != (4, 2) or not np.isfinite(xy).all() or (np.abs(xy[:, 1]) < 1e-6).any():
        raise InputError(f"primaries {xy.tolist()}: four pairs x, y with y other than 0 are needed: red, green, blue, white")
    x, y = xy.T
    columns = np.stack([x / y, np.ones(4), (1 - x - y) / y])
    if abs(np.linalg.det(np.stack([x[:3], y[:3], np.ones(3)]))) < 1e-4:  # twice the area of their triangle
        raise InputError(f"primaries {xy[:3].tolist()} lie on one line; red, green and blue must span a triangle")
    return columns[:, :3] * np.linalg.solve(columns[:, :3], columns[:, 3]), columns[:, 3]


def lab_from_linear(rgb: ArrayLike) -> Array:
    """Return CIELAB (..., 3) of linear Rec.709 (..., 3) in [0, 1], white D65: L* in [0, 100], a*, b* (ISO/CIE 11664-4).

    >>> lab_from_linear([1.0, 1.0, 1.0]).round(6) + 0.0
    array([100.,   0.,   0.])
    """
    to_xyz, white = _xyz_of(REC709_PRIMARIES)
    relative = np.asarray(rgb, np.float64) @ (to_xyz / white[:, None]).T
    return np.moveaxis(lab_from_relative(np.moveaxis(relative, -1, 0)), 0, -1)


def lab_from_relative(xyz: Array) -> Array:
    """Return CIELAB (3, ...) of CIE XYZ (3, ...) over that of white (ISO/CIE 11664-4); the dtype stays."""
    bend = 6 / 29
    x, y, z = np.where(xyz > bend**3, np.cbrt(xyz), xyz / (3 * bend**2) + 4 / 29)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)])


def luminance(rgb: ArrayLike) -> Array:
    """Compute the luminance 0.2126 R + 0.7152 G + 0.0722 B of linear colours (..., 3); result (...)."""
    rgb = _floating(rgb)
    if rgb.shape[-1:] != (3,):
        raise InputError(f"luminance: found shape {rgb.shape}, the last axis must be R, G, B")
    return rgb @ np.asarray(REC709_LUMINANCE, rgb.dtype)


def key_exposure(radiance: ArrayLike, valid: Array | None = None, key: float = 0.18) -> float:
    """Compute the factor that brings the log-average of the luminance, exp(mean(ln Y)), to `key` (Reinhard et al. 2002).

    Luminance of linear radiance (..., 3) below 1e-6 of the mean is raised to that value. 1 for a picture without light.
    """
    y = luminance(radiance).astype(np.float64)
    y = y[np.isfinite(y) if valid is None else np.isfinite(y) & valid]
    level = float(y.mean()) if y.size else 0.0
    return float(key / np.exp(np.log(np.maximum(y, 1e-6 * level)).mean())) if level > 1e-12 else 1.0


def tone_map(radiance: ArrayLike, exposure: float = 1.0) -> Array:
    """Encode linear radiance for display: sRGB(clip(exposure L, 0, 1)), shape kept, in [0, 1]; NaN becomes 0."""
    exposed = np.nan_to_num(_floating(radiance) * exposure, nan=0.0, posinf=1.0, neginf=0.0)
    return srgb_from_linear(np.clip(exposed, 0.0, 1.0))


def to_uint8(picture: ArrayLike) -> Array:
    """Convert [0, 1] to 0 ... 255, rounded to nearest; values outside are clipped, NaN becomes 0."""
    return np.rint(np.clip(np.nan_to_num(_floating(picture)), 0.0, 1.0) * 255).astype(np.uint8)


def id_colours(ids: ArrayLike) -> Array:
    """Assign distinct sRGB colours (..., 3) in [0, 1] to integer ids; an id has the same colour in every picture.

    The hue advances by the golden ratio, so that neighbouring ids are far apart; lightness and chroma cycle with the
    periods 3 and 2 in OKLCh. Negative ids (none) are dark grey.
    """
    ids = np.asarray(ids, np.int64)
    unique, inverse = np.unique(ids, return_inverse=True)
    hue = 2 * np.pi * np.mod(unique * GOLDEN_RATIO, 1.0)
    lightness = np.asarray([0.72, 0.58, 0.84])[unique % 3]
    chroma = np.asarray([0.13, 0.09])[(unique // 3) % 2]
    colours = srgb_from_linear(np.clip(_linear_from_oklab(lightness, chroma * np.cos(hue), chroma * np.sin(hue)), 0, 1))
    colours[unique < 0] = NO_ID_COLOUR
    return colours[inverse.ravel()].reshape(*ids.shape, 3)


def _floating(x: ArrayLike) -> Array:
    x = np.asarray(x)
    return x if x.dtype in (np.float32, np.float64) else x.astype(np.float64)


def _linear_from_oklab(lightness: Array, a: Array, b: Array) -> Array:
    """Linear sRGB (n, 3) of OKLab colours (Ottosson 2020)."""
    l_ = (lightness + 0.3963377774 * a + 0.2158037573 * b) ** 3
    m_ = (lightness - 0.1055613458 * a - 0.0638541728 * b) ** 3
    s_ = (lightness - 0.0894841775 * a - 1.2914855480 * b) ** 3
    return np.stack(
        [
            4.0767416621 * l_ - 3.3077115913 * m_ + 0.2309699292 * s_,
            -1.2684380046 * l_ + 2.6097574011 * m_ - 0.3413193965 * s_,
            -0.0041960863 * l_ - 0.7034186147 * m_ + 1.7076147010 * s_,
        ],
        -1,
    )
