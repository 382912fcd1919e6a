"""segmentation: which face belongs to which object, and the segments that follow in every view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from iif_core.errors import InputError
from iif_core.felzenszwalb import segment_mesh, smooth_over_faces
from iif_core.segments import face_adjacency, interior, segment_table, vote_faces
from workflow.artifacts.store import ids_to_disk
from workflow.job import Job
from workflow.normal_form import CaptureReader

COLOUR_ROUNDS = 3
"""Steps over the mesh by which a face that no pixel saw borrows colour."""


@dataclass(frozen=True)
class Objects:
    """object_of_face (m,) int32 from 0 without gaps; name of every object and the share of pixels that agree."""

    object_of_face: np.ndarray
    names: list[str]
    agreement: np.ndarray


def run(job: Job) -> None:
    """Read the capture, decide objects, write faces, objects, segments and maps.

    Raises:
        InputError: `given` without ids.
    """
    capture = CaptureReader(job.read("capture"))
    vertices, faces = capture.mesh()
    if job.settings.segmentation.kind == "given":
        objects = given_objects(capture, vertices, faces)
    else:
        objects = geometric_objects(capture, vertices, faces, job.settings.segmentation)

    count = len(objects.names)
    maps = [_object_map(capture.gbuffer(view)[1], objects.object_of_face) for view in capture]
    segment_maps, table = segment_table(maps)
    view_ids = np.array([view.view_id for view in capture], np.int32)
    border = job.settings.segmentation.border_erosion
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

    corners = vertices.astype(np.float64)[faces]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    face_id = np.arange(len(faces), dtype=np.int32)
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
    job.log.info("%d objects, %d of them seen, %d segments in %d views", count, seen, len(table), len(maps))


def _object_map(face_id: np.ndarray, object_of_face: np.ndarray) -> np.ndarray:
    return np.where(face_id >= 0, object_of_face[face_id], -1).astype(np.int32)


def given_objects(capture: CaptureReader, vertices: np.ndarray, faces: np.ndarray) -> Objects:
    """Objects from ids of the faces, else from ids in the views by the majority of the pixels that see a face.

    Faces without an id form one object `unlabelled`; so do faces that no vote reaches. Objects that no view sees stay.
    """
    instance = capture.faces()["instance_id"]
    if (instance >= 0).any():
        names = {}
        if capture.reader.has("instances.parquet"):
            table = capture.reader.table("instances.parquet")
            names = dict(zip(table["instance_id"].tolist(), table["name"].tolist(), strict=True))
        ids, labels = np.unique(instance, return_inverse=True)
        # np.unique puts -1 first: roll it to the end so that given objects keep their order.
        unlabelled = int(ids[0] < 0)
        labels = (labels.ravel() - unlabelled) % len(ids)
        texts = [str(names.get(i, f"instance {i}")) for i in ids[unlabelled:].tolist()] + ["unlabelled"] * unlabelled
        return Objects(labels.astype(np.int32), texts, np.ones(len(ids)))
    face_ids, instance_ids = [], []
    for view in capture.used:
        given = capture.given_instances(view)
        if given is not None:
            face_ids.append(capture.gbuffer(view)[1].ravel())
            instance_ids.append(given.ravel())
    if not face_ids:
        raise InputError(
            "`segmentation: {kind: given}`, but the capture has no instance ids, neither of faces nor of views;"
            " give `instances/<view>.png` or an `instance` property of the mesh's faces (docs/own-data.md),"
            " or set `segmentation: {kind: geometry}`"
        )
    face, instance = np.concatenate(face_ids), np.concatenate(instance_ids)
    if not ((face >= 0) & (instance >= 0)).any():
        raise InputError(
            "`segmentation: {kind: given}`: no pixel of the given instance maps has both an id and a face under it;"
            " check the files in instances/ against the photographs, or set `segmentation: {kind: geometry}`"
        )
    votes = vote_faces(face, instance, len(faces), face_adjacency(faces, vertices))
    names = ["unlabelled" if i == votes.background else f"instance {i}" for i in votes.object_id.tolist()]
    labels = np.searchsorted(votes.object_id, votes.object_of_face).astype(np.int32)
    return Objects(labels, names, votes.agreement)


def geometric_objects(capture: CaptureReader, vertices: np.ndarray, faces: np.ndarray, settings: object) -> Objects:
    """Pieces of the mesh by Felzenszwalb's method on bend and, weakly, colour."""
    pairs = face_adjacency(faces, vertices)
    colour = None
    if settings.colour > 0:
        mean, pixels = mean_face_colour(capture, len(faces))
        colour = smooth_over_faces(mean, pixels, pairs, COLOUR_ROUNDS)
    labels = segment_mesh(vertices, faces, settings.scale, settings.min_faces, colour, settings.colour, pairs)
    names = [f"piece {i}" for i in range(int(labels.max()) + 1)]
    return Objects(labels, names, np.ones(len(names)))


def mean_face_colour(capture: CaptureReader, count: int) -> tuple[np.ndarray, np.ndarray]:
    """(m, 3) mean colour of the pixels that see a face, roughly in [0, 1], and (m,) how many do.

    Sensor values are divided by exposure^0.45 (what a usual response makes of it), radiance L is shown as
    L / (L + mean of its view): a weak hint is all that is asked of colour.
    """
    total, pixels = np.zeros((count, 3)), np.zeros(count)
    for view in capture.used:
        photo, valid = capture.photo(view)
        face = capture.gbuffer(view)[1]
        used = valid & (face >= 0)
        if not used.any():
            continue
        values, face = photo[used].astype(np.float64), face[used]
        if capture.is_hdr:
            values = values / (values + max(float(values.mean()), 1e-12))
        else:
            values = np.clip(values / view.exposure**0.45, 0, 1.5)
        pixels += np.bincount(face, minlength=count)
        for c in range(3):
            total[:, c] += np.bincount(face, values[:, c], count)
    return total / np.maximum(pixels, 1)[:, None], pixels
