"""What a capture delivers of pictures that a source has rendered: photographs and cameras as they would be ideally, or with the
errors of real captures (lab/docs/simulated.md#as-captured)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from lab.settings.capture import IDEAL, paths
from lab.simulated.denoise import denoise_alone
from lab.sources.rendered import DENOISED, RenderedWriter
from workflow.artifacts.store import ids_from_disk, rgb
from workflow.models.denoise import denoise, require_denoiser
from workflow.scene.normal_form import Truth, View

if TYPE_CHECKING:
    from lab.simulated.photographs import ResponseCurve
    from workflow.runtime.job import Job
    from workflow.sources.folder_scene.room import Room

Array = np.ndarray

RESPONSE = "filmic"
METERING_PIXELS = 4096  # per view; their radiance sets the exposure


def effects(capture: Any) -> Any:
    """Return which effects of real captures the settings of a capture ask for."""
    return capture.realism or IDEAL


class Renderings:
    """How a capture renders its pictures: paths, denoiser, and what a light meter sees.

    Raises:
        InputError: the denoiser is needed and cannot be loaded.
    """

    def __init__(self, capture: Any):
        self.guided = capture.denoise and not effects(capture).unguided
        self.alone = effects(capture).unguided
        self.samples = paths({"samples": capture.samples, "realism": vars(capture.realism) if capture.realism else None})
        if self.guided or self.alone:
            require_denoiser()

    def denoised(self, image: Array, albedo: Array, normal: Array) -> Array:
        """Denoise a picture (H, W, 3) as asked; true albedo and normals (H, W, 3) guide the denoiser of ideal captures alone."""
        if self.alone:
            return denoise_alone(image)
        return denoise(image, albedo, normal) if self.guided else image

    def notes(self) -> list[str]:
        """Say what the denoiser saw."""
        words = f"photographs of {self.samples} paths a pixel, denoised without guides: so is the radiance truth"
        return [words] if self.alone else [DENOISED] if self.guided else []


def metered(image: Array, usable: Array) -> tuple[Array, Array]:
    """Return some of the pixels of a picture (H, W, 3), (n, 3), and which of them a light meter heeds, (n,); `usable`: (H, W)."""
    step = max(1, usable.size // METERING_PIXELS)
    return np.array(image).reshape(-1, 3)[::step], usable.ravel()[::step]


@dataclass
class Rendered:
    """All pictures of a source.

    Attributes:
        views: the true cameras; G-buffer and truth of each have been written.
        radiance: (V, H, W, 3) float32 linear; overwritten by the photographs.
        meters: of each view, from `metered`.
        usable: packed bits of the pixels of each view that were rendered; empty = all.
    """

    views: list[View]
    radiance: Array
    meters: list[tuple[Array, Array]]
    usable: list[Array] = field(default_factory=list)

    def valid(self, number: int) -> Array:
        """Return which pixels (H, W) of a view were rendered."""
        shape = self.radiance.shape[1:3]
        if not self.usable:
            return np.ones(shape, bool)
        return np.unpackbits(self.usable[number], count=shape[0] * shape[1]).view(bool).reshape(shape)


class Surface(NamedTuple):
    """The delivered mesh: vertices (n, 3), faces (m, 3), object of each face (m,)."""

    vertices: Array
    faces: Array
    owner: Array


@dataclass
class Delivered:
    """Cameras as delivered, the true response (None: radiance), and what capture.json says."""

    views: list[View]
    response: ResponseCurve | None
    notes: list[str] = field(default_factory=list)
    facts: dict[str, Any] = field(default_factory=dict)


def deliver(
    job: Job,
    writer: RenderedWriter,
    rendered: Rendered,
    surface: Surface,
    owner: Array,
    response: ResponseCurve | None = None,
) -> Delivered:
    """Write photographs and cameras, and G-buffers and truth again where cameras or mesh are not the true ones.

    Truth stays what the photographs show. It is known where the delivered surface at the delivered camera is of the same object.

    Args:
        job, writer: of the capture.
        rendered: what the source has rendered with the true cameras.
        surface: the delivered mesh.
        owner: object of each face of the true mesh.
        response: of the camera; None = `RESPONSE`.
    """
    from lab.simulated.photographs import response_curve
    from workflow.sources.folder_scene.exposure import SharedSurface
    from workflow.sources.folder_scene.room import Room

    capture, wanted = job.settings.capture, effects(job.settings.capture)
    encoded, estimated = capture.dynamic_range == "ldr", wanted.exposure or capture.exposure == "estimate"
    out = Delivered(list(rendered.views), (response or response_curve(RESPONSE)) if encoded else None)
    exposures = _photographs(job, rendered, out)
    if encoded and not estimated:
        out.views = [replace(view, exposure=float(e)) for view, e in zip(out.views, exposures, strict=True)]
    numbers = list(range(len(out.views)))  # rows of `rendered`
    if wanted.cameras or wanted.mesh or estimated:
        room = Room.of(surface, job.threads)
        if wanted.cameras:
            numbers = _registered(job, writer, rendered, room, out)
        shared = SharedSurface(sum(view.split != "test" for view in out.views), encoded)
        for view, number in zip(out.views, numbers, strict=True):
            depth, face = room.seen(view)
            if wanted.cameras or wanted.mesh:
                _rewrite(writer, view, depth, face, surface.owner, owner)
            if view.split != "test":
                photo, hit = np.array(rendered.radiance[number]), face >= 0
                footprint = float(np.median(depth[hit])) / view.fx if hit.any() else 1.0
                shared.add(photo, rendered.valid(number) & hit, view.points(depth), footprint)
        if estimated:
            _estimated(out, shared, rendered, numbers, encoded)
    for view, number in zip(out.views, numbers, strict=True):
        writer.photo(view.name, np.array(rendered.radiance[number]), rendered.valid(number), encoded)
    writer.cameras(out.views)
    if capture.realism:
        out.facts["realism"] = vars(capture.realism)
    return out


def _photographs(job: Job, rendered: Rendered, out: Delivered) -> Array:
    """Photograph every picture in its place; return the true exposures (V,)."""
    from lab.simulated.photographs import exposures
    from lab.simulated.realism import automatic_exposures, stream, white_balance

    wanted, gains = effects(job.settings.capture), np.ones((len(rendered.views), 3))
    pictures, masks = [image for image, _ in rendered.meters], [mask for _, mask in rendered.meters]
    if wanted.exposure:
        chosen = automatic_exposures(pictures, masks)
        gains = np.array([white_balance(stream(job.seed, "white_balance", view.view_id)) for view in rendered.views])
    else:
        chosen = exposures(pictures, masks, used=[view.split != "test" for view in rendered.views])
    for number, view in enumerate(rendered.views):
        rng = stream(job.seed, "noise", view.view_id)
        image = np.array(rendered.radiance[number], np.float64)
        rendered.radiance[number] = taken(image, float(chosen[number]), gains[number], wanted, out.response, rng)
    if wanted.exposure or job.settings.capture.exposure == "estimate":
        out.facts["exposure_truth"] = [round(float(e), 8) for e in chosen]
        out.facts["white_balance_truth"] = gains.round(6).tolist()
    return chosen


def taken(
    radiance: Array, exposure: float, gains: Array, wanted: Any, curve: ResponseCurve | None, rng: np.random.Generator
) -> Array:
    """Photograph one picture: blur, exposure, noise, saturation, white balance, response, eight bits, JPEG; then reduce it.

    Args:
        radiance: (H, W, 3) float64.
        exposure: factor on radiance; gains: (3,) of the channels.
        wanted: the effects.
        curve: response; None: the result is linear, relative to the exposure unless `wanted.exposure`.
        rng: of the noise.
    """
    from lab.simulated import realism
    from lab.simulated.photographs import expose

    times = wanted.reduced if wanted.blur or wanted.noise or wanted.jpeg else 1  # nothing else depends on the size
    if times > 1:
        radiance = radiance.repeat(times, 0).repeat(times, 1)
    image = realism.lens_blur(radiance) if wanted.blur else radiance
    if curve is None and not (wanted.noise or wanted.exposure):
        return _means(image, times)
    signal = exposure * image
    if wanted.noise:
        signal = np.maximum(realism.sensor_noise(signal, rng), 0)
    if curve is None:
        return _means(gains * signal / (1 if wanted.exposure else exposure), times)
    photo = expose(gains * np.minimum(signal, 1), 1.0, curve)
    return _means(realism.jpeg(photo) if wanted.jpeg else photo, times)


def _means(image: Array, edge: int) -> Array:
    """Means of squares of `edge` pixels."""
    if edge == 1:
        return image
    height, width = image.shape[0] // edge, image.shape[1] // edge
    return image.reshape(height, edge, width, edge, 3).mean((1, 3))


def _registered(job: Job, writer: RenderedWriter, rendered: Rendered, room: Room, out: Delivered) -> list[int]:
    """Replace the cameras by wrong ones, registered as a folder's are; return the rows of `rendered` that are left."""
    from iif_core.camera.alignment import Photo
    from iif_core.camera.distortion import Distortion
    from lab.simulated.realism import POSE_ERROR, focal_factor, misplaced, stream
    from workflow.sources.folder import MIN_COVERAGE
    from workflow.sources.folder_scene import images, registration
    from workflow.sources.folder_scene.frames import Frame
    from workflow.sources.folder_scene.photographs import pinhole, view_of

    factor, frames, photos = focal_factor(stream(job.seed, "focal")), [], []
    for number, view in enumerate(out.views):
        depth = writer.writer.channels(f"gbuffer/{view.name}.exr")["depth.Z"]
        seen, error = view.points(depth, np.float64)[depth > 0], POSE_ERROR / effects(job.settings.capture).reduced
        view = misplaced(view, seen, stream(job.seed, "pose", view.view_id), error)
        camera = pinhole(replace(view, fx=factor * view.fx, fy=factor * view.fy))
        frame = Frame(view.name, view.name, Path(view.name), 1, camera, Distortion("radial_tangential"), view.world_from_camera)
        small = view_of(frame, view.world_from_camera, number, (registration.WIDTH, registration.WIDTH))
        depth, face = room.seen(small)
        size = small.width, small.height
        pixels, usable = images.reduce_area(np.array(rendered.radiance[number]), rendered.valid(number), *size)
        lens = (small.fx, small.fy), (small.cx, small.cy)
        photo = Photo(pixels, usable, depth, room.normals_of(face), *lens, view.world_from_camera, view.split == "test")
        frames.append(frame)
        photos.append(photo if (face >= 0).mean() >= MIN_COVERAGE else None)
    found = registration.register_frames(frames, [frame.matrix for frame in frames], photos, "opencv", 1.0)
    numbers = [number for number, frame in enumerate(frames) if frame.name not in found.left_out]
    views = []
    for number in numbers:
        camera = found.frames[number].camera
        lens = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}
        view = replace(out.views[number], view_id=len(views), world_from_camera=found.poses[number], **lens)
        views.append(view)
    out.views = views
    out.notes += [*found.notes, *(f"view {name} left out: {reason}" for name, reason in found.left_out.items())]
    out.facts |= {"registration": found.facts, "left_out_views": found.left_out, "plan": found.plan}
    return numbers


