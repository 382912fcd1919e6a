"""The files of views, decoded once for all passes of a job over them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from iif_core.camera.pixels import DecodedView, ViewPixels, pixels_of_view
from workflow.artifacts.store import StageReader, ids_from_disk
from workflow.scene.normal_form import CaptureReader, View

MEMORY_MB = 512.0
"""Megabytes of decoded files that are kept; every pass over the views decodes the others again. Passes visit the views in the
same order, so the first ones are kept."""


@dataclass(frozen=True)
class Segmented:
    """Object and segment of every pixel of a view, (H, W) int32 with -1 = none, and whether it is away from borders, (H, W)."""

    object_id: np.ndarray
    segment_id: np.ndarray
    interior: np.ndarray


class DecodedViews:
    """Reader of photographs, G-buffers and segmentation, whose arrays must not be written to."""

    def __init__(self, capture: CaptureReader, segmentation: StageReader, memory_mb: float = MEMORY_MB):
        self.capture, self.segmentation, self.memory_mb = capture, segmentation, memory_mb
        self._kept: dict[tuple[str, int], tuple[np.ndarray, ...]] = {}

    def photo(self, view: View) -> tuple[np.ndarray, np.ndarray]:
        """Return values (H, W, 3) and usable pixels (H, W); the photograph of a held-out view is not read, and none is usable."""
        if view.split == "test":
            return np.zeros((view.height, view.width, 3), np.float32), np.zeros((view.height, view.width), bool)
        return self._once("photo", view, lambda: self.capture.photo(view))

    def gbuffer(self, view: View) -> tuple[np.ndarray, np.ndarray]:
        """Return z-depth (H, W) in metres, 0 = miss, and face ids (H, W), -1 = miss."""
        return self._once("gbuffer", view, lambda: self.capture.gbuffer(view))

    def segmented(self, view: View) -> Segmented:
        """Return what the segmentation says of the pixels."""

        def read() -> tuple[np.ndarray, ...]:
            maps = self.segmentation.exr(f"maps/{view.name}.exr")
            return ids_from_disk(maps["object.id"]), ids_from_disk(maps["segment.id"]), maps["interior"] > 0.5

        return Segmented(*self._once("segmented", view, read))

    def decoded(self, view: View) -> DecodedView:
        """Return all of it."""
        segmented = self.segmented(view)
        return DecodedView(*self.photo(view), *self.gbuffer(view), segmented.object_id, segmented.interior)

    def pixels(self, view: View, normals: np.ndarray) -> ViewPixels:
        """Return the pixels that hit the mesh; `normals`: (m, 3) of its faces. No pixel of a held-out view is valid."""
        return pixels_of_view(view, self.decoded(view), normals)

    def _once(self, what: str, view: View, read: Callable[[], tuple[np.ndarray, ...]]) -> Any:
        key = what, view.view_id
        if key in self._kept:
            return self._kept[key]
        arrays = read()
        megabytes = sum(array.nbytes for array in arrays) / 1e6
        if megabytes <= self.memory_mb:
            self.memory_mb -= megabytes
            self._kept[key] = arrays
        return arrays
