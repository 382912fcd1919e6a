"""How much the objects depend on the choice of photographs (docs/method/objects.md#stability)."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from types import ModuleType, SimpleNamespace

import numpy as np

from iif_core.errors import InputError
from iif_core.surface.segments import partition_agreement
from workflow.segmentations.surface import FOLDS, Objects, Stability, Surface


def measure_stability(
    kind: ModuleType,
    surface: Surface,
    settings: SimpleNamespace,
    objects: Objects,
    progress: Callable[[int, int, str], None] = lambda *_: None,
) -> Stability:
    """Measure the agreement of the objects with those of perturbed runs, weighted by pixels.

    A run without input, as when the only photograph with ids is left out, is not counted.

    Args:
        kind: the segmentation plug-in.
        surface: mesh and photographs.
        settings: as the plug-in takes them.
        objects: the result.
        progress: called with runs done, runs in all, and what they are.

    Returns:
        The stability; without a value if the runs change nothing.
    """
    count, values, best = len(objects.agreement), [], []
    folds = range(FOLDS) if kind.perturbs(surface) else ()
    for fold in folds:
        progress(fold, FOLDS, "perturbed runs")
        try:
            other = kind.segment(surface, settings, fold)
        except InputError:
            continue
        value, overlap = partition_agreement(objects.object_of_face, other.object_of_face, surface.pixels(fold))
        values.append(value)
        best.append(np.r_[overlap, np.full(count - len(overlap), np.nan)])
    if not values:
        return Stability(None, np.full(count, np.nan), [])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # for objects that no view sees
        return Stability(float(np.mean(values)), np.nanmean(best, axis=0), values)
