"""The files of views, decoded once for all passes of a job over them.

Everything that a job reads of photographs, G-buffers and segmentation comes from here. Held-out photographs stay unread.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from threading import Lock
from typing import Any, TypeVar

import numpy as np

from iif_core.camera.pixels import ViewMaps, ViewPixels, pixels_of_view
from workflow.artifacts.store import StageReader, ids_from_disk
from workflow.scene.normal_form import CaptureReader, View

MEMORY_MB = 512.0
"""Megabytes of decoded files that are kept; every pass over the views decodes the others again."""
_Made = TypeVar("_Made")


class Kept:
    """What was made of single views, kept as far as it fits into memory.

    Passes visit the views in the same order, so the first ones are kept. Threads may ask at the same time.
    """

    def __init__(self, memory_mb: float):
        self._free, self._kept, self._lock = memory_mb, {}, Lock()

    def once(self, key: Hashable, make: Callable[[], _Made]) -> _Made:
        """Return what is kept under the key, or else what `make` returns: arrays, or a tuple or record of arrays."""
        if key in self._kept:
            return self._kept[key]
        made = make()
        megabytes = _megabytes(made)
        with self._lock:
            if key not in self._kept and megabytes <= self._free:
                self._free -= megabytes
                self._kept[key] = made
        return made

    def forget(self) -> None:
        """Let go of everything."""
        with self._lock:
            self._free += sum(_megabytes(made) for made in self._kept.values())
            self._kept = {}


def _megabytes(made: Any) -> float:
    if isinstance(made, np.ndarray):
        return made.nbytes / 1e6
    parts = made if isinstance(made, tuple) else getattr(made, "__dict__", {}).values()
    return sum(_megabytes(part) for part in parts)


class DecodedViews:
    """Reader of photographs, G-buffers and segmentation, whose arrays must not be written to.

    Args:
        capture: the normal form.
        segmentation: objects and segments of the views; None before there are any.
        memory_mb: megabytes of decoded files that are kept.
    """

    def __init__(self, capture: CaptureReader, segmentation: StageReader | None = None, memory_mb: float = MEMORY_MB):
        self.capture, self.segmentation, self._kept = capture, segmentation, Kept(memory_mb)

    def photo(self, view: View) -> tuple[np.ndarray, np.ndarray]:
        """Return values (H, W, 3) and usable pixels (H, W); the photograph of a held-out view is not read, and none is usable."""
        if view.split == "test":
            return _unread(view)
        return self._kept.once(("photo", view.view_id), lambda: self.capture.photo(view))

    def gbuffer(self, view: View) -> tuple[np.ndarray, np.ndarray]:
        """Return z-depth (H, W) in metres, 0 = miss, and face ids (H, W), -1 = miss."""
        return self._kept.once(("gbuffer", view.view_id), lambda: self.capture.gbuffer(view))

    def maps(self, view: View, photograph: bool = True) -> ViewMaps:
        """Return the view as images, with objects, segments and interior if there is a segmentation.

        photograph: without it, the photograph is as that of a held-out view.
        """
        (value, valid), (depth, face) = self.photo(view) if photograph else _unread(view), self.gbuffer(view)
        found: dict[str, np.ndarray] = {}
        if self.segmentation is not None:
            names = ("object_id", "segment_id", "interior")
            segmented = self._kept.once(("segmented", view.view_id), lambda: _segmented(self.segmentation, view))
            found = dict(zip(names, segmented, strict=True))
        return ViewMaps(camera=view, value=value, valid=valid, depth=depth, face=face, **found)

    def pixels(self, view: View, normals: np.ndarray) -> ViewPixels:
        """Return the pixels that hit the mesh; `normals`: (m, 3) of its faces. No pixel of a held-out view is valid."""
        return pixels_of_view(self.maps(view), normals)

    def on_objects(self, view: View, normals: np.ndarray) -> ViewPixels:
        """Return the pixels that show an object, without what the photograph shows; `normals` as for `pixels`."""
        pixels = pixels_of_view(self.maps(view, photograph=False), normals)
        return pixels.take(pixels.of_object)


def _unread(view: View) -> tuple[np.ndarray, np.ndarray]:
    return np.zeros((view.height, view.width, 3), np.float32), np.zeros((view.height, view.width), bool)


def _segmented(segmentation: StageReader, view: View) -> tuple[np.ndarray, ...]:
    maps = segmentation.exr(f"maps/{view.name}.exr")
    return ids_from_disk(maps["object.id"]), ids_from_disk(maps["segment.id"]), maps["interior"] > 0.5
