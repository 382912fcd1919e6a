"""Reads and checks cameras in the form of `transforms.json` of nerfstudio and instant-ngp, from JSON and image headers only.

Every message names the file, the frame, the value found, the values allowed and the remedy. Other camera files (COLMAP,
ScanNet++, FIPT) are read as the same entries and pass the same checks (`frames_of`).
"""

from __future__ import annotations

import difflib
import fnmatch
import math
import os
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from iif_core.camera.distortion import Distortion, Pinhole
from iif_core.errors import InputError
from workflow.intake import limits
from workflow.intake.documents import read_json
from workflow.intake.names import existing, fault_of_name, forward, same_name, shown
from workflow.settings.names import data_folder, did_you_mean_path
from workflow.sources.folder_scene import images

METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "km": 1000.0, "ft": 0.3048, "in": 0.0254}
PERSPECTIVE = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "PERSPECTIVE")
FISHEYE = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
INTRINSICS = ("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_angle_x", "camera_angle_y")
KEYS = (
    *INTRINSICS,
    *("k1", "k2", "k3", "k4", "p1", "p2", "camera_model", "is_fisheye", "pixel_centres_at"),
    *("frames", "file_path", "transform_matrix", "mask_path", "depth_file_path", "applied_transform", "applied_scale"),
    *("train_filenames", "val_filenames", "test_filenames"),
)
"""Keys of a transforms.json that are read; keys of other tools are ignored."""
MISSPELT = 0.85
"""Similarity (difflib) from which an unknown key counts as a misspelt known one."""
_HEIC = "Convert all of them: heif-convert <name>.HEIC <name>.jpg, or mogrify -format jpg *.HEIC (ImageMagick)"
_RAW = "Develop all of them to linear EXR in sRGB primaries (darktable-cli <name>.DNG <name>.exr), or to JPEG"
CONVERTERS = {
    **dict.fromkeys((".heic", ".heif", ".avif"), _HEIC),
    **dict.fromkeys((".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2"), _RAW),
    **dict.fromkeys((".tif", ".tiff", ".webp", ".bmp"), "Convert all of them: mogrify -format png <files> (ImageMagick)"),
}
"""What to do with photographs of other formats."""
OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
RIGID_TOLERANCE = 5e-3  # largest entry of R^T R - I: rounding to three decimals passes, a scale of 1 % does not
SAME_SHAPE = 0.03
"""Difference of the ratio of sides by which a depth image is still one of the same camera."""
MIN_OFFSET_IF_SWAPPED = 0.08
"""Offset of the principal point from the middle, as a share of the picture, above which x and y may have been swapped."""


@dataclass(frozen=True)
class Entry:
    """One photograph as a file of cameras lists it, before anything about it is checked.

    Attributes:
        file_path: as written.
        where: names it in messages.
        keys: of its own, as in transforms.json: intrinsics, `transform_matrix`, depth.
        stated_name: of the view; None = the name of the file without extension.
        mask, mask_full, split, seen: as in `Frame`.
    """

    file_path: str
    where: str
    keys: dict[str, Any]
    stated_name: str | None = None
    mask: Path | None = None
    mask_full: bool = False
    split: str | None = None
    seen: np.ndarray | None = None

    @property
    def name(self) -> str:
        """Name of the view."""
        return self.stated_name or Path(self.file_path).stem


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
class Transforms:
    """A checked camera file.

    Attributes:
        path: the file.
        frames: in order.
        depth_unit: metres per value of the depth images, where the file states it.
        axes: camera axes of the frames' matrices, `opengl` or `opencv`.
        known: whether the format of the file determines the axes, so that no setting can be wrong.
        notes: what was left out, as text.
        also: further files that were read.
    """

    path: Path
    frames: tuple[Frame, ...]
    depth_unit: float | None
    axes: str = "opengl"
    known: bool = False
    notes: tuple[str, ...] = ()
    also: tuple[Path, ...] = ()


