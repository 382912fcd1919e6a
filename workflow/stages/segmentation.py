"""Stage segmentation: assigns faces to objects and derives the segments of every view."""

from __future__ import annotations

import importlib

import numpy as np

from iif_core.objects.description import described
from iif_core.objects.options import BorderOptions
from iif_core.surface.segments import interior, segment_table
from workflow import plugins
from workflow.artifacts.store import ids_to_disk
from workflow.decisions import objects as decisions
from workflow.runtime.job import Job
from workflow.scene.base_scene import made_up_objects
from workflow.scene.normal_form import CaptureReader
from workflow.segmentations.face_colour import object_albedo
from workflow.segmentations.stability import measure_stability
from workflow.segmentations.surface import Objects, Surface
from workflow.segmentations.tables import UNITS, face_columns, object_columns, segment_columns
from workflow.settings.options import options_of


def run(job: Job) -> None:
    """Read the capture, find the objects, measure their stability, write faces, objects, segments, maps and facts.

    Raises:
        InputError: the input that the kind needs is missing.
    """
    capture, own = CaptureReader(job.read("capture")), job.settings.segmentation
    surface = Surface(capture, job.read("prior"))
    kind = importlib.import_module(plugins.implementation("segmentation", own.kind))
    if hasattr(kind, "prepare"):
        with job.timed("masks"):
            kind.prepare(job, surface)
    with job.timed("objects"):
        objects = kind.segment(surface, job.settings)
    with job.timed("stability"):
        stability = measure_stability(kind, surface, job.settings, objects, job.progress)

    maps = [objects.map_of(surface.decoded.gbuffer(view)[1]) for view in capture]
    segment_maps, segments = segment_table(maps)
    border = options_of(BorderOptions, own).border_erosion
    for done, (view, object_map, segment_map) in enumerate(zip(capture, maps, segment_maps, strict=True), 1):
        ids = {"object.id": ids_to_disk(object_map), "segment.id": ids_to_disk(segment_map)}
        job.writer.exr(f"maps/{view.name}.exr", {**ids, "interior": interior(object_map, border)})
        job.progress(done, len(capture.views), "maps")

    names = objects.names or _described(surface, objects)
    view_ids = np.array([view.view_id for view in capture], np.int32)
    job.writer.table("faces.parquet", face_columns(objects))
    job.writer.table("objects.parquet", object_columns(surface, objects, names, stability, segments), UNITS)
    job.writer.table("segments.parquet", segment_columns(segments, view_ids))
    count, seen = len(names), len(np.unique(segments.object))
    document = {
        "kind": own.kind,
        "objects": count,
        "objects_seen": seen,
        **objects.facts,
        "stability": None if stability.value is None else round(stability.value, 6),
        "stability_runs": [round(value, 6) for value in stability.runs],
        "perturbed": kind.PERTURBED,
        "plan": [decisions.segmentation(own.kind, seen, stability.value, kind.PERTURBED, objects.facts)],
    }
    job.writer.json("segmentation.json", document)
    job.log.info("%d objects, %d of them seen, %d segments in %d views", count, seen, len(segments), len(maps))


def _described(surface: Surface, objects: Objects) -> list[str]:
    """Return names by colour and place for objects without one; what the capture built around the scan comes last in its mesh."""
    albedo, pixels = object_albedo(surface, objects)
    label = objects.object_of_face
    built = made_up_objects(label, len(albedo), int(surface.capture.facts.get("added_faces", 0)))
    return described(label, surface.vertices, surface.faces, albedo, pixels > 0, surface.capture.up, built)
