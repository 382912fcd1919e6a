"""Checks the photographs that a file of cameras lists, whichever program wrote it, from image headers alone.

Every message names the file, the frame, the value found, the values allowed and the remedy.
"""

from __future__ import annotations

import os
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from iif_core.camera.distortion import Distortion, Pinhole
from iif_core.errors import InputError
from workflow.intake.names import existing
from workflow.settings.names import data_folder, did_you_mean_path
from workflow.sources.folder_scene import images
from workflow.sources.folder_scene.camera import (
    lens_of,
    number,
    pinhole_of,
    pixel_offset,
    pose_of,
    refuse_bad_poses,
    refuse_other_sizes,
    refuse_swapped,
    size_of,
)
from workflow.sources.folder_scene.entries import Entry, locate, notes_of_choice, some

SAME_SHAPE = 0.03
"""Difference of the ratio of sides by which a depth image is still one of the same camera."""
MOST_FILES = 100_000
"""Files and folders among which those of a scene are looked for; where there are more, a whole disk was named."""


@dataclass(frozen=True)
class Frame:
    """One photograph and all files that belong to it.

    Attributes:
        name: of the view.
        file_path: as written.
        image: the file.
        turn: EXIF orientation that makes the stored pixels upright.
        camera: of the stored (or EXIF-turned) picture, pixel centres at +0.5.
        lens: its distortion.
        matrix: (4, 4) `transform_matrix` as written.
        depth: depth image.
        depth_camera, depth_matrix: of the depth image where they differ from the photograph's; the matrix has OpenCV axes.
        mask: picture of the pixels that may be used: those that are not 0, or with `mask_full` only those of the largest value.
        split: `train` or `test` where lists say so.
        seen: (n, 3) points of a sparse reconstruction that this photograph sees, in the unit of the poses.
        exposure: factor on radiance before the response, where the source itself knows it.
        ids: map of object ids.
        truth: kind -> map of true materials, emission or radiance.
        colour: space of its colours, `file` = as the file says (`source.colour`).
    """

    name: str
    file_path: str
    image: Path
    turn: int
    camera: Pinhole
    lens: Distortion
    matrix: np.ndarray
    depth: Path | None = None
    depth_camera: Pinhole | None = None
    depth_matrix: np.ndarray | None = None
    mask: Path | None = None
    mask_full: bool = False
    split: str | None = None
    seen: np.ndarray | None = None
    exposure: float | None = None
    ids: Path | None = None
    truth: dict[str, Path] = field(default_factory=dict)
    colour: str = "file"

    def files(self) -> list[Path]:
        """List all files of the photograph."""
        return [path for path in (self.image, self.depth, self.mask, self.ids, *self.truth.values()) if path]


@dataclass(frozen=True)
class Cameras:
    """A checked camera file.

    Attributes:
        path: the file.
        frames: in order.
        depth_unit: metres per value of the depth images, where the file states it.
        axes: camera axes of the frames' matrices, `opengl` or `opencv`.
        known: whether the format of the file determines the axes, so that no setting can be wrong.
        notes: which photographs were chosen, and what was left out, as text.
        also: further files that were read.
    """

    path: Path
    frames: tuple[Frame, ...]
    depth_unit: float | None
    axes: str = "opengl"
    known: bool = False
    notes: tuple[str, ...] = ()
    also: tuple[Path, ...] = ()


def folder_at(source: dict[str, Any], holds: str) -> Path:
    """Return `source.path`, which must be a folder; `holds` says in messages what it contains."""
    folder = data_folder(source["path"])
    if not folder.is_dir():
        found, hint = ("is a file", "") if folder.exists() else ("not found", did_you_mean_path(folder))
        raise InputError(f"{folder}: {found}; `source.path` must be a folder with {holds} (docs/guide/own-data.md).{hint}")
    return folder


def files_below(folder: Path, suffixes: Collection[str]) -> list[Path]:
    """List the files with one of some suffixes (lower case) in a folder and in those below it; links to folders are not followed.

    Raises:
        InputError: more than `MOST_FILES` lie there.
    """
    count, found = 0, []
    for here, folders, names in os.walk(folder):
        count += len(folders) + len(names)
        if count > MOST_FILES:
            raise InputError(f"{folder}: more than {MOST_FILES:,} files lie below; name the folder of this scene in `source`")
        found += [Path(here, name) for name in names if os.path.splitext(name)[1].lower() in suffixes]
    return sorted(path for path in found if path.is_file())


