"""`python -m lab pack <capture> <folder>`: a capture as a folder scene, as if somebody had photographed the room.

It holds photographs, cameras, exposures, the mesh and, where there is one, the truth that scores read
(docs/guide/own-data.md#4-the-folder). A room of the laboratory thus becomes a scene that needs nothing of it.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from iif_core.errors import InputError
from workflow.artifacts.files import write_exr
from workflow.artifacts.store import StageReader, split_rgb
from workflow.scene.normal_form import CaptureReader, View

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Axes of a camera in transforms.json (x right, y up, looking along -z) in our axes (x right, y down, z forward)."""


def pack(capture: Path, folder: Path) -> list[str]:
    """Write a capture as a folder scene, and return what was written, line by line.

    Photographs are 8-bit PNG, or half-float EXR where they are radiance. Truth is rounded to half precision.

    Args:
        capture: folder of a finished stage `capture`.
        folder: where the scene goes; new or empty.

    Raises:
        InputError: no capture is there, or the folder holds something.
    """
    manifest = capture / "manifest.json"
    if not manifest.is_file():
        raise InputError(f"{capture}: no manifest.json; name the folder of a finished capture, such as results/kitchen/capture")
    if folder.exists() and any(folder.iterdir()):
        raise InputError(f"{folder}: not empty; name a folder that does not exist yet")
    scene = json.loads(manifest.read_text())["scene"]
    reader = CaptureReader(StageReader(capture, "capture", scene))
    extension = "exr" if reader.is_hdr else "png"
    frames = [_frame(view, f"images/{view.name}.{extension}") for view in reader.views]
    held_out = [f"images/{view.name}.{extension}" for view in reader.views if view.split == "test"]
    lists = {"test_filenames": held_out} if held_out else {}
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "images").mkdir()
    for view in reader.views:
        _write_photograph(reader, view, folder / f"images/{view.name}.{extension}")
        if reader.has_truth:
            _write_truth(reader, view, folder / "truth")
    (folder / "transforms.json").write_text(json.dumps({"camera_model": "PINHOLE", **lists, "frames": frames}, indent=1) + "\n")
    if not (reader.is_hdr or reader.facts.get("exposure_estimated")):
        exposures = {frame["file_path"]: view.exposure for frame, view in zip(frames, reader.views, strict=True)}
        (folder / "exposures.json").write_text(json.dumps(exposures, indent=1) + "\n")
    _write_mesh(reader, folder / "mesh.ply")
    return [
        f"{folder}: {len(frames)} photographs, {len(reader.mesh()[1])} faces{', truth' if reader.has_truth else ''};"
        f" {sum(path.stat().st_size for path in folder.rglob('*') if path.is_file()) / 1e6:.1f} MB"
    ]


def _frame(view: View, path: str) -> dict[str, object]:
    pose = np.asarray(view.world_from_camera, np.float64) @ OPENGL
    camera = {"fl_x": view.fx, "fl_y": view.fy, "cx": view.cx, "cy": view.cy, "w": view.width, "h": view.height}
    return {"file_path": path, **camera, "transform_matrix": pose.tolist()}


def _write_photograph(reader: CaptureReader, view: View, path: Path) -> None:
    photo, _ = reader.photo(view, held_out=True)
    if reader.is_hdr:
        write_exr(path, split_rgb(photo, dtype=np.float16))
        return
    Image.fromarray(np.rint(255 * np.clip(photo, 0, 1)).astype(np.uint8)).save(path, optimize=True)


def _write_truth(reader: CaptureReader, view: View, folder: Path) -> None:
    """Write the four maps of a view. Pixels without a truth are NaN in the roughness, and scores ignore them."""
    import OpenEXR

    truth = reader.truth(view)
    maps = {
        "albedo": truth.albedo,
        "roughness": np.where(truth.valid, truth.roughness, np.nan),
        "metallic": truth.metallic,
        "emission": truth.emission,
    }
    for kind, values in maps.items():
        channels = split_rgb(values, dtype=np.float16) if values.ndim == 3 else {"Y": values.astype(np.float16)}
        (folder / kind).mkdir(parents=True, exist_ok=True)
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        with OpenEXR.File(header, {name: np.ascontiguousarray(array) for name, array in channels.items()}) as file:
            file.write(str(folder / kind / f"{view.name}.exr"))


def _write_mesh(reader: CaptureReader, path: Path) -> None:
    vertices, faces = reader.mesh()
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mesh.face_attributes["instance"] = np.asarray(reader.faces()["instance_id"], np.int32)
    mesh.export(path, vertex_normal=False)
