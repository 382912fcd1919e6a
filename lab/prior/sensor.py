"""From rendered radiance to photographs: exposure, tint, blur, noise, response, eight bits, JPEG; or radiance as it is (HDR)."""

from __future__ import annotations

import io
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from lab.simulated.photographs import ResponseCurve, exposures

HDR = 0.12
"""Share of the captures that deliver radiance."""


@dataclass(frozen=True)
class Photographs:
    """The photographs of a capture.

    Attributes:
        values: (V, H, W, 3), uint8 sensor values, or float16 radiance of an HDR capture.
        exposure: (V,) as the capture names them, which may be off by a few per cent.
    """

    values: np.ndarray
    exposure: np.ndarray

    @property
    def is_hdr(self) -> bool:
        """Whether the values are radiance."""
        return self.values.dtype != np.uint8


def draw_response(rng: np.random.Generator) -> ResponseCurve:
    """Draw a response curve: S-shaped ones that differ between channels, powers, sRGB."""
    kind = rng.random()
    if kind < 0.15:
        return ResponseCurve("srgb")
    if kind < 0.25:
        return ResponseCurve("power", (1 / float(rng.uniform(1.8, 2.6)),) * 3, linear=True)
    about = lambda centre, width: tuple(float(v) for v in centre + rng.uniform(-width, width, 3))  # noqa: E731
    strength = tuple(float(s) for s in np.clip(about(rng.uniform(0, 0.48), 0.04), 0, 0.6))
    return ResponseCurve("random", about(rng.uniform(0.88, 1.08), 0.05), strength, about(rng.uniform(0.85, 1.1), 0.05))


def photograph(radiance: np.ndarray, metered: np.ndarray, rng: np.random.Generator) -> Photographs:
    """Photograph rendered radiance with a random camera.

    Args:
        radiance: (V, H, W, 3) linear.
        metered: (V, H, W) bool, pixels that the exposure heeds: no lamps.
        rng: random numbers.

    Returns:
        The photographs.
    """
    stops = np.sort(2.0 ** (rng.uniform(0, 2) * np.linspace(-1, 1, 5)))
    sparse = [r.reshape(-1, 3)[::4] for r in radiance], [m.ravel()[::4] for m in metered]
    gains = exposures(*sparse, stops=stops, grey=float(rng.uniform(0.1, 0.28)))
    image = radiance * np.exp(rng.normal(0, 0.08, 3)) * _vignette(radiance.shape[1:3], rng)[..., None]
    if rng.random() < 0.5:
        width = rng.uniform(0.2, 0.7)
        image = gaussian_filter(image, (0, width, width, 0))
    if rng.random() < HDR:
        return Photographs(np.minimum(image, 6e4).astype(np.float16), np.ones(len(radiance)))
    exposed = gains[:, None, None, None] * image
    if rng.random() < 0.6:
        shot, read = rng.uniform(0, 0.012), rng.uniform(0, 0.004)
        exposed = exposed + rng.normal(size=radiance.shape) * (read + shot * np.sqrt(np.maximum(exposed, 0)))
    encoded = draw_response(rng)(np.clip(exposed, 0, 1))
    values = np.rint(255 * np.clip(encoded, 0, 1)).astype(np.uint8)
    if rng.random() < 0.4:
        quality = int(rng.integers(60, 97))
        values = np.stack([_jpeg(value, quality) for value in values])
    stated = gains * (np.exp(rng.normal(0, 0.04, len(gains))) if rng.random() < 0.3 else 1.0)
    return Photographs(values, stated)


def _vignette(shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """Fall-off (H, W) towards the corners, in three captures of ten."""
    strength = rng.uniform(0, 0.3) if rng.random() < 0.3 else 0.0
    y, x = (np.linspace(-1, 1, n) for n in shape)
    return 1 - strength * (x[None] ** 2 + y[:, None] ** 2) / 2


def _jpeg(value: np.ndarray, quality: int) -> np.ndarray:
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(value).save(buffer, "JPEG", quality=quality)
    return np.asarray(Image.open(buffer))
