"""The predictions of a capture, as stage prior wrote them or as they were just made."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from iif_core.reflectance.material import PROPERTIES
from workflow.artifacts.store import StageReader, rgb
from workflow.scene.normal_form import View


class Predictions(Protocol):
    """The predictions of a capture, view by view."""

    samples: int
    """K."""

    def has(self, view: View) -> bool:
        """Return whether there are predictions of a view."""
        ...

    def maps(self, view: View, samples: int) -> np.ndarray:
        """Return the first `samples` predictions of a view, (K, H, W, 5) float16 in [0, 1], NaN where one is missing."""
        ...

    def scale(self, view: View) -> np.ndarray | None:
        """Return the Laplace scales (H, W, 3) that the prior states for a view, or None."""
        ...


class StoredPredictions:
    """Predictions as stage prior wrote them."""

    def __init__(self, prior: StageReader):
        self._prior = prior
        self.samples = int(prior.table("predictions.parquet")["k"].max(initial=0)) + 1

    def has(self, view: View) -> bool:
        return self._prior.has(f"maps/{view.name}.exr")

    def maps(self, view: View, samples: int) -> np.ndarray:
        channels = self._prior.exr(f"maps/{view.name}.exr")
        out = np.full((samples, view.height, view.width, 5), np.nan, np.float16)
        for k in range(samples):
            layer = f"prior.{k:03d}"
            if f"{layer}.roughness" in channels:
                out[k, ..., :3] = rgb(channels, f"{layer}.albedo")
                out[k, ..., 3], out[k, ..., 4] = channels[f"{layer}.roughness"], channels[f"{layer}.metallic"]
        return np.clip(out, 0, 1, out=out)  # every solver reads the same values; NaN stays

    def scale(self, view: View) -> np.ndarray | None:
        channels = self._prior.exr(f"maps/{view.name}.exr")
        names = [f"scale.{name}" for name in PROPERTIES]
        return np.stack([channels[name] for name in names], -1) if names[0] in channels else None
