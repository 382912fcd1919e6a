"""Reads `transforms.json` of nerfstudio and instant-ngp."""

from __future__ import annotations

import difflib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from iif_core.errors import InputError
from workflow.intake import limits
from workflow.intake.documents import read_json
from workflow.intake.names import existing, forward, shown
from workflow.settings.names import did_you_mean_path
from workflow.sources.folder_scene.camera import INTRINSICS, fault_of_similarity, number
from workflow.sources.folder_scene.entries import Entry, fault_of_path, some
from workflow.sources.folder_scene.frames import Cameras, checked_frames, folder_at

KEYS = (
    *INTRINSICS,
    *("k1", "k2", "k3", "k4", "p1", "p2", "camera_model", "is_fisheye", "pixel_centres_at"),
    *("frames", "file_path", "transform_matrix", "mask_path", "depth_file_path", "applied_transform", "applied_scale"),
    *("train_filenames", "val_filenames", "test_filenames"),
)
"""Keys of a transforms.json that are read; keys of other tools are ignored."""
MISSPELT = 0.85
"""Similarity (difflib) from which an unknown key counts as a misspelt known one."""


def read(source: dict[str, Any], capture: dict[str, Any]) -> Cameras:
    """Read the frames of a folder that `source.frames` and `capture.views` choose, and check everything about them.

    Raises:
        InputError: at the first fault; of a list of faulty files the message names the first few.
    """
    path = folder_at(source, "transforms.json") / (source["cameras"] or "transforms.json")
    document = load(path)
    _refuse_misspelt(path, document)
    entries = _listed_splits(path, document, entries_of(path, document))
    entries = [
        replace(e, mask=existing(path.parent / str(e.keys["mask_path"]))) if e.keys.get("mask_path") else e for e in entries
    ]
    world = _applied(path, document) if source["applied_transform"] == "undo" else None
    return checked_frames(path, document, entries, path.parent, source, capture, world)


def load(path: Path) -> dict[str, Any]:
    """Read a JSON object.

    Raises:
        InputError: missing, not JSON, or not an object.
    """
    if not path.is_file():
        hint = did_you_mean_path(path)
        raise InputError(f"{path}: not found; a `folder` scene needs it (docs/guide/own-data.md shows how to make one){hint}")
    document = read_json(path, "a list of cameras")
    if not isinstance(document, dict):
        raise InputError(f"{path}: found a {type(document).__name__}, expected an object with `frames`")
    return document


def entries_of(path: Path, document: dict[str, Any], key: str = "frames") -> list[Entry]:
    """Return the checked list of frames of a document."""
    return [_entry(path, i, entry, key) for i, entry in enumerate(_frames(path, document, key))]


def _refuse_misspelt(path: Path, document: dict[str, Any]) -> None:
    """Refuse an unknown key that is similar to a known, absent one, because a mask or focal length would be ignored silently."""
    frames = document.get("frames")
    places = [("", document)]
    places += [(f"frames[{i}]: ", f) for i, f in enumerate(frames if isinstance(frames, list) else []) if isinstance(f, dict)]
    near: dict[str, list[str]] = dict.fromkeys((*KEYS, "pixel_centers_at"), [])
    for where, place in places:
        for key in place:
            if key not in near:
                if len(near) > limits.KEYS:
                    raise InputError(f"{path}: more than {limits.KEYS} different keys; this is no list of cameras")
                near[key] = difflib.get_close_matches(key, KEYS, 1, MISSPELT) if len(key) < 64 else []
            if near[key] and near[key][0] not in place:
                raise InputError(f"{path}: {where}`{key}`: unknown key. Did you mean `{near[key][0]}`? Rename or remove it")


def _listed_splits(path: Path, document: dict[str, Any], entries: list[Entry]) -> list[Entry]:
    """State the split of every entry that nerfstudio's lists of file names contain; validation counts as test."""
    lists = {key: document[key] for key in ("train_filenames", "val_filenames", "test_filenames") if key in document}
    if not lists:
        return entries
    names = {}
    for key, listed in lists.items():
        if not isinstance(listed, list) or not all(isinstance(name, str) for name in listed):
            raise InputError(f"{path}: `{key}` must be a list of file paths as in `frames`")
        for name in listed:
            name = forward(name).removeprefix("./")
            other = names.setdefault(name, key)
            if other != key and "train_filenames" in (other, key):
                raise InputError(f"{path}: {name!r} is in `{other}` and in `{key}`: a test photograph must not be used")
    unknown = sorted(set(names) - {e.file_path for e in entries})
    if unknown:
        raise InputError(f"{path}: {some(unknown)} listed for train or test: no frame has such a `file_path`")
    kept = [e for e in entries if e.file_path in names] if "train_filenames" in lists else entries
    return [replace(e, split="train" if names.get(e.file_path, "train_filenames") == "train_filenames" else "test") for e in kept]


def _applied(path: Path, document: dict[str, Any]) -> np.ndarray:
    """Return the inverse of nerfstudio's `applied_transform` (3 or 4 rows of 4) and `applied_scale`."""
    stated = document.get("applied_transform")
    try:
        rows = np.array(stated, np.float64)
    except (TypeError, ValueError, OverflowError):
        rows = np.zeros(0)
    if rows.shape not in ((3, 4), (4, 4)) or not np.isfinite(rows).all():
        found = "missing" if stated is None else shown(stated)
        raise InputError(
            f"{path}: `source.applied_transform: undo`, but `applied_transform` is {found};"
            " it must be 3 rows of 4 numbers, as ns-process-data writes it. Set `source.applied_transform: keep`"
        )
    matrix = np.eye(4)
    matrix[: len(rows)] = rows
    if fault := fault_of_similarity(matrix):
        raise InputError(f"{path}: `applied_transform` {fault}")
    scale = number(path, "top level", document, "applied_scale", 1.0)
    if not scale > 0:
        raise InputError(f"{path}: `applied_scale` is {scale:g}; must be positive")
    return np.linalg.inv(matrix) @ np.diag([1 / scale, 1 / scale, 1 / scale, 1.0])


def _frames(path: Path, document: dict[str, Any], key: str) -> list[Any]:
    frames = document.get(key)
    if not isinstance(frames, list) or not frames:
        found = f"no `{key}`" if frames is None else f"`{key}` is empty" if frames == [] else f"`{key}` is not a list"
        raise InputError(f"{path}: {found}; at least one photograph with file_path and transform_matrix is needed")
    if len(frames) > limits.FRAMES:
        raise InputError(f"{path}: {len(frames)} entries in `{key}`; allowed are {limits.FRAMES}")
    return frames


def _entry(path: Path, index: int, entry: Any, key: str) -> Entry:
    if not isinstance(entry, dict) or not isinstance(entry.get("file_path"), str) or not entry["file_path"]:
        raise InputError(f"{path}: {key}[{index}]: needs a `file_path` (text) and a `transform_matrix`")
    file_path = forward(entry["file_path"]).removeprefix("./")
    if fault := fault_of_path(file_path):
        raise InputError(f"{path}: {key}[{index}]: `file_path` {shown(file_path)} {fault}")
    keys = {name: entry[name] for name in entry if name != "file_path"}
    for other in ("mask_path", "depth_file_path"):
        if isinstance(keys.get(other), str):
            keys[other] = forward(keys[other])
        if keys.get(other) and (fault := fault_of_path(keys[other])):
            raise InputError(f"{path}: {key}[{index}]: `{other}` {shown(keys[other])} {fault}")
    return Entry(file_path, f"{key}[{index}] ({file_path})", keys)
