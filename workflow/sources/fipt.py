"""Source `fipt`: scenes of FIPT and of Intrinsic Image Fusion (docs/guide/own-data.md, docs/method/camera.md#axes-and-pixels).

    synthetic   scene.obj, train/ and val/: transforms.json, Image/NNN_0001.{exr,png}, Image/cam/{exposure,crf}.npy,
                BaseCol, Roughness, Metallic, Emit, IndexMA/NNN_0001.exr, segmentation/NNN.exr
    real        scene.obj, cam.txt, K_list.txt, Image/NNN_0001.{exr,png}, segmentation/NNN.exr

`capture.dynamic_range` selects exr (radiance) or png (sensor values, with exposures).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from iif_core.errors import InputError
from workflow.intake.arrays import read_npy
from workflow.intake.documents import read_text
from workflow.runtime.job import Job
from workflow.sources import folder
from workflow.sources.folder_scene import images, mesh, transforms
from workflow.sources.folder_scene.camera import metres_per_unit
from workflow.sources.folder_scene.entries import Entry
from workflow.sources.folder_scene.frames import checked_frames, folder_at
from workflow.sources.folder_scene.inputs import Inputs

OPENCV_FROM_LEFT_UP_FORWARD = np.diag([-1.0, -1.0, 1.0, 1.0])  # from the camera axes of the synthetic scenes
MAX_COSINE_TO_UP = 2e-3  # between viewing direction and up vector of a real camera
TRUTH = {"albedo": "BaseCol", "roughness": "Roughness", "metallic": "Metallic", "emission": "Emit"}
IDS = {"parts": "IndexMA", "semantic": "segmentation"}


@dataclass
class Listed:
    """Cameras as they are listed.

    Attributes:
        path: file of the cameras, for messages.
        entries: one per photograph.
        at: name of a view -> folder and index of its photograph.
        flip: (4, 4), from OpenCV's camera axes to those of the entries.
        homes: folders of photographs.
        also: further files that were read.
        notes: what was left out, as text.
    """

    path: Path
    flip: np.ndarray
    entries: list[Entry] = field(default_factory=list)
    at: dict[str, tuple[Path, int]] = field(default_factory=dict)
    homes: list[Path] = field(default_factory=list)
    also: list[Path] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def add(self, home: Path, place: Path, index: int, encoded: bool, keys: dict[str, Any], split: str | None = None) -> None:
        """Add photograph `index` of folder `place`, which is in the folder `home` of the scene."""
        picture = place / "Image" / f"{_file(index)}.{'png' if encoded else 'exr'}"
        file_path = picture.relative_to(home).as_posix()
        name = ("val_" if place.name == "val" else "") + _file(index)
        self.entries.append(Entry(file_path, f"camera {index} ({file_path})", keys, name, split=split))
        self.at[name] = place, index


def raw_inputs(document: dict[str, Any]) -> list[Path]:
    """List the files that the capture reads, after the checks that need no pixels; raises InputError."""
    return find_inputs(document["source"], document["capture"]).files()


def capture(job: Job) -> None:
    """Write the normal form of the scene."""
    folder.capture_photographs(job, find_inputs(vars(job.settings.source), vars(job.settings.capture)))


def find_inputs(source: dict[str, Any], settings: dict[str, Any]) -> Inputs:
    """Find and check the cameras of a scene, with OpenCV axes, and the files that belong to them.

    Raises:
        InputError: missing or inconsistent files, by name.
    """
    home = folder_at(source, "scene.obj")
    encoded = settings["dynamic_range"] == "ldr"
    if (home / "train/transforms.json").is_file():
        found = _synthetic(home, source, encoded)
    elif (home / "cam.txt").is_file():
        found = _real(home, encoded)
    else:
        raise InputError(
            f"{home}: neither train/transforms.json (synthetic) nor cam.txt and K_list.txt (real); `source.path` is the folder"
            " of one FIPT scene"
        )
    listed = checked_frames(found.path, {}, found.entries, home, source, settings)
    at = {frame.name: found.at[frame.name] for frame in listed.frames}
    exposures, response, cam = _sensor(found, at) if encoded else ({}, None, [])
    truth = _truth(found, at)
    ids, lists = _ids(found, at)
    frames = tuple(
        replace(f, matrix=f.matrix @ found.flip, exposure=exposures.get(f.name), ids=ids.get(f.name), truth=truth.get(f.name, {}))
        for f in listed.frames
    )
    listed = replace(listed, frames=frames, axes="opencv", known=True, notes=tuple(found.notes), also=tuple(found.also))
    return Inputs(
        listed,
        mesh.find(home, source["mesh"]),
        metres=metres_per_unit(source["unit"]),
        load_ids=partial(load_ids, _listed_ids(lists)),
        response=response,
        also=(*cam, *lists),
    )


def _file(index: int) -> str:
    return f"{index:03d}_0001"


# --------------------------------------------------------------------------------------------------------------- cameras


def _synthetic(home: Path, source: dict[str, Any], encoded: bool) -> Listed:
    found = Listed(home / "train/transforms.json", OPENCV_FROM_LEFT_UP_FORWARD)
    for split in ("train", "val"):
        path = home / split / "transforms.json"
        if split == "val" and not path.is_file():
            continue
        document = transforms.load(path)
        frames = document.get("frames")
        if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
            raise InputError(f"{path}: `frames` must be a list of {{transform_matrix: 4 rows of 4}}, one a photograph")
        if "camera_angle_x" not in document:
            raise InputError(f"{path}: no `camera_angle_x` (radians); FIPT's synthetic scenes have one lens for all views")
        shared = {"camera_angle_x": document["camera_angle_x"]}
        for i, frame in enumerate(frames):
            keys = {key: frame[key] for key in ("transform_matrix",) if key in frame}
            found.add(home, home / split, i, encoded, {**shared, **keys}, "test" if split == "val" else "train")
        found.homes.append(home / split)
        found.also.append(path)
    if len(found.homes) == 1:  # without val/, `capture.test_every` alone decides which views are held out
        found.entries = [replace(entry, split=None) for entry in found.entries]
    return found


def _real(home: Path, encoded: bool) -> Listed:
    cameras, lenses = home / "cam.txt", home / "K_list.txt"
    found = Listed(cameras, np.eye(4), homes=[home], also=[lenses])
    poses, matrices = _triples(cameras, "origin, look-at point, up"), _triples(lenses, "the rows of K")
    if len(poses) != len(matrices):
        raise InputError(f"{lenses}: {len(matrices)} cameras, cam.txt has {len(poses)}; both must list the same photographs")
    for i, (pose, k) in enumerate(zip(poses, matrices, strict=True)):
        if k[0, 1] or k[1, 0] or not np.allclose(k[2], [0, 0, 1]):
            raise InputError(f"{lenses}: camera {i}: K = {k.tolist()}; expected fx 0 cx / 0 fy cy / 0 0 1")
        lens = {"fl_x": float(k[0, 0]), "fl_y": float(k[1, 1]), "cx": float(k[0, 2]), "cy": float(k[1, 2])}
        matrix = _looking(cameras, i, *pose).tolist()
        found.add(home, home, i, encoded, {"transform_matrix": matrix, **lens})
    return found


def _triples(path: Path, what: str) -> np.ndarray:
    """Read (n, 3, 3) from a file that holds n, then three lines of three numbers per camera."""
    if not path.is_file():
        raise InputError(f"{path}: not found; a real FIPT scene needs cam.txt and K_list.txt")
    text = read_text(path)
    try:
        first, *rest = text.split("\n", 1)
        count = int(first)
        numbers = np.array("".join(rest).split(), np.float64)
    except ValueError as error:
        raise InputError(f"{path}: expected the number of cameras, then three lines a camera ({error})") from None
    if count < 1 or numbers.size != 9 * count or not np.isfinite(numbers).all():
        raise InputError(
            f"{path}: {numbers.size} numbers for {count} cameras; expected 9 finite ones each: {what} (three lines of three)"
        )
    return numbers.reshape(count, 3, 3)


def _looking(path: Path, index: int, origin: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return the OpenCV pose with z towards the target, y = -up and x = y cross z."""
    ahead, length = target - origin, np.linalg.norm(up)
    distance = np.linalg.norm(ahead)
    if distance < 1e-9 or length < 1e-9:
        raise InputError(f"{path}: camera {index}: looks at its own place, or has no up vector")
    z, y = ahead / distance, -up / length
    if abs(z @ y) > MAX_COSINE_TO_UP:
        raise InputError(
            f"{path}: camera {index}: viewing direction and up vector are not square (cosine {-z @ y:.4g}, allowed"
            f" {MAX_COSINE_TO_UP:g}); three lines a camera are origin, look-at point, up"
        )
    pose = np.eye(4)
    pose[:3, :3] = np.stack([np.cross(y, z), y, z], 1)
    pose[:3, 3] = origin
    return pose