def _rewrite(writer: RenderedWriter, view: View, depth: Array, face: Array, owner: Array, true_owner: Array) -> None:
    """Write the G-buffer of a view as delivered; truth is known where it shows the object that the photograph shows."""
    names = f"gbuffer/{view.name}.exr", f"truth/{view.name}.exr"
    was, true = (writer.writer.channels(name) for name in names)
    true_face = ids_from_disk(was["face.id"])
    same = (face >= 0) & (true_face >= 0) & (owner[face] == true_owner[true_face])
    writer.gbuffer(view.name, depth, face)
    images = rgb(true, "albedo"), true["roughness"], true["metallic"], rgb(true, "emission"), rgb(true, "radiance")
    writer.truth(view.name, Truth(*images, valid=(true["valid"] > 0.5) & same))


def _estimated(out: Delivered, shared: Any, rendered: Rendered, numbers: Sequence[int], encoded: bool) -> None:
    """Give the views exposures that are estimated from surface that they share, as those of a folder are; held-out views keep 1.
    Radiance is divided by its exposure."""
    found = shared.gains()
    own = [i for i, view in enumerate(out.views) if view.split != "test"]
    out.facts["exposure_estimated"] = True
    out.notes.append(f"exposures estimated from surface that views share (residual {found.residual:.3f})")
    for i, gain in zip(own, found.gain, strict=True):
        if encoded:
            out.views[i] = replace(out.views[i], exposure=float(gain))
        else:
            rendered.radiance[numbers[i]] /= np.float32(gain)
