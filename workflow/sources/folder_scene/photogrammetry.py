"""Cameras of photogrammetry programs: the XML of Metashape, the JSON of Meshroom (AliceVision)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from iif_core.errors import InputError
from workflow.intake import limits
from workflow.intake.documents import read_json, read_text, reading
from workflow.intake.names import existing, forward, shown
from workflow.settings.names import did_you_mean_path
from workflow.sources.folder_scene.entries import Entry
from workflow.sources.folder_scene.frames import Cameras, checked_frames

SUFFIXES = (".xml", ".sfm")
NAMES = ("cameras.xml", "cameras.sfm", "sfm.json")
"""Names under which cameras are looked for if none is stated."""
DEFAULT_IMAGES = "images"
"""`source.images` if it is not given; then photographs may also lie beside the cameras."""
_MOST_SKEW = 0.5
"""Pixels of skew (b2 of Metashape) that do not count."""
_UNDISTORT = "export undistorted photographs with their cameras"


def find(folder: Path, stated: str | None) -> Path | None:
    """Return the file of the cameras: `source.cameras` if it is such a file, or the first of `NAMES`; None = there is none."""
    if stated is not None:
        path = existing(folder / stated)
        if path.suffix.lower() not in SUFFIXES and path.name != "sfm.json":
            return None
        if not path.is_file():
            raise InputError(
                f"{path}: not found (`source.cameras: {stated}`, which counts from `source.path`).{did_you_mean_path(path)}"
            )
        return path
    return next((folder / name for name in NAMES if (folder / name).is_file()), None)


def frames_of(folder: Path, path: Path, source: dict[str, Any], capture: dict[str, Any]) -> Cameras:
    """Read the frames of such a file, with the same checks as for transforms.json.

    Raises:
        InputError: what is missing or does not fit, by name.
    """
    program = "Metashape" if path.suffix.lower() == ".xml" else "Meshroom"
    entries, without, world = (_metashape if program == "Metashape" else _meshroom)(path)
    if not entries:
        raise InputError(f"{path}: none of its photographs has a pose; align them, and export the cameras again")
    root = existing(folder / source["images"])
    if not root.is_dir() and source["images"] != DEFAULT_IMAGES:
        raise InputError(f"{root}: not found (`source.images`).{did_you_mean_path(root)}")
    root = root if root.is_dir() else folder
    listed = checked_frames(path, {}, entries, root, source, capture, world)
    notes = [f"cameras: {program}"]
    if without:
        notes.append(f"{len(without)} photographs have no pose in {path.name} and are not used, such as {without[0]}")
    return replace(listed, axes="opencv", known=True, notes=tuple(notes))


_Found = tuple[list[Entry], list[str], "np.ndarray | None"]
"""Entries, names of photographs without a pose, and the transform (4, 4) to the world of the mesh."""


# ------------------------------------------------------------------------------------------------------------- Metashape


def _metashape(path: Path) -> _Found:
    """Cameras as *Export Cameras, Agisoft XML* writes them (its manual, appendix D): poses of cameras in the chunk,
    in OpenCV axes; the chunk has a rotation, a translation and a scale to the world in which it exports models."""
    text = read_text(path, limits.DOCUMENT_BYTES, "cameras of Metashape")
    if "<!ENTITY" in text or "<!DOCTYPE" in text:
        raise InputError(f"{path}: defines entities, which cameras of Metashape do not; export them again")
    with reading(path, "not readable as XML", "; export the cameras again"):
        chunk = ElementTree.fromstring(text).find("chunk")
    if chunk is None or chunk.find("cameras") is None:
        raise InputError(f"{path}: no cameras of Metashape (`document/chunk/cameras`); export them as Agisoft XML")
    reference = (chunk.findtext("reference") or "").strip()
    if reference and not reference.startswith("LOCAL_CS"):
        raise InputError(
            f"{path}: the chunk is in map coordinates ({reference[:40]}...), in which Metashape turns and scales the models"
            " that it exports; set the chunk's coordinate system to Local Coordinates, and export cameras and model again"
        )
    sensors = {own.get("id"): own for own in chunk.iterfind("sensors/sensor")}
    parts = {own.get("id"): _placed(path, own.find("transform")) for own in chunk.iterfind("components/component")}
    whole, entries, without = _placed(path, chunk.find("transform")), [], []
    for camera in chunk.iterfind(".//camera"):
        label = forward(camera.get("label") or "")
        where = f"camera {shown(label)}"
        told = (camera.findtext("transform") or "").split()
        if not label or camera.get("enabled", "1").lower() in ("0", "false") or len(told) != 16:
            without.append(label)
            continue
        with reading(path, f"{where}: its transform holds no numbers"):
            matrix = np.array(told, np.float64).reshape(4, 4)
        place = parts.get(camera.get("component_id"), whole)
        keys = _lens(path, where, sensors.get(camera.get("sensor_id")), camera)
        entries.append(Entry(label, where, keys | {"transform_matrix": _moved(place, matrix).tolist()}))
    return entries, without, None


def _placed(path: Path, transform: ElementTree.Element | None) -> np.ndarray:
    """The transform (4, 4) of a chunk or component to the world."""
    out = np.eye(4)
    if transform is None:
        return out
    with reading(path, "the transform of the chunk holds no numbers", "; export the cameras again"):
        rotation, translation, scale = (transform.findtext(name) for name in ("rotation", "translation", "scale"))
        if rotation:
            out[:3, :3] = np.array(rotation.split(), np.float64).reshape(3, 3)
        out[:3, :3] *= float(scale) if scale else 1.0
        if translation:
            out[:3, 3] = np.array(translation.split(), np.float64)
    return out


def _moved(place: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """A pose after a similarity of the world, which does not stretch the axes of the camera."""
    out = place @ matrix
    scale = np.cbrt(abs(np.linalg.det(place[:3, :3])))
    out[:3, :3] /= max(scale, 1e-300)
    return out


def _lens(path: Path, where: str, sensor: ElementTree.Element | None, camera: ElementTree.Element) -> dict[str, Any]:
    """Intrinsics in the names of transforms.json; Metashape counts cx and cy from the middle, and has p1 and p2 the other way."""
    if sensor is None:
        raise InputError(f"{path}: {where}: its sensor is not in the file; export the cameras again")
    if sensor.get("type", "frame") != "frame":
        raise InputError(f"{path}: {where}: a lens of type {sensor.get('type')!r:.30}; allowed: frame. {_UNDISTORT.capitalize()}")
    found = [*camera.iterfind("calibration"), *sensor.iterfind("calibration")]
    adjusted = [own for own in found if own.get("class", "adjusted") == "adjusted"] or found
    size = sensor.find("resolution")
    if not adjusted or size is None:
        raise InputError(f"{path}: {where}: its sensor has no calibration; align the photographs and export the cameras again")
    with reading(path, f"{where}: its calibration holds no numbers", "; export the cameras again"):
        width, height = int(size.get("width", "")), int(size.get("height", ""))
        own = {child.tag: float(child.text or "nan") for child in adjusted[0] if child.tag in _NUMBERS}
    if not np.isfinite(list(own.values())).all() or not own.get("f", 0.0) > 0:
        raise InputError(f"{path}: {where}: its calibration has no focal length `f`, or empty numbers; export the cameras again")
    extra = [name for name in ("k4", "p3", "p4") if own.get(name)]
    if extra or abs(own.get("b2", 0.0)) > _MOST_SKEW:
        raise InputError(
            f"{path}: {where}: its lens has {', '.join(extra or ['b2'])}, which are not read: {_UNDISTORT}, or optimise the"
            " cameras without them"
        )
    return {
        "camera_model": "OPENCV",
        "w": width,
        "h": height,
        "fl_x": own["f"] + own.get("b1", 0.0),
        "fl_y": own["f"],
        "cx": 0.5 * width + own.get("cx", 0.0),
        "cy": 0.5 * height + own.get("cy", 0.0),
        **{name: own.get(name, 0.0) for name in ("k1", "k2", "k3")},
        "p1": own.get("p2", 0.0),
        "p2": own.get("p1", 0.0),
    }


_NUMBERS = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")


# -------------------------------------------------------------------------------------------------------------- Meshroom


def _meshroom(path: Path) -> _Found:
    """`views`, `intrinsics` and `poses` of AliceVision. A rotation is world to camera by columns, so read by rows it is camera to
    world."""
    document = read_json(path, "cameras of Meshroom")
    if not isinstance(document, dict):
        raise InputError(
            f"{path}: found a {type(document).__name__}; cameras of Meshroom are an object with views, intrinsics, poses"
        )
    with reading(path, "not as Meshroom writes cameras", "; export them again (ConvertSfMFormat, sfm or json)"):
        lenses = {own["intrinsicId"]: _lens_of(path, own) for own in _listed(document, "intrinsics")}
        poses = {}
        for own in _listed(document, "poses"):
            transform, pose = own["pose"]["transform"], np.eye(4)
            pose[:3, :3] = np.array(transform["rotation"], np.float64).reshape(3, 3)
            pose[:3, 3] = np.array(transform["center"], np.float64)
            poses[own["poseId"]] = pose
        entries, without = [], []
        for view in _listed(document, "views"):
            name = Path(forward(view["path"])).name
            lens, pose = lenses.get(view.get("intrinsicId")), poses.get(view.get("poseId"))
            if lens is None or pose is None:
                without.append(name)
                continue
            entries.append(Entry(name, f"view {shown(name)}", lens | {"transform_matrix": pose.tolist()}))
    return entries, without, None


def _listed(document: dict[str, Any], key: str) -> Iterable[dict[str, Any]]:
    found = document.get(key, [])
    return [own for own in found if isinstance(own, dict)] if isinstance(found, list) else []


_LENSES = {"pinhole": (), "radial1": ("k1",), "radial3": ("k1", "k2", "k3"), "brown": ("k1", "k2", "k3", "p1", "p2")}


_SINCE_2023 = {"none": "pinhole", "radialk1": "radial1", "radialk3": "radial3"}


def _lens_of(path: Path, own: dict[str, Any]) -> dict[str, Any]:
    width, height = float(own["width"]), float(own["height"])
    kind = str(own.get("type"))
    if kind == "pinhole" and "distortionType" in own:  # since 2023
        kind = _SINCE_2023.get(str(own["distortionType"]), str(own["distortionType"]))
    if kind not in _LENSES:
        raise InputError(f"{path}: a lens of type {shown(kind)}; allowed: {', '.join(_LENSES)}. {_UNDISTORT.capitalize()}")
    if "pxFocalLength" in own:
        pair = np.broadcast_to(np.array(own["pxFocalLength"], np.float64).ravel(), 2)
    else:
        pair = np.full(2, float(own["focalLength"]) / float(own["sensorWidth"]) * width)
    point = np.array(own.get("principalPoint", (0, 0)), np.float64)
    # Versions before 2023 count it from the corner of the picture, later ones from its middle.
    middle = 0.5 * np.array([width, height])
    point = point if (np.abs(point - middle) < 0.5 * middle).all() else point + middle
    bent = dict(zip(_LENSES[kind], np.array(own.get("distortionParams") or (), np.float64).tolist(), strict=False))
    at = {"w": width, "h": height, "fl_x": float(pair[0]), "fl_y": float(pair[1]), "cx": float(point[0]), "cy": float(point[1])}
    return {"camera_model": "OPENCV", **at, **bent}
