"""Arrays, pictures and light maps as text inside of room.html; deterministic, and undone by `decode` of viewer.js."""

from __future__ import annotations

import base64
import io
import zlib
from dataclasses import dataclass

import numpy as np

Array = np.ndarray


@dataclass(frozen=True)
class Blob:
    """Data of one `<script type="application/octet-stream">` of the page.

    Attributes:
        text: base64.
        kind: `array` or a MIME type such as `image/webp`.
        dtype: of an array, as JavaScript calls it (`Uint16Array`), else "".
        components: numbers of an item; items: how many; both 0 of pictures.
    """

    text: str
    kind: str
    dtype: str = ""
    components: int = 0
    items: int = 0


_NAMES = {np.dtype(np.uint8): "Uint8Array", np.dtype(np.uint16): "Uint16Array", np.dtype(np.uint32): "Uint32Array"}


def array_blob(values: Array) -> Blob:
    """Compress unsigned integers (items, components): differences along the items of each component, modulo the range of the
    type, then all lowest bytes, all second bytes and so on, then deflate. Neighbours are alike, so most bytes become small.
    """
    values = np.ascontiguousarray(values.reshape(len(values), int(np.prod(values.shape[1:]))).T)
    steps = np.diff(values, axis=1, prepend=np.zeros((len(values), 1), values.dtype))  # wraps around
    planes = steps.astype(values.dtype).ravel().view(np.uint8).reshape(values.size, values.itemsize).T
    packed = zlib.compress(np.ascontiguousarray(planes).tobytes(), 9)
    return Blob(base64.b64encode(packed).decode(), "array", _NAMES[values.dtype], *values.shape)


def picture_blob(picture: Array, quality: int | None) -> Blob:
    """Encode (H, W, 3), (H, W, 4) or (H, W) uint8 as WebP of this quality, or without loss where it is None."""
    from PIL import Image

    buffer = io.BytesIO()
    options = {"lossless": True, "quality": 80, "method": 4} if quality is None else {"quality": quality, "method": 4}
    Image.fromarray(np.ascontiguousarray(picture)).save(buffer, "WEBP", exact=True, **options)
    return Blob(base64.b64encode(buffer.getvalue()).decode(), "image/webp")


def quantized(values: Array, low: Array, high: Array) -> Array:
    """Map values (n, C) from [low, high] to 0 ... 65535, rounded to nearest; uint16."""
    span = np.maximum(np.asarray(high, np.float64) - low, 1e-30)
    return np.rint(np.clip((np.asarray(values, np.float64) - low) / span, 0, 1) * 65535).astype(np.uint16)


def normals_to_bytes(normals: Array) -> Array:
    """Map unit vectors (n, 3) to bytes, 128 + 127 n rounded to nearest; uint8."""
    return np.rint(128 + 127 * np.clip(normals, -1, 1)).astype(np.uint8)
