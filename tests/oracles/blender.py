"""An exported glTF file as Blender has it: what it imports, and what its renderer looks up at every pixel."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from workflow.artifacts.files import read_exr

WORKER = Path(__file__).with_name("blender_reads.py")


def python_with_bpy() -> str | None:
    """Return a Python that has Blender's module: $IIF_BPY_PYTHON, else this one; None if there is none."""
    return os.environ.get("IIF_BPY_PYTHON") or (sys.executable if find_spec("bpy") else None)


def require_bpy() -> str:
    """Return a Python that has Blender's module; a test is skipped without one."""
    import pytest

    return python_with_bpy() or pytest.skip(
        "Blender's module bpy is not installed; name a Python that has it in IIF_BPY_PYTHON (pip install bpy==4.5.*)"
    )


@dataclass(frozen=True)
class Imported:
    """What Blender read.

    Attributes:
        version: of Blender.
        cameras: pose in Blender's world (4, 4), `angle_x` and `angle_y` (radians) by name.
        emission: (3,) colour times strength by material.
        spaces: colour space by the name of a texture; textures: (h, w, 4) uint8, first row on top.
        values: for each view (H W, 5): linear base colour, roughness, metallic.
        depth: for each view (H W,) metres along the camera's axis, infinite where nothing is.
    """

    version: str
    cameras: dict[str, dict[str, Any]]
    emission: dict[str, np.ndarray]
    spaces: dict[str, str]
    textures: dict[str, np.ndarray]
    values: list[np.ndarray]
    depth: list[np.ndarray]


def read_by_blender(python: str, glb: Path, document: dict[str, Any], views: list[str], limit: float = 900) -> Imported:
    """Import `glb` and look at it from some of the cameras of cameras.json.

    Args:
        python: `python_with_bpy`.
        glb: the file.
        document: content of cameras.json, which has lenses, shifts and the world of Blender.
        views: names of the frames to look from.
        limit: seconds.
    """
    turn = np.asarray(document["blender"]["world_to_blender"])
    frames = {frame["name"]: frame for frame in document["frames"]}
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        wanted = []
        for name in views:
            frame, own = frames[name], frames[name]["blender"]
            pose = (turn @ np.asarray(frame["transform_matrix"])).tolist()
            size = [frame["w"], frame["h"]]
            wanted.append({"lens": own["lens_mm"], "shift": own["shift"], "pixel_aspect": own["pixel_aspect"]})
            wanted[-1] |= {"pose": pose, "size": size}
        (out / "request.json").write_text(json.dumps({"glb": str(glb.resolve()), "out": folder, "views": wanted}))
        clean = {**os.environ, "PYTHONPATH": ""}
        command = [python, str(WORKER), str(out / "request.json")]
        done = subprocess.run(command, capture_output=True, text=True, timeout=limit, env=clean)
        if "READ" not in done.stdout:
            raise RuntimeError(f"Blender did not read {glb}: {done.stdout[-2000:]} {done.stderr[-2000:]}")
        read = json.loads((out / "read.json").read_text())
        values, depth = [], []
        for number in range(len(views)):
            colour, surface = (_channels(out / f"{number}-{suffix}.exr") for suffix in ("colour", "surface"))
            rows = [colour["R"], colour["G"], colour["B"], surface["R"], surface["G"]]
            values.append(np.stack([row.ravel() for row in rows], 1).astype(np.float64))
            depth.append(np.where(colour["Z"] > 1e9, np.inf, colour["Z"]).ravel())
        textures = {name: np.load(out / f"{name}.npy") for name in read["textures"]}
    emission = {name: np.asarray(value) for name, value in read["emission"].items()}
    return Imported(read["blender"], read["cameras"], emission, read["textures"], textures, values, depth)


def _channels(path: Path) -> dict[str, np.ndarray]:
    """Colour and depth of a picture of many layers."""
    return {name.rpartition(".")[2]: pixels for name, pixels in read_exr(path).items()}
