"""What a lighting artist expects with the scene: cameras, photographs, the camera's response as a table, a script for Blender.

Everything is returned as bytes by name; stage export writes them.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from iif_core.light.environment import as_map, solid_angles
from iif_core.numerics import color
from workflow.exporters import blender_import
from workflow.exporters.glb import rotation_to_y
from workflow.scene.normal_form import View

Array = np.ndarray

FILM_MM = 36.0
"""Width of the sensor of cameras for programs that ask for millimetres: the width of 35 mm film."""
LUT_SIZE = 1024
SCRIPT = "blender_import.py"
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""From camera axes x right, y down, z forward (OpenCV) to x right, y up, z backward (OpenGL, glTF, Blender), or back."""


def cameras_json(
    views: Sequence[View],
    photos: Sequence[str],
    gains: Array,
    up: Array,
    environment: dict[str, Any] | None = None,
    response: str | None = None,
    origin: Sequence[float] = (0.0, 0.0, 0.0),
) -> bytes:
    """Return cameras.json in the form of nerfstudio's transforms.json, with what Blender needs in the block `blender`.

    Args:
        views: the photographs; photos: name of the file of each.
        gains: (views, 3) factor on radiance before the response, R G B.
        up: (3,) unit vector of the world.
        environment: `mean_radiance`, and `map` where it is one; None = black.
        response: name of the lookup table of the camera's response; None = the photographs are linear.
        origin: (3,) metres, in the coordinates of the input.

    `transform_matrix` is the camera-to-world matrix with OpenGL axes, in metres and in the axes of the capture; `fl_x, fl_y, cx,
    cy` are pixels, the centre of the first pixel at 0.5. `blender.world_to_blender` turns that world to the one that Blender's
    importer makes of scene.glb; `shift` are shares of the width of the sensor, and `pixel_aspect` belongs into Blender's render
    settings.
    """
    frames = []
    for view, name, gain in zip(views, photos, gains, strict=True):
        frames.append(
            {
                "file_path": name,
                "transform_matrix": _plain(np.asarray(view.world_from_camera, np.float64) @ OPENGL),
                "w": view.width,
                "h": view.height,
                "fl_x": view.fx,
                "fl_y": view.fy,
                "cx": view.cx,
                "cy": view.cy,
                "name": view.name,
                "held_out": view.split == "test",
                "exposure": float(np.mean(gain)),
                "gain": _plain(gain),
                "blender": blender_camera(view),
            }
        )
    document = {
        "camera_model": "OPENCV",
        **dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0),
        "origin": _plain(np.asarray(origin, np.float64)),
        "units": "metres, from `origin` in the coordinates of the input;"
        " gain: factor on the radiance of scene.glb and emitters.parquet before the response",
        "blender": {
            "world_to_blender": _plain(world_to_blender(up)),
            "environment": environment,
            "response": response,
            "sensor_width_mm": FILM_MM,
        },
        "frames": frames,
    }
    return (json.dumps(document, indent=1, allow_nan=False) + "\n").encode()


def blender_camera(view: View) -> dict[str, Any]:
    """Return focal length in mm, shift and pixel aspect of a view, for a sensor FILM_MM wide that is fitted horizontally."""
    return {
        "lens_mm": view.fx * FILM_MM / view.width,
        "shift": [(0.5 * view.width - view.cx) / view.width, (view.cy - 0.5 * view.height) / view.width * view.fx / view.fy],
        "pixel_aspect": [max(1.0, view.fy / view.fx), max(1.0, view.fx / view.fy)],
    }


def world_to_blender(up: Array) -> Array:
    """Return the (4, 4) rotation from the capture's world to Blender's: scene.glb turns it to y up, the importer to z up."""
    x, y, z, w = rotation_to_y(np.asarray(up, np.float64))
    to_gltf = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    out = np.eye(4)
    out[:3, :3] = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]) @ to_gltf
    return out


def photograph_png(sensor: Array, valid: Array) -> bytes:
    """Return sensor values (H, W, 3) in [0, 1] as an 8-bit PNG; pixels that are not `valid` (H, W) are transparent."""
    from PIL import Image

    pixels = color.to_uint8(sensor)
    if not valid.all():
        pixels = np.concatenate([pixels, np.where(valid, 255, 0).astype(np.uint8)[..., None]], -1)
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


def response_cube(curve: Callable[[Array], Array]) -> bytes:
    """Return a response f, (n, 3) in [0, 1] -> (n, 3), as a 1D table (`.cube`): exposed radiance to sensor values."""
    x = np.linspace(0.0, 1.0, LUT_SIZE)
    rows = np.asarray(curve(np.repeat(x[:, None], 3, 1)))
    lines = ['TITLE "camera response: exposed linear radiance to sensor values"', f"LUT_1D_SIZE {LUT_SIZE}"]
    lines += ["DOMAIN_MIN 0 0 0", "DOMAIN_MAX 1 1 1", *(" ".join(f"{v:.7f}" for v in row) for row in rows)]
    return ("\n".join(lines) + "\n").encode()


def script() -> bytes:
    """Return blender_import.py, which needs nothing of this repository."""
    return Path(blender_import.__file__).read_bytes()


def environment_picture(radiance: Array) -> Array:
    """Return a map (H, W, 3) of the light from outside as most programs have it, in the axes of the capture: z up, the middle
    column towards +x, columns to the right towards -y. Columns of `iif_core.light.environment` run from +x to +y."""
    return np.roll(radiance[:, ::-1], radiance.shape[1] // 2, axis=1)


def environment_note(environment: Array) -> dict[str, Any] | None:
    """Return the mean radiance of the light from outside, for programs and formats that have no map; None where it is dark."""
    if not environment.any():
        return None
    radiance = as_map(environment)
    mean = np.average(radiance, (0, 1), np.repeat(solid_angles(*radiance.shape[:2])[..., None], 3, -1))
    return {"mean_radiance": [round(float(value), 6) for value in mean]}


def photo_names(views: Iterable[View], is_hdr: bool) -> list[str]:
    """Return the name of the file of each photograph."""
    return [f"photos/{view.name}.{'exr' if is_hdr else 'png'}" for view in views]


def _plain(array: Array) -> list:
    return np.asarray(array, np.float64).tolist()