def metres_per_unit(unit: str | float) -> float:
    """Return the metres per unit of `source.unit`.

    >>> metres_per_unit("cm"), metres_per_unit(0.5)
    (0.01, 0.5)
    """
    factor = METRES.get(unit, unit) if isinstance(unit, str) else unit
    try:
        factor = float(factor)
    except (ValueError, OverflowError):
        factor = math.nan
    if not (math.isfinite(factor) and factor > 0):
        raise InputError(f"`source.unit`: found {unit!r}; allowed: {', '.join(METRES)} or metres per unit (a number > 0)")
    return factor


def opencv_pose(matrix: np.ndarray, axes: str, metres: float) -> np.ndarray:
    """Return `world_from_camera` (4, 4) float64 with OpenCV axes, in metres and with an exactly orthonormal rotation."""
    pose = matrix @ OPENGL_TO_OPENCV if axes == "opengl" else matrix.copy()
    u, _, vt = np.linalg.svd(pose[:3, :3])
    pose[:3, :3] = u @ vt
    pose[:3, 3] *= metres
    return pose


def evenly_spread(count: int, wanted: int) -> list[int]:
    """Return `wanted` of `count` indices, evenly spread, or all of them if there are fewer.

    >>> evenly_spread(10, 3)
    [1, 5, 8]
    """
    if count <= wanted:
        return list(range(count))
    return [int((i + 0.5) * count / wanted) for i in range(wanted)]


