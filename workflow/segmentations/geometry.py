"""Segmentation `geometry`: pieces of the mesh by Felzenszwalb and Huttenlocher's method (docs/method/objects.md#geometry)."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from iif_core.objects.felzenszwalb import segment_mesh, smooth_over_faces
from iif_core.objects.options import PieceOptions
from workflow.artifacts.store import StageReader
from workflow.segmentations.surface import FOLDS, Objects, Surface
from workflow.settings.options import options_of

PERTURBED = "every third photograph's colours left out, `scale` times 1/sqrt(2), 1, sqrt(2)"

COLOUR_ROUNDS = 3  # steps across the mesh over which a face that no pixel sees takes its colour


def segment(surface: Surface, settings: SimpleNamespace, fold: int | None = None) -> Objects:
    """Make every piece an object."""
    labels = pieces(surface, options_of(PieceOptions, settings.segmentation), fold)
    names = [f"piece {i}" for i in range(int(labels.max()) + 1)]
    return Objects(labels, names, np.ones(len(names)), {})


def perturbs(surface: Surface) -> bool:
    """Return True: every run changes scale and colours."""
    return True


def pieces(surface: Surface, own: PieceOptions, fold: int | None = None) -> np.ndarray:
    """Return the piece of every face, (m,) int32 from 0; with `fold` as `PERTURBED` says."""
    scale = own.scale if fold is None else own.scale * 2 ** (0.5 * (fold - FOLDS // 2))
    colour = None
    if own.colour > 0:
        mean, pixels = mean_face_colour(surface, fold)
        colour = smooth_over_faces(mean, pixels, surface.pairs, COLOUR_ROUNDS)
    mesh = surface.vertices, surface.faces
    return segment_mesh(*mesh, scale, own.min_faces, colour, own.colour, surface.pairs, own.min_area)


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
