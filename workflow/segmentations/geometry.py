"""Segmentation `geometry`: pieces of the mesh by Felzenszwalb and Huttenlocher's method (docs/method/objects.md#geometry)."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from iif_core.objects.felzenszwalb import segment_mesh, smooth_over_faces
from iif_core.objects.options import PieceOptions
from workflow.segmentations.face_colour import mean_face_colour
from workflow.segmentations.surface import FOLDS, Objects, Surface
from workflow.settings.options import options_of

PERTURBED = "every third photograph's colours left out, `scale` times 1/sqrt(2), 1, sqrt(2)"

COLOUR_ROUNDS = 3  # steps across the mesh over which a face that no pixel sees takes its colour


def segment(surface: Surface, settings: SimpleNamespace, fold: int | None = None) -> Objects:
    """Make every piece an object."""
    labels = pieces(surface, options_of(PieceOptions, settings.segmentation), fold)
    return Objects(labels, None, np.ones(int(labels.max()) + 1), {})


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
