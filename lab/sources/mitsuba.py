"""Source `mitsuba`: photographs, cameras, mesh and ground truth of any Mitsuba 3 scene.

Mesh and material truth approximate the scene by the workflow's model (`mitsuba_scene.materials`); `capture.json` notes every
difference.
"""

from __future__ import annotations

import tempfile
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from iif_core.errors import InputError
from lab.mitsuba_scene.document import referenced_files
from lab.sources.delivery import Delivered, Rendered, Renderings, Surface, deliver, effects, metered
from lab.sources.footprint import Seen, over_pixels
from lab.sources.rendered import RenderedWriter
from workflow.intake.meshes import check_mesh
from workflow.intake.pictures import check_texture
from workflow.scene.normal_form import Truth, View
from workflow.sources.folder_scene.camera import metres_per_unit
from workflow.sources.folder_scene.mesh import check_across

if TYPE_CHECKING:
    from lab.simulated.scanned import Scanned
    from workflow.runtime.job import Job

Array = np.ndarray

FIELD_OF_VIEW = 75.0  # degrees across the wider side, for all views except the scene's own
DEPTH_TOLERANCE = 1e-4
"""Relative difference of depth between mesh and original surface above which a pixel has no truth (glass in between)."""
ROUND_DEPTH_TOLERANCE = 0.01
"""The same on spheres, cylinders and disks, which are tessellated."""
TESSELLATED = ("sphere", "cylinder", "disk")


def raw_inputs(document: dict[str, Any]) -> list[Path]:
    """Return the XML and every file that it names.

    Raises:
        InputError: a file is missing or malformed, or larger than is allowed.
    """
    files = referenced_files(Path(document["source"]["path"]))
    for path in files:
        if path.suffix.lower() in (".ply", ".obj"):
            check_mesh(path)
        else:
            check_texture(path)
    return files


def capture(job: Job) -> None:
    """Write the whole capture of the scene that `source.path` names."""
    from workflow.runtime import device, native

    native.prepare()
    device.mitsuba()
    native.limit_threads(job.threads)
    _Capture(job).run()


