"""relight: renders the recovered scene under other light and along other camera paths (docs/method/light.md#relighting)."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING

import numpy as np

from iif_core.camera.pinhole import direction_derivatives, pixel_directions
from iif_core.camera.response import Response, response
from iif_core.errors import InputError
from iif_core.light.environment import as_map, resample
from iif_core.light.relighting import axes_of_map, camera_path, exposure_for, frame_times, sphere_mesh
from iif_core.numerics.color import to_uint8
from workflow.artifacts.files import read_exr
from workflow.artifacts.store import rgb, split_rgb
from workflow.exporters.surface import up_axis
from workflow.models.denoise import denoise, require_denoiser
from workflow.runtime.job import Job
from workflow.scene.base_scene import Light
from workflow.scene.normal_form import CaptureReader, View
from workflow.scene.recovered import Recovered, read_recovered, read_response
from workflow.settings import require_relighting

if TYPE_CHECKING:
    from iif_core.light.transport.scene import Scene

_SEEDS = 0x72656C69  # keeps the random streams of this stage apart from those of others
MAP_ROWS = 128
"""Environment files are averaged down to at most this many rows."""
SHEET_COLUMNS = 6  # frames of each relighting on the contact sheet
CAPTION = 16  # pixels above each of its rows for a name


def run(job: Job) -> None:
    """Write <name>/frame_<i>.exr and .png of every relighting, contact_sheet.png and relight.json."""
    wanted = require_relighting({"relight": job.settings.relight}, job.scene)
    capture, scene = CaptureReader(job.read("capture")), read_recovered(job)
    curve = read_response(job.read("affines"))
    if capture.is_hdr:
        curve = response("srgb")  # linear radiance has no response of its own; pictures are for screens
    up = np.asarray(capture.facts.get("up") or up_axis(np.stack([view.world_from_camera for view in capture.views])), np.float64)
    facts, sheet = [], []
    for number, entry in enumerate(wanted):
        made, pictures = _relight(job, capture, scene, curve, up, number, _settings(entry))
        facts.append(made)
        shown = np.unique(np.linspace(0, len(pictures) - 1, min(SHEET_COLUMNS, len(pictures))).round().astype(int))
        sheet.append((made["name"], [pictures[i] for i in shown]))
    job.writer.bytes("contact_sheet.png", _png(_sheet(sheet)))
    job.writer.json("relight.json", {"relightings": facts, "up": up.tolist()})


def _settings(entry: dict) -> SimpleNamespace:
    inner = {name: SimpleNamespace(**value) if isinstance(value, dict) else value for name, value in entry.items()}
    return SimpleNamespace(**inner)


def _relight(
    job: Job,
    capture: CaptureReader,
    scene: Recovered,
    curve: Response,
    up: np.ndarray,
    number: int,
    wanted: SimpleNamespace,
) -> tuple[dict, list[np.ndarray]]:
    """Render and write all frames of one relighting; returns facts and the 8-bit pictures."""
    if wanted.denoise:
        require_denoiser()
    camera, times = _Camera.of(capture, wanted), frame_times(wanted.camera.frames)
    poses = camera_path(camera.poses, times)
    light = _light(scene, wanted, up)
    exposure, world, pictures = wanted.exposure, None, []
    for frame, (pose, time) in enumerate(zip(poses, times, strict=True)):
        job.progress(frame, len(poses), f"frames of {wanted.name}")
        if world is None or (wanted.sphere and wanted.sphere.path_to):
            world = _world(scene, light, wanted, float(time))
        seed = ((((job.seed << 32) | _SEEDS) << 16 | number) << 32) | frame
        radiance = _frame(world, camera, pose, wanted, seed)
        if not np.isfinite(radiance).all():
            raise InputError(f"relighting {wanted.name}, frame {frame}: radiance is not finite; please report it with the scene")
        exposure = exposure or exposure_for(radiance)
        picture = to_uint8(curve(np.clip(exposure * radiance, 0, 1)))
        job.writer.exr(f"{wanted.name}/frame_{frame:04d}.exr", split_rgb(radiance), "relative")
        job.writer.bytes(f"{wanted.name}/frame_{frame:04d}.png", _png(picture))
        pictures.append(picture)
    job.progress(len(poses), len(poses), f"frames of {wanted.name}")
    facts = {"name": wanted.name, "frames": len(poses), "exposure": exposure, "poses": poses.reshape(-1, 16).tolist()}
    if not any(picture.any() for picture in pictures):
        facts["note"] = "black: no light is on, or none reaches the room"
        job.log.warning("relighting %s is %s", wanted.name, facts["note"])
    return facts, pictures


@dataclass(frozen=True)
class _Camera:
    """Key poses (k, 4, 4) and the intrinsics of all frames, in pixels."""

    poses: np.ndarray
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    @staticmethod
    def of(capture: CaptureReader, wanted: SimpleNamespace) -> _Camera:
        by_name: dict[str, View] = {view.name: view for view in capture.views}
        names = wanted.camera.views or [capture.views[0].name]
        unknown = [name for name in names if name not in by_name]
        if unknown:
            raise InputError(
                f"`relight.camera.views` of {wanted.name}: found {', '.join(unknown)}; the views are"
                f" {', '.join(list(by_name)[:8])}{' ...' if len(by_name) > 8 else ''}"
            )
        first = by_name[names[0]]
        width, height = wanted.camera.width or first.width, wanted.camera.height or first.height
        sx = width / first.width
        fx, fy = first.fx * sx, first.fy * sx
        cx, cy = width * first.cx / first.width, height * first.cy / first.height
        if wanted.camera.fov:
            fx = fy = 0.5 * width / np.tan(np.radians(wanted.camera.fov) / 2)
            cx, cy = width / 2, height / 2
        return _Camera(np.stack([by_name[name].world_from_camera for name in names]), fx, fy, cx, cy, width, height)


def _light(scene: Recovered, wanted: SimpleNamespace, up: np.ndarray) -> Light:
    """The light of the scene as the settings ask for it; an emitter that is off reflects like any other surface."""
    found, factor = scene.light, np.float32(wanted.emitters)
    if wanted.environment == "keep":
        environment = found.environment
    elif wanted.environment == "off":
        environment = np.zeros(3, np.float32)
    elif isinstance(wanted.environment, str):
        environment = _read_environment(Path(wanted.environment), up, wanted.environment_turn)
    else:
        environment = np.asarray(wanted.environment, np.float32)
    emits = found.emits if factor > 0 else np.zeros_like(found.emits)
    return Light(found.radiance * factor, found.side, emits, environment)


def _read_environment(path: Path, up: np.ndarray, turn: float) -> np.ndarray:
    """(H, W, 3) map in world axes from a latitude-longitude picture: top row = up, to the right = clockwise seen from above."""
    channels = read_exr(path)
    if not {"R", "G", "B"} <= set(channels):
        raise InputError(f"{path}: found the channels {', '.join(channels)}; an environment needs R, G and B")
    image = as_map(np.maximum(rgb(channels).astype(np.float32), 0))[:, ::-1]  # columns of a map run counter-clockwise
    rows = min(MAP_ROWS, len(image))
    points = 2 * -(-len(image) // rows)
    return resample(image, axes_of_map(up, turn), rows, 2 * rows, points)


def _world(scene: Recovered, light: Light, wanted: SimpleNamespace, time: float) -> Scene:
    """Geometry, materials and emitters on the device, with the sphere at its place at `time` in [0, 1]."""
    from iif_core.light.transport.scene import Scene

    if wanted.sphere is None:
        geometry, material = scene.surface.traceable(light.emits)
        return Scene(geometry, material, light.emitters(geometry))
    ball = wanted.sphere
    start = np.asarray(ball.center, np.float64)
    centre = start if ball.path_to is None else start + time * (np.asarray(ball.path_to, np.float64) - start)
    mesh = sphere_mesh(centre, ball.radius)
    geometry, material = scene.surface.traceable(light.emits, mesh)
    count = len(mesh[1])
    with_ball = Light(
        np.concatenate([light.radiance, np.tile(np.float32(ball.radiance), (count, 1))]),
        np.concatenate([light.side, np.ones(count, np.int8)]),
        np.concatenate([light.emits, np.ones(count, bool)]),
        light.environment,
    )
    return Scene(geometry, material, with_ball.emitters(geometry))


def _frame(world: Scene, camera: _Camera, pose: np.ndarray, wanted: SimpleNamespace, seed: int) -> np.ndarray:
    """(H, W, 3) float32 radiance."""
    from iif_core.light.transport.render import first_hits, render
    from iif_core.light.transport.scene import PathOptions

    shape, eye = (camera.height, camera.width, 3), pose[:3, 3]
    directions = pixel_directions(camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height, pose).reshape(-1, 3)
    jitter = direction_derivatives(camera.fx, camera.fy, pose)
    paths = PathOptions(wanted.samples, wanted.max_bounces, seed)
    radiance = render(world, eye, directions, paths, jitter).reshape(shape)
    if not wanted.denoise:
        return radiance
    albedo, normals, _ = first_hits(world.geometry, world.material, eye, directions)
    return denoise(radiance, albedo.reshape(shape), normals.reshape(shape))


def _png(picture: np.ndarray) -> bytes:
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(picture)).save(buffer, "PNG")
    return buffer.getvalue()


def _sheet(rows: list[tuple[str, list[np.ndarray]]], gap: int = 4) -> np.ndarray:
    """One row for each relighting, on white, under its name."""
    from PIL import Image, ImageDraw

    heights = [CAPTION + max(p.shape[0] for p in pictures) + gap for _, pictures in rows]
    width = max(sum(p.shape[1] + gap for p in pictures) for _, pictures in rows) + gap
    sheet = Image.new("RGB", (width, sum(heights) + gap), "white")
    y = gap
    for (name, pictures), height in zip(rows, heights, strict=True):
        ImageDraw.Draw(sheet).text((gap, y), name, fill="black")
        x = gap
        for picture in pictures:
            sheet.paste(Image.fromarray(np.ascontiguousarray(picture)), (x, y + CAPTION))
            x += picture.shape[1] + gap
        y += height
    return np.asarray(sheet)
