"""Radiance of photographs, and where it is only a lower bound (docs/method/light.md#radiance-and-bounds)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from iif_core.camera.response import SATURATION, Response


@dataclass(frozen=True)
class Sensor:
    """What turns sensor values into radiance.

    Attributes:
        curve: camera response; is_hdr: values are linear radiance already; saturation: sensor value from which a
            pixel only bounds the radiance from below.
    """

    curve: Response
    is_hdr: bool
    saturation: float = SATURATION

    def radiance(self, value: np.ndarray, exposure: float) -> tuple[np.ndarray, np.ndarray]:
        """Return (n, 3) linear radiance f^-1(I) / exposure, and (n, 3) bool where it is only a lower bound (Eq. L.1)."""
        if self.is_hdr:
            return np.maximum(value, 0.0), np.zeros(value.shape, bool)
        bound = value >= self.saturation
        # From saturation on a value proves no more than f^-1(I_sat) / exposure.
        return self.curve.inverse(np.clip(value, 0.0, self.saturation)) / exposure, bound
