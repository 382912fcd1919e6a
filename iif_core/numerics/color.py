"""Colour for the border: the sRGB transfer curve, luminance, and pictures of radiance, ids and errors for people.

Everything inside the project is linear. The curve as a camera response, with derivatives, is `response("srgb")`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from iif_core.errors import InputError

Array = np.ndarray

REC709_LUMINANCE = (0.2126, 0.7152, 0.0722)
"""Weights of linear R, G, B in luminance (ITU-R BT.709)."""

SRGB_KNEE = 0.0031308
"""Linear value below which the sRGB curve is a straight line, 12.92 x (IEC 61966-2-1)."""

GOLDEN_RATIO = 0.6180339887498949
NO_ID_COLOUR = (0.08, 0.08, 0.08)

# 17 samples of two perceptually uniform maps (inferno, viridis; CC0), sRGB-encoded. Dark = small.
_MAPS = {
    "error": "000004 0b0724 210c4a 3d0965 57106e 71196e 8a226a a32c61 bc3754"
    " d24644 e45a31 f1731d f98e09 fcac11 f9cb35 f2ea69 fcffa4",
    "value": "440154 48186a 472d7b 424086 3b528b 33638d 2c728e 26828e 21918c"
    " 1fa088 28ae80 3fbc73 5ec962 84d44b addc30 d8e219 fde725",
}


def srgb_from_linear(x: ArrayLike) -> Array:
    """Encode: 12.92 x below 0.0031308, else 1.055 x^(1/2.4) - 0.055 (IEC 61966-2-1); odd in x.

    Any shape, result float64 (float32 in, float32 out). Example: 0.5 -> 0.73536.
    """
    x = _floating(x)
    size = np.abs(x)
    high = 1.055 * np.maximum(size, SRGB_KNEE) ** (1 / 2.4) - 0.055
    return np.copysign(np.where(size <= SRGB_KNEE, 12.92 * size, high), x).astype(x.dtype)


def linear_from_srgb(y: ArrayLike) -> Array:
    """Decode: the inverse of `srgb_from_linear`. Example: 0.5 -> 0.21404."""
    y = _floating(y)
    size = np.abs(y)
    high = ((np.maximum(size, 0.04045) + 0.055) / 1.055) ** 2.4
    return np.copysign(np.where(size <= 0.04045, size / 12.92, high), y).astype(y.dtype)


def luminance(rgb: ArrayLike) -> Array:
    """Luminance Y = 0.2126 R + 0.7152 G + 0.0722 B of linear (..., 3); result (...)."""
    rgb = _floating(rgb)
    if rgb.shape[-1:] != (3,):
        raise InputError(f"luminance: found shape {rgb.shape}, the last axis must be R, G, B")
    return rgb @ np.asarray(REC709_LUMINANCE, rgb.dtype)


def key_exposure(radiance: ArrayLike, valid: Array | None = None, key: float = 0.18) -> float:
    """Factor that brings the log-average of luminance, exp(mean(ln Y)), to `key` (Reinhard et al. 2002); 1 without light.

    Luminance below 1e-6 of its mean counts as that, so that black pixels do not decide.

    Args:
        radiance: (..., 3) linear.
        valid: (...) bool, which pixels count; default all.
    """
    y = luminance(radiance).astype(np.float64)
    y = y[np.isfinite(y) if valid is None else np.isfinite(y) & valid]
    level = float(y.mean()) if y.size else 0.0
    return float(key / np.exp(np.log(np.maximum(y, 1e-6 * level)).mean())) if level > 1e-12 else 1.0


def tone_map(radiance: ArrayLike, exposure: float = 1.0) -> Array:
    """Picture of linear radiance: sRGB(clip(exposure L, 0, 1)); NaN becomes 0. Shape kept, values in [0, 1]."""
    exposed = np.nan_to_num(_floating(radiance) * exposure, nan=0.0, posinf=1.0, neginf=0.0)
    return srgb_from_linear(np.clip(exposed, 0.0, 1.0))


def to_uint8(picture: ArrayLike) -> Array:
    """[0, 1] -> 0 ... 255, rounded to nearest; values outside are clipped, NaN becomes 0."""
    return np.rint(np.clip(np.nan_to_num(_floating(picture)), 0.0, 1.0) * 255).astype(np.uint8)


def id_colours(ids: ArrayLike) -> Array:
    """Distinct sRGB colours (..., 3) in [0, 1] of integer ids: the same id has the same colour in every picture.

    The hue advances by the golden ratio, so that neighbouring ids are far apart; lightness and chroma cycle with
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


def false_colour(values: ArrayLike, low: float = 0.0, high: float = 1.0, scheme: str = "error") -> Array:
    """Scalar map (...) as sRGB colours (..., 3) in [0, 1] by a perceptually uniform map: `low` dark, `high` light.

    Values outside the range take its end, NaN is mid-grey. `scheme`: `error` (inferno) or `value` (viridis).

    Raises:
        InputError: unknown scheme, or high <= low.
    """
    if scheme not in _MAPS:
        raise InputError(f"colour map {scheme!r}: unknown; allowed: {', '.join(_MAPS)}")
    if not high > low:
        raise InputError(f"colour map range {low} ... {high}: the upper end must be larger")
    values = _floating(values)
    anchors = np.array([[int(text[i : i + 2], 16) for i in (0, 2, 4)] for text in _MAPS[scheme].split()]) / 255
    position = np.clip((np.nan_to_num(values, nan=low, posinf=high, neginf=low) - low) / (high - low), 0, 1)
    grid = np.linspace(0, 1, len(anchors))
    colours = np.stack([np.interp(position, grid, anchors[:, c]) for c in range(3)], -1)
    return np.where(np.isnan(values)[..., None], 0.5, colours)


def _floating(x: ArrayLike) -> Array:
    x = np.asarray(x)
    return x if x.dtype in (np.float32, np.float64) else x.astype(np.float64)


def _linear_from_oklab(lightness: Array, a: Array, b: Array) -> Array:
    """Linear sRGB (n, 3) of OKLab (Ottosson 2020)."""
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
