"""`transforms.json` of nerfstudio and instant-ngp -> cameras in the project's conventions, checked before any work.

Reads JSON and image headers only, because it runs while Snakemake plans. Every message names the file, the frame,
what was found, what is allowed and what to do.
"""

from __future__ import annotations

import fnmatch
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from iif_core.distortion import Distortion, Pinhole
from iif_core.errors import InputError
from workflow.sources.folder_scene import images

METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "km": 1000.0, "ft": 0.3048, "in": 0.0254}
PERSPECTIVE = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "PERSPECTIVE")
FISHEYE = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
INTRINSICS = ("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_angle_x", "camera_angle_y")
OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
RIGID_TOLERANCE = 5e-3
"""Largest entry of R^T R - I: rounding to three decimals passes, a scale of 1 % does not."""


@dataclass(frozen=True)
class Frame:
    """One photograph, as the file describes it.

    camera: of the stored (or EXIF-turned) picture, pixel centres at +0.5. matrix: `transform_matrix` as written.
    depth_camera, depth_matrix: of the depth image where they differ from the photograph's (matrix: OpenCV axes).
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


@dataclass(frozen=True)
class Transforms:
    """The checked file: its frames in order, and metres per value of the depth images where it says so."""

    path: Path
    frames: tuple[Frame, ...]
    depth_unit: float | None


def metres_per_unit(unit: str | float) -> float:
    """Factor of `source.unit`."""
    factor = METRES.get(unit, unit) if isinstance(unit, str) else unit
    try:
        factor = float(factor)
    except ValueError:
        factor = math.nan
    if not (math.isfinite(factor) and factor > 0):
        raise InputError(f"`source.unit`: found {unit!r}; allowed: {', '.join(METRES)} or metres per unit (a number > 0)")
    return factor


def opencv_pose(matrix: np.ndarray, axes: str, metres: float) -> np.ndarray:
    """`world_from_camera` (4, 4) float64, OpenCV axes, metres; its rotation made exactly orthonormal."""
    pose = matrix @ OPENGL_TO_OPENCV if axes == "opengl" else matrix.copy()
    u, _, vt = np.linalg.svd(pose[:3, :3])
    pose[:3, :3] = u @ vt
    pose[:3, 3] *= metres
    return pose


def spread(count: int, wanted: int) -> list[int]:
    """`wanted` of `count` indices, evenly spread, all of them when there are fewer."""
    if count <= wanted:
        return list(range(count))
    return [int((i + 0.5) * count / wanted) for i in range(wanted)]


def read(source: dict[str, Any], capture: dict[str, Any]) -> Transforms:
    """Frames of a folder after `frames` glob and `capture.views`, everything about them checked.

    Args:
        source, capture: the dumped settings sections.

    Raises:
        InputError: on the first thing that cannot be used; lists of files name the first few.
    """
    folder = Path(source["path"])
    if not folder.is_dir():
        found = "is a file" if folder.exists() else "not found"
        raise InputError(f"{folder}: {found}; `source.path` must be a folder with transforms.json (docs/own-data.md)")
    path = folder / "transforms.json"
    document = _load(path)
    raw = [_entry(path, i, entry) for i, entry in enumerate(_frames(path, document))]
    raw = _matching(path, raw, source.get("frames"))
    raw = [raw[i] for i in spread(len(raw), capture["views"])]
    _unique_names(path, raw)
    located = [(entry, _find_image(path, entry)) for entry in raw]
    _all_present(path, [(entry, image) for entry, image in located if not image.is_file()])
    _one_range(path, [image for _, image in located], capture["dynamic_range"])

    offset = _pixel_offset(path, document, source["pixel_centre"])
    headers = {image: images.header(image) for _, image in located}
    _same_sizes(path, document, located, headers)
    frames = [_frame(path, document, entry, image, headers[image], offset) for entry, image in located]
    absent = [f.depth for f in frames if f.depth is not None and not f.depth.is_file()]
    if absent:
        raise InputError(f"{path}: {_some(absent)} named by `depth_file_path`: not found; add them or remove the key")
    return Transforms(path, tuple(frames), _depth_unit(path, document))


def _load(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise InputError(f"{path}: not found; a `folder` scene needs it (docs/own-data.md shows how to make one)")
    try:
        document = json.loads(path.read_text())
    except (ValueError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not valid JSON ({error})") from None
    if not isinstance(document, dict):
        raise InputError(f"{path}: found a {type(document).__name__}, expected an object with `frames`")
    return document


def _frames(path: Path, document: dict[str, Any]) -> list[Any]:
    frames = document.get("frames")
    if not isinstance(frames, list) or not frames:
        found = "no `frames`" if frames is None else "`frames` is empty" if frames == [] else "`frames` is not a list"
        raise InputError(f"{path}: {found}; at least one photograph with file_path and transform_matrix is needed")
    return frames


def _entry(path: Path, index: int, entry: Any) -> dict[str, Any]:
    if not isinstance(entry, dict) or not isinstance(entry.get("file_path"), str) or not entry["file_path"]:
        raise InputError(f"{path}: frames[{index}]: needs a `file_path` (text) and a `transform_matrix`")
    return {**entry, "file_path": entry["file_path"].removeprefix("./"), "_index": index}


def _matching(path: Path, entries: list[dict[str, Any]], pattern: str | None) -> list[dict[str, Any]]:
    if pattern is None:
        return entries
    kept = [e for e in entries if fnmatch.fnmatchcase(e["file_path"], pattern)]
    if not kept:
        example = entries[0]["file_path"]
        raise InputError(f"{path}: `source.frames: {pattern}` matches none of {len(entries)} frames (such as {example!r})")
    return kept


def _unique_names(path: Path, entries: list[dict[str, Any]]) -> None:
    seen: dict[str, str] = {}
    for entry in entries:
        name = Path(entry["file_path"]).stem
        if name in seen:
            raise InputError(
                f"{path}: {seen[name]!r} and {entry['file_path']!r} would both be view {name!r}; file names without"
                " extension must differ: rename one, or select with `source.frames`"
            )
        seen[name] = entry["file_path"]


def _find_image(path: Path, entry: dict[str, Any]) -> Path:
    stated = path.parent / entry["file_path"]
    if stated.suffix.lower() in images.EXTENSIONS:
        return stated
    candidates = [stated.with_name(stated.name + extension) for extension in images.EXTENSIONS]
    found = [c for c in candidates if c.is_file()]
    if len(found) > 1:
        names = " and ".join(c.name for c in found)
        raise InputError(f"{path}: {entry['file_path']!r} has no extension and {names} exist; name the one you mean")
    if not found and stated.is_file():
        allowed = ", ".join(images.EXTENSIONS)
        raise InputError(f"{stated}: not an image format that is read here; allowed: {allowed}. Convert it")
    return found[0] if found else stated


def _some(paths: list[Any], shown: int = 3) -> str:
    names = ", ".join(str(p) for p in paths[:shown])
    return names + (f" and {len(paths) - shown} more" if len(paths) > shown else "")


def _all_present(path: Path, missing: list[tuple[dict[str, Any], Path]]) -> None:
    if missing:
        names = _some([image for _, image in missing])
        raise InputError(
            f"{path}: {len(missing)} image(s) not found: {names}. `file_path` counts from the folder of"
            f" transforms.json, with extension ({', '.join(images.EXTENSIONS)}) or without"
        )


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
    """What is added to cx, cy so that pixel centres lie at +0.5."""
    stated = document.get("pixel_centres_at")
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
        f"{path}: `pixel_centres_at` is {stated!r}; allowed: 'integer coordinates', 'half-integer coordinates'."
        " Or set `source.pixel_centre: half` or `integer`"
    )


def _same_sizes(
    path: Path,
    document: dict[str, Any],
    located: list[tuple[dict[str, Any], Path]],
    headers: dict[Path, images.Header],
) -> None:
    """Images that share the top-level intrinsics must have one size."""
    sizes: dict[tuple[int, int], list[Path]] = {}
    for entry, image in located:
        if not any(key in entry for key in INTRINSICS):
            sizes.setdefault(headers[image].size, []).append(image)
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
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(f"{path}: {where}: `{key}` is {value!r}; expected a finite number")
    return float(value)


def _frame(
    path: Path, document: dict[str, Any], entry: dict[str, Any], image: Path, header: images.Header, offset: float
) -> Frame:
    where = f"frames[{entry['_index']}] ({entry['file_path']})"
    values = {key: value for key, value in document.items() if key != "frames"} | entry
    width, height, turn = _size(path, where, values, image, header)
    camera = _camera(path, where, values, width, height, offset, strict="w" not in values)
    depth, depth_camera, depth_matrix = None, None, None
    if entry.get("depth_file_path"):
        depth = path.parent / str(entry["depth_file_path"])
        if isinstance(values.get("depth_intrinsics"), dict):
            own = values["depth_intrinsics"]
            size = images.header(depth).size if depth.is_file() else (width, height)
            depth_camera = _camera(path, f"{where}: depth_intrinsics", own, *size, offset)
        if "depth_c2w_opencv" in entry:
            depth_matrix = _matrix(path, where, entry, "depth_c2w_opencv")
    return Frame(
        Path(entry["file_path"]).stem,
        entry["file_path"],
        image,
        turn,
        camera,
        _lens(path, where, values),
        _matrix(path, where, entry, "transform_matrix"),
        depth,
        depth_camera,
        depth_matrix,
    )


def _size(path: Path, where: str, values: dict[str, Any], image: Path, header: images.Header) -> tuple[int, int, int]:
    """Width and height of the picture that the intrinsics speak of, and the EXIF turn that makes it."""
    stored = header.size
    width, height = (_number(path, where, values, key, size) for key, size in zip("wh", stored, strict=True))
    stated = (int(round(width)), int(round(height)))
    turned = stored[::-1] if header.orientation >= 5 else stored
    if header.orientation != 1:
        known = "w" in values and "h" in values
        if known and stated == turned and stored != turned:
            return *stated, header.orientation
        if not (known and stated == stored and stored != turned):
            raise InputError(
                f"{image}: its EXIF orientation is {header.orientation} and transforms.json does not tell whether the"
                " cameras belong to the turned picture; save the images upright (orientation 1) and repeat the pose"
                " estimation, or remove the EXIF tag if the poses were made from the stored pixels"
            )
    if stated != stored:
        factor = stored[0] / stated[0] if stated[0] else 0
        same_shape = factor > 0 and abs(stored[1] - stated[1] * factor) <= 1
        advice = (
            f"multiply fl_x, fl_y, cx, cy by {factor:.6g} and set w, h to {stored[0]}, {stored[1]}"
            if same_shape
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
    cx = _number(path, where, values, "cx", width / 2 - offset) + offset
    cy = _number(path, where, values, "cy", height / 2 - offset) + offset
    reach = 0.25 if strict else 1.0  # without w, h the principal point is the only sign of another resolution
    if abs(cx - width / 2) > reach * width or abs(cy - height / 2) > reach * height:
        raise InputError(
            f"{path}: {where}: the principal point ({cx:g}, {cy:g}) is not near the middle of the {width}x{height}"
            " image; fl_x, fl_y, cx, cy seem to be for another resolution: give `w` and `h` with them, and images of"
            " that size"
        )
    return Pinhole(fx, fy, cx, cy, width, height)


def _lens(path: Path, where: str, values: dict[str, Any]) -> Distortion:
    model = str(values.get("camera_model", "OPENCV")).upper()
    fisheye = model in FISHEYE or bool(values.get("is_fisheye", False))
    if not fisheye and model not in PERSPECTIVE:
        allowed = ", ".join((*PERSPECTIVE, *FISHEYE))
        raise InputError(f"{path}: {where}: `camera_model` {values['camera_model']!r}: unknown; allowed: {allowed}")
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


def _matrix(path: Path, where: str, entry: dict[str, Any], key: str) -> np.ndarray:
    try:
        matrix = np.array(entry.get(key), np.float64)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.shape != (4, 4):
        found = "missing" if key not in entry else f"has shape {'x'.join(map(str, matrix.shape)) or 'of a scalar'}"
        raise InputError(f"{path}: {where}: `{key}` {found}; expected 4 rows of 4 numbers, camera-to-world")
    if not np.isfinite(matrix).all():
        raise InputError(f"{path}: {where}: `{key}` holds NaN or infinity: this image has no pose; remove the frame")
    rotation, last = matrix[:3, :3], matrix[3]
    determinant = float(np.linalg.det(rotation))
    if np.abs(last - [0, 0, 0, 1]).max() > 1e-6:
        raise InputError(f"{path}: {where}: last row of `{key}` is {last.tolist()}; expected 0 0 0 1 (row-major matrix)")
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > RIGID_TOLERANCE or determinant < 0:
        kind = "a reflection" if determinant < 0 else "a scale or shear"
        raise InputError(
            f"{path}: {where}: `{key}` holds {kind} (determinant {determinant:.4g}, expected 1); poses must be rotation"
            " and translation only: keep scale in the translation and use `source.unit`"
        )
    return matrix


def _depth_unit(path: Path, document: dict[str, Any]) -> float | None:
    value = _number(path, "top level", document, "depth_unit_m")
    if value is not None and value <= 0:
        raise InputError(f"{path}: `depth_unit_m` is {value:g}; expected metres per depth value, such as 0.001")
    return value
