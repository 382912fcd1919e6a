"""Source `builtin`: photographs, cameras, mesh and ground truth of a room that the project makes itself.

The photographs are path traced with the workflow's own reflectance model and with the textures of the truth maps.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lab.sources.rendered import DENOISED, RenderedWriter
from workflow.models.denoise import denoise, require_denoiser
from workflow.scene.normal_form import Truth, View

if TYPE_CHECKING:
    from lab.rooms.room import Room
    from workflow.runtime.job import Job

Array = np.ndarray

RESPONSE = "filmic"
METERING_PIXELS = 4096  # per view; their radiance sets the exposure
COVERAGE_POINTS = 8000


def raw_inputs(document: dict[str, Any]) -> list[Path]:
    """Return no files: the room is made, not read."""
    return []


def capture(job: Job) -> None:
    """Build the room, photograph it, and write the normal form with ground truth."""
    from workflow.runtime import device, native

    native.prepare()
    device.mitsuba()
    native.limit_threads(job.threads)
    if job.settings.capture.denoise:
        require_denoiser()
    from lab import rooms

    _Capture(job, rooms.build(job.settings.source.scene, job.settings.source.quarterings)).run()


class _Capture:
    """One capture: the room on the device and its views."""

    def __init__(self, job: Job, room: Room):
        from iif_core.light.transport.emitters import Emitters
        from iif_core.light.transport.geometry import build_geometry

        self.job, self.settings, self.room = job, job.settings.capture, room
        self.writer = RenderedWriter(job.writer)
        self.geometry = build_geometry(room.vertices, room.faces, room.object_id)
        front = np.ones(len(room.faces), np.int8)
        outside = {} if room.environment is None else {"environment": room.environment}
        self.emitters = Emitters(self.geometry, room.emission, front, **outside)
        self.scan = room.scan
        self.surface = build_geometry(self.scan.vertices, self.scan.faces, self.scan.material_id)
        self.material = room.materials.drjit()

    def run(self) -> None:
        views = self._plan()
        scan = self.scan
        self.writer.mesh(scan.vertices, scan.faces, scan.object_id, list(scan.names), scan.emission)
        with tempfile.TemporaryFile() as scratch:
            shape = (len(views), self.settings.height, self.settings.width, 3)
            radiance = np.memmap(scratch, np.float32, "w+", shape=shape)
            meters = [self._view(view, radiance[i]) for i, view in enumerate(self._counted(views))]
            views = self._photographs(views, radiance, meters)
            del radiance
        self.writer.cameras(views)
        self._finish(views)

    def _plan(self) -> list[View]:
        width, height, every = self.settings.width, self.settings.height, self.settings.test_every

        def split(i: int) -> str:
            return "test" if every and i % every == every - 1 else "train"

        focal = 0.5 * width / np.tan(np.radians(self.room.field_of_view / 2))
        return [
            View(i, f"{i:03d}", width, height, focal, focal, width / 2, height / 2, pose, 1.0, split(i))
            for i, pose in enumerate(self.room.cameras(self.settings.views))
        ]

    def _counted(self, views: list[View]) -> Any:
        for i, view in enumerate(views):
            yield view
            self.job.progress(i + 1, len(views), "rendered views")

    def _view(self, view: View, radiance: Array) -> tuple[Array, Array]:
        """Write G-buffer and truth and fill in `radiance`; return radiance and mask of the pixels for metering."""
        kept = self.writer.kept(view.name)
        radiance[:], emits = self._render(view) if kept is None else kept[:2]
        step = max(1, emits.size // METERING_PIXELS)
        return np.array(radiance).reshape(-1, 3)[::step], ~emits.ravel()[::step]

    def _render(self, view: View) -> tuple[Array, Array]:
        """Write G-buffer and truth; return the radiance (H, W, 3) and where it shows emitters (H, W)."""
        from iif_core.camera.pinhole import direction_derivatives
        from iif_core.light.transport.geometry import trace
        from iif_core.light.transport.render import render
        from iif_core.light.transport.scene import PathOptions, Scene

        shape = (view.height, view.width)
        origin = view.world_from_camera[:3, 3]
        rays = view.directions().reshape(-1, 3)
        face, depth = trace(self.surface, origin, rays)
        hit = face >= 0
        depth = np.where(hit, depth, 0).astype(np.float32)
        on = np.maximum(face, 0)
        albedo, roughness, metallic = self.room.materials.numpy(origin + depth[:, None] * rays, self.scan.material_id[on])
        cosine = (self.surface.normals[on] * rays).sum(1)
        emission = np.where((hit & (cosine < 0))[:, None], self.scan.emission[on], 0)

        steps = direction_derivatives(view.fx, view.fy, view.world_from_camera)
        seed = int(np.random.SeedSequence([self.job.seed, view.view_id]).generate_state(1)[0])
        scene = Scene(self.geometry, self.material, self.emitters)
        image = render(scene, origin, rays, PathOptions(self.settings.samples, self.room.max_bounces, seed), jitter=steps)
        if self.settings.denoise:
            normal = np.where(hit[:, None], -np.sign(cosine)[:, None] * self.surface.normals[on], 0)
            image = denoise(*(a.reshape(*shape, 3) for a in (image, albedo, normal))).reshape(-1, 3)
        truth = Truth(
            np.where(hit[:, None], albedo, 0).reshape(*shape, 3),
            np.where(hit, roughness, 0).reshape(shape),
            np.where(hit, metallic, 0).reshape(shape),
            emission.reshape(*shape, 3),
            image.reshape(*shape, 3),
            hit.reshape(shape),
        )
        self.writer.rendered(view.name, depth.reshape(shape), face.reshape(shape), truth, {})
        return truth.radiance, truth.emission.any(-1)

    def _photographs(self, views: list[View], radiance: Array, meters: list[tuple[Array, Array]]) -> list[View]:
        """Write the photographs and return the views with their exposures."""
        from lab.simulated.photographs import expose, exposures, response_curve

        self.response = None
        if self.settings.dynamic_range == "hdr":
            for view, image in zip(views, radiance, strict=True):
                self.writer.photo(view.name, np.array(image), encoded=False)
            return views
        self.response = response_curve(RESPONSE)
        used = [view.split != "test" for view in views]
        gains = exposures([image for image, _ in meters], [mask for _, mask in meters], used=used)
        views = [replace(view, exposure=float(gain)) for view, gain in zip(views, gains, strict=True)]
        for view, image in zip(views, radiance, strict=True):
            self.writer.photo(view.name, expose(image, view.exposure, self.response))
        return views

    def _finish(self, views: list[View]) -> None:
        from lab.rooms.coverage import seen_from, surface_points

        points = surface_points(self.room, COVERAGE_POINTS)
        opening = self.room.field_of_view

        def count(cameras: list[Array], aspect: float) -> Array:
            return np.sum([seen_from(self.geometry, points, opening, aspect, pose) for pose in cameras], axis=0)

        views_of_point = count([v.world_from_camera for v in views], views[0].height / views[0].width)
        reachable = (views_of_point > 0) | (count(self.room.cameras(len(self.room.shots)), 1.0) > 0)
        once, twice = (float((views_of_point[reachable] >= n).mean()) for n in (1, 2))
        self.job.log.info("of the visible surface %.1f %% are seen, %.1f %% twice or more", 100 * once, 100 * twice)
        notes = [f"{len(self.scan.names)} objects, {len(self.scan.faces)} faces; up to {self.room.max_bounces} bounces"]
        if self.response is not None:
            notes.append(f"8-bit photographs through the response `{self.response.name}`; exposures differ")
        if self.settings.denoise:
            notes.append(DENOISED)
        coverage = {"seen_once": round(once, 4), "seen_twice": round(twice, 4), "points": COVERAGE_POINTS}
        facts = {"room": self.room.name, "coverage": coverage}
        samples = None if self.response is None else self.response.samples()
        self.writer.finish("builtin", self.settings.dynamic_range, True, notes, samples, facts)
