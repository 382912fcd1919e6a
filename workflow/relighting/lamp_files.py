"""The files in which stage lamp_images writes a frame: a layer of R, G and B for every lamp."""

from __future__ import annotations

import numpy as np

Array = np.ndarray

LARGEST_HALF = 6e4
"""Radiance above which pictures are kept as single instead of half floats."""


def lamp_channels(pictures: Array) -> dict[str, Array]:
    """Return the channels of a frame from the radiance (L, H, W, 3) of its lamps."""
    dtype = np.float16 if pictures.max(initial=0.0) < LARGEST_HALF else np.float32
    return {
        _channel(lamp, c): picture[..., i].astype(dtype) for lamp, picture in enumerate(pictures) for i, c in enumerate("RGB")
    }


def lamp_pictures(channels: dict[str, Array], lamps: int) -> Array:
    """Return the radiance (L, H, W, 3) float32 of the lamps from the channels of a frame."""
    return np.stack([np.stack([channels[_channel(lamp, c)] for c in "RGB"], -1).astype(np.float32) for lamp in range(lamps)])


def _channel(lamp: int, colour: str) -> str:
    return f"lamp{lamp:03d}.{colour}"
