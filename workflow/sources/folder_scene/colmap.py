"""Reads COLMAP models (text or binary) as entries like those of transforms.json (https://colmap.github.io/format.html).

COLMAP's conventions are the project's own, OpenCV camera axes and pixel centres at +0.5, except that poses are world-to-camera.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from iif_core.camera.distortion import distort
from iif_core.errors import InputError
from workflow.intake import limits
from workflow.intake.documents import check_file, reading
from workflow.intake.names import existing, forward, shown
from workflow.sources.folder_scene.entries import Entry, fault_of_path
from workflow.sources.folder_scene.frames import Cameras, checked_frames, files_below
from workflow.sources.folder_scene.images import EXTENSIONS

PARTS = ("cameras", "images", "points3D")
PLACES = ("sparse/0", "sparse", "colmap/sparse/0", "colmap")
MAX_SEEN_POINTS = 2000  # sparse points kept of a photograph; enough for medians
MAX_REPROJECTION = 0.01  # median distance of points from their keypoints, as a share of the longer side; good models have 0.001

MODELS: dict[str, tuple[int, str, tuple[str, ...]]] = {
    "SIMPLE_PINHOLE": (0, "PINHOLE", ("f", "cx", "cy")),
    "PINHOLE": (1, "PINHOLE", ("fl_x", "fl_y", "cx", "cy")),
    "SIMPLE_RADIAL": (2, "OPENCV", ("f", "cx", "cy", "k1")),
    "RADIAL": (3, "OPENCV", ("f", "cx", "cy", "k1", "k2")),
    "OPENCV": (4, "OPENCV", ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2")),
    "OPENCV_FISHEYE": (5, "OPENCV_FISHEYE", ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4")),
    "FULL_OPENCV": (6, "OPENCV", ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    "FOV": (7, "", ("fl_x", "fl_y", "cx", "cy", "omega")),
    "SIMPLE_RADIAL_FISHEYE": (8, "OPENCV_FISHEYE", ("f", "cx", "cy", "k1")),
    "RADIAL_FISHEYE": (9, "OPENCV_FISHEYE", ("f", "cx", "cy", "k1", "k2")),
    "THIN_PRISM_FISHEYE": (10, "", ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1")),
}
"""Model -> id in binary files, corresponding `camera_model` ("" = none), parameters in COLMAP's order."""
_NAME_OF = {number: name for name, (number, _, _) in MODELS.items()}


@dataclass(frozen=True)
class Image:
    """One registered image: id of its camera, `world_from_camera` (4, 4), keypoints (n, 2) with their points' ids (n,)."""

    name: str
    camera: int
    pose: np.ndarray
    keypoints: np.ndarray
    point_ids: np.ndarray


