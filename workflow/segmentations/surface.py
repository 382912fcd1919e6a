"""Input and output of every kind of segmentation: mesh and photographs, and objects."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from iif_core.surface.segments import face_adjacency
from workflow.artifacts.store import StageReader
from workflow.scene.decoded import DecodedViews
from workflow.scene.normal_form import CaptureReader, View

FOLDS = 3  # perturbed runs; each leaves out every third photograph
MEMORY_MB = 256.0
"""Megabytes of decoded files that are kept: the memory of this stage is to stay small."""


@dataclass(frozen=True)
class Objects:
    """A segmentation.

    Attributes:
        object_of_face: (m,) int32 from 0 without gaps.
        names: of the objects; None = nobody has named them, and they are called by what they are like.
        agreement: (objects,) share of the pixels that agree.
        facts: numbers for segmentation.json.
    """

    object_of_face: np.ndarray
    names: list[str] | None
    agreement: np.ndarray
    facts: dict[str, int | float]

    def map_of(self, face_id: np.ndarray) -> np.ndarray:
        """Return the object of each pixel, (H, W) int32, from its face (H, W); -1 where that is -1."""
        return np.where(face_id >= 0, self.object_of_face[face_id], -1).astype(np.int32)


@dataclass(frozen=True)
class Stability:
    """Agreement of the objects with those of perturbed runs (docs/method/objects.md#stability).

    Attributes:
        value: mean adjusted Rand index between the result and the perturbed runs; None if nothing is perturbed.
        of_object: (objects,) mean of the best intersection over union with an object of a perturbed run; NaN if not seen.
        runs: adjusted Rand index of each run.
    """

    value: float | None
    of_object: np.ndarray
    runs: list[float]


class Surface:
    """Mesh, photographs and, if they are there, predictions of a scene.

    Costly properties are cached; plug-ins may cache results in `kept`. `decoded` are the files of the capture.
    """

    def __init__(self, capture: CaptureReader, prior: StageReader | None = None, decoded: DecodedViews | None = None):
        self.capture, self.prior = capture, prior
        self.decoded = DecodedViews(capture, memory_mb=MEMORY_MB) if decoded is None else decoded
        self.kept: dict[str, Any] = {}
        self.vertices, self.faces = capture.mesh()

    @cached_property
    def pairs(self) -> np.ndarray:
        """Pairs of faces that share an edge, (e, 2)."""
        return face_adjacency(self.faces, self.vertices)

    def views(self, fold: int | None = None) -> list[View]:
        """Return the photographs that are not held out; with `fold` without those of the fold, unless none would remain."""
        views = self.capture.used
        return [view for i, view in enumerate(views) if fold is None or i % FOLDS != fold] or views

    @cached_property
    def pixels_of_face(self) -> list[np.ndarray]:
        """Numbers of pixels that see each face, (m,) for every fold."""
        out = [np.zeros(len(self.faces), np.int64) for _ in range(FOLDS)]
        for i, view in enumerate(self.capture.used):
            maps = self.decoded.maps(view, photograph=False)
            out[i % FOLDS] += np.bincount(maps.face[maps.hit], minlength=len(self.faces))
        return out

    def pixels(self, fold: int | None = None) -> np.ndarray:
        """Return the numbers of pixels of `views(fold)` that see each face, (m,) int64."""
        kept = [p for i, p in enumerate(self.pixels_of_face) if i != fold]
        total = np.sum(kept, axis=0)
        return total if total.any() else np.sum(self.pixels_of_face, axis=0)