# ---------------------------------------------------------------------------------------------------------------- sensor


def _sensor(found: Listed, at: dict[str, tuple[Path, int]]) -> tuple[dict[str, float], np.ndarray | None, list[Path]]:
    """Read the exposures of the photographs that are used, by name, and, where the scene has it, the true response (3, 101).

    Returns them with the files of both.
    """
    files, tables = [], {}
    for home in found.homes:
        path = home / "Image/cam/exposure.npy"
        if not path.is_file():
            found.notes.append(f"no {path}: exposures are 1")
            continue
        table = _array(path)
        count = sum(place == home for place, _ in found.at.values())
        if table.size != count or not (np.isfinite(table).all() and (table > 0).all()):
            raise InputError(f"{path}: {table.size} exposures (smallest {table.min():g}); expected {count} positive numbers")
        tables[home] = table.ravel()
        files.append(path)
    exposures = {name: float(tables[home][i]) if home in tables else 1.0 for name, (home, i) in at.items()}
    path = found.homes[0] / "Image/cam/crf.npy"
    if not path.is_file():
        return exposures, None, files
    curve = _array(path)
    if curve.ndim != 2 or curve.shape[0] != 3 or curve.shape[1] < 2 or not np.isfinite(curve).all():
        raise InputError(f"{path}: shape {curve.shape}; expected (3, n) samples of the response, one row a channel")
    even = np.linspace(0, 1, curve.shape[1])
    return exposures, np.stack([np.interp(np.linspace(0, 1, 101), even, row) for row in curve]), [*files, path]


