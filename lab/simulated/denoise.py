"""Denoising without the truth."""

from __future__ import annotations

import numpy as np

from workflow.models.denoise import _oidn


def denoise_alone(radiance: np.ndarray) -> np.ndarray:
    """Denoise a linear HDR picture (H, W, 3) without guides."""
    return np.maximum(_oidn().denoise(np.ascontiguousarray(radiance, np.float32), hdr=True), 0)
