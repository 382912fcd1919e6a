"""The camera of one photograph."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import DTypeLike

from iif_core.camera.pinhole import pixel_directions


@dataclass(frozen=True)
class View:
    """The camera of one photograph: OpenCV axes, pixel centres at (u + 0.5, v + 0.5), lengths in metres."""

    view_id: int
    name: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_from_camera: np.ndarray  # (4, 4) float64
    exposure: float = 1.0  # multiplies radiance before the response
    split: str = "train"  # or "test": held out

    def directions(self) -> np.ndarray:
        """Return (H, W, 3) float32 world directions through pixel centres; point = origin + z-depth * direction (Eq. C.1)."""
        return pixel_directions(self.fx, self.fy, self.cx, self.cy, self.width, self.height, self.world_from_camera)

    def points(self, depth: np.ndarray, kind: DTypeLike = np.float32) -> np.ndarray:
        """Return (H, W, 3) surface points in metres from z-depth (H, W); they mean nothing where the depth is 0."""
        return (self.world_from_camera[:3, 3] + depth[..., None] * self.directions()).astype(kind)