def _array(path: Path) -> np.ndarray:
    found = read_npy(path).astype(np.float64)
    if found.size == 0:
        raise InputError(f"{path}: holds no number")
    return found


# ----------------------------------------------------------------------------------------------------------------- truth


def _truth(found: Listed, at: dict[str, tuple[Path, int]]) -> dict[str, dict[str, Path]]:
    """List the four truth maps of every photograph and its radiance; empty if the folder of a kind is missing."""
    absent = sorted({name for name in TRUTH.values() for home in found.homes if not (home / name).is_dir()})
    if absent:
        if len(absent) < len(TRUTH):
            found.notes.append(f"no ground truth: {', '.join(absent)} missing (DiffCol and albedo/ are no base colour)")
        return {}
    out = {}
    for name, (home, i) in at.items():
        out[name] = {kind: home / below / f"{_file(i)}.exr" for kind, below in TRUTH.items()}
        radiance = home / "Image" / f"{_file(i)}.exr"
        if radiance.is_file():
            out[name]["radiance"] = radiance
    missing = [path for maps in out.values() for path in maps.values() if not path.is_file()]
    if missing:
        raise InputError(f"{missing[0]}: not found ({len(missing)} truth maps are missing); complete or remove the folders")
    return out


def _ids(found: Listed, at: dict[str, tuple[Path, int]]) -> tuple[dict[str, Path], list[Path]]:
    """List the id maps of the photographs, of the first kind that is there, and the files that say which ids each may contain."""
    kind = next((k for k, below in IDS.items() if all((home / below).is_dir() for home in found.homes)), None)
    if kind is None:
        return {}, []
    files = {}
    for name, (home, i) in at.items():
        files[name] = home / IDS[kind] / (f"{_file(i)}.exr" if kind == "parts" else f"{i:03d}.exr")
    missing = [path for path in files.values() if not path.is_file()]
    if missing:
        raise InputError(f"{missing[0]}: not found ({len(missing)} id maps are missing); complete or remove the folders")
    lists = [path for home in found.homes if (path := home / IDS[kind] / "object_ids.txt").is_file()]
    return files, lists


def _listed_ids(lists: list[Path]) -> dict[Path, list[np.ndarray]]:
    """Read object_ids.txt, a line of numbers per photograph: folder of id maps -> ids that occur in each photograph."""
    out = {}
    for path in lists:
        lines = read_text(path).splitlines()
        try:
            out[path.parent] = [np.array([int(float(v)) for v in line.split(",") if v.strip()], np.int64) for line in lines]
        except (ValueError, OverflowError) as error:
            raise InputError(f"{path}: expected a line of ids, parted by commas, for every photograph ({error})") from None
    return out


def load_ids(listed: dict[Path, list[np.ndarray]], path: Path, turn: int = 1, size: tuple[int, int] | None = None) -> np.ndarray:
    """Read object ids (H, W) int32 from the first channel of an EXR, -1 = none.

    There is no id where the value is negative, not finite or between integers (anti-aliased edges,
    docs/method/numerics.md#ids-between-integers), nor where object_ids.txt does not list it for this photograph (blends).
    """
    values = images.load_map(path, 1, size)
    known = np.isfinite(values)
    whole = np.rint(np.where(known, values, -1))
    known &= (np.abs(np.where(known, values, 0) - whole) <= 1e-3) & (whole >= 0)
    index = int(path.stem[:3])
    if path.parent in listed and index < len(listed[path.parent]):
        known &= np.isin(whole, listed[path.parent][index])
    return images.TURNS[turn](np.where(known, whole, -1).astype(np.int32))