class _Capture:
    """One capture: the scene, its mesh and the notes about both."""

    def __init__(self, job: Job):
        self.job, self.settings, self.source = job, job.settings.capture, job.settings.source
        self.writer = RenderedWriter(job.writer)
        self.renderings = Renderings(self.settings)

    def run(self) -> None:
        import mitsuba as mi

        from lab.mitsuba_scene import flatten, materials, scene, trial

        xml = Path(self.source.path)
        trial.check(xml, mi.variant())
        self.loaded = scene.load(xml)
        self.metres = metres_per_unit(self.source.unit)
        everything = flatten.flatten(self.loaded)
        everything = replace(everything, vertices=everything.vertices * self.metres)
        check_across(xml, everything.vertices, self.source.unit, self.metres)
        self.table = materials.MaterialTable(everything.shapes)
        self.notes = [*self.loaded.notes, *everything.notes, *self.table.notes(everything)]
        self._environment()
        transparent = self.table.of_faces(everything, "transparent")
        keep = self.table.face_opacity(everything) >= materials.OPAQUE
        self._note_faces(transparent, ~keep)
        if self.source.drop_transparent:
            self.mesh = flatten.compact(everything, keep & ~transparent)
        else:
            self.mesh = flatten.compact(everything, keep)
        if not len(self.mesh.faces):
            raise InputError(f"{xml}: every face is transparent; a capture needs opaque surface")
        self.job.log.info("mesh: %d faces of %d shapes", len(self.mesh.faces), len(np.unique(self.mesh.shape)))

        views = self._plan(flatten.compact(everything, keep), bool(transparent.any()) and self.source.drop_transparent)
        del everything
        shapes, instance = np.unique(self.mesh.shape, return_inverse=True)
        names = [self.mesh.shapes[i].name for i in shapes]
        instance = instance.astype(np.int32)
        mesh, owner = self.mesh, instance
        if effects(self.settings).mesh:
            mesh = self._scanned(instance, views)
            owner = mesh.ids[:, 0]
        self.writer.mesh(mesh.vertices, mesh.faces, owner, names, mesh.emission)
        with tempfile.TemporaryFile() as scratch:
            shape = (len(views), self.settings.height, self.settings.width, 3)
            radiance = np.memmap(scratch, np.float32, "w+", shape=shape)
            rendered = self._views(views, radiance)
            found = deliver(self.job, self.writer, rendered, Surface(mesh.vertices, mesh.faces, owner), instance)
            del radiance, rendered
        self._finish(found)

    # ------------------------------------------------------------------------------------------------------ scene

    def _environment(self) -> None:
        from lab.mitsuba_scene.path import fibonacci_sphere

        self.facts: dict[str, Any] = {}
        loose: Counter[str] = Counter()
        for emitter in self.loaded.scene.emitters():
            if emitter.is_environment():
                self.facts["environment"] = {
                    "kind": emitter.class_name(),
                    "mean_radiance": _mean_radiance(emitter, fibonacci_sphere(4096)),
                }
            elif emitter.class_name() not in ("AreaLight", "DirectionalArea"):
                loose[emitter.class_name()] += 1
        self.notes += [f"{n} {kind}: light that is not on the mesh, no emission truth" for kind, n in loose.items()]

    def _note_faces(self, transparent: Array, thin: Array) -> None:
        if transparent.any():
            what = "left out of the mesh" if self.source.drop_transparent else "kept in the mesh"
            self.notes.append(f"{transparent.sum()} transparent faces {what}; no truth where a ray meets one")
        if thin.any():
            self.notes.append(f"{thin.sum()} faces of low opacity left out of the mesh; no truth where a ray meets one")

    def _plan(self, solid_mesh: Any, glass: bool) -> list[View]:
        """Build the geometry for tracing and choose the views."""
        from iif_core.light.transport.geometry import build_geometry, trace
        from lab.mitsuba_scene import path

        self.geometry = build_geometry(self.mesh.vertices, self.mesh.faces, self.mesh.shape)
        solid = build_geometry(solid_mesh.vertices, solid_mesh.faces, solid_mesh.shape) if glass else self.geometry
        width, height = self.settings.width, self.settings.height
        sensors = self._sensors()
        up = path.upright(-sensors[0][0][:3, 1])
        wide = np.tan(np.radians(FIELD_OF_VIEW / 2)) / max(width, height)
        given = [(pose, path.Lens(tangent, tangent * height / width)) for pose, tangent in sensors]
        found = path.plan_views(
            lambda o, d: trace(solid, o, d),
            lambda o, d: trace(self.geometry, o, d),
            self.mesh.vertices,
            self.mesh.faces,
            given,
            path.Lens(wide * width, wide * height),
            up,
            self.settings.views,
            self.job.seed,
        )
        self.notes += found.notes
        self.facts["path"] = found.facts
        views = []
        for i, pose in enumerate(found.poses):
            focal = width / 2 / sensors[i][1] if found.given[i] else 1 / (2 * wide)
            test = self.settings.test_every and i % self.settings.test_every == self.settings.test_every - 1
            split = "test" if test else "train"
            views.append(View(i, f"{i:03d}", width, height, focal, focal, width / 2, height / 2, pose, 1.0, split))
        share = found.facts
        self.job.log.info(
            "%d views; of the reachable surface %.1f %% are seen, %.1f %% three times or more",
            len(views),
            100 * share["coverage_1"],
            100 * share["coverage_3"],
        )
        return views

    def _sensors(self) -> list[tuple[Array, float]]:
        """Return (world_from_camera, tangent of half the horizontal field of view) of the XML's perspective sensors."""
        import mitsuba as mi

        from iif_core.camera.pinhole import look_at

        out = []
        for sensor in self.loaded.scene.sensors():
            parameters = mi.traverse(sensor)
            if "x_fov" not in parameters:
                self.notes.append(f"sensor {sensor.class_name()}: no pinhole, not used")
                continue
            matrix = np.array(parameters["to_world"].matrix, np.float64).reshape(4, 4)
            origin, forward, upward = matrix[:3, 3] * self.metres, matrix[:3, 2], matrix[:3, 1]
            if np.linalg.det(matrix[:3, :3]) < 0:
                self.notes.append("a sensor's to_world mirrors the picture: the view is taken unmirrored")
            tangent = float(np.tan(np.radians(np.array(parameters["x_fov"]).ravel()[0]) / 2))
            out.append((look_at(origin, origin + forward, upward), tangent))
        if not out:
            raise InputError(f"{self.source.path}: no perspective sensor; add one inside the room")
        return out

    # ------------------------------------------------------------------------------------------------------ views

    def _views(self, views: list[View], radiance: Array) -> Rendered:
        """Write G-buffer and truth of every view and fill in `radiance`, from which the photographs are made."""
        from lab.mitsuba_scene import render

        integrator = render.path_integrator(self.source.max_bounces)
        render.balance_lights(self.loaded.scene, self.loaded.scene.shapes())
        self.dropped = 0
        out = Rendered(views, radiance, [], [])
        for i, view in enumerate(views):
            kept = self.writer.kept(view.name)
            image, emits, facts = self._render(view, integrator) if kept is None else kept
            self.dropped += facts["dropped"]
            valid = np.ones(image.shape[:2], bool)
            valid.ravel()[facts["invalid"]] = False
            radiance[i] = image
            out.usable.append(np.packbits(valid))
            out.meters.append(metered(image, valid & ~emits))
            self.job.progress(i + 1, len(views), "rendered views")
        return out

    def _render(self, view: View, integrator: Any) -> tuple[Array, Array, dict[str, Any]]:
        """Write G-buffer and truth of a view; return its radiance (H, W, 3), where it shows emitters (H, W), and what else is
        needed of it: the number of samples that were dropped and the pixels without any."""
        from lab.mitsuba_scene import render

        depth, face, truth = over_pixels(view, self._look, self.mesh.shape)
        samples = self.renderings.samples
        pose = view.world_from_camera.copy()
        pose[:3, 3] /= self.metres
        in_scene = replace(view, world_from_camera=pose)
        image, valid, dropped = render.render_view(self.loaded.scene, integrator, in_scene, samples, self.job.seed)
        image = self.renderings.denoised(image, truth.albedo, self._normals(view, face))
        facts = {"dropped": dropped, "invalid": np.flatnonzero(~valid).tolist()}
        self.writer.rendered(view.name, depth, face, replace(truth, radiance=image), facts)
        return image, truth.emission.any(-1), facts

    def _look(self, view: View) -> Seen:
        """Return z-depth, face ids and truth at the pixel centres; the radiance of the truth is still 0."""
        from iif_core.light.transport.geometry import trace
        from lab.mitsuba_scene import materials, render

        origin = view.world_from_camera[:3, 3]
        rays = view.directions().reshape(-1, 3)
        face, t = trace(self.geometry, origin, rays)
        hit = np.flatnonzero(face >= 0)
        if view.view_id == 0 and not len(hit):
            raise InputError(f"{self.source.path}: the scene's sensor sees no surface; point it into the room")
        on = face[hit]
        point = origin + t[hit, None].astype(np.float64) * rays[hit]
        surface = self.table.evaluate(self.mesh, on, materials.barycentric_of(self.mesh, on, point))
        front = (self.geometry.normals[on] * rays[hit]).sum(1) < 0
        original = render.original_distance(self.loaded.scene, origin / self.metres, rays[hit]) * self.metres
        tessellated = np.array([shape.plugin in TESSELLATED for shape in self.mesh.shapes])
        slack = np.where(tessellated[self.mesh.shape[on]], ROUND_DEPTH_TOLERANCE, DEPTH_TOLERANCE)
        undisturbed = np.abs(original - t[hit]) <= slack * t[hit]
        two_sided = self.table.of_faces(self.mesh, "two_sided")[on]

        def raster(values: Array) -> Array:
            out = np.zeros((view.height * view.width, *values.shape[1:]), values.dtype)
            out[hit] = values
            return out.reshape(view.height, view.width, *values.shape[1:])

        emission = np.where(front[:, None], self.mesh.emission[on], 0)
        truth = Truth(
            raster(surface.albedo),
            raster(surface.roughness),
            raster(surface.metallic),
            raster(emission),
            np.zeros((view.height, view.width, 3), np.float32),
            raster(surface.truth & undisturbed & (front | two_sided)),
        )
        shape = (view.height, view.width)
        return Seen(np.where(face >= 0, t, 0).reshape(shape).astype(np.float32), face.reshape(shape), truth)

    def _scanned(self, instance: Array, views: list[View]) -> Scanned:
        """Return the mesh as a scan of it would be."""
        from lab.simulated.realism import stream
        from lab.simulated.scanned import closed, scanned

        rng, eyes = stream(self.job.seed, "mesh"), np.stack([view.world_from_camera[:3, 3] for view in views])
        return closed(scanned(self.mesh.vertices, self.mesh.faces, instance[:, None], self.mesh.emission, rng, eyes))

    def _normals(self, view: View, face: Array) -> Array:
        """Return world normals towards the camera (H, W, 3), 0 where nothing is hit."""
        normal = np.where(face[..., None] >= 0, self.geometry.normals[np.maximum(face, 0)], 0)
        return np.where((normal * view.directions()).sum(-1, keepdims=True) > 0, -normal, normal)

    def _finish(self, found: Delivered) -> None:
        if self.dropped:
            self.notes.append(f"{self.dropped} path samples were not finite and are left out of the photographs")
        self.notes += [*self.renderings.notes(), *found.notes]
        samples = None if found.response is None else found.response.samples()
        facts = {**self.facts, **found.facts}
        self.writer.finish("mitsuba", self.settings.dynamic_range, True, self.notes, samples, facts)
        for note in self.notes:
            self.job.log.info("%s", note)


def _mean_radiance(emitter: Any, directions: Array) -> list[float]:
    """Return the mean RGB radiance of an environment light over the sphere."""
    import drjit as dr
    import mitsuba as mi

    si = dr.zeros(mi.SurfaceInteraction3f, len(directions))
    si.wi = mi.Vector3f(*(mi.Float(np.ascontiguousarray(-directions[:, i], np.float32)) for i in range(3)))
    value = np.array(mi.Color3f(emitter.eval(si))).T
    return [round(float(v), 6) for v in np.broadcast_to(value, (len(directions), 3)).mean(0)]
