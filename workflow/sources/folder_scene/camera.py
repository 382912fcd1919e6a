"""The camera of one photograph: intrinsics, lens and pose from keys of `transforms.json`, which all readers of cameras fill."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from iif_core.camera.distortion import Distortion, Pinhole
from iif_core.errors import InputError
from workflow.intake import limits
from workflow.intake.names import shown
from workflow.sources.folder_scene import images
from workflow.sources.folder_scene.entries import Entry, some

METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "km": 1000.0, "ft": 0.3048, "in": 0.0254}
PERSPECTIVE = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "PERSPECTIVE")
FISHEYE = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
INTRINSICS = ("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_angle_x", "camera_angle_y")
OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
RIGID_TOLERANCE = 5e-3  # largest entry of R^T R - I: rounding to three decimals passes, a scale of 1 % does not
MIN_OFFSET_IF_SWAPPED = 0.08
"""Offset of the principal point from the middle, as a share of the picture, above which x and y may have been swapped."""


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


def fault_of_similarity(matrix: np.ndarray) -> str:
    """Return why a matrix (4, 4) is no rotation and translation with one scale, or an empty text if it is."""
    if not np.isfinite(matrix).all():
        return "holds NaN or infinity"
    turn = matrix[:3, :3]
    size = float(np.linalg.det(turn))
    if size <= 0 or np.abs(turn.T @ turn / np.cbrt(size) ** 2 - np.eye(3)).max() > RIGID_TOLERANCE:
        return f"is no rotation with one scale (determinant {size:.4g})"
    return "" if np.abs(matrix[3] - [0, 0, 0, 1]).max() < 1e-6 else f"has the last row {matrix[3].tolist()}"


def number(path: Path, where: str, values: dict[str, Any], key: str, default: float | None = None) -> float | None:
    """Return a finite number of a place in a file; `default` where it is absent."""
    if key not in values:
        return default
    value = values[key]
    if isinstance(value, bool) or not isinstance(value, int | float) or value != value or abs(value) == math.inf:
        raise InputError(f"{path}: {where}: `{key}` is {shown(value)}; expected a finite number")
    if abs(value) > limits.NUMBER:  # compared before it is converted: an integer may be larger than any float
        raise InputError(f"{path}: {where}: `{key}` is {shown(value)}; expected a number up to {limits.NUMBER:g}")
    return float(value)


def pixel_offset(path: Path, document: dict[str, Any], setting: str) -> float:
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


def size_of(path: Path, where: str, values: dict[str, Any], image: Path, header: images.Header) -> tuple[int, int, int]:
    """Return width and height of the picture that the intrinsics describe, and the EXIF turn that produces it."""
    stored = header.shown
    width, height = (number(path, where, values, key, size) for key, size in zip("wh", stored, strict=True))
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


def refuse_other_sizes(
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


def pinhole_of(
    path: Path, where: str, values: dict[str, Any], width: int, height: int, offset: float, strict: bool = False
) -> Pinhole:
    """Return the camera that focal lengths (pixels) or angles of view (radians) and the principal point state, once plausible.

    Args:
        path, where: for messages.
        values: the keys.
        width, height: of the picture that they describe, pixels.
        offset: what brings the principal point to pixel centres at +0.5.
        strict: whether a principal point far from the middle stands for another resolution.
    """
    fx, fy = (number(path, where, values, key) for key in ("fl_x", "fl_y"))
    angle_x, angle_y = (number(path, where, values, key) for key in ("camera_angle_x", "camera_angle_y"))
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
    cx = number(path, where, values, "cx", width / 2 - offset) + offset
    cy = number(path, where, values, "cy", height / 2 - offset) + offset
    reach = 0.25 if strict else 1.0  # without w and h, only the principal point can reveal another resolution
    if abs(cx - width / 2) > reach * width or abs(cy - height / 2) > reach * height:
        raise InputError(
            f"{path}: {where}: the principal point ({cx:g}, {cy:g}) is not near the middle of the {width}x{height}"
            " image; fl_x, fl_y, cx, cy seem to be for another resolution: give `w` and `h` with them, and images of"
            " that size"
        )
    return Pinhole(fx, fy, cx, cy, width, height)


def refuse_swapped(path: Path, where: str, camera: Pinhole) -> None:
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


def lens_of(path: Path, where: str, values: dict[str, Any]) -> Distortion:
    """Return the distortion of the lens; its model is stated, or OPENCV (radial and tangential)."""
    model = str(values.get("camera_model", "OPENCV")).upper()
    fisheye = model in FISHEYE or bool(values.get("is_fisheye", False))
    if not fisheye and model not in PERSPECTIVE:
        allowed = ", ".join((*PERSPECTIVE, *FISHEYE))
        raise InputError(f"{path}: {where}: `camera_model` {shown(values['camera_model'])}: unknown; allowed: {allowed}")
    k = tuple(number(path, where, values, f"k{i}", 0.0) for i in (1, 2, 3, 4))
    p = tuple(number(path, where, values, f"p{i}", 0.0) for i in (1, 2))
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


def pose_of(path: Path, where: str, entry: Entry, key: str) -> np.ndarray:
    """Return a rigid camera-to-world matrix (4, 4) float64 of an entry."""
    if fault := fault_of_pose(entry.keys, key):
        raise InputError(f"{path}: {where}: `{key}` {fault}")
    return np.array(entry.keys[key], np.float64)


def fault_of_pose(keys: dict[str, Any], key: str) -> str:
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


def refuse_bad_poses(path: Path, entries: list[Entry]) -> None:
    """Refuse poses that are not rigid; the message names the photographs that share the first fault."""
    photographs: dict[str, list[str]] = {}
    for entry in entries:
        if fault := fault_of_pose(entry.keys, "transform_matrix"):
            photographs.setdefault(fault, []).append(entry.where)
    for fault, where in photographs.items():
        raise InputError(f"{path}: {some(where, 20)}: `transform_matrix` {fault}")
