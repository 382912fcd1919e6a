"""render: re-renders every view from the recovered materials and emitters, by path tracing
(docs/method/shading.md#re-rendering)."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import minimum_filter

from iif_core.camera.pinhole import direction_derivatives, pixel_directions
from iif_core.camera.pixels import pixel_gains
from iif_core.errors import InputError
from iif_core.evaluation.consistency import held_out_gain
from iif_core.reflectance.material import BLACK
from workflow.artifacts.store import rgb, split_rgb
from workflow.decisions import light as decisions
from workflow.models.denoise import denoise, require_denoiser
from workflow.runtime import device
from workflow.runtime.job import Job
from workflow.scene.base_scene import read_gains, read_radiance_cache
from workflow.scene.cached_light import has_lobes
from workflow.scene.normal_form import CaptureReader, View
from workflow.scene.picture_facts import view_attributes
from workflow.scene.recovered import Recovered, read_recovered, read_response

MAX_BOUNCES = 16  # of a path
_SEEDS = 0x72656E  # keeps the random streams of this stage apart from those of others


def run(job: Job) -> None:
    """Write maps/<view>.exr, which is published: the re-rendering, its sensor value, emission and the fitted maps; and
    held_out.parquet.

    The sensor value is the re-rendering through the gains of the view and the fitted response, clipped to [0, 1]. A held-out
    photograph of unknown exposure gets the gain with which its own re-rendering is nearest to it, one for each channel where
    the white balance of the camera was found to change. Nothing else is taken from its colours.
    """
    capture, scene = CaptureReader(job.read("capture")), read_recovered(job)
    curve, gains = read_response(job.read("affines")), read_gains(job)
    device.mitsuba()
    geometry, material = scene.surface.traceable(scene.light.emits)
    from iif_core.light.transport.render import render
    from iif_core.light.transport.scene import PathOptions, Scene

    if job.settings.render.denoise:
        require_denoiser()
    emitters = scene.light.emitters(geometry)
    if not (emitters.can_be_sampled or scene.light.environment.any()):
        job.log.warning("no emitter and no environment: the re-renderings are black (see emission.json)")
    # What matte surface shows of other surface is a mean over many directions, for which photographed radiance is good enough.
    cache = None if has_lobes(job) or not _ends_in_cache(job) else read_radiance_cache(job, scene.light_scale)
    how = "whole paths" if cache is None else "paths that end where radiance was photographed"
    job.log.info("views are re-rendered by %s", how)
    world = Scene(geometry, material, emitters, cache)
    found: dict[int, np.ndarray] = {}
    through_holes = job.read("emission").json("emission.json")["escape_share"]["secondary"] > decisions.ESCAPE_OPEN
    white_balance = bool((gains.gain != gains.gain[:, :1]).any())
    for done, view in enumerate(capture.views):
        job.progress(done, len(capture.views), "views re-rendered")
        eye = view.world_from_camera[:3, 3]
        _, face_id = capture.gbuffer(view)
        seed = ((job.seed << 32) | _SEEDS) << 32 | view.view_id
        fitted = _fitted(job, view)
        paths = PathOptions(job.settings.render.samples, MAX_BOUNCES, seed)
        jitter = _pixel_steps(view, face_id, through_holes)
        radiance = render(world, eye, _directions(view).reshape(-1, 3), paths, jitter).reshape(view.height, view.width, 3)
        if not np.isfinite(radiance).all():
            raise InputError(f"view {view.name}: re-rendered radiance is not finite; please report it with the scene")
        if job.settings.render.denoise:
            radiance = denoise(radiance, *_guides(scene, fitted, face_id, eye))
        factor = pixel_gains(gains, done, view, np.arange(view.height * view.width)).reshape(radiance.shape)
        if view.split == "test" and capture.facts.get("exposure_estimated"):
            photo, valid = capture.photo(view, held_out=True)
            found[view.view_id] = held_out_gain(factor * radiance, photo, valid & (face_id >= 0), curve, white_balance)
            factor = factor * found[view.view_id]
        sensor = curve(np.clip(factor * radiance, 0, 1))
        channels = {**split_rgb(radiance), **split_rgb(np.clip(sensor, 0, 1), "ldr")}
        emission = scene.emission_map(face_id, eye)
        channels |= split_rgb(emission, "emission") | _without_emitters(fitted, emission.any(-1))
        attributes = view_attributes(view, float(factor.mean()))
        job.writer.exr(f"maps/{view.name}.exr", channels, "relative", attributes=attributes)
    if found:
        rows = np.array(list(found.values()))
        columns = {"view_id": np.array(list(found), np.int32), **{f"gain_{c}": rows[:, i] for i, c in enumerate("rgb")}}
        job.writer.table("held_out.parquet", columns)
    job.progress(len(capture.views), len(capture.views), "views re-rendered")
    job.writer.json("render.json", {"paths": how, "plan": [decisions.denoiser(job.settings.render.denoise)]})


def _ends_in_cache(job: Job) -> bool:
    """Return whether the cached light of the fit ended in photographed radiance, too."""
    plan = job.read("shading").json("shading.json")["plan"]
    return all(item["included"] for item in plan if item["component"] == "radiance_cache")


def _fitted(job: Job, view: View) -> dict[str, np.ndarray]:
    """Fitted materials and uncertainty (half) and object ids (UINT) of one view, as far as the stages wrote them."""
    file = f"maps/{view.name}.exr"
    channels: dict[str, np.ndarray] = {}
    if job.read("affines").has(file):
        names = ("albedo.R", "albedo.G", "albedo.B", "roughness", "metallic", "uncertainty")
        fitted = job.read("affines").exr(file)
        channels = {name: fitted[name].astype(np.float16) for name in names}
    if job.read("segmentation").has(file):
        channels["instance.id"] = job.read("segmentation").exr(file)["object.id"]
    return channels


def _without_emitters(fitted: dict[str, np.ndarray], emits: np.ndarray) -> dict[str, np.ndarray]:
    """The fitted maps with the material that the model gives to emitters: black, rough, not metallic."""
    values = {**dict(zip(("albedo.R", "albedo.G", "albedo.B", "roughness", "metallic"), BLACK, strict=True)), "uncertainty": 0}
    return {
        name: np.where(emits, np.float16(values[name]), channel) if name in values else channel
        for name, channel in fitted.items()
    }


def _pixel_steps(view: View, face_id: np.ndarray, holes: bool) -> tuple[np.ndarray, np.ndarray]:
    """Change of direction (3,) to the next pixel on the right and below; (n, 3) each where the mesh has large `holes`.

    Behind holes lie the directions that light the room, not what the camera would see, so pixels next to a miss have step 0:
    their rays stay in the middle."""
    steps = direction_derivatives(view.fx, view.fy, view.world_from_camera)
    if not holes:
        return steps
    whole = minimum_filter(face_id >= 0, 3, mode="nearest").reshape(-1, 1)
    return steps[0] * whole, steps[1] * whole


def _guides(
    scene: Recovered, fitted: dict[str, np.ndarray], face_id: np.ndarray, eye: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Fitted albedo and the normals on the side of the camera, (H, W, 3) each, 0 where nothing is seen."""
    albedo = rgb(fitted, "albedo") if "albedo.R" in fitted else np.zeros((*face_id.shape, 3), np.float32)
    surface = scene.surface
    facing = np.sign(np.einsum("ij,ij->i", surface.normals, eye - surface.vertices[surface.faces[:, 0]]))
    normals = np.where((face_id >= 0)[..., None], (surface.normals * facing[:, None])[face_id], 0)
    return albedo, normals.astype(np.float32)


def _directions(view: View) -> np.ndarray:
    return pixel_directions(view.fx, view.fy, view.cx, view.cy, view.width, view.height, view.world_from_camera)
