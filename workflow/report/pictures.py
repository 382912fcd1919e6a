"""Pictures of maps for the report: 8-bit arrays from linear data, and their encoding for the page."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from iif_core.errors import InputError
from iif_core.numerics import color

Array = np.ndarray

SEGMENT_EDGE = (1.0, 0.55, 0.0)
OBJECT_BORDER = (0.05, 0.05, 0.05)
DEPTH_EDGE = (0.0, 0.85, 1.0)
DEPTH_STEP = 0.05  # relative, see `depth_edges`
_COLOUR_MAPS = {"error": "inferno", "value": "viridis"}
SCALAR_STEPS = 128
"""Colours of a scalar map: few enough for a palette, so that the page can read values back from the colours."""


def png_address(path: Path) -> str:
    """Return the `data:` address of a PNG file."""
    return f"data:image/png;base64,{base64.b64encode(path.read_bytes()).decode()}"


def encoded(image: Array) -> Array:
    """Show sensor or sRGB values in [0, 1] unchanged."""
    return color.to_uint8(image)


def linear(image: Array, exposure: float = 1.0) -> Array:
    """Show linear colour (H, W, 3), encoded with the sRGB curve."""
    return color.to_uint8(color.tone_map(image, exposure))


def false_colour(values: Array, low: float = 0.0, high: float = 1.0, scheme: str = "error") -> Array:
    """Map scalars to sRGB colours (..., 3) in [0, 1] by a perceptually uniform colour map: `low` is dark, `high` is light.

    Args:
        values: (...) scalars; values outside the range take the colour of its end, NaN becomes mid-grey.
        low, high: range of the colour map.
        scheme: `error` (inferno) or `value` (viridis).

    Returns:
        (..., 3) float64.

    Raises:
        InputError: unknown scheme, or high <= low.
    """
    from matplotlib import colormaps

    if scheme not in _COLOUR_MAPS:
        raise InputError(f"colour map {scheme!r}: unknown; allowed: {', '.join(_COLOUR_MAPS)}")
    if not high > low:
        raise InputError(f"colour map range {low} ... {high}: the upper end must be larger")
    values = np.asarray(values, np.float64)
    position = np.clip((np.nan_to_num(values, nan=low, posinf=high, neginf=low) - low) / (high - low), 0, 1)
    return np.where(np.isnan(values)[..., None], 0.5, np.asarray(colormaps[_COLOUR_MAPS[scheme]](position))[..., :3])


def scalar(values: Array, low: float = 0.0, high: float = 1.0, scheme: str = "value", mask: Array | None = None) -> Array:
    """Draw a scalar map in false colours.

    Args:
        values: (H, W).
        low, high, scheme: as for `false_colour`.
        mask: (H, W) bool; pixels outside are grey.

    Returns:
        (H, W, 3) uint8.
    """
    if not high > low:
        raise InputError(f"colour map range {low} ... {high}: the upper end must be larger")
    position = np.clip(
        (np.nan_to_num(np.asarray(values, np.float64), nan=np.nan, posinf=high, neginf=low) - low) / (high - low), 0, 1
    )
    picture = false_colour(np.round(position * (SCALAR_STEPS - 1)) / (SCALAR_STEPS - 1), 0.0, 1.0, scheme)
    return color.to_uint8(picture if mask is None else np.where(mask[..., None], picture, 0.35))


def palette(scheme: str) -> list[str]:
    """Return the `SCALAR_STEPS` colours of `scalar`, from `low` to `high`, as `#rrggbb`."""
    ramp = color.to_uint8(false_colour(np.linspace(0, 1, SCALAR_STEPS), 0.0, 1.0, scheme))
    return ["#{:02x}{:02x}{:02x}".format(*rgb) for rgb in ramp]


def gradient(scheme: str, stops: int = 9) -> str:
    """Return the colour map as a CSS gradient, dark end first."""
    colours = palette(scheme)
    chosen = [colours[round(i * (len(colours) - 1) / (stops - 1))] for i in range(stops)]
    return f"linear-gradient(to right,{','.join(chosen)})"


def grey(values: Array) -> Array:
    """Show (H, W) values in [0, 1] as grey levels without encoding."""
    return color.to_uint8(np.repeat(values[..., None], 3, -1))


def ids(values: Array) -> Array:
    """Show (H, W) ids in distinct colours."""
    return color.to_uint8(color.id_colours(values))


def overlay(photo: Array, values: Array) -> Array:
    """Blend the colours of (H, W) ids with the photograph (H, W, 3); borders between ids are dark."""
    picture = 0.5 * np.clip(photo, 0, 1) + 0.5 * color.id_colours(values)
    picture[edges(values)] = OBJECT_BORDER
    return color.to_uint8(picture)


def difference(a: Array, b: Array, mask: Array, high: float = 0.25) -> Array:
    """Show the mean absolute difference of two images in false colours.

    Args:
        a, b: (H, W, 3) or (H, W).
        mask: (H, W) bool; pixels outside are grey.
        high: difference that is shown lightest.

    Returns:
        (H, W, 3) uint8.
    """
    error = np.abs(np.asarray(a, np.float64) - b)
    return scalar(error.mean(-1) if error.ndim == 3 else error, 0.0, high, "error", mask)


def edges(ids: Array) -> Array:
    """Find pixels whose id differs from the id of the pixel to the right or below; (H, W) bool."""
    out = np.zeros(ids.shape, bool)
    out[:-1] |= ids[:-1] != ids[1:]
    out[:, :-1] |= ids[:, :-1] != ids[:, 1:]
    return out


def depth_edges(depth: Array, step: float = DEPTH_STEP) -> Array:
    """Find depth discontinuities: the second difference of inverse depth exceeds the share `step` of it; (H, W) bool.

    Inverse depth is linear over the image of a plane, so slanted walls have no edges; steps and sharp folds have.
    Depth 0 (miss) counts as infinitely far.
    """
    w = np.where(depth > 0, 1 / np.maximum(depth, 1e-6), 0)
    out = np.zeros(depth.shape, bool)
    for a, b, c, middle in (
        (w[:-2], w[1:-1], w[2:], out[1:-1]),
        (w[:, :-2], w[:, 1:-1], w[:, 2:], out[:, 1:-1]),
    ):
        middle |= np.abs(a - 2 * b + c) > step * np.maximum(np.maximum(a, b), c)
    return out


def alignment(photo: Array, object_id: Array, depth: Array) -> Array:
    """Draw the mesh's object borders and depth edges over a pale photograph, to check that the mesh fits the photograph."""
    picture = 0.55 * np.repeat(np.clip(photo, 0, 1).mean(-1, keepdims=True), 3, -1) + 0.2
    picture[depth_edges(depth)] = DEPTH_EDGE
    picture[edges(object_id)] = SEGMENT_EDGE
    return color.to_uint8(picture)