def choose_entries(entries: list[Entry], views: int) -> list[Entry]:
    """Return at most `views` entries, evenly spread; at most one in eight is a test photograph."""
    tests = [e for e in entries if e.split == "test"]
    others = [e for e in entries if e.split != "test"]
    if len(entries) > views:
        kept = min(len(tests), max(1, views // 8)) if views > 1 else 0
        tests = [tests[i] for i in evenly_spread(len(tests), kept)]
        others = [others[i] for i in evenly_spread(len(others), views - kept)]
    taken = {id(e) for e in (*others, *tests)}
    return [e for e in entries if id(e) in taken]


def folder_at(source: dict[str, Any], holds: str) -> Path:
    """Return `source.path`, which must be a folder; `holds` says in messages what it contains."""
    folder = data_folder(source["path"])
    if not folder.is_dir():
        found, hint = ("is a file", "") if folder.exists() else ("not found", did_you_mean_path(folder))
        raise InputError(f"{folder}: {found}; `source.path` must be a folder with {holds} (docs/guide/own-data.md).{hint}")
    return folder


def read(source: dict[str, Any], capture: dict[str, Any]) -> Transforms:
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
    return frames_of(path, document, entries, path.parent, source, capture, world)


def frames_of(
    path: Path,
    document: dict[str, Any],
    entries: list[Entry],
    root: Path,
    source: dict[str, Any],
    capture: dict[str, Any],
    world: np.ndarray | None = None,
) -> Transforms:
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
    for entry in entries:
        if fault := fault_of_path(entry.file_path):
            raise InputError(f"{path}: {shown(entry.file_path)} {fault}")
    every = _told_apart(_matching(path, entries, source.get("frames")))
    found = {id(entry): _find_image(path, root, entry) for entry in every}
    raw = choose_entries(every, capture["views"])
    if all(entry.split == "test" for entry in raw):
        raise InputError(f"{path}: lists keep all {len(raw)} photographs for testing; at least one must be there to use")
    _unique_names(path, raw)
    # Also those that are not taken: another quality takes others.
    _all_present(path, root, [image for image in found.values() if not image.is_file()])
    located = [(entry, found[id(entry)]) for entry in raw]
    _one_range(path, [image for _, image in located], capture["dynamic_range"])

    offset = _pixel_offset(path, document, source.get("pixel_centre", "auto"))
    headers = {image: images.header(image) for _, image in located}
    _same_sizes(path, document, located, headers)
    _refuse_bad_poses(path, raw)
    strict = source["alignment"] != "off"
    frames = [_frame(path, root, document, entry, image, headers[image], offset, strict) for entry, image in located]
    absent = [f.depth for f in frames if f.depth is not None and not f.depth.is_file()]
    if absent:
        raise InputError(f"{path}: {_some(absent)} named by `depth_file_path`: not found; add them or remove the key")
    for frame in frames:
        _same_shape(frame)
    absent = [f.mask for f in frames if f.mask is not None and not f.mask.is_file()]
    if absent:
        raise InputError(
            f"{path}: {len(absent)} mask(s) not found: {_some(absent)}; without them what they hide would count as surface."
            " Add them, or leave these photographs out"
        )
    for frame in frames:
        if frame.mask is not None:
            images.header(frame.mask)  # refuses what is no picture, or cut short
    frames = [replace(frame, colour=source.get("colour", "file")) for frame in frames]
    if world is not None:
        frames = [replace(f, matrix=_in_world(world, f.matrix)) for f in frames]
    return Transforms(path, tuple(frames), _depth_unit(path, document), source.get("axes", "opengl"))


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
    scale = _number(path, "top level", document, "applied_scale", 1.0)
    if not scale > 0:
        raise InputError(f"{path}: `applied_scale` is {scale:g}; must be positive")
    return np.linalg.inv(matrix) @ np.diag([1 / scale, 1 / scale, 1 / scale, 1.0])


def fault_of_similarity(matrix: np.ndarray) -> str:
    """Return why a matrix (4, 4) is no rotation and translation with one scale, or an empty text if it is."""
    if not np.isfinite(matrix).all():
        return "holds NaN or infinity"
    turn = matrix[:3, :3]
    size = float(np.linalg.det(turn))
    if size <= 0 or np.abs(turn.T @ turn / np.cbrt(size) ** 2 - np.eye(3)).max() > RIGID_TOLERANCE:
        return f"is no rotation with one scale (determinant {size:.4g})"
    return "" if np.abs(matrix[3] - [0, 0, 0, 1]).max() < 1e-6 else f"has the last row {matrix[3].tolist()}"


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
        raise InputError(f"{path}: {_some(unknown)} listed for train or test: no frame has such a `file_path`")
    kept = [e for e in entries if e.file_path in names] if "train_filenames" in lists else entries
    return [replace(e, split="train" if names.get(e.file_path, "train_filenames") == "train_filenames" else "test") for e in kept]


def entries_of(path: Path, document: dict[str, Any], key: str = "frames") -> list[Entry]:
    """Return the checked list of frames of a document."""
    return [_entry(path, i, entry, key) for i, entry in enumerate(_frames(path, document, key))]


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


def fault_of_path(stated: Any) -> str:
    """Return why a path in a list of cameras names no file, or an empty text. Where it leads is left open: it is read alone."""
    if not isinstance(stated, str):
        return "is no text"
    if len(stated) > limits.TEXT:
        return f"has {len(stated)} characters (allowed {limits.TEXT})"
    *folders, name = Path(stated).parts or ("",)
    for part in folders:
        if fault := fault_of_name(part.lstrip("./") or "root", 255):
            return f"goes through no folder ({part!r:.40} {fault})"
    fault = fault_of_name(name)
    return f"names no file ({name!r:.40} {fault})" if fault else ""


def _matching(path: Path, entries: list[Entry], pattern: str | None) -> list[Entry]:
    if pattern is None:
        return entries
    kept = [e for e in entries if fnmatch.fnmatchcase(e.file_path, pattern)]
    if not kept:
        example = entries[0].file_path
        raise InputError(f"{path}: `source.frames: {pattern}` matches none of {len(entries)} frames (such as {example!r})")
    return kept


def _told_apart(entries: list[Entry]) -> list[Entry]:
    """Name all views by folder and file where files of one name lie in several folders, as in rigs: `left_0000`, `right_0000`."""
    names = [same_name(entry.name) for entry in entries]
    files = {os.path.normpath(entry.file_path) for entry in entries}
    if len(set(names)) == len(names) or len(files) < len(entries) or any(entry.stated_name for entry in entries):
        return entries
    paths = [Path(entry.file_path).with_suffix("") for entry in entries]
    shared = len(os.path.commonprefix([path.parent.parts for path in paths]))
    longer = ["_".join(path.parts[shared:]) for path in paths]
    if len({same_name(name) for name in longer}) < len(longer):
        return entries
    return [replace(entry, stated_name=name) for entry, name in zip(entries, longer, strict=True)]


def _unique_names(path: Path, entries: list[Entry]) -> None:
    seen: dict[str, Entry] = {}
    for entry in entries:
        name = entry.name
        if fault := fault_of_name(name):
            raise InputError(f"{path}: {entry.where}: the name of a view {fault}; rename the photograph")
        other = seen.setdefault(same_name(name), entry)
        if other is entry:
            continue
        if _one_photograph(other.file_path, entry.file_path):
            raise InputError(
                f"{path}: {other.where} and {entry.where} are the same photograph, which is listed twice; remove one of"
                " the two frames"
            )
        if other.name != name:
            raise InputError(
                f"{path}: views {other.name!r} and {name!r} differ only in capital letters, which some disks ignore; rename"
                " one of the photographs"
            )
        raise InputError(
            f"{path}: {other.file_path!r} and {entry.file_path!r} would both be view {name!r}; file names without"
            " extension must differ: rename one, or select with `source.frames`"
        )


def _one_photograph(first: str, second: str) -> bool:
    """Return whether two file paths name one file; the extension may be left out."""
    a, b = Path(os.path.normpath(first)), Path(os.path.normpath(second))
    return a == b or (a.with_suffix("") == b.with_suffix("") and "" in (a.suffix, b.suffix))


def _find_image(path: Path, root: Path, entry: Entry) -> Path:
    stated = existing(root / entry.file_path)
    if stated.suffix.lower() in images.EXTENSIONS:
        return stated
    found = [c for c in (existing(stated.with_name(stated.name + e)) for e in images.EXTENSIONS) if c.is_file()]
    if len(found) > 1:
        names = " and ".join(c.name for c in found)
        raise InputError(f"{path}: {entry.file_path!r} has no extension and {names} exist; name the one you mean")
    if not found and stated.is_file():
        allowed = ", ".join(images.EXTENSIONS)
        cure = CONVERTERS.get(stated.suffix.lower(), "Convert it")
        raise InputError(f"{stated}: not an image format that is read here; allowed: {allowed}. {cure}")
    return found[0] if found else stated


def _some(paths: list[Any], shown: int = 3) -> str:
    names = ", ".join(str(p) for p in paths[:shown])
    return names + (f" and {len(paths) - shown} more" if len(paths) > shown else "")


def _all_present(path: Path, root: Path, missing: list[Path]) -> None:
    if missing:
        start = f"the folder of {path.name}" if path.parent == root else str(root)
        raise InputError(
            f"{path}: {len(missing)} image(s) not found: {_some(missing)}."
            f" {'`file_path` counts' if path.suffix == '.json' else 'Names count'} from {start},"
            f" with extension ({', '.join(images.EXTENSIONS)}) or without.{_elsewhere(path, missing[0])}"
        )


def _elsewhere(path: Path, missing: Path) -> str:
    """Say in which folder beside the cameras a missing photograph lies, if it does."""
    wanted = same_name(missing.stem)
    for folder in sorted(own for own in path.parent.iterdir() if own.is_dir()):
        if any(same_name(file.stem) == wanted and file.suffix.lower() in images.EXTENSIONS for file in folder.iterdir()):
            cure = "write it before the names" if path.suffix == ".json" else f"set `source.images: {folder.name}`"
            return f" There is one in {folder.name}/: {cure}"
    return ""


def _one_range(path: Path, files: list[Path], dynamic_range: str) -> None:
    hdr = [f for f in files if f.suffix.lower() == ".exr"]
    if hdr and len(hdr) < len(files):
        other = next(f for f in files if f.suffix.lower() != ".exr")
        raise InputError(f"{path}: mixes HDR ({hdr[0].name}) and LDR ({other.name}) images; choose with `source.frames`")
    if hdr and dynamic_range == "ldr":
        raise InputError(
            f"{path}: the images are EXR, which hold linear radiance, but `capture.dynamic_range` is ldr;"
            " set `capture: {dynamic_range: hdr}`"
        )
    if not hdr and dynamic_range == "hdr":
        raise InputError(
            f"{path}: `capture.dynamic_range` is hdr, but the images are {files[0].suffix.lower()};"
            " set `capture: {dynamic_range: ldr}` or give linear EXR images"
        )


def _pixel_offset(path: Path, document: dict[str, Any], setting: str) -> float:
    """Return the offset on cx and cy that puts pixel centres at +0.5."""
    stated = document.get("pixel_centres_at", document.get("pixel_centers_at"))
    if setting != "auto":
        return 0.5 if setting == "integer" else 0.0
    if stated is None:
        return 0.0
    text = str(stated).lower()
    if text.startswith("integer"):
        return 0.5
    if text.startswith("half") or text == "0.5":
        return 0.0
    raise InputError(
        f"{path}: `pixel_centres_at` is {shown(stated)}; allowed: 'integer coordinates', 'half-integer coordinates'."
        " Or set `source.pixel_centre: half` or `integer`"
    )


def _same_sizes(
    path: Path,
    document: dict[str, Any],
    located: list[tuple[Entry, Path]],
    headers: dict[Path, images.Header],
) -> None:
    """Refuse images of different sizes that share the top-level intrinsics."""
    sizes: dict[tuple[int, int], list[Path]] = {}
    for entry, image in located:
        if not any(key in entry.keys for key in INTRINSICS):
            header = headers[image]
            stated = (document.get("w"), document.get("h"))
            turned = header.orientation >= 5 and stated == header.size[::-1]
            shown = header.size if stated == header.size else header.shown
            sizes.setdefault(stated if turned else shown, []).append(image)
    if len(sizes) > 1:
        rows = sorted(sizes.items(), key=lambda item: -len(item[1]))
        text = "; ".join(f"{w}x{h}: {len(found)} image(s) such as {found[0].name}" for (w, h), found in rows[:4])
        raise InputError(
            f"{path}: images of different sizes share one set of intrinsics ({text})."
            " Write w, h, fl_x, fl_y, cx, cy into each frame, or select one size with `source.frames`"
        )


def _number(path: Path, where: str, values: dict[str, Any], key: str, default: float | None = None) -> float | None:
    if key not in values:
        return default
    value = values[key]
    if isinstance(value, bool) or not isinstance(value, int | float) or value != value or abs(value) == math.inf:
        raise InputError(f"{path}: {where}: `{key}` is {shown(value)}; expected a finite number")
    if abs(value) > limits.NUMBER:  # compared before it is converted: an integer may be larger than any float
        raise InputError(f"{path}: {where}: `{key}` is {shown(value)}; expected a number up to {limits.NUMBER:g}")
    return float(value)


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
    width, height, turn = _size(path, where, values, image, header)
    camera = _camera(path, where, values, width, height, offset, strict="w" not in values)
    if strict:
        _not_swapped(path, where, camera)
    depth, depth_camera, depth_matrix = None, None, None
    if entry.keys.get("depth_file_path"):
        depth = existing(root / str(entry.keys["depth_file_path"]))
        if isinstance(values.get("depth_intrinsics"), dict):
            own = values["depth_intrinsics"]
            size = images.header(depth).size if depth.is_file() else (width, height)
            depth_camera = _camera(path, f"{where}: depth_intrinsics", own, *size, offset)
        if "depth_c2w_opencv" in entry.keys:
            depth_matrix = _matrix(path, where, entry, "depth_c2w_opencv")
    return Frame(
        entry.name,
        entry.file_path,
        image,
        turn,
        camera,
        _lens(path, where, values),
        _matrix(path, where, entry, "transform_matrix"),
        depth,
        depth_camera,
        depth_matrix,
        entry.mask,
        entry.mask_full,
        entry.split,
        entry.seen,
    )


def _size(path: Path, where: str, values: dict[str, Any], image: Path, header: images.Header) -> tuple[int, int, int]:
    """Return width and height of the picture that the intrinsics describe, and the EXIF turn that produces it."""
    stored = header.shown
    width, height = (_number(path, where, values, key, size) for key, size in zip("wh", stored, strict=True))
    stated = (int(round(width)), int(round(height)))
    turned = stored[::-1] if header.orientation >= 5 else stored
    if header.orientation != 1:
        known = "w" in values and "h" in values
        if known and stated == turned and stored != turned:
            return *stated, header.orientation
        if not (known and stated == stored and stored != turned):
            raise InputError(
                f"{image}: its EXIF orientation is {header.orientation} and {path.name} does not tell whether the"
                " cameras belong to the turned picture; save the images upright (orientation 1) and repeat the pose"
                " estimation, or remove the EXIF tag if the poses were made from the stored pixels"
            )
    if stated == header.size:  # of an EXR with overscan, or a crop, whose cameras belong to all its pixels
        return *stated, 1
    if stated != stored:
        factor = stored[0] / stated[0] if stated[0] else 0
        same_shape = factor > 0 and abs(stored[1] - stated[1] * factor) <= 1
        advice = (
            f"multiply fl_x, fl_y, cx, cy by {factor:.6g} and set w, h to {stored[0]}, {stored[1]}"
            if same_shape
            else "w and h seem swapped: swap them, and fl_x, fl_y and cx, cy with them"
            if stated == stored[::-1]
            else f"take the intrinsics that belong to {stored[0]}x{stored[1]}"
        )
        raise InputError(
            f"{path}: {where}: the image is {stored[0]}x{stored[1]} pixels, `w` x `h` say {stated[0]}x{stated[1]}"
            f" (intrinsics for another resolution); {advice}, or give the images of that size"
        )
    return *stored, 1


def _camera(
    path: Path, where: str, values: dict[str, Any], width: int, height: int, offset: float, strict: bool = False
) -> Pinhole:
    fx, fy = (_number(path, where, values, key) for key in ("fl_x", "fl_y"))
    angle_x, angle_y = (_number(path, where, values, key) for key in ("camera_angle_x", "camera_angle_y"))
    for key, angle in (("camera_angle_x", angle_x), ("camera_angle_y", angle_y)):
        if angle is not None and not 0 < angle < math.pi:
            raise InputError(f"{path}: {where}: `{key}` is {angle}; expected radians between 0 and pi")
    if fx is None and angle_x is not None:
        fx = 0.5 * width / math.tan(0.5 * angle_x)
    if fy is None and angle_y is not None:
        fy = 0.5 * height / math.tan(0.5 * angle_y)
    fx, fy = fx if fx is not None else fy, fy if fy is not None else fx
    if fx is None or fy is None:
        raise InputError(f"{path}: {where}: no focal length; give `fl_x` (pixels) or `camera_angle_x` (radians)")
    if not (fx > 0 and fy > 0):
        raise InputError(f"{path}: {where}: focal lengths fl_x = {fx:g}, fl_y = {fy:g}; must be positive pixels")
    low, high = (share * max(width, height) for share in limits.FOCAL)
    if not (low <= min(fx, fy) and max(fx, fy) <= high):
        raise InputError(
            f"{path}: {where}: focal lengths fl_x = {fx:g}, fl_y = {fy:g} of a {width}x{height} image; expected"
            f" {low:g} to {high:g} pixels"
        )
    cx = _number(path, where, values, "cx", width / 2 - offset) + offset
    cy = _number(path, where, values, "cy", height / 2 - offset) + offset
    reach = 0.25 if strict else 1.0  # without w and h, only the principal point can reveal another resolution
    if abs(cx - width / 2) > reach * width or abs(cy - height / 2) > reach * height:
        raise InputError(
            f"{path}: {where}: the principal point ({cx:g}, {cy:g}) is not near the middle of the {width}x{height}"
            " image; fl_x, fl_y, cx, cy seem to be for another resolution: give `w` and `h` with them, and images of"
            " that size"
        )
    return Pinhole(fx, fy, cx, cy, width, height)


def _not_swapped(path: Path, where: str, camera: Pinhole) -> None:
    """Refuse a principal point that is far from the middle as given and near it with x and y exchanged."""

    def offset(cx: float, cy: float) -> float:
        return max(abs(cx / camera.width - 0.5), abs(cy / camera.height - 0.5))

    given, other = offset(camera.cx, camera.cy), offset(camera.cy, camera.cx)
    if given > MIN_OFFSET_IF_SWAPPED and other < 0.25 * given:
        raise InputError(
            f"{path}: {where}: the principal point ({camera.cx:g}, {camera.cy:g}) of a {camera.width}x{camera.height} image:"
            f" cx and cy seem swapped (then {other:.1%} from the middle instead of {given:.1%}); swap cx, cy, and fl_x, fl_y"
            " with them. If the image is a crop and they are right: `source.alignment: off`"
        )


def _lens(path: Path, where: str, values: dict[str, Any]) -> Distortion:
    model = str(values.get("camera_model", "OPENCV")).upper()
    fisheye = model in FISHEYE or bool(values.get("is_fisheye", False))
    if not fisheye and model not in PERSPECTIVE:
        allowed = ", ".join((*PERSPECTIVE, *FISHEYE))
        raise InputError(f"{path}: {where}: `camera_model` {shown(values['camera_model'])}: unknown; allowed: {allowed}")
    k = tuple(_number(path, where, values, f"k{i}", 0.0) for i in (1, 2, 3, 4))
    p = tuple(_number(path, where, values, f"p{i}", 0.0) for i in (1, 2))
    if model in ("PINHOLE", "SIMPLE_PINHOLE") and not fisheye and (any(k) or any(p)):
        raise InputError(
            f"{path}: {where}: `camera_model` is {model}, but k = {k}, p = {p}; write OPENCV, or remove the"
            " coefficients if the images are undistorted already"
        )
    if not fisheye and k[3] != 0:
        raise InputError(
            f"{path}: {where}: k4 = {k[3]:g} with `camera_model` {model}: tools disagree on its meaning; calibrate with"
            " k1, k2, k3, p1, p2, or write OPENCV_FISHEYE if the lens is one"
        )
    if fisheye and any(p):
        raise InputError(f"{path}: {where}: p1, p2 = {p} with a fisheye camera, which has k1 ... k4 only")
    return Distortion("fisheye" if fisheye else "radial_tangential", k, p)


def _matrix(path: Path, where: str, entry: Entry, key: str) -> np.ndarray:
    if fault := _fault_of_pose(entry.keys, key):
        raise InputError(f"{path}: {where}: `{key}` {fault}")
    return np.array(entry.keys[key], np.float64)


def _fault_of_pose(keys: dict[str, Any], key: str) -> str:
    """Return why `keys[key]` is not a rigid camera-to-world matrix, or an empty text if it is."""
    try:
        matrix = np.array(keys.get(key), np.float64)
    except (TypeError, ValueError, OverflowError):
        matrix = np.zeros(0)
    if matrix.shape != (4, 4):
        found = "missing" if key not in keys else f"has shape {'x'.join(map(str, matrix.shape)) or 'of a scalar'}"
        return f"{found}; expected 4 rows of 4 numbers, camera-to-world"
    if not np.isfinite(matrix).all():
        return "holds NaN or infinity: this image has no pose; remove the frame"
    if np.abs(matrix).max() > limits.NUMBER:
        return f"holds {np.abs(matrix).max():g}; expected numbers up to {limits.NUMBER:g}"
    rotation, last = matrix[:3, :3], matrix[3]
    determinant = float(np.linalg.det(rotation))
    if np.abs(last - [0, 0, 0, 1]).max() > 1e-6:
        return f"has the last row {last.tolist()}; expected 0 0 0 1 (row-major matrix)"
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > RIGID_TOLERANCE or determinant < 0:
        kind = "a reflection" if determinant < 0 else "a scale or shear"
        return (
            f"holds {kind} (determinant {determinant:.4g}, expected 1); poses must be rotation and translation only: keep scale"
            " in the translation and use `source.unit`"
        )
    return ""


def _refuse_bad_poses(path: Path, entries: list[Entry]) -> None:
    """Refuse poses that are not rigid; the message names the photographs that share the first fault."""
    photographs: dict[str, list[str]] = {}
    for entry in entries:
        if fault := _fault_of_pose(entry.keys, "transform_matrix"):
            photographs.setdefault(fault, []).append(entry.where)
    for fault, where in photographs.items():
        raise InputError(f"{path}: {_some(where, 20)}: `transform_matrix` {fault}")


def _depth_unit(path: Path, document: dict[str, Any]) -> float | None:
    value = _number(path, "top level", document, "depth_unit_m")
    if value is not None and value <= 0:
        raise InputError(f"{path}: `depth_unit_m` is {value:g}; expected metres per depth value, such as 0.001")
    return value
