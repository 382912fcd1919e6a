"""The colour of each face, as predictions or else photographs show it."""

from __future__ import annotations

import numpy as np

from workflow.artifacts.store import StageReader
from workflow.segmentations.surface import Objects, Surface


def mean_face_colour(surface: Surface, fold: int | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean colour (m, 3) of the pixels that see each face, roughly in [0, 1], and their number (m,).

    It is the square root of the predicted albedo, in which shadows have no edges. Without predictions it is what the photographs
    show: sensor values are divided by exposure^0.45, as a usual response suggests; radiance L becomes L / (L + mean of its view).
    Both are rough, because colour has little weight in the segmentation.
    """
    if surface.prior is not None:
        return _mean_face_albedo(surface, surface.prior, fold)
    capture, count = surface.capture, len(surface.faces)
    total, pixels = np.zeros((count, 3)), np.zeros(count)
    for view in surface.views(fold):
        maps = surface.decoded.maps(view)
        used = maps.valid & maps.hit
        if not used.any():
            continue
        values, face = maps.value[used].astype(np.float64), maps.face[used]
        if capture.is_hdr:
            values = values / (values + max(float(values.mean()), 1e-12))
        else:
            values = np.clip(values / view.exposure**0.45, 0, 1.5)
        pixels += np.bincount(face, minlength=count)
        for c in range(3):
            total[:, c] += np.bincount(face, values[:, c], count)
    return total / np.maximum(pixels, 1)[:, None], pixels


def _mean_face_albedo(surface: Surface, prior: StageReader, fold: int | None) -> tuple[np.ndarray, np.ndarray]:
    """Square root of the mean predicted albedo of each face (m, 3), and its pixels (m,)."""
    table = prior.table("faces.parquet")
    kept = np.ones(len(table["fold"]), bool) if fold is None else table["fold"] != fold
    if not kept.any():  # the only photographs are those of the fold
        kept[:] = True
    face, weight = table["face_id"][kept], table["pixels"][kept].astype(np.float64)
    pixels = np.bincount(face, weight, len(surface.faces))
    total = [np.bincount(face, weight * table[f"albedo_{c}"][kept], len(surface.faces)) for c in "rgb"]
    return np.sqrt(np.stack(total, 1) / np.maximum(pixels, 1)[:, None]), pixels


def object_albedo(surface: Surface, objects: Objects) -> tuple[np.ndarray, np.ndarray]:
    """Return roughly the albedo (objects, 3), the mean square of the colours of the pixels of an object, and their number."""
    colour, pixels = mean_face_colour(surface)
    count, label = len(objects.agreement), objects.object_of_face
    total = np.bincount(label, pixels, count)
    sums = [np.bincount(label, pixels * colour[:, c] ** 2, count) for c in range(3)]
    return np.stack(sums, 1) / np.maximum(total, 1)[:, None], total