def selected_prediction(segment_id: Array, row_segment: Array, row_k: Array, row_weight: Array) -> Array:
    """Find the prediction with the largest weight in the segment of every pixel.

    Args:
        segment_id: (H, W) int.
        row_segment, row_k, row_weight: (n,) segment, prediction number and weight of every row of the weight table.

    Returns:
        (H, W) int, the smallest such number; -1 for pixels without a segment or without weights.
    """
    if not len(row_segment):
        return np.full(segment_id.shape, -1, np.int64)
    order = np.lexsort((-row_k, row_weight, row_segment))  # heaviest row last; ties: smaller k
    segments, first = np.unique(row_segment[order][::-1], return_index=True)
    best = np.full(max(int(segments.max()), int(segment_id.max(initial=-1))) + 2, -1, np.int64)
    best[segments] = row_k[order][::-1][first]
    return np.where(segment_id >= 0, best[segment_id], -1)


def data_uri(image: Array, lossless: bool = False, longest: int | None = None) -> str:
    """Encode (H, W, 3) uint8 as a `data:` address: JPEG without colour subsampling, or PNG; deterministic.

    A picture whose longer side exceeds `longest` is made smaller: by the mean of its pixels, or, if it is to be lossless (ids,
    scalars in false colours), by the nearest ones. A lossless picture of at most 256 colours gets a palette.
    """
    from PIL import Image

    buffer = io.BytesIO()
    picture = Image.fromarray(np.ascontiguousarray(image))
    if longest and max(picture.size) > longest:
        size = tuple(max(1, round(side * longest / max(picture.size))) for side in picture.size)
        picture = picture.resize(size, Image.Resampling.NEAREST if lossless else Image.Resampling.BOX)
    if lossless:
        _indexed(np.asarray(picture)).save(buffer, "PNG", optimize=True)
    else:
        picture.save(buffer, "JPEG", quality=90, subsampling=0, optimize=True)
    kind = "png" if lossless else "jpeg"
    return f"data:image/{kind};base64,{base64.b64encode(buffer.getvalue()).decode()}"


def _indexed(image: Array) -> Any:
    """Return (H, W, 3) uint8 as a Pillow image, with a palette if it has at most 256 colours."""
    from PIL import Image

    key = (image.astype(np.uint32) << np.array([16, 8, 0], np.uint32)).sum(-1)
    colours, index = np.unique(key, return_inverse=True)
    if len(colours) > 256:
        return Image.fromarray(np.ascontiguousarray(image))
    out = Image.fromarray(index.reshape(key.shape).astype(np.uint8), "P")
    out.putpalette(np.stack([colours >> 16 & 255, colours >> 8 & 255, colours & 255], -1).astype(np.uint8).tobytes())
    return out


def curves_svg(curves: Sequence[tuple[Array, Array, str, bool]], title: str, width: int = 340, height: int = 250) -> str:
    """Draw curves, given as (x, y, name of a CSS class, dashed), over [0, 1] x [0, 1] as SVG text, which `title` describes."""
    left, bottom, top, right = 44, 34, 8, 8
    w, h = width - left - right, height - top - bottom
    out = [f'<svg viewBox="0 0 {width} {height}" width="{width}" height="{height}" role="img" aria-label="{escape(title)}">']
    for tick in (0, 0.25, 0.5, 0.75, 1):
        x, y = left + tick * w, top + (1 - tick) * h
        out.append(f'<path d="M{x:.1f} {top}V{top + h}M{left} {y:.1f}H{left + w}" class="grid"/>')
        out.append(f'<text x="{x:.1f}" y="{top + h + 13}" text-anchor="middle">{tick:g}</text>')
        out.append(f'<text x="{left - 4}" y="{y + 3:.1f}" text-anchor="end">{tick:g}</text>')
    for x, y, name, dashed in curves:
        points = " ".join(
            f"{left + np.clip(a, 0, 1) * w:.1f},{top + (1 - np.clip(b, 0, 1)) * h:.1f}" for a, b in zip(x, y, strict=True)
        )
        out.append(f'<polyline points="{points}" class="curve {name}{" dashed" if dashed else ""}"/>')
    out.append(f'<text x="{left + w / 2}" y="{height - 5}" text-anchor="middle">exposed radiance</text>')
    middle = top + h / 2
    out.append(f'<text x="11" y="{middle}" text-anchor="middle" transform="rotate(-90 11 {middle})">sensor value</text></svg>')
    return "".join(out)
