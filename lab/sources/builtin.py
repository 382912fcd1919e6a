"""Source `builtin`: photographs, cameras, mesh and ground truth of a room that the project makes itself.

The photographs are path traced with the workflow's own reflectance model and with the textures of the truth maps.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lab.sources.delivery import Delivered, Rendered, Renderings, Surface, deliver, effects, metered
from lab.sources.footprint import Seen, over_pixels
from lab.sources.rendered import RenderedWriter
from workflow.scene.normal_form import Truth, View

if TYPE_CHECKING:
    from lab.rooms.room import Room, Scan
    from workflow.runtime.job import Job

Array = np.ndarray

COVERAGE_POINTS = 8000


def raw_inputs(document: dict[str, Any]) -> list[Path]:
    """Return no files: the room is made, not read."""
    return []


def capture(job: Job) -> None:
    """Build the room, photograph it, and write the normal form with ground truth."""
    from lab import rooms

    photograph_room(job, rooms.build(job.settings.source.scene, job.settings.source.quarterings))


def photograph_room(job: Job, room: Room) -> None:
    """Photograph a room, and write the normal form with ground truth."""
    from workflow.runtime import device, native

    native.prepare()
    device.mitsuba()
    native.limit_threads(job.threads)
    _Capture(job, room).run()


class _Capture:
    """One capture: the room on the device and its views."""

    def __init__(self, job: Job, room: Room):
        from iif_core.light.transport.emitters import Emitters
        from iif_core.light.transport.geometry import build_geometry

        self.job, self.settings, self.room = job, job.settings.capture, room
        self.renderings = Renderings(self.settings)
        self.writer = RenderedWriter(job.writer)
        self.geometry = build_geometry(room.vertices, room.faces, room.object_id)
        front = np.ones(len(room.faces), np.int8)
        outside = {} if room.environment is None else {"environment": room.environment}
        self.emitters = Emitters(self.geometry, room.emission, front, **outside)
        self.scan = room.scan
        self.surface = build_geometry(self.scan.vertices, self.scan.faces, self.scan.material_id)
        self.material = room.materials.drjit()

    def run(self) -> None:
        views, scan = self._plan(), self._scanned() if effects(self.settings).mesh else self.scan
        self.writer.mesh(scan.vertices, scan.faces, scan.object_id, list(scan.names), scan.emission)
        with tempfile.TemporaryFile() as scratch:
            shape = (len(views), self.settings.height, self.settings.width, 3)
            radiance = np.memmap(scratch, np.float32, "w+", shape=shape)
            meters = [self._view(view, radiance[i]) for i, view in enumerate(self._counted(views))]
            rendered, surface = Rendered(views, radiance, meters), Surface(scan.vertices, scan.faces, scan.object_id)
            found = deliver(self.job, self.writer, rendered, surface, self.scan.object_id, self.room.response)
            del radiance, rendered
        self._finish(views, found, scan)

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
        return metered(radiance, ~emits)

    def _scanned(self) -> Scan:
        """Return the mesh as a scan of it would be."""
        from lab.rooms.room import Scan
        from lab.simulated.realism import stream
        from lab.simulated.scanned import closed, scanned

        scan = self.scan
        ids = np.column_stack([scan.object_id, scan.material_id])
        found = closed(scanned(scan.vertices, scan.faces, ids, scan.emission, stream(self.job.seed, "mesh")))
        owner, material = found.ids.T
        return Scan(found.vertices, found.faces, owner, material, scan.names, found.emission)

    def _render(self, view: View) -> tuple[Array, Array]:
        """Write G-buffer and truth; return the radiance (H, W, 3) and where it shows emitters (H, W)."""
        from iif_core.camera.pinhole import direction_derivatives
        from iif_core.light.transport.render import render
        from iif_core.light.transport.scene import PathOptions, Scene

        depth, face, truth = over_pixels(view, self._look, self.scan.object_id)
        rays = view.directions().reshape(-1, 3)
        steps = direction_derivatives(view.fx, view.fy, view.world_from_camera)
        seed = int(np.random.SeedSequence([self.job.seed, view.view_id]).generate_state(1)[0])
        scene = Scene(self.geometry, self.material, self.emitters)
        paths = PathOptions(self.renderings.samples, self.room.max_bounces, seed)
        image = render(scene, view.world_from_camera[:3, 3], rays, paths, jitter=steps).reshape(truth.albedo.shape)
        normal = np.where(face[..., None] >= 0, self.surface.normals[face], 0)
        toward = -np.sign((normal * view.directions()).sum(-1, keepdims=True))
        truth = replace(truth, radiance=self.renderings.denoised(image, truth.albedo, toward * normal))
        self.writer.rendered(view.name, depth, face, truth, {})
        return truth.radiance, truth.emission.any(-1)

    def _look(self, view: View) -> Seen:
        """Return z-depth, face ids and truth at the pixel centres; the radiance of the truth is still 0."""
        from iif_core.light.transport.geometry import trace

        shape = (view.height, view.width)
        origin = view.world_from_camera[:3, 3]
        rays = view.directions().reshape(-1, 3)
        face, depth = trace(self.surface, origin, rays)
        hit = face >= 0
        depth = np.where(hit, depth, 0).astype(np.float32)
        on = np.maximum(face, 0)
        albedo, roughness, metallic = self.room.materials.numpy(origin + depth[:, None] * rays, self.scan.material_id[on])
        front = (self.surface.normals[on] * rays).sum(1) < 0
        truth = Truth(
            np.where(hit[:, None], albedo, 0).reshape(*shape, 3),
            np.where(hit, roughness, 0).reshape(shape),
            np.where(hit, metallic, 0).reshape(shape),
            np.where((hit & front)[:, None], self.scan.emission[on], 0).reshape(*shape, 3),
            np.zeros((*shape, 3), np.float32),
            hit.reshape(shape),
        )
        return Seen(depth.reshape(shape), face.reshape(shape), truth)

    def _finish(self, views: list[View], found: Delivered, scan: Scan) -> None:
        from lab.rooms.coverage import seen_from, surface_points

        points = surface_points(self.room, COVERAGE_POINTS)
        opening = self.room.field_of_view

        def count(cameras: list[Array], aspect: float) -> Array:
            return np.sum([seen_from(self.geometry, points, opening, aspect, pose) for pose in cameras], axis=0)

        views_of_point = count([v.world_from_camera for v in views], views[0].height / views[0].width)
        reachable = (views_of_point > 0) | (count(self.room.cameras(len(self.room.shots)), 1.0) > 0)
        once, twice = (float((views_of_point[reachable] >= n).mean()) for n in (1, 2))
        self.job.log.info("of the visible surface %.1f %% are seen, %.1f %% twice or more", 100 * once, 100 * twice)
        notes = [f"{len(scan.names)} objects, {len(scan.faces)} faces; up to {self.room.max_bounces} bounces"]
        if found.response is not None:
            notes.append(f"8-bit photographs through the response `{found.response.name}`; exposures differ")
        notes += [*self.renderings.notes(), *found.notes]
        coverage = {"seen_once": round(once, 4), "seen_twice": round(twice, 4), "points": COVERAGE_POINTS}
        facts = {"room": self.room.name, "coverage": coverage, **found.facts}
        samples = None if found.response is None else found.response.samples()
        self.writer.finish("builtin", self.settings.dynamic_range, True, notes, samples, facts)
