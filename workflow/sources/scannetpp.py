"""Source `scannetpp`: a scene of ScanNet++ as released (docs/guide/own-data.md, docs/method/camera.md#axes-and-pixels).

    scans/mesh_aligned_0.05.ply, segments.json, segments_anno.json
    dslr/resized_images, resized_anon_masks, nerfstudio/transforms.json, colmap/, train_test_lists.json

The poses of nerfstudio/transforms.json are in a world that is turned against the mesh. MESH_FROM_NERFSTUDIO undoes the turn, and
the result is compared with colmap/, which is in the frame of the mesh.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from iif_core.errors import InputError
from workflow.intake.documents import read_json, reading
from workflow.runtime.job import Job
from workflow.sources import folder
from workflow.sources.folder_scene import colmap, mesh, transforms
from workflow.sources.folder_scene.camera import opencv_pose
from workflow.sources.folder_scene.entries import Entry
from workflow.sources.folder_scene.frames import Cameras, checked_frames, folder_at
from workflow.sources.folder_scene.inputs import Inputs

MESH_FROM_NERFSTUDIO = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])
"""Exchanges rows 0 and 1 and negates row 2: a rotation that is its own inverse."""
PLACES = {
    "dslr": ("resized_images", "resized_anon_masks", "nerfstudio/transforms.json"),
    "undistorted": ("undistorted_images", "undistorted_anon_masks", "nerfstudio/transforms_undistorted.json"),
}
"""`source.images` -> photographs, masks and cameras below dslr/."""
MAX_DISTANCE, MAX_ANGLE = 0.01, 0.01  # metres and radians by which two pose files of one release may differ (rounding)


def raw_inputs(document: dict[str, Any]) -> list[Path]:
    """List the files that the capture reads, after the checks that need no pixels; raises InputError."""
    found = find_inputs(document["source"], document["capture"])
    if found.of_vertices is None and document["segmentation"]["kind"] == "given":
        missing = next(path for path in _annotation_files(found.mesh.parent) if not path.is_file())
        raise InputError(
            f"{missing}: not found; `segmentation: {{kind: given}}` takes the objects from it. Download it, or set"
            " `segmentation: {kind: geometry}` (or `masks`, docs/guide/segmentation.md), which needs no annotation"
        )
    return found.files()


def capture(job: Job) -> None:
    """Write the normal form of the scene."""
    folder.capture_photographs(job, find_inputs(vars(job.settings.source), vars(job.settings.capture), points=True))


def find_inputs(source: dict[str, Any], settings: dict[str, Any], points: bool = False) -> Inputs:
    """Find and check the cameras of a scene, in the frame of the mesh, and the files that belong to them.

    `points`: also read the sparse points of colmap/, which is slow, for the check of the mesh.

    Raises:
        InputError: missing or inconsistent files, by name.
    """
    home = folder_at(source, "dslr/ and scans/")
    for name in ("dslr", "scans"):
        if not (home / name).is_dir():
            below = [path.name for path in (home / "data", *home.iterdir()) if (path / "dslr").is_dir()]
            hint = f" One scene is meant, such as {home / below[0]}." if below else ""
            raise InputError(f"{home}: no folder {name}/; `source.path` is the folder of one ScanNet++ scene.{hint}")
    dslr, scans = home / "dslr", home / "scans"
    pictures, masks, cameras = (dslr / name for name in PLACES[source["images"]])
    if not cameras.is_file():
        made = "the toolbox makes it (dslr.undistort)" if source["images"] == "undistorted" else "it is part of the release"
        raise InputError(f"{cameras}: not found; {made}. `source.images` is {source['images']}; allowed: {', '.join(PLACES)}")
    document = transforms.load(cameras)
    entries, notes, lists = _entries(document, cameras, dslr, pictures)
    entries, without_masks = _masked(entries, masks)
    notes += without_masks
    world = MESH_FROM_NERFSTUDIO if source["world"] == "nerfstudio" else None
    listed = checked_frames(cameras, document, entries, pictures, source, settings, world)
    listed, also = _compared_with_colmap(listed, dslr / "colmap", source["world"], points)
    mesh_path = scans / "mesh_aligned_0.05.ply"
    if not mesh_path.is_file():
        raise InputError(f"{mesh_path}: not found; download the scene's `scans` too")
    mesh.find(scans, mesh_path.name)  # refuses what its header tells to be no mesh, or cut short
    annotation = _annotation_files(scans)
    missing = [path.name for path in annotation if not path.is_file()]
    if missing:
        notes.append(f"no {' and '.join(missing)}: the scene comes without object ids")
    of_vertices = None if missing else partial(vertex_ids, *annotation)
    listed = replace(listed, known=True, notes=tuple(notes), also=(*lists, *also, *(() if missing else annotation)))
    return Inputs(listed, mesh_path, of_vertices=of_vertices)


def _entries(document: dict[str, Any], cameras: Path, dslr: Path, pictures: Path) -> tuple[list[Entry], list[str], list[Path]]:
    """Return the frames of both lists with their split, notes about those left out, and the list file."""
    entries = [replace(e, split="train") for e in transforms.entries_of(cameras, document)]
    if document.get("test_frames"):
        entries += [replace(e, split="test") for e in transforms.entries_of(cameras, document, "test_frames")]
    notes: list[str] = []
    path = dslr / "train_test_lists.json"
    if path.is_file():
        stated = _lists(path)
        entries = [replace(e, split=stated.get(e.file_path, e.split)) for e in entries]
        posed = {e.file_path for e in entries}
        without = [name for name in stated if name not in posed]
        if without:
            notes.append(f"{len(without)} listed photographs have no pose and are not used, such as {without[0]}")
    if bad := [e for e in entries if e.keys.get("is_bad")]:
        entries = [e for e in entries if not e.keys.get("is_bad")]
        notes.append(f"{len(bad)} photographs that the release marks as bad are left out")
    hidden = [e for e in entries if e.split == "test" and not (pictures / e.file_path).is_file()]
    if hidden:
        notes.append(f"{len(hidden)} test photographs are not in {pictures.name}/ (the release withholds some)")
    gone = {id(e) for e in hidden}
    kept = sorted((e for e in entries if id(e) not in gone), key=lambda entry: entry.file_path)
    return kept, notes, [path] if path.is_file() else []


def _lists(path: Path) -> dict[str, str]:
    """Read train_test_lists.json: file name -> train or test."""
    document = read_json(path, "a list of photographs")
    try:
        found = {key: [str(name) for name in document[key]] for key in ("train", "test")}
    except (KeyError, TypeError) as error:
        raise InputError(f'{path}: expected {{"train": [names], "test": [names]}} ({type(error).__name__}: {error})') from None
    both = sorted(set(found["train"]) & set(found["test"]))
    if both:
        raise InputError(f"{path}: {both[0]} is in both lists ({len(both)} in all): a test photograph must not be used")
    return {name: key for key, names in found.items() for name in names}


def _masked(entries: list[Entry], masks: Path) -> tuple[list[Entry], list[str]]:
    """Return the entries with their anonymisation masks, and a note where the release has none."""
    if not masks.is_dir():
        return entries, [f"no {masks.name}/: nothing is masked"]
    names = [str(e.keys.get("mask_path") or Path(e.file_path).with_suffix(".png")) for e in entries]
    return [replace(e, mask=masks / name, mask_full=True) for e, name in zip(entries, names, strict=True)], []


def _compared_with_colmap(listed: Cameras, model: Path, world: str, points: bool) -> tuple[Cameras, list[Path]]:
    """Compare the poses with colmap/ (which may be missing), which is in the frame of the mesh; refuse poses that differ.

    Returns the frames, with their sparse points if `points`, and the files of the model.
    """
    if not colmap.is_model(model):
        return listed, []
    found = colmap.read(model, points)
    named = {Path(image.name).name: image for image in found.images}
    pairs = [(f, named[Path(f.file_path).name].pose) for f in listed.frames if Path(f.file_path).name in named]
    if not pairs:
        return listed, list(found.files)
    moved, turned = _difference([f.matrix for f, _ in pairs], [p for _, p in pairs])
    if moved > MAX_DISTANCE or turned > MAX_ANGLE:
        before = [MESH_FROM_NERFSTUDIO @ f.matrix for f, _ in pairs]  # its own inverse
        other = _difference(before, [p for _, p in pairs])
        fits = other[0] <= MAX_DISTANCE and other[1] <= MAX_ANGLE
        advice = (
            f"`source.world: {'mesh' if world == 'nerfstudio' else 'nerfstudio'}` fits"
            if fits
            else "one of the files is not of this release: download both again"
        )
        raise InputError(
            f"{listed.path}: its cameras differ from those of {found.path} (median {moved:.3g} m,"
            f" {np.degrees(turned):.1f} degrees over {len(pairs)} photographs); {advice}"
        )
    if not points:
        return listed, list(found.files)
    seen = {name: found.seen(image)[0] for name, image in named.items()}
    frames = [replace(f, seen=seen.get(Path(f.file_path).name)) for f in listed.frames]
    return replace(listed, frames=tuple(frames)), list(found.files)


def _difference(opengl: list[np.ndarray], opencv: list[np.ndarray]) -> tuple[float, float]:
    """Return the median distance (metres) and angle (radians) between poses of OpenGL and of OpenCV axes."""
    a, b = np.array([opencv_pose(m, "opengl", 1.0) for m in opengl]), np.array(opencv)
    chord = np.linalg.norm(a[:, :3, :3] - b[:, :3, :3], axis=(1, 2)) / np.sqrt(8)  # = sin(angle / 2)
    distance = np.linalg.norm(a[:, :3, 3] - b[:, :3, 3], axis=1)
    return float(np.median(distance)), float(np.median(2 * np.arcsin(np.clip(chord, 0, 1))))


def _annotation_files(scans: Path) -> tuple[Path, Path]:
    """Return the two files of object ids, which a scene may lack."""
    return scans / "segments.json", scans / "segments_anno.json"


def vertex_ids(segments: Path, annotation: Path) -> mesh.VertexIds:
    """Read the object of every vertex: the `objectId` of the group that contains the vertex's segment; -1 for 0 and for none.

    Where groups overlap, the one with fewer vertices, which is more specific, is used.

    Raises:
        InputError: files of another form.
    """
    document = read_json(segments, "segments of the vertices")
    with reading(segments, "expected `segIndices`, a segment of every vertex"):
        index = np.asarray(document["segIndices"], np.int64)
    document = read_json(annotation, "objects of the segments")
    with reading(annotation, "expected `segGroups` with objectId, label and segments"):
        objects = [
            (int(np.int64(g["objectId"])), str(g.get("label", "object")), np.asarray(g["segments"], np.int64).ravel())
            for g in document["segGroups"]
        ]
    if index.ndim != 1:
        raise InputError(f"{segments}: `segIndices` must be one list of numbers")
    kept, position, size = np.unique(index, return_inverse=True, return_counts=True)
    of_segment = np.full(len(kept), -1, np.int64)
    weighed = []
    for number, label, members in objects:
        at = np.searchsorted(kept, members)
        at = at[(at < len(kept)) & (kept[np.minimum(at, len(kept) - 1)] == members)] if len(kept) else at[:0]
        weighed.append((int(size[at].sum()), number, label, at))
    for _, number, _, at in sorted(weighed, key=lambda item: (-item[0], item[1])):
        of_segment[at] = number if number > 0 else -1
    names = {number: f"{label} {number}" for _, number, label, _ in weighed}
    return mesh.VertexIds(of_segment[position.ravel()], names, segments)
