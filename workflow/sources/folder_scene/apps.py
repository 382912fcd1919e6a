"""Raw exports of scanning apps on telephones: Polycam, Record3D, 3D Scanner App. All have ARKit's axes: y up, OpenGL cameras."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from iif_core.errors import InputError
from workflow.intake.documents import read_json, reading
from workflow.intake.names import shown
from workflow.sources.folder_scene import images
from workflow.sources.folder_scene.camera import fault_of_similarity
from workflow.sources.folder_scene.entries import Entry
from workflow.sources.folder_scene.frames import Cameras, checked_frames

POLYCAM, RECORD3D, SCANNER = "Polycam", "Record3D", "3D Scanner App"
MESHES = {POLYCAM: ("raw.glb",), RECORD3D: (), SCANNER: ("export_refined.obj", "export.obj")}
"""Names of the meshes that the apps export with the photographs."""


def find(folder: Path) -> str | None:
    """Return which app has exported a folder, None = none of these."""
    if (folder / "keyframes").is_dir():
        return POLYCAM
    if _metadata(folder) is not None:
        return RECORD3D
    return SCANNER if next(folder.glob("frame_*.json"), None) is not None else None


def frames_of(app: str, folder: Path, source: dict[str, Any], capture: dict[str, Any]) -> Cameras:
    """Read the frames of such a folder, with the same checks as for transforms.json.

    Raises:
        InputError: what is missing or does not fit, by name.
    """
    path, entries, files, notes, world = {POLYCAM: _polycam, RECORD3D: _record3d, SCANNER: _scanner}[app](folder)
    if not entries:
        raise InputError(f"{path}: a folder of {app} without any photograph that has a camera; export the raw data again")
    listed = checked_frames(path, {}, entries, folder, source, capture, world)
    also = tuple(file for file in files if file != path)
    return replace(listed, axes="opengl", known=True, notes=(f"cameras: raw data of {app}", *notes), also=also)


_Found = tuple[Path, list[Entry], list[Path], list[str], "np.ndarray | None"]
"""The file that messages name, entries, files that were read, notes, and the transform (4, 4) to the world of the mesh."""


def _number(path: Path, document: dict[str, Any], key: str) -> float:
    value = document.get(key)
    if not isinstance(value, int | float) or isinstance(value, bool):
        raise InputError(f"{path}: `{key}` is {shown(value)}; a number is needed: export the raw data again")
    return float(value)


def _object(path: Path, what: str) -> dict[str, Any]:
    document = read_json(path, what)
    if not isinstance(document, dict):
        raise InputError(f"{path}: found a {type(document).__name__}; {what} is an object: export the raw data again")
    return document


def _array(path: Path, key: str, values: Any, shape: tuple[int, ...]) -> np.ndarray:
    with reading(path, f"`{key}` holds no {' x '.join(map(str, shape))} numbers", "; export the raw data again"):
        return np.array(values, np.float64).reshape(shape)


# --------------------------------------------------------------------------------------------------------------- Polycam


def _polycam(folder: Path) -> _Found:
    """`keyframes/`: JSON of each camera by its time stamp, photographs and depth of the same names
    (https://github.com/PolyCam/polyform). Its mesh is turned by `alignmentTransform`, and so are the poses then."""
    frames, notes, world = folder / "keyframes", [], None
    corrected = (frames / "corrected_cameras").is_dir()
    cameras, photographs = ("corrected_cameras", "corrected_images") if corrected else ("cameras", "images")
    if not corrected:
        notes.append("poses and photographs are those of the session: the app has not optimised them (no corrected_cameras)")
    files = sorted((frames / cameras).glob("*.json"))
    info, read = folder / "mesh_info.json", list(files)
    if info.is_file():
        turned = _object(info, "what Polycam says of its mesh").get("alignmentTransform")
        read.append(info)
        # Stored column by column.
        world = None if turned is None else _array(info, "alignmentTransform", turned, (4, 4)).T
        if world is not None and (fault := fault_of_similarity(world)):
            raise InputError(f"{info}: `alignmentTransform` {fault}; export the raw data again")
    entries = []
    for file in files:
        document, name = _object(file, "a camera of Polycam"), file.stem
        image = next((p for s in images.EXTENSIONS if (p := frames / photographs / f"{name}{s}").is_file()), None)
        if image is None:
            continue
        rows = [[_number(file, document, f"t_{i}{j}") for j in range(4)] for i in range(3)]
        keys: dict[str, Any] = {to: _number(file, document, key) for to, key in _INTRINSICS.items()}
        keys["transform_matrix"] = [*rows, [0.0, 0.0, 0.0, 1.0]]
        if (frames / "depth" / f"{name}.png").is_file():
            keys["depth_file_path"] = f"keyframes/depth/{name}.png"
        entries.append(Entry(image.relative_to(folder).as_posix(), f"camera {name}", keys))
    if not files:
        raise InputError(f"{frames}: no {cameras}/*.json; export the raw data again (docs/guide/programs.md)")
    return info if info.is_file() else files[0], entries, read, notes, world


_INTRINSICS = {"fl_x": "fx", "fl_y": "fy", "cx": "cx", "cy": "cy", "w": "width", "h": "height"}


# -------------------------------------------------------------------------------------------------------------- Record3D


def _metadata(folder: Path) -> Path | None:
    """The list of poses of Record3D, which is called so in a folder that was exported or in an .r3d that was unzipped."""
    for name in ("metadata.json", "metadata"):
        if (folder / name).is_file() and any((folder / below).is_dir() for below in ("rgb", "rgbd")):
            return folder / name
    return None


def _record3d(folder: Path) -> _Found:
    """`poses`: quaternion x y z w and position of each frame; `perFrameIntrinsicCoeffs`: fx fy cx cy, or one `K` by columns, for
    pictures of w x h."""
    path = _metadata(folder)
    assert path is not None
    document = _object(path, "the metadata of Record3D")
    poses = _array(path, "poses", document.get("poses"), (-1, 7))
    given = document.get("perFrameIntrinsicCoeffs")
    if given:
        lenses = _array(path, "perFrameIntrinsicCoeffs", given, (len(poses), 4))
    else:
        k = _array(path, "K", document.get("K"), (3, 3)).T
        lenses = np.tile([k[0, 0], k[1, 1], k[0, 2], k[1, 2]], (len(poses), 1))
    size = _number(path, document, "w"), _number(path, document, "h")
    below = "rgb" if (folder / "rgb").is_dir() else "rgbd"
    entries = []
    for number, (pose, lens) in enumerate(zip(poses, lenses, strict=True)):
        image = next((p for s in images.EXTENSIONS if (p := folder / below / f"{number}{s}").is_file()), None)
        if image is None:
            continue
        width, height = images.header(image).size
        across, down = width / size[0], height / size[1]
        fx, fy, cx, cy = lens * [across, down, across, down]
        keys: dict[str, Any] = {"w": width, "h": height, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}
        keys["transform_matrix"] = _of_quaternion(path, number, pose).tolist()
        if (folder / "depth" / f"{number}.exr").is_file():
            keys["depth_file_path"] = f"depth/{number}.exr"
        entries.append(Entry(image.relative_to(folder).as_posix(), f"frame {number}", keys))
    return path, entries, [path], [], None


def _of_quaternion(path: Path, number: int, pose: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    if not np.isfinite(pose).all() or np.linalg.norm(pose[:4]) < 1e-6:
        raise InputError(f"{path}: pose {number} is {pose.tolist()}; a quaternion x y z w and a position are needed")
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = Rotation.from_quat(pose[:4]).as_matrix(), pose[4:]
    return out


# -------------------------------------------------------------------------------------------------------- 3D Scanner App


def _scanner(folder: Path) -> _Found:
    """`frame_00000.json` beside `frame_00000.jpg`: `cameraPoseARFrame` and `intrinsics` row by row; `depth_00000.png` in
    millimetres."""
    entries, files = [], sorted(folder.glob("frame_*.json"))
    for file, image in _pairs(files):
        document = _object(file, "a frame of 3D Scanner App")
        matrix = _array(file, "cameraPoseARFrame", document.get("cameraPoseARFrame"), (4, 4))
        k = _array(file, "intrinsics", document.get("intrinsics"), (3, 3))
        width, height = images.header(image).size
        keys: dict[str, Any] = {"w": width, "h": height, "fl_x": k[0, 0], "fl_y": k[1, 1], "cx": k[0, 2], "cy": k[1, 2]}
        keys = {key: float(value) for key, value in keys.items()} | {"transform_matrix": matrix.tolist()}
        depth = re.sub("^frame_", "depth_", file.stem) + ".png"
        if (folder / depth).is_file():
            keys["depth_file_path"] = depth
        entries.append(Entry(image.name, f"frame {file.stem}", keys))
    return files[0], entries, files, [], None


def _pairs(files: Sequence[Path]) -> Iterator[tuple[Path, Path]]:
    """Files of frames with their photographs; most frames have none."""
    for file in files:
        image = next((p for s in images.EXTENSIONS if (p := file.with_suffix(s)).is_file()), None)
        if image is not None:
            yield file, image
