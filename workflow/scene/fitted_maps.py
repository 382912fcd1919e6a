"""The fitted materials of a view, as stage render publishes them."""

from __future__ import annotations

import numpy as np

from iif_core.reflectance.material import BLACK
from workflow.artifacts.store import StageReader
from workflow.scene.normal_form import View

MATERIAL = ("albedo.R", "albedo.G", "albedo.B", "roughness", "metallic")


def fitted_maps(affines: StageReader, segmentation: StageReader, view: View) -> dict[str, np.ndarray]:
    """Read fitted materials and uncertainty (half) and object ids (UINT) of one view, as far as the stages wrote them."""
    file = f"maps/{view.name}.exr"
    channels: dict[str, np.ndarray] = {}
    if affines.has(file):
        fitted = affines.exr(file)
        channels = {name: fitted[name].astype(np.float16) for name in (*MATERIAL, "uncertainty")}
    if segmentation.has(file):
        channels["instance.id"] = segmentation.exr(file)["object.id"]
    return channels


def without_emitters(fitted: dict[str, np.ndarray], emits: np.ndarray) -> dict[str, np.ndarray]:
    """Return the fitted maps with the material of emitters in the model where `emits` (H, W): black, rough, not metallic."""
    values = {**dict(zip(MATERIAL, BLACK, strict=True)), "uncertainty": 0}
    return {
        name: np.where(emits, np.float16(values[name]), channel) if name in values else channel
        for name, channel in fitted.items()
    }
