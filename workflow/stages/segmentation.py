"""Stage segmentation: assigns faces to objects and derives the segments of every view."""

from __future__ import annotations

import importlib
import warnings
from types import ModuleType
from typing import Any

import numpy as np

from iif_core.errors import InputError
from iif_core.objects.options import BorderOptions
from iif_core.surface.segments import interior, partition_agreement, segment_table
from iif_core.surface.triangles import face_geometry
from workflow import plugins
from workflow.artifacts.store import ids_to_disk
from workflow.decisions import objects as decisions
from workflow.runtime.job import Job
from workflow.scene.normal_form import CaptureReader
from workflow.segmentations.surface import FOLDS, Objects, Stability, Surface
from workflow.settings.options import options_of


def run(job: Job) -> None:
    """Read the capture, find the objects, measure their stability, write faces, objects, segments, maps and facts.

    Raises:
        InputError: the input that the kind needs is missing.
    """
    capture = CaptureReader(job.read("capture"))
    surface = Surface(capture, job.read("prior"))
    kind = importlib.import_module(plugins.implementation("segmentation", job.settings.segmentation.kind))
    if hasattr(kind, "prepare"):
        with job.timed("masks"):
            kind.prepare(job, surface)
    with job.timed("objects"):
        objects = kind.segment(surface, job.settings)
    with job.timed("stability"):
        stability = measure_stability(job, kind, surface, objects)

    count = len(objects.names)
    maps = [_object_map(capture.gbuffer(view)[1], objects.object_of_face) for view in capture]
    segment_maps, table = segment_table(maps)
    view_ids = np.array([view.view_id for view in capture], np.int32)
    border = options_of(BorderOptions, job.settings.segmentation).border_erosion
    for i, view in enumerate(capture):
        job.writer.exr(
            f"maps/{view.name}.exr",
            {
                "object.id": ids_to_disk(maps[i]),
                "segment.id": ids_to_disk(segment_maps[i]),
                "interior": interior(maps[i], border),
            },
        )
        job.progress(i + 1, len(capture.views), "maps")

    area = face_geometry(surface.vertices, surface.faces)[1]
    face_id = np.arange(len(surface.faces), dtype=np.int32)
    job.writer.table("faces.parquet", {"face_id": face_id, "object_id": objects.object_of_face})
    job.writer.table(
        "objects.parquet",
        {
            "object_id": np.arange(count, dtype=np.int32),
            "name": objects.names,
            "faces": np.bincount(objects.object_of_face, minlength=count).astype(np.int32),
            "area_m2": np.bincount(objects.object_of_face, area, count).astype(np.float32),
            "pixels": np.bincount(table.object, table.pixels, count).astype(np.int64),
            "views": np.bincount(table.object, minlength=count).astype(np.int32),
            "agreement": objects.agreement.astype(np.float32),
            "stability": np.nan_to_num(stability.of_object, nan=-1.0).astype(np.float32),
        },
        {"area_m2": "m^2"},
    )
    job.writer.table(
        "segments.parquet",
        {
            "segment_id": table.segment_id,
            "view_id": view_ids[table.view],
            "object_id": table.object,
            "pixels": table.pixels,
        },
    )
    seen = len(np.unique(table.object))
    job.writer.json("segmentation.json", _document(job, kind, objects, stability, seen))
    job.log.info("%d objects, %d of them seen, %d segments in %d views", count, seen, len(table), len(maps))


def _object_map(face_id: np.ndarray, object_of_face: np.ndarray) -> np.ndarray:
    return np.where(face_id >= 0, object_of_face[face_id], -1).astype(np.int32)


def measure_stability(job: Job, kind: ModuleType, surface: Surface, objects: Objects) -> Stability:
    """Measure the agreement of the objects with those of perturbed runs, weighted by pixels (docs/method/objects.md#stability).

    A run without input, as when the only photograph with ids is left out, is not counted.

    Args:
        job: for settings and progress.
        kind: the segmentation plug-in.
        surface: mesh and photographs.
        objects: the result.

    Returns:
        The stability; without a value if the runs change nothing.
    """
    count, values, best = len(objects.names), [], []
    folds = range(FOLDS) if kind.perturbs(surface) else ()
    for fold in folds:
        job.progress(fold, FOLDS, "perturbed runs")
        try:
            other = kind.segment(surface, job.settings, fold)
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


def _document(job: Job, kind: ModuleType, objects: Objects, stability: Stability, seen: int) -> dict[str, Any]:
    own = job.settings.segmentation.kind
    return {
        "kind": own,
        "objects": len(objects.names),
        "objects_seen": seen,
        **objects.facts,
        "stability": None if stability.value is None else round(stability.value, 6),
        "stability_runs": [round(value, 6) for value in stability.runs],
        "perturbed": kind.PERTURBED,
        "plan": [decisions.segmentation(own, seen, stability.value, kind.PERTURBED, objects.facts)],
    }