def checked_frames(
    path: Path,
    document: dict[str, Any],
    entries: list[Entry],
    root: Path,
    source: dict[str, Any],
    capture: dict[str, Any],
    world: np.ndarray | None = None,
) -> Cameras:
    """Return the frames that `source.frames` and `capture.views` choose of `entries`, after checking everything about them.

    Args:
        path: the file that messages name.
        document: keys that all frames share (intrinsics), and those of the whole file.
        entries: one per photograph.
        root: folder that `file_path` counts from.
        source, capture: the dumped settings sections.
        world: (4, 4) rotation, translation and uniform scale from the world of the poses to the mesh's; None = identity.

    Returns:
        The checked frames.

    Raises:
        InputError: at the first fault.
    """
    located = locate(path, entries, root, source.get("frames"), capture)
    offset = pixel_offset(path, document, source.get("pixel_centre", "auto"))
    headers = {image: images.header(image) for _, image in located}
    refuse_other_sizes(path, document, located, headers)
    refuse_bad_poses(path, [entry for entry, _ in located])
    strict = source["alignment"] != "off"
    frames = [_frame(path, root, document, entry, image, headers[image], offset, strict) for entry, image in located]
    absent = [f.depth for f in frames if f.depth is not None and not f.depth.is_file()]
    if absent:
        raise InputError(f"{path}: {some(absent)} named by `depth_file_path`: not found; add them or remove the key")
    for frame in frames:
        _same_shape(frame)
    absent = [f.mask for f in frames if f.mask is not None and not f.mask.is_file()]
    if absent:
        raise InputError(
            f"{path}: {len(absent)} mask(s) not found: {some(absent)}; without them what they hide would count as surface."
            " Add them, or leave these photographs out"
        )
    for frame in frames:
        if frame.mask is not None:
            images.header(frame.mask)  # refuses what is no picture, or cut short
    frames = [replace(frame, colour=source.get("colour", "file")) for frame in frames]
    if world is not None:
        frames = [replace(f, matrix=_in_world(world, f.matrix)) for f in frames]
    said = notes_of_choice(len(frames), len(entries), source.get("frames"), capture["views"])
    return Cameras(path, tuple(frames), _depth_unit(path, document), source.get("axes", "opengl"), notes=said)


def _frame(
    path: Path,
    root: Path,
    document: dict[str, Any],
    entry: Entry,
    image: Path,
    header: images.Header,
    offset: float,
    strict: bool,
) -> Frame:
    where = entry.where
    values = {key: value for key, value in document.items() if key != "frames"} | entry.keys
    width, height, turn = size_of(path, where, values, image, header)
    camera = pinhole_of(path, where, values, width, height, offset, strict="w" not in values)
    if strict:
        refuse_swapped(path, where, camera)
    depth, depth_camera, depth_matrix = None, None, None
    if entry.keys.get("depth_file_path"):
        depth = existing(root / str(entry.keys["depth_file_path"]))
        if isinstance(values.get("depth_intrinsics"), dict):
            own = values["depth_intrinsics"]
            size = images.header(depth).size if depth.is_file() else (width, height)
            depth_camera = pinhole_of(path, f"{where}: depth_intrinsics", own, *size, offset)
        if "depth_c2w_opencv" in entry.keys:
            depth_matrix = pose_of(path, where, entry, "depth_c2w_opencv")
    return Frame(
        entry.name,
        entry.file_path,
        image,
        turn,
        camera,
        lens_of(path, where, values),
        pose_of(path, where, entry, "transform_matrix"),
        depth,
        depth_camera,
        depth_matrix,
        entry.mask,
        entry.mask_full,
        entry.split,
        entry.seen,
    )


def _depth_unit(path: Path, document: dict[str, Any]) -> float | None:
    value = number(path, "top level", document, "depth_unit_m")
    if value is not None and value <= 0:
        raise InputError(f"{path}: `depth_unit_m` is {value:g}; expected metres per depth value, such as 0.001")
    return value


def _same_shape(frame: Frame) -> None:
    """Refuse a depth image without a camera of its own whose sides have another ratio than those of the photograph."""
    if frame.depth is None or frame.depth_camera is not None or frame.turn != 1:
        return
    size = images.header(frame.depth)
    own = (frame.camera.width, frame.camera.height)
    width, height = own if own in (size.size, size.shown) else size.size
    if abs(width * own[1] / (height * own[0]) - 1) > SAME_SHAPE:
        raise InputError(
            f"{frame.depth}: {width}x{height}, its photograph has {own[0]}x{own[1]}: another shape, so another camera; give"
            " `depth_intrinsics` (docs/guide/own-data.md), or remove `depth_file_path`"
        )


def _in_world(world: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Return the pose after a similarity of the world, whose scale moves the camera but does not stretch its axes."""
    scale = float(np.cbrt(np.linalg.det(world[:3, :3])))
    out = world @ matrix
    if abs(scale - 1) > 1e-12:  # permutations of the axes stay exact
        out[:3, :3] /= scale
    return out
