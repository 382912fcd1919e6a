"""Pictures of maps for people: 8-bit arrays from linear data, and their encoding into a page."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence

import numpy as np

from iif_core.numerics import color

Array = np.ndarray

SEGMENT_EDGE = (1.0, 0.55, 0.0)
OBJECT_BORDER = (0.05, 0.05, 0.05)
DEPTH_EDGE = (0.0, 0.85, 1.0)
DEPTH_STEP = 0.05  # see `depth_edges`


def encoded(image: Array) -> Array:
    """Sensor or sRGB values in [0, 1] as they are."""
    return color.to_uint8(image)


def linear(image: Array, exposure: float = 1.0) -> Array:
    """Linear colour (H, W, 3), sRGB-encoded."""
    return color.to_uint8(color.tone_map(image, exposure))


def scalar(values: Array, low: float = 0.0, high: float = 1.0, scheme: str = "value", mask: Array | None = None) -> Array:
    """(H, W) in false colours; grey where `mask` is False."""
    picture = color.false_colour(values, low, high, scheme)
    return color.to_uint8(picture if mask is None else np.where(mask[..., None], picture, 0.35))


def grey(values: Array) -> Array:
    """(H, W) in [0, 1] as grey without encoding: 0.5 looks like the middle."""
    return color.to_uint8(np.repeat(values[..., None], 3, -1))


def ids(values: Array) -> Array:
    """(H, W) ids in distinct colours."""
    return color.to_uint8(color.id_colours(values))


def overlay(photo: Array, values: Array) -> Array:
    """(H, W) ids in distinct colours over the photograph (H, W, 3), borders dark."""
    picture = 0.5 * np.clip(photo, 0, 1) + 0.5 * color.id_colours(values)
    picture[edges(values)] = OBJECT_BORDER
    return color.to_uint8(picture)


def difference(a: Array, b: Array, mask: Array, high: float = 0.25) -> Array:
    """Mean absolute difference of two (H, W, 3) or (H, W) images, 0 ... `high`; grey outside `mask`."""
    error = np.abs(np.asarray(a, np.float64) - b)
    return scalar(error.mean(-1) if error.ndim == 3 else error, 0.0, high, "error", mask)


def edges(ids: Array) -> Array:
    """(H, W) bool: the id differs from that of the pixel to the right or below."""
    out = np.zeros(ids.shape, bool)
    out[:-1] |= ids[:-1] != ids[1:]
    out[:, :-1] |= ids[:, :-1] != ids[:, 1:]
    return out


def depth_edges(depth: Array, step: float = DEPTH_STEP) -> Array:
    """(H, W) bool: inverse depth bends by more than the share `step` of itself between three neighbours.

    Inverse depth is linear over the image of a plane, so slanted walls have no edges, only steps and sharp folds do.
    0 = miss counts as infinitely far.
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
    """Edges of the mesh over the pale photograph, where they should lie on what they outline: objects, depth steps."""
    picture = 0.55 * np.repeat(np.clip(photo, 0, 1).mean(-1, keepdims=True), 3, -1) + 0.2
    picture[depth_edges(depth)] = DEPTH_EDGE
    picture[edges(object_id)] = SEGMENT_EDGE
    return color.to_uint8(picture)


def selected_prediction(segment_id: Array, row_segment: Array, row_k: Array, row_weight: Array) -> Array:
    """(H, W) int: number of the prediction with the largest weight in each pixel's segment, -1 without one."""
    if not len(row_segment):
        return np.full(segment_id.shape, -1, np.int64)
    order = np.lexsort((-row_k, row_weight, row_segment))  # last row of a segment: heaviest, ties to the smaller k
    segments, first = np.unique(row_segment[order][::-1], return_index=True)
    best = np.full(max(int(segments.max()), int(segment_id.max(initial=-1))) + 2, -1, np.int64)
    best[segments] = row_k[order][::-1][first]
    return np.where(segment_id >= 0, best[segment_id], -1)


def data_uri(image: Array, lossless: bool = False) -> str:
    """(H, W, 3) uint8 as a `data:` address, JPEG without colour subsampling, or PNG. Same image, same bytes."""
    from PIL import Image

    buffer = io.BytesIO()
    picture = Image.fromarray(np.ascontiguousarray(image))
    if lossless:
        picture.save(buffer, "PNG", optimize=True)
    else:
        picture.save(buffer, "JPEG", quality=90, subsampling=0)
    kind = "png" if lossless else "jpeg"
    return f"data:image/{kind};base64,{base64.b64encode(buffer.getvalue()).decode()}"


def curves_svg(curves: Sequence[tuple[Array, Array, str, bool]], width: int = 300, height: int = 220) -> str:
    """Curves over [0, 1] x [0, 1] as SVG text: (x, y, colour, dashed)."""
    left, bottom, top, right = 34, 28, 8, 8
    w, h = width - left - right, height - top - bottom
    out = [f'<svg viewBox="0 0 {width} {height}" width="{width}" height="{height}" role="img">']
    for tick in (0, 0.25, 0.5, 0.75, 1):
        x, y = left + tick * w, top + (1 - tick) * h
        out.append(f'<path d="M{x:.1f} {top}V{top + h}M{left} {y:.1f}H{left + w}" stroke="#ddd" fill="none"/>')
        out.append(f'<text x="{x:.1f}" y="{top + h + 13}" text-anchor="middle">{tick:g}</text>')
        out.append(f'<text x="{left - 4}" y="{y + 3:.1f}" text-anchor="end">{tick:g}</text>')
    for x, y, colour, dashed in curves:
        points = " ".join(
            f"{left + np.clip(a, 0, 1) * w:.1f},{top + (1 - np.clip(b, 0, 1)) * h:.1f}" for a, b in zip(x, y, strict=True)
        )
        dash = ' stroke-dasharray="5 4"' if dashed else ""
        out.append(f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="1.6"{dash}/>')
    out.append(f'<text x="{left + w / 2}" y="{height - 2}" text-anchor="middle">exposed radiance</text></svg>')
    return "".join(out)