@dataclass(frozen=True)
class Model:
    """A reconstruction.

    Attributes:
        path: file of the images, for messages.
        cameras: id -> keys of transforms.json.
        images: sorted by name.
        point_ids, points: ascending ids (n,) and positions (n, 3), empty without points3D.
        files: that were read.
    """

    path: Path
    cameras: dict[int, dict[str, Any]]
    images: list[Image]
    point_ids: np.ndarray
    points: np.ndarray
    files: tuple[Path, ...]

    def seen(self, image: Image) -> tuple[np.ndarray, np.ndarray]:
        """Return the positions (n, 3) of sparse points that an image sees, and their keypoints (n, 2)."""
        if len(self.points) == 0 or len(image.point_ids) == 0:
            return np.zeros((0, 3)), np.zeros((0, 2))
        at = np.minimum(np.searchsorted(self.point_ids, image.point_ids), len(self.point_ids) - 1)
        known = np.flatnonzero(self.point_ids[at] == image.point_ids)
        known = known[:: max(1, len(known) // MAX_SEEN_POINTS)]
        return self.points[at[known]], image.keypoints[known]


def find(folder: Path, stated: str | None) -> Path | None:
    """Return the folder of a model: `source.cameras`, or the first of the usual places that holds one, or None."""
    if stated is not None:
        path = folder / stated
        path = path.parent if path.is_file() and path.stem in PARTS else path
        if not is_model(path):
            raise InputError(
                f"{path}: no COLMAP model (`source.cameras: {stated}`); expected cameras and images as .bin or .txt, or name"
                " transforms.json"
            )
        return path
    return next((folder / place for place in PLACES if is_model(folder / place)), None)


def is_model(path: Path) -> bool:
    """Return whether a folder holds cameras and images."""
    return any(all((path / f"{part}{suffix}").is_file() for part in PARTS[:2]) for suffix in (".bin", ".txt"))


def read(path: Path, with_points: bool = True) -> Model:
    """Read a model, the binary form if both exist; without points, keypoints are not read either, which is fast.

    Raises:
        InputError: damaged files, an unsupported lens, images without camera.
    """
    suffix = ".bin" if all((path / f"{part}.bin").is_file() for part in PARTS[:2]) else ".txt"
    files = [path / f"{part}{suffix}" for part in PARTS]
    readers = (_binary_cameras, _binary_images, _binary_points) if suffix == ".bin" else (_cameras, _images, _points)
    with_points = with_points and files[2].is_file()
    cameras = _guarded(files[0], readers[0])
    images = sorted(_guarded(files[1], lambda file: readers[1](file, with_points)), key=lambda image: image.name)
    ids, points = _guarded(files[2], readers[2]) if with_points else (np.zeros(0, np.int64), np.zeros((0, 3)))
    if not images:
        raise InputError(f"{files[1]}: no image is registered; the reconstruction failed or is another model (sparse/1?)")
    lost = next((image for image in images if image.camera not in cameras), None)
    if lost is not None:
        raise InputError(f"{files[1]}: {shown(lost.name)} has camera {lost.camera}, which {files[0].name} does not hold")
    order = np.argsort(ids, kind="stable")
    return Model(files[1], cameras, images, ids[order], points[order], tuple(files[: 3 if with_points else 2]))


def _guarded(path: Path, reader: Any) -> Any:
    check_file(path, limits.MODEL_BYTES, "a file of a COLMAP model")
    with reading(path, "not a COLMAP file, or cut short"):
        return reader(path)


def _count(data: bytes, least: int) -> int:
    """Return the number of entries that a binary file announces, each of which has at least `least` bytes.

    Raises:
        ValueError: the file is too short for them.
    """
    (count,) = struct.unpack_from("<Q", data)
    if count * least > len(data) - 8:
        raise ValueError(f"{count} entries announced, {len(data)} bytes in the file")
    return int(count)


def entry_of(model: Model, image: Image) -> Entry:
    """Return an entry like those of transforms.json, but with camera-to-world of OpenCV axes."""
    where = f"image {shown(image.name)}"
    if fault := fault_of_path(image.name):
        raise InputError(f"{model.path}: {where}: its name {fault}")
    keys = {**model.cameras[image.camera], "transform_matrix": image.pose.tolist()}
    return Entry(image.name, where, keys, seen=model.seen(image)[0])


def frames_of(folder: Path, place: Path, source: dict[str, Any], capture: dict[str, Any], points: bool) -> Cameras:
    """Read the frames of a folder whose cameras are a COLMAP model, with the same checks as for transforms.json.

    Args:
        folder: of the scene.
        place: folder of the model.
        source, capture: the dumped settings sections.
        points: also read the sparse points, check the cameras by them, and keep them for the check of the mesh.

    Returns:
        The checked frames.

    Raises:
        InputError: what is missing or does not fit, by name.
    """
    model = read(place, points)
    root = folder / source["images"]
    if not root.is_dir():
        raise InputError(f"{root}: not found; `source.images` is the folder that the image names of {model.path} count from")
    entries = [entry_of(model, image) for image in model.images]
    masks = folder / "masks"
    # COLMAP's own form of the name; 0001.png would be a mask of objects (docs/guide/segmentation.md).
    named = {entry.file_path: existing(masks / f"{entry.file_path}.png") for entry in entries}
    entries = [replace(entry, mask=named[entry.file_path]) if named[entry.file_path].is_file() else entry for entry in entries]
    listed = checked_frames(model.path, {}, entries, root, source, capture)
    if points:
        _check_reprojection(model, listed)
    names = {image.name for image in model.images}
    there = files_below(root, EXTENSIONS)
    without = [path.name for path in there if path.relative_to(root).as_posix() not in names]
    notes = [*listed.notes]
    if without:
        notes.append(f"{len(without)} of {len(there)} images have no pose in {model.path} and are not used, such as {without[0]}")
    return replace(listed, axes="opencv", known=True, notes=tuple(notes), also=model.files)


def _check_reprojection(model: Model, listed: Cameras) -> None:
    """Refuse cameras that do not project the sparse points to their keypoints, as after an edit or with another model's file."""
    found = {image.name: image for image in model.images}
    errors = {}
    for frame in listed.frames:
        points, keypoints = model.seen(found[frame.file_path])
        local = (points - frame.matrix[:3, 3]) @ frame.matrix[:3, :3]
        front = local[:, 2] > 1e-9
        at, unique = distort(frame.lens, local[front, :2] / local[front, 2:])
        camera = frame.camera
        pixel = at * [camera.fx, camera.fy] + [camera.cx, camera.cy]
        off = np.linalg.norm(pixel - keypoints[front], axis=1)[unique]
        if len(off):
            errors[frame.name] = float(np.median(off)) / max(camera.width, camera.height)
    median = float(np.median(list(errors.values()))) if errors else 0.0
    if median > MAX_REPROJECTION:
        raise InputError(
            f"{model.path}: its sparse points miss their keypoints by {median:.1%} of the picture (median of"
            f" {len(errors)} images, allowed {MAX_REPROJECTION:.1%}): cameras and images are of different runs, or the intrinsics"
            " were changed (fx with fy, cx with cy?); take all files of one model"
        )


def _camera(path: Path, number: int, model: str, width: int, height: int, values: list[float]) -> dict[str, Any]:
    if model not in MODELS or not MODELS[model][1]:
        allowed = ", ".join(name for name, (_, lens, _) in MODELS.items() if lens)
        raise InputError(f"{path}: camera {number} is {model:.40}; allowed: {allowed}. Run `colmap image_undistorter`")
    _, lens, names = MODELS[model]
    if len(values) != len(names):
        raise ValueError(f"camera {number}, {model:.40}: {len(values)} parameters instead of {len(names)}")
    out: dict[str, Any] = dict(zip(names, map(float, values), strict=True))
    if model == "FULL_OPENCV" and any([out.pop(key) for key in ("k4", "k5", "k6")]):
        raise InputError(f"{path}: camera {number} has k4, k5, k6, which are not read here. Run `colmap image_undistorter`")
    if "f" in out:
        out["fl_x"] = out["fl_y"] = out.pop("f")
    return {"camera_model": lens, "w": int(width), "h": int(height), **out}


def _pose(quaternion: Any, translation: Any) -> np.ndarray:
    """Return `world_from_camera` of COLMAP's world-to-camera quaternion (w, x, y, z) and translation."""
    q = np.asarray(quaternion, np.float64)
    norm = np.linalg.norm(q)
    if not (np.isfinite(q).all() and norm > 1e-6):
        raise ValueError(f"quaternion {q.tolist()}")
    w, x, y, z = q / norm
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    pose = np.eye(4)
    pose[:3, :3] = rotation.T
    pose[:3, 3] = -rotation.T @ np.asarray(translation, np.float64)
    return pose


def _image(name: str, camera: int, values: Any, xy: np.ndarray, ids: np.ndarray) -> Image:
    tracked = ids >= 0
    return Image(forward(name), camera, _pose(values[:4], values[4:7]), xy[tracked], ids[tracked])


# ------------------------------------------------------------------------------------------------------------------ text


def _lines(path: Path) -> Iterator[str]:
    """Yield the lines without comments, one at a time because these files hold every keypoint of every image."""
    with open(path, encoding="utf-8-sig") as file:
        for line in file:
            if not line.startswith("#"):
                yield line.strip()


def _cameras(path: Path) -> dict[int, dict[str, Any]]:
    out = {}
    for line in filter(None, _lines(path)):
        number, model, width, height, *values = line.split()
        out[int(number)] = _camera(path, int(number), model, int(width), int(height), [float(v) for v in values])
    return out


def _images(path: Path, keypoints: bool) -> list[Image]:
    """Read two lines per image, of which the second (keypoints) may be empty."""
    out, lines = [], _lines(path)
    for first in lines:
        if not first:
            continue
        second = next(lines, "")
        fields = first.split(maxsplit=9)
        numbers = np.array(second.split() if keypoints else [], np.float64).reshape(-1, 3)
        values = [float(v) for v in fields[1:8]]
        out.append(_image(fields[9], int(fields[8]), values, numbers[:, :2], numbers[:, 2].astype(np.int64)))
    return out


def _points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    ids, points = array("q"), array("d")
    for line in filter(None, _lines(path)):
        number, x, y, z, _ = line.split(maxsplit=4)
        ids.append(int(number))
        points.extend((float(x), float(y), float(z)))
    return np.array(ids, np.int64), np.array(points, np.float64).reshape(-1, 3)


# ---------------------------------------------------------------------------------------------------------------- binary


def _binary_cameras(path: Path) -> dict[int, dict[str, Any]]:
    data, out = path.read_bytes(), {}
    count, at = _count(data, 24), 8
    for _ in range(count):
        number, model, width, height = struct.unpack_from("<iiQQ", data, at)
        name = _NAME_OF.get(model, f"model {model}")
        size = len(MODELS[name][2]) if name in MODELS else 0
        values = struct.unpack_from(f"<{size}d", data, at + 24)
        out[number] = _camera(path, number, name, width, height, list(values))
        at += 24 + 8 * size
    return out


_KEYPOINT = np.dtype([("x", "<f8"), ("y", "<f8"), ("id", "<i8")])


def _binary_images(path: Path, keypoints: bool) -> list[Image]:
    data, out = path.read_bytes(), []
    count, at = _count(data, 73), 8
    for _ in range(count):
        fields = struct.unpack_from("<i7di", data, at)
        end = data.index(b"\0", at + 64)
        name = data[at + 64 : end].decode()
        (points,) = struct.unpack_from("<Q", data, end + 1)
        if points * _KEYPOINT.itemsize > len(data) - end - 9:
            raise ValueError(f"{name[:80]}: {points} keypoints announced, fewer in the file")
        found = np.frombuffer(data, _KEYPOINT, points if keypoints else 0, end + 9)
        out.append(_image(name, fields[8], fields[1:8], np.stack([found["x"], found["y"]], -1), found["id"].astype(np.int64)))
        at = end + 9 + _KEYPOINT.itemsize * points
    return out


def _binary_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    data = path.read_bytes()
    count, at = _count(data, 51), 8
    ids, points = np.zeros(count, np.int64), np.zeros((count, 3))
    for i in range(count):
        ids[i], *points[i] = struct.unpack_from("<Q3d", data, at)
        (track,) = struct.unpack_from("<Q", data, at + 43)
        at += 51 + 8 * track
    return ids, points
