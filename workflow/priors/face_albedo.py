"""The albedo that predictions have on the faces of the mesh, from which masks and geometry are told apart."""

from __future__ import annotations

import numpy as np

from workflow.artifacts.store import StageWriter, rgb
from workflow.scene.normal_form import CaptureReader
from workflow.segmentations.surface import FOLDS


def albedo_of_faces(writer: StageWriter, capture: CaptureReader, predicted_views: set[int]) -> dict[str, np.ndarray]:
    """Return the columns of faces.parquet: the albedo that the written predictions have on each face, for each of the FOLDS of
    views by itself."""
    count = len(capture.faces()["face_id"])
    pixels, total = np.zeros((FOLDS, count), np.int64), np.zeros((FOLDS, count, 3))
    for i, view in enumerate(capture.used):
        if view.view_id not in predicted_views:
            continue
        channels = writer.channels(f"maps/{view.name}.exr")
        layers = sorted(key.removesuffix(".albedo.R") for key in channels if key.endswith(".albedo.R"))
        albedo = np.mean([rgb(channels, f"{layer}.albedo") for layer in layers], 0, np.float32)
        face, shown = capture.gbuffer(view)[1], capture.photo(view)[1]
        use = (face >= 0) & shown
        pixels[i % FOLDS] += np.bincount(face[use], minlength=count)
        for c in range(3):
            total[i % FOLDS, :, c] += np.bincount(face[use], albedo[use][:, c], count)
    fold, seen = np.nonzero(pixels)
    mean = total[fold, seen] / pixels[fold, seen, None]
    columns = {"face_id": seen.astype(np.int32), "fold": fold.astype(np.int32), "pixels": pixels[fold, seen]}
    columns |= {f"albedo_{name}": mean[:, c].astype(np.float32) for c, name in enumerate("rgb")}
    return columns
