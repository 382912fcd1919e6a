"""Segmentation `given`: ids of the mesh's faces, else a majority vote of the ids in the views (Eq. O.3)."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from iif_core.errors import InputError
from iif_core.surface.segments import vote_faces
from workflow.intake.ply import face_properties
from workflow.segmentations.surface import Objects, Surface
from workflow.sources.folder_scene.inputs import find_inputs

PERTURBED = "every third photograph's ids left out"
NO_IDS = (
    "`segmentation: {kind: given}`, but the capture has no instance ids, neither of faces nor of views;"
    " give `instances/<view>.png` or an `instance` property of the mesh's faces (docs/guide/own-data.md),"
    " or set `segmentation: {kind: geometry}`"
)


def raw_inputs(document: dict[str, Any]) -> list[Path]:
    """List no files, as the capture holds the ids.

    Raises:
        InputError: they can be nowhere: photographs alone, or a folder without maps of ids whose mesh is a PLY without them.
    """
    source = document["source"]
    if source["kind"] == "photographs":
        raise InputError(NO_IDS)
    if source["kind"] == "folder":
        inputs = find_inputs(source, document["capture"])
        of_views = any(frame.ids is not None for frame in inputs.cameras.frames)
        if not of_views and inputs.mesh.suffix.lower() == ".ply" and "instance" not in face_properties(inputs.mesh):
            raise InputError(NO_IDS)
    return []


def segment(surface: Surface, settings: SimpleNamespace, fold: int | None = None) -> Objects:
    """Return the given objects, also those that no view sees; faces without an id and without votes form one, `unlabelled`.

    Raises:
        InputError: the capture has no ids.
    """
    instance = surface.capture.faces()["instance_id"]
    return _by_face(surface, instance) if (instance >= 0).any() else _by_view(surface, fold)


def perturbs(surface: Surface) -> bool:
    """Return whether the ids come from the views, whose votes the runs change."""
    return not (surface.capture.faces()["instance_id"] >= 0).any()


def _by_face(surface: Surface, instance: np.ndarray) -> Objects:
    names = {}
    if surface.capture.reader.has("instances.parquet"):
        table = surface.capture.reader.table("instances.parquet")
        names = dict(zip(table["instance_id"].tolist(), table["name"].tolist(), strict=True))
    ids, labels = np.unique(instance, return_inverse=True)
    # np.unique puts -1 first; it moves to the end so that the given objects keep their order.
    unlabelled = int(ids[0] < 0)
    labels = (labels.ravel() - unlabelled) % len(ids)
    texts = [str(names.get(i, f"instance {i}")) for i in ids[unlabelled:].tolist()] + ["unlabelled"] * unlabelled
    return Objects(labels.astype(np.int32), texts, np.ones(len(ids)), {})


def _by_view(surface: Surface, fold: int | None) -> Objects:
    face_ids, instance_ids = [], []
    for view in surface.views(fold):
        given = surface.capture.given_instances(view)
        if given is not None:
            face_ids.append(surface.decoded.gbuffer(view)[1].ravel())
            instance_ids.append(given.ravel())
    if not face_ids:
        raise InputError(NO_IDS)
    face, instance = np.concatenate(face_ids), np.concatenate(instance_ids)
    if not ((face >= 0) & (instance >= 0)).any():
        raise InputError(
            "`segmentation: {kind: given}`: no pixel of the given instance maps has both an id and a face under it;"
            " check the files in instances/ against the photographs, or set `segmentation: {kind: geometry}`"
        )
    votes = vote_faces(face, instance, len(surface.faces), surface.pairs)
    names = ["unlabelled" if i == votes.background else f"instance {i}" for i in votes.object_id.tolist()]
    labels = np.searchsorted(votes.object_id, votes.object_of_face).astype(np.int32)
    return Objects(labels, names, votes.agreement, {})
