"""What every kind of segmentation reads: photographs, mesh and what follows from them; and what it returns."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from iif_core.surface.segments import face_adjacency
from workflow.scene.normal_form import CaptureReader, View

FOLDS = 3
"""Perturbed runs: each leaves out every third photograph."""


@dataclass(frozen=True)
class Objects:
    """object_of_face (m,) int32 from 0 without gaps; name of every object and the share of pixels that agree.

    facts: numbers about how it came about, for segmentation.json.
    """

    object_of_face: np.ndarray
    names: list[str]
    agreement: np.ndarray
    facts: dict[str, int | float]


@dataclass(frozen=True)
class Stability:
    """How far the objects depend on what should not decide them (docs/segmentation.md).

    value: mean adjusted Rand index between the result and the perturbed runs; None if there is nothing to perturb.
    of_object: (objects,) mean best overlap over union with an object of the perturbed runs; NaN where nothing is seen.
    """

    value: float | None
    of_object: np.ndarray
    runs: list[float]


class Surface:
    """Mesh and photographs of a scene; what is costly is kept, `kept` is for the kinds."""

    def __init__(self, capture: CaptureReader):
        self.capture = capture
        self.kept: dict[str, Any] = {}
        self.vertices, self.faces = capture.mesh()

    @cached_property
    def pairs(self) -> np.ndarray:
        """Faces that share an edge, (e, 2)."""
        return face_adjacency(self.faces, self.vertices)

    def views(self, fold: int | None = None) -> list[View]:
        """All photographs but those held out, or of them those that are not in this fold (all, where nothing would be left)."""
        views = self.capture.used
        return [view for i, view in enumerate(views) if fold is None or i % FOLDS != fold] or views

    @cached_property
    def pixels_of_face(self) -> list[np.ndarray]:
        """Pixels that see each face, (m,) for every fold."""
        out = [np.zeros(len(self.faces), np.int64) for _ in range(FOLDS)]
        for i, view in enumerate(self.capture.used):
            face = self.capture.gbuffer(view)[1]
            out[i % FOLDS] += np.bincount(face[face >= 0], minlength=len(self.faces))
        return out

    def pixels(self, fold: int | None = None) -> np.ndarray:
        """Pixels of `views(fold)` that see each face, (m,) int64."""
        kept = [p for i, p in enumerate(self.pixels_of_face) if i != fold]
        total = np.sum(kept, axis=0)
        return total if total.any() else np.sum(self.pixels_of_face, axis=0)
