"""Source `folder`: the user's own scene, in the form that common tools write (docs/guide/own-data.md).

`raw_inputs` checks everything that headers and JSON can show, while Snakemake plans.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from iif_core.camera.distortion import Pinhole, pinhole_inside, undistort_image
from iif_core.camera.registration import Photo
from iif_core.errors import InputError
from iif_core.numerics.color import linear_from_srgb
from iif_core.surface.triangles import face_geometry
from workflow.runtime import device, native
from workflow.runtime.job import Job
from workflow.scene.normal_form import CaptureWriter, Truth, View
from workflow.sources.folder_scene import alignment, exposure, images, mesh, registration, transforms
from workflow.sources.folder_scene.inputs import Inputs, find_inputs
from workflow.sources.folder_scene.transforms import Frame

MIN_COVERAGE = 0.01  # share of the rays of a view that must hit the mesh
BLACK, WHITE = 2.5 / 255, 253.5 / 255  # sensor values of all channels below and above which a pixel tells nothing about the light
EVERYWHERE = 0.999  # share of such pixels that makes a photograph black or white
MAX_LOG_PIXEL_ASPECT = 0.1  # |log(fl_x / fl_y)| above which a note asks whether it is right; real lenses stay below 0.01


def raw_inputs(document: dict[str, Any]) -> list[Path]:
    """List the files that the capture reads, after checking everything that can be checked without pixels.

    Raises:
        InputError: missing or inconsistent files, by name.
    """
    return find_inputs(document["source"], document["capture"]).files()


def capture(job: Job) -> None:
    """Write the normal form of the folder.

    Raises:
        InputError: the mesh is unusable, no view sees it, or photographs and mesh do not belong together.
    """
    capture_photographs(job, find_inputs(vars(job.settings.source), vars(job.settings.capture), points=True))


def capture_photographs(job: Job, inputs: Inputs) -> None:
    """Write the normal form of photographs with known cameras and a mesh, whichever source found them."""
    _Capture(job, inputs).run()


class _Capture:
    """One capture: settings, mesh and notes."""

    def __init__(self, job: Job, inputs: Inputs):
        self.job, self.source, self.settings, self.inputs = job, job.settings.source, job.settings.capture, inputs
        self.writer = CaptureWriter(job.writer)
        self.metres = inputs.metres
        self.conventions = alignment.Conventions(inputs.transforms.axes, self.metres, mesh_up=self.source.mesh_up)
        self.listed = any(frame.split for frame in inputs.transforms.frames)
        self.encoded = self.settings.dynamic_range == "ldr"
        self.notes: list[str] = list(inputs.transforms.notes)
        self.counts = dict.fromkeys(("non_finite", "transparent", "negative", "masked"), 0)
        self.forms: dict[str, set[str]] = {}
        self.unexposed: dict[str, list[str]] = {"black": [], "white": []}  # names of views without a picture
        self.alignment = alignment.Alignment.empty()
        count = len(inputs.transforms.frames)
        self.tried = {inputs.transforms.frames[i].name for i in transforms.evenly_spread(count, alignment.TRIAL_VIEWS)}
        spread = transforms.evenly_spread(count, alignment.COMPARED_VIEWS)
        self.compared = {inputs.transforms.frames[i].name for i in spread}
        self.trials: list[tuple[Frame, Pinhole, np.ndarray, np.ndarray]] = []

    def run(self) -> None:
        frames = self.inputs.transforms.frames
        poses = [self.conventions.pose(f) for f in frames]
        of_vertices = self.inputs.of_vertices() if self.inputs.of_vertices else None
        self.mesh = mesh.load(self.inputs.mesh, self.metres, of_vertices, self.source.mesh_up)
        self.notes += self.mesh.notes
        centres = np.array([pose[:3, 3] for pose in poses])
        mesh.check_size(self.inputs.mesh, self.mesh, getattr(self.source, "unit", "m"), self.metres, centres)
        if self.mesh.from_nodes and self.inputs.instances:
            self.mesh.instance = self.mesh.names = None
        self._build()
        self.normals = face_geometry(self.mesh.vertices, self.mesh.faces)[0].astype(np.float32)
        given = self._given_exposures()
        frames, poses, found = self._registered(frames, poses, given)
        shared = exposure.SharedSurface(len(frames), self.encoded)

        views: list[View] = []
        used: list[Frame] = []
        blind: list[tuple[Frame, View]] = []
        dropped: dict[str, float] = {}
        for i, (frame, pose) in enumerate(zip(frames, poses, strict=True)):
            if frame.name in found.left_out:
                continue
            view = replace(self._view(frame, pose, len(views), given[i]), split=self._split(frame, i))
            depth, face = self._trace(view)
            share = float((face >= 0).mean())
            if share < MIN_COVERAGE:
                dropped[frame.name] = share
                blind.append((frame, view))
                continue
            photo, valid = self._photo(frame, view, given[i])
            valid &= self._look_for_light(view.name, photo[valid])
            self.writer.photo(view.name, photo, valid, self.encoded)
            self.writer.gbuffer(view.name, depth, face)
            self._extras(frame, view, photo, valid, face)
            self._compare(frame, view, photo, valid, depth, face)
            if self.settings.exposure == "estimate" and view.split != "test":
                points = view.world_from_camera[:3, 3] + depth[..., None] * view.directions()
                footprint = float(np.median(depth[face >= 0])) / view.fx
                shared.add(photo, valid & (face >= 0), points, footprint)
            views.append(view)
            used.append(frame)
            self.job.progress(i + 1, len(frames), "photographs")

        self._check_views(len(frames), dropped, blind)
        self._check_exposed(len(views))
        self._check_alignment(used, views)
        if self.settings.exposure == "estimate":
            views = self._estimated(shared, used, views)
        self.writer.cameras(views)
        self.writer.mesh(self.mesh.vertices, self.mesh.faces, self.mesh.instance, self.mesh.names)
        self._note_pixels(frames)
        self._note_views(frames, views)
        facts = {
            "alignment": self.alignment.report(),
            "dropped_views": dropped,
            "left_out_views": found.left_out,
            "registration": found.facts,
            "plan": found.plan,
            "exposure_estimated": self.settings.exposure == "estimate",
        }
        has_truth = bool(self.inputs.truth)
        self.writer.finish(self.source.kind, self.settings.dynamic_range, has_truth, self.notes, self.inputs.response, facts)
        for note in self.notes:
            self.job.log.info("%s", note)

    def _build(self) -> None:
        native.prepare()
        device.mitsuba()
        native.limit_threads(self.job.threads)
        from iif_core.light.transport.geometry import build_geometry

        no_object = np.full(len(self.mesh.faces), -1, np.int32)
        self.geometry = build_geometry(self.mesh.vertices, self.mesh.faces, no_object)

    def _target(self, frame: Frame) -> Pinhole:
        """Return the pinhole camera at full size."""
        return frame.camera if frame.lens.is_identity else pinhole_inside(frame.lens, frame.camera)

    def _view(self, frame: Frame, pose: np.ndarray, view_id: int, gain: float, longest: float = np.inf) -> View:
        full = self._target(frame)
        limits = min(longest, self.settings.width), min(longest, self.settings.height)
        camera = alignment.scaled(full, *images.fitted_size(full.width, full.height, *limits))
        intrinsics = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        return View(view_id, frame.name, *intrinsics, pose, gain if self.encoded else 1.0)

    def _split(self, frame: Frame, number: int) -> str:
        """Return `train` or `test`; lists of the data set take precedence over `capture.test_every`."""
        if self.listed:
            return frame.split or "train"
        every = self.settings.test_every
        return "test" if every and number % every == every - 1 else "train"

    def _registered(
        self, frames: tuple[Frame, ...], poses: list[np.ndarray], gains: list[float]
    ) -> tuple[tuple[Frame, ...], list[np.ndarray], registration.Registered]:
        """Return frames and poses registered with the mesh and the other photographs."""
        if self.source.registration == "off":
            return frames, poses, registration.Registered(list(frames), poses, {}, {}, [], [])
        counts, notes, photos = dict(self.counts), list(self.notes), []
        for i, (frame, pose) in enumerate(zip(frames, poses, strict=True)):
            view = self._view(frame, pose, i, gains[i], registration.WIDTH)
            depth, face = self._trace(view)
            photos.append(None)
            if (face >= 0).mean() < MIN_COVERAGE:
                continue
            photo, valid = self._photo(frame, view, gains[i])
            normal = np.where(face[..., None] >= 0, self.normals[face], 0)
            held = self._split(frame, i) == "test"
            photos[-1] = Photo(photo, valid, depth, normal, (view.fx, view.fy), (view.cx, view.cy), pose, held)
            self.job.progress(i + 1, len(frames), "photographs registered")
        self.counts, self.notes = counts, notes
        found = registration.register_frames(frames, poses, photos, self.conventions.axes, self.metres)
        self.notes += found.notes
        self.notes += [f"view {name} left out: {reason}" for name, reason in found.left_out.items()]
        return tuple(found.frames), found.poses, found

    def _trace(self, view: View) -> tuple[np.ndarray, np.ndarray]:
        """Return z-depth (0 = miss) and face ids of a view."""
        from iif_core.light.transport.geometry import trace

        rays = view.directions()
        face, t = trace(self.geometry, view.world_from_camera[:3, 3], rays.reshape(-1, 3))
        shape = rays.shape[:2]
        return np.where(face >= 0, t, 0).reshape(shape).astype(np.float32), face.reshape(shape)

    def _upright(self, frame: Frame, path: Path, pixels: np.ndarray) -> np.ndarray:
        if pixels.shape[:2] != (frame.camera.height, frame.camera.width):
            raise InputError(
                f"{path}: {pixels.shape[1]}x{pixels.shape[0]} pixels, its photograph has"
                f" {frame.camera.width}x{frame.camera.height}; give both in one size"
            )
        return pixels

    def _resized(self, frame: Frame, view: View, pixels: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the picture undistorted and reduced by area."""
        if not frame.lens.is_identity:
            pixels, valid = undistort_image(pixels, frame.lens, frame.camera, self._target(frame), valid)
        return images.reduce_area(pixels, valid, view.width, view.height)

    def _photo(self, frame: Frame, view: View, gain: float) -> tuple[np.ndarray, np.ndarray]:
        """Return sensor values, or radiance (divided by the exposure), at the size of `view`, and the pixels that may be used."""
        photo = images.load_photo(frame.image, frame.turn)
        self._upright(frame, frame.image, photo.pixels)
        if photo.form:
            self.forms.setdefault(photo.form, set()).add(frame.name)
        if frame.mask is not None:
            kept = self._upright(frame, frame.mask, images.load_mask(frame.mask, frame.turn, frame.mask_full))
            photo.masked = int((photo.valid & ~kept).sum())
            photo.valid &= kept
        for key in self.counts:
            self.counts[key] += getattr(photo, key)
        pixels, valid = self._resized(frame, view, photo.pixels, photo.valid)
        pixels = pixels if self.encoded else pixels / np.float32(gain)
        if not valid.any():
            self.notes.append(f"view {view.name}: no usable pixel (all transparent, masked or NaN)")
        return pixels, valid

    def _ids(self, frame: Frame, view: View, path: Path) -> np.ndarray:
        ids = self._upright(frame, path, self.inputs.load_ids(path, frame.turn))
        if not frame.lens.is_identity:
            moved, seen = undistort_image(ids, frame.lens, frame.camera, self._target(frame), nearest=True)
            ids = np.where(seen, moved, -1)
        return images.reduce_nearest(ids, view.width, view.height)

    def _extras(self, frame: Frame, view: View, photo: np.ndarray, valid: np.ndarray, face: np.ndarray) -> None:
        if frame.name in self.inputs.instances:
            self.writer.given_instances(view.name, self._ids(frame, view, self.inputs.instances[frame.name]))
        if frame.name not in self.inputs.truth:
            return
        maps, known = {}, np.ones(face.shape, bool)
        for kind, path in self.inputs.truth[frame.name].items():
            channels = 1 if kind in ("roughness", "metallic") else 3
            values = images.TURNS[frame.turn](images.load_map(path, channels))
            values = self._upright(frame, path, values.reshape(*values.shape[:2], channels))
            finite = np.isfinite(values).all(-1)
            values, covered = self._resized(frame, view, np.where(finite[..., None], values, 0), finite)
            maps[kind] = values if channels == 3 else values[..., 0]
            known &= covered
        if "radiance" not in maps:
            maps["radiance"] = linear_from_srgb(photo) if self.encoded else photo
        meaningful = known & valid & (face >= 0)
        self.writer.truth(view.name, Truth(**maps, valid=meaningful))

    def _compare(
        self, frame: Frame, view: View, photo: np.ndarray, valid: np.ndarray, depth: np.ndarray, face: np.ndarray
    ) -> None:
        if self.source.alignment == "off":
            return
        if frame.depth is not None:
            measured = images.load_depth(frame.depth, self.inputs.transforms.depth_unit)
            ratio = alignment.depth_ratio(frame, self.conventions, _pinhole(view), depth, measured)
            self.alignment.ratios[frame.name] = ratio
        elif frame.seen is not None and len(frame.seen) >= alignment.MIN_POINTS:
            self.alignment.what = "sparse points"
            self.alignment.ratios[frame.name] = alignment.point_ratio(frame, self.conventions, _pinhole(view), depth)
        normal = np.where(face[..., None] >= 0, self.normals[face], 0)
        edges = alignment.edge_pictures(photo, valid, depth, normal)
        self.alignment.add_edges(frame.name, *edges, frame.name in self.compared)
        if frame.name in self.tried:
            self._try(frame, view, photo, valid)

    def _check_views(self, count: int, dropped: dict[str, float], blind: list[tuple[Frame, View]]) -> None:
        if len(dropped) == count:
            better = self._advice(blind) or self._blind_advice(blind)
            raise InputError(
                f"{self.inputs.transforms.path}: none of {count} cameras sees {self.inputs.mesh.name} (rays that"
                f" hit it: {max(dropped.values()):.1%} at most); "
                + (better or f"mesh and poses differ in frame or unit, or their axes ({self.conventions.axes}) are wrong")
                + " (docs/guide/own-data.md)"
            )
        for name, share in dropped.items():
            self.notes.append(f"view {name} dropped: it looks at nothing ({share:.1%} of its rays hit the mesh)")
        if count - len(dropped) == 1:
            self.notes.append("one view only: nothing is seen twice, so materials and exposure rest on the prior alone")

    def _look_for_light(self, name: str, pixels: np.ndarray) -> bool:
        """Remember a photograph whose usable pixels (n, 3) are all black or all white. Returns whether they may be used: those of
        a black one would say that all surface that it shows is black."""
        if not len(pixels):
            return True
        if (pixels.max(1) <= (BLACK if self.encoded else 0)).mean() >= EVERYWHERE:
            self.unexposed["black"].append(name)
            return False
        if self.encoded and (pixels.min(1) >= WHITE).mean() >= EVERYWHERE:
            self.unexposed["white"].append(name)
        return True

    def _check_exposed(self, count: int) -> None:
        """Refuse photographs that are all black or white; note those that are."""
        found = {kind: names for kind, names in self.unexposed.items() if names}
        if sum(map(len, found.values())) == count:
            raise InputError(
                f"{self.inputs.transforms.path}: all {count} photographs are {' or '.join(found)}"
                f" ({'no light was recorded' if 'black' in found else 'every pixel is saturated'}): check the exposure, and the"
                " conversion that wrote the files"
            )
        for kind, names in found.items():
            more = f" and {len(names) - 5} more" if len(names) > 5 else ""
            what = "are not used" if kind == "black" else "only show that their surface is bright"
            self.notes.append(
                f"WARNING {len(names)} of {count} photographs are {kind} all over ({', '.join(names[:5])}{more}) and {what}:"
                " check their exposure"
            )

    def _check_alignment(self, used: list[Frame], views: list[View]) -> None:
        if self.source.alignment == "off":
            self.notes.append("alignment was not checked (`source.alignment: off`)")
            return
        self.notes += self.alignment.notes(self.source.alignment_tolerance)

        path, tolerance = self.inputs.transforms.path, self.source.alignment_tolerance
        message = self.alignment.refuse(path, tolerance, lambda: self._advice(list(zip(used, views, strict=True))))
        alignment.raise_or_note(message, self.source.alignment, self.notes)
        warning = self.alignment.edge_warning(tolerance)
        better = self._edge_advice() if warning and not self.alignment.ratios else ""
        if better:
            message = f"{path}: photographs and mesh do not belong together as read: {better}. To continue anyway:"
            alignment.raise_or_note(f"{message} `source.alignment: warn`", self.source.alignment, self.notes)
        alignment.raise_or_note(warning, "warn", self.notes)

    def _advice(self, seen: list[tuple[Frame, View]]) -> str:
        """Say which other convention fits the depth images or sparse points; empty without them."""
        pairs = [(f, _pinhole(v)) for f, v in seen if f.depth is not None or (f.seen is not None and len(f.seen))]
        if not pairs:
            return ""
        unit, tolerance = self.inputs.transforms.depth_unit, self.source.alignment_tolerance
        known = self.inputs.transforms.known
        return alignment.explain(pairs, self._depth_along, self.conventions, known, unit, tolerance)

    def _blind_advice(self, blind: list[tuple[Frame, View]]) -> str:
        """Return the same for photographs of which none sees the mesh."""
        for frame, view in blind:
            if frame.name in self.tried:
                self._try(frame, view, *self._photo(frame, view, 1.0))
        known = self.inputs.transforms.known
        return alignment.explain_edges(self.trials, self._surface_along, self.conventions, known, 0.0)

    def _try(self, frame: Frame, view: View, photo: np.ndarray, valid: np.ndarray) -> None:
        small = alignment.shrunk(_pinhole(view), alignment.EDGE_WIDTH)
        self.trials.append((frame, small, *images.reduce_area(photo, valid, small.width, small.height)))

    def _edge_advice(self) -> str:
        """Say which other convention fits the edges of the photographs clearly better."""
        known = self.inputs.transforms.known
        now = self.alignment.report()["edge_correlation"]
        return alignment.explain_edges(self.trials, self._surface_along, self.conventions, known, now)

    def _depth_along(self, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
        return self._surface_along(origin, rays)[0]

    def _surface_along(self, origin: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return z-depth (h, w) with 0 = miss, and normals (h, w, 3), along rays (h, w, 3)."""
        from iif_core.light.transport.geometry import trace

        face, t = trace(self.geometry, origin, rays.reshape(-1, 3))
        normal = np.where(face[:, None] >= 0, self.normals[face], 0)
        return np.where(face >= 0, t, 0).reshape(rays.shape[:2]), normal.reshape(*rays.shape[:2], 3)

    def _given_exposures(self) -> list[float]:
        frames = self.inputs.transforms.frames
        if self.inputs.gains is not None and self.settings.exposure == "given":
            return list(self.inputs.gains)
        if self.inputs.exposures is None:
            if self.settings.exposure == "given" and len(frames) > 1:
                self.notes.append(
                    "no exposures.json: the photographs count as equally exposed; with automatic exposure, set"
                    " `capture: {exposure: estimate}`"
                )
            return [1.0] * len(frames)
        if self.settings.exposure == "estimate":
            self.notes.append("exposures.json is not used: `capture.exposure` is estimate")
            return [1.0] * len(frames)
        return exposure.read_given(self.inputs.exposures, [(f.name, f.file_path) for f in frames])

    def _estimated(self, shared: exposure.SharedSurface, used: list[Frame], views: list[View]) -> list[View]:
        """Return the views with estimated exposures; held-out views keep 1, because scoring estimates theirs."""
        every, own = views, [i for i, view in enumerate(views) if view.split != "test"]
        used, views = [used[i] for i in own], [views[i] for i in own]
        gains = shared.gains()
        apart = int((~gains.estimated).sum())
        groups = int(gains.group.max()) + 1
        if apart:
            self.notes.append(f"exposure: {apart} view(s) share no surface with others and keep exposure 1")
        if groups > 1:
            self.notes.append(f"exposure: the views fall into {groups} groups without shared surface; each has mean 1")
        if gains.pairs:
            low, high = gains.gain.min(), gains.gain.max()
            self.notes.append(f"exposure estimated from shared surface: {low:.3g} to {high:.3g} (residual {gains.residual:.3f})")
        if self.encoded:
            found = {v.view_id: replace(v, exposure=float(g)) for v, g in zip(views, gains.gain, strict=True)}
            return [found.get(v.view_id, v) for v in every]
        counts = dict(self.counts)
        for frame, view, gain in zip(used, views, gains.gain, strict=True):
            photo, valid = self._photo(frame, view, float(gain))
            self.writer.photo(view.name, photo, valid, encoded=False)
            self._extras(frame, view, photo, valid, self._trace(view)[1])
        self.counts = counts
        return every

    def _note_pixels(self, frames: tuple[Frame, ...]) -> None:
        words = {
            "non_finite": "NaN or infinite pixels are ignored",
            "transparent": "transparent pixels are ignored (alpha < 0.5)",
            "negative": "pixels with negative values were set to 0",
            "masked": f"masked pixels are ignored ({sum(f.mask is not None for f in frames)} masks)",
        }
        self.notes += [f"photographs: {self.counts[k]} {text}" for k, text in words.items() if self.counts[k]]
        grey, deep = "the same value in R, G and B", "values / 65535"
        meaning = {"grey": grey, "16-bit": deep, "16-bit grey": f"{deep}, the same in R, G and B"}
        self.notes += [f"photographs: {len(names)} {form}: {meaning[form]}" for form, names in sorted(self.forms.items())]
        turned = sum(f.turn != 1 for f in frames)
        if turned:
            self.notes.append(f"photographs: {turned} turned upright by their EXIF orientation, as `w` x `h` say")

    def _note_views(self, frames: tuple[Frame, ...], views: list[View]) -> None:
        aspects = (f.camera.fx / f.camera.fy for f in frames)
        ratio = next((aspect for aspect in aspects if abs(np.log(aspect)) > MAX_LOG_PIXEL_ASPECT), None)
        if ratio:
            self.notes.append(
                f"WARNING fl_x / fl_y is {ratio:.3g}: are the pixels that far from square, or is one of them wrong?"
            )
        if self.listed:
            tests = sum(v.split == "test" for v in views)
            every = "; `capture.test_every` is not used" if self.settings.test_every else ""
            self.notes.append(f"lists of the source keep {tests} of {len(views)} views for testing{every}")
        bent = [f for f in frames if not f.lens.is_identity]
        if bent:
            self.notes.append(f"lens distortion ({bent[0].lens.kind}) removed from {len(bent)} photographs")
        first = frames[0].camera
        if (views[0].width, views[0].height) != (first.width, first.height):
            self.notes.append(
                f"photographs of {first.width}x{first.height} reduced to {views[0].width}x{views[0].height} by the mean"
                f" of {'sensor values' if self.encoded else 'radiance'} over each pixel's area"
            )
        if self.inputs.instances and len(self.inputs.instances) < len(frames):
            self.notes.append(f"instances are given for {len(self.inputs.instances)} of {len(frames)} views")
        if self.mesh.from_nodes and self.mesh.names is not None:
            self.notes.append(f"the {len(self.mesh.names)} nodes of {self.inputs.mesh.name} serve as instances")


def _pinhole(view: View) -> Pinhole:
    return Pinhole(view.fx, view.fy, view.cx, view.cy, view.width, view.height)
