"""Denoising of rendered pictures: photographs, re-renderings, the light of the baselines. Never of what our fit reads."""

from __future__ import annotations

import numpy as np

from iif_core.errors import InputError

NOTE = "photographs denoised (Intel Open Image Denoise): biased, and so is the radiance truth"


def require_denoiser() -> None:
    """Raises InputError where the denoiser does not load."""
    try:
        import pyoidn  # noqa: F401
    except (ImportError, OSError) as error:
        raise InputError(
            f"denoise: the package pyoidn (Intel Open Image Denoise) does not load ({error});"
            " run `bash envs/setup.sh`, or set capture.denoise: false and render.denoise: false"
        ) from None


def denoise(radiance: np.ndarray, albedo: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """An HDR picture (H, W, 3) without its noise, guided by noise-free albedo and world normals."""
    import pyoidn

    images = [np.ascontiguousarray(image, np.float32) for image in (radiance, albedo, normal)]
    return np.maximum(pyoidn.denoise(*images, hdr=True, clean_aux=True), 0)
