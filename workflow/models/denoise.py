"""Denoising of rendered pictures: photographs, re-renderings and the light of the baselines, but never data of
our solvers."""

from __future__ import annotations

import sys
from types import ModuleType

import numpy as np

from iif_core.errors import InputError


def require_denoiser() -> None:
    """Raise InputError if the denoiser cannot be loaded."""
    try:
        _oidn()
    except (ImportError, OSError) as error:
        raise InputError(
            f"denoise: the package pyoidn (Intel Open Image Denoise) does not load ({error});"
            " run `bash envs/setup.sh`, or set `components: {denoiser: off}`"
        ) from None


def denoise(radiance: np.ndarray, albedo: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Denoise a linear HDR picture (H, W, 3), guided by noise-free albedo and world normals."""
    images = [np.ascontiguousarray(image, np.float32) for image in (radiance, albedo, normal)]
    return np.maximum(_oidn().denoise(*images, hdr=True, clean_aux=True), 0)


def _oidn() -> ModuleType:
    """Import pyoidn without torch. It would import torch, which takes two seconds, only to accept tensors as well."""
    hidden = "torch" not in sys.modules
    if hidden:
        sys.modules["torch"] = None  # type: ignore[assignment]  # an import of it now raises ImportError
    try:
        import pyoidn
    finally:
        if hidden:
            del sys.modules["torch"]
    return pyoidn
