"""Source `folder`: the user's own scene, in the form that common tools write (docs/guide/own-data.md).

`raw_inputs` checks everything that headers and JSON can show, while Snakemake plans.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from iif_core.camera.alignment import Photo
from iif_core.camera.exposure import ExposureGains
from iif_core.camera.pinhole import up_axis
from iif_core.errors import InputError
from iif_core.reconstruction.frame import upward
from workflow.decisions import camera as camera_decisions
from workflow.decisions.record import Decision
from workflow.intake.documents import reading
from workflow.runtime.job import Job
from workflow.scene.normal_form import CaptureWriter, View
from workflow.settings.source import mesh_axes
from workflow.sources.folder_scene import (
    alignment,
    borders,
    exposure,
    held_out,
    images,
    mesh,
    notes,
    photographs,
    registration,
)
from workflow.sources.folder_scene.entries import evenly_spread
from workflow.sources.folder_scene.frames import Frame
from workflow.sources.folder_scene.inputs import Inputs, find_inputs
from workflow.sources.folder_scene.photographs import Photograph, decoded, photograph, pinhole, view_of
from workflow.sources.folder_scene.room import Room

MIN_COVERAGE = 0.01  # share of the rays of a view that must hit the mesh


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
    source, settings = job.settings.source, job.settings.capture
    conventions = alignment.Conventions(inputs.cameras.axes, inputs.metres, mesh_axes=mesh_axes(source.mesh_up))
    surface = _mesh(inputs, source)
    origin = surface.origin
    inputs, surface = inputs.from_origin(origin), surface.from_origin(origin)
    frames = inputs.cameras.frames
    poses = [conventions.pose(frame) for frame in frames]
    centres = np.array([pose[:3, 3] for pose in poses])
    mesh.check_size(inputs.mesh, surface, getattr(source, "unit", "m"), inputs.metres, centres)
    surface = surface.closed(source.close_holes)
    said = [*inputs.cameras.notes, *surface.notes, *notes.of_origin(origin)]
    exposures, words = exposure.given(inputs.exposures, frames, settings.exposure)
    said += words
    task = _Task(inputs, source, settings, conventions, Room.of(surface, job.threads))
    held, decision = _held_out(task, poses)
    task, names = replace(task, splits=held.split), [frame.name for frame in frames]
    said += held.notes(names)
    if source.borders == "leave_out":
        own = [frame for frame, split in zip(frames, held.split, strict=True) if split != "test"]
        task = replace(task, borders=borders.find_borders(own, task.encoded, decoded))
        said += borders.notes_of(task.borders)
    posed, forms = _registered(job, task, poses, exposures)
    said += [*posed.notes, *(f"view {name} left out: {reason}" for name, reason in posed.left_out.items())]

    taken = _take(job, task, posed, exposures, CaptureWriter(job.writer))
    said += taken.notes
    if not taken.views:
        raise InputError(_sees_nothing(task, taken))
    said += notes.of_dropped(taken.dropped, len(frames))
    used = sum(view.split != "test" for view in taken.views)
    said += notes.of_blank(inputs.cameras.path, taken.blank, used)
    said += _checked_alignment(task, taken)
    views = taken.views
    estimated = task.asks_exposures
    if estimated:
        found = taken.shared.gains()
        estimated = settings.exposure == "estimate" or not exposure.are_alike(found)
        said += notes.of_exposures(found, not estimated)
    if estimated:
        views = _exposed(task, taken, found, CaptureWriter(job.writer))
    said += notes.of_pixels(posed.frames, taken.counts, [*forms, *taken.forms])
    said += notes.of_views(posed.frames, views, task.listed, settings.test_every, task.encoded)
    said += notes.of_objects(posed.frames, surface, inputs.mesh.name)
    # Cameras see the scan alone: what an added wall would show is not what is there.
    closed = surface.enclosed(source.close, [view.world_from_camera for view in views])
    said += closed.notes[len(surface.notes) :]
    facts = held.facts(names), len(closed.faces) - len(surface.faces), estimated
    _write(job, task, posed, taken, views, closed, said, *facts, decision, origin)


@dataclass(frozen=True)
class _Task:
    """What the photographs of a scene are taken with; `splits`: `train` or `test` for each frame, once that is known; `borders`:
    of the photographs of each size that have some."""

    inputs: Inputs
    source: Any
    settings: Any
    conventions: alignment.Conventions
    room: Room
    splits: Sequence[str] = ()
    borders: Mapping[borders.Size, borders.Unpictured] = field(default_factory=dict)

    @property
    def asks_exposures(self) -> bool:
        """The photographs are asked for their exposures."""
        given = self.inputs.exposures, self.inputs.cameras.frames
        return exposure.are_asked_for(*given, self.settings.exposure, self.encoded)

    @property
    def encoded(self) -> bool:
        """The photographs hold sensor values and not radiance."""
        return self.settings.dynamic_range == "ldr"

    @property
    def listed(self) -> bool:
        """Lists of the source say which photographs are held out."""
        return any(frame.split for frame in self.inputs.cameras.frames)

    def spread(self, count: int) -> set[str]:
        """Return the names of at most `count` frames, evenly spread."""
        frames = self.inputs.cameras.frames
        return {frames[i].name for i in evenly_spread(len(frames), count)}

    def photograph(self, frame: Frame, view: View, gain: float) -> Photograph:
        """Decode the photograph of a frame at the size of its view."""
        found = self.borders.get((frame.camera.width, frame.camera.height))
        return photograph(frame, view, self.encoded, gain, None if found is None else found.all)

    def view(self, frame: Frame, pose: np.ndarray, number: int, gain: float, longest: float = np.inf) -> View:
        """Return the camera of a frame in the size of the capture, or `longest` if that is less."""
        limits = min(longest, self.settings.width), min(longest, self.settings.height)
        return view_of(frame, pose, number, limits, gain if self.encoded else 1.0)


@dataclass
class _Taken:
    """What was found while the photographs were taken.

    Attributes:
        frames, views: that see the mesh.
        dropped: name of a view that does not -> share of its rays that hit the mesh; blind: these frames and views.
        blank: `black` and `white` -> names of photographs that are so all over.
        counts, forms: of the files' pixels, and (form, name) of their format where it is unusual.
        aligned: comparisons with the mesh; trials: photographs to try other conventions on.
        shared: surface that several views show.
        notes: what a person should know.
    """

    frames: list[Frame]
    views: list[View]
    dropped: dict[str, float]
    blind: list[tuple[Frame, View]]
    blank: dict[str, list[str]]
    counts: Counter[str]
    forms: list[tuple[str, str]]
    aligned: alignment.Alignment
    trials: list[alignment.Trial]
    shared: exposure.SharedSurface
    notes: list[str]


def _mesh(inputs: Inputs, source: Any) -> mesh.Mesh:
    of_vertices = inputs.of_vertices() if inputs.of_vertices else None
    found = mesh.load(inputs.mesh, inputs.metres, of_vertices, mesh_axes(source.mesh_up))
    if found.from_nodes and any(frame.ids for frame in inputs.cameras.frames):
        found = replace(found, instance=None, names=None)
    return found


def _held_out(task: _Task, poses: Sequence[np.ndarray]) -> tuple[held_out.HeldOut, list[Decision]]:
    """Hold out what is asked for, and what repeats it; lists of the data set take precedence over `capture.test_every`.

    Raises:
        InputError: that leaves no photograph to use.
    """
    frames, every = task.inputs.cameras.frames, task.settings.test_every
    listed = [frame.split or "train" for frame in frames]
    if "test" not in listed and (task.listed or not every):
        return held_out.HeldOut(listed, {}, np.zeros(0), np.zeros(0)), []
    digests, focal, widths, depths = [], np.zeros(len(frames)), np.ones(len(frames)), np.full(len(frames), np.nan)
    for i, (frame, pose) in enumerate(zip(frames, poses, strict=True)):
        with reading(frame.image, "not a readable image"), frame.image.open("rb") as file:
            digests.append(hashlib.file_digest(file, "sha256").hexdigest())
        view = task.view(frame, pose, i, 1.0)
        focal[i], widths[i] = view.fx, view.width
        depth, face = task.room.seen(task.view(frame, pose, i, 1.0, held_out.DEPTH_WIDTH))
        depths[i] = np.median(depth[face >= 0]) if (face >= 0).any() else np.nan
    asked = None if task.listed else held_out.asked(poses, focal / widths, depths, every)
    found = held_out.hold_out(asked.split if asked else listed, digests, poses, focal, depths)
    if "train" not in found.split:
        fewer = "hold out fewer in its lists" if task.listed else "set `capture.test_every: 0`"
        raise InputError(
            f"{task.inputs.cameras.path}: every photograph that is not held out repeats a held-out one (the same file, or the"
            f" same place to a pixel), so none is left to use: remove repeated photographs, or {fewer}"
        )
    if not len(found.distance):  # fewer photographs than `capture.test_every`
        return found, []
    if asked is None:
        return found, [camera_decisions.held_out_by_lists(found.nearest)]
    return found, [camera_decisions.held_out(asked.step, every, asked.blocks, found.nearest)]


def _registered(
    job: Job, task: _Task, poses: list[np.ndarray], gains: list[float]
) -> tuple[registration.Registered, list[tuple[str, str]]]:
    """Return frames and poses registered with the mesh and the other photographs; also the (form, name) of those of an unusual
    format."""
    frames = task.inputs.cameras.frames
    if task.source.registration == "off":
        return registration.Registered(list(frames), poses, {}, {}, [], []), []
    photos: list[Photo | None] = []
    forms = []
    for i, (frame, pose) in enumerate(zip(frames, poses, strict=True)):
        view = task.view(frame, pose, i, gains[i], registration.WIDTH)
        depth, face = task.room.seen(view)
        photos.append(None)
        if (face >= 0).mean() < MIN_COVERAGE:
            continue
        one = task.photograph(frame, view, gains[i])
        held = task.splits[i] == "test"
        forms += [(one.form, frame.name)] * bool(one.form and not held)
        camera = (view.fx, view.fy), (view.cx, view.cy), pose
        photos[-1] = Photo(one.pixels, one.valid, depth, task.room.normals_of(face), *camera, held)
        job.progress(i + 1, len(frames), "photographs registered")
    return registration.register_frames(frames, poses, photos, task.conventions.axes, task.inputs.metres), forms


def _take(job: Job, task: _Task, posed: registration.Registered, gains: list[float], writer: CaptureWriter) -> _Taken:
    """Write photograph, G-buffer, object ids and truth of every view that sees the mesh."""
    shared, frames = exposure.SharedSurface(len(posed.frames), task.encoded), posed.frames
    out = _Taken([], [], {}, [], {"black": [], "white": []}, Counter(), [], alignment.Alignment.empty(), [], shared, [])
    tried, compared = task.spread(alignment.TRIAL_VIEWS), task.spread(alignment.COMPARED_VIEWS)
    for i, (frame, pose) in enumerate(zip(frames, posed.poses, strict=True)):
        if frame.name in posed.left_out:
            continue
        view = replace(task.view(frame, pose, len(out.views), gains[i]), split=task.splits[i])
        depth, face = task.room.seen(view)
        share = float((face >= 0).mean())
        if share < MIN_COVERAGE:
            out.dropped[frame.name] = share
            out.blind.append((frame, view))
            continue
        one = task.photograph(frame, view, gains[i])
        seen = one.without_black(task.encoded)
        writer.gbuffer(view.name, depth, face)
        _write_photograph(task, writer, frame, view, seen, face)
        out.views.append(view)
        out.frames.append(frame)
        job.progress(i + 1, len(frames), "photographs")
        if view.split == "test":  # a held-out photograph is copied, and nothing is found out about it
            continue
        out.counts.update(one.counts)
        out.forms += [(one.form, frame.name)] * bool(one.form)
        if not one.valid.any():
            out.notes.append(f"view {view.name}: no usable pixel (all transparent, masked or NaN)")
        if blank := one.blank(task.encoded):
            out.blank[blank].append(view.name)
        if task.source.alignment != "off":
            out.aligned.add_depth(frame, task.conventions, pinhole(view), depth, task.inputs.cameras.depth_unit)
            edges = alignment.edge_pictures(seen.pixels, seen.valid, depth, task.room.normals_of(face))
            out.aligned.add_edges(frame.name, *edges, frame.name in compared)
            out.trials += [_trial(frame, view, seen)] * (frame.name in tried)
        if task.asks_exposures:
            points = view.world_from_camera[:3, 3] + depth[..., None] * view.directions()
            shared.add(seen.pixels, seen.valid & (face >= 0), points, float(np.median(depth[face >= 0])) / view.fx)
    return out


def _write_photograph(task: _Task, writer: CaptureWriter, frame: Frame, view: View, one: Photograph, face: np.ndarray) -> None:
    """Write the photograph of a view, and its object ids and truth where there are any; `face`: (H, W) what it meets."""
    writer.photo(view.name, one.pixels, one.valid, task.encoded)
    if frame.ids:
        writer.given_instances(view.name, photographs.object_ids(frame, view, task.inputs.load_ids))
    if frame.truth:
        writer.truth(view.name, photographs.truth(frame, view, one, task.encoded, face))


def _trial(frame: Frame, view: View, one: Photograph) -> alignment.Trial:
    small = alignment.shrunk(pinhole(view), alignment.EDGE_WIDTH)
    return frame, small, *images.reduce_area(one.pixels, one.valid, small.width, small.height)


def _exposed(task: _Task, taken: _Taken, found: ExposureGains, writer: CaptureWriter) -> list[View]:
    """Return the views with exposures that were found. Held-out views keep 1, because scoring estimates theirs; radiance is
    written again, divided by its exposure."""
    own = [i for i, view in enumerate(taken.views) if view.split != "test"]
    if task.encoded:
        gain = {taken.views[i].view_id: float(g) for i, g in zip(own, found.gain, strict=True)}
        return [replace(v, exposure=gain[v.view_id]) if v.view_id in gain else v for v in taken.views]
    for i, gain in zip(own, found.gain, strict=True):
        frame, view = taken.frames[i], taken.views[i]
        one = task.photograph(frame, view, float(gain)).without_black(task.encoded)
        _write_photograph(task, writer, frame, view, one, task.room.seen(view)[1])
    return taken.views


def _write(
    job: Job,
    task: _Task,
    posed: registration.Registered,
    taken: _Taken,
    views: list[View],
    surface: mesh.Mesh,
    said: list[str],
    held: dict[str, object],
    added: int,
    estimated: bool,
    decided: list[Decision],
    origin: np.ndarray,
) -> None:
    writer = CaptureWriter(job.writer)
    writer.cameras(views)
    writer.mesh(surface.vertices, surface.faces, surface.instance, surface.names)
    facts = {
        "alignment": taken.aligned.report(),
        "dropped_views": taken.dropped,
        "left_out_views": posed.left_out,
        "registration": posed.facts,
        "plan": [*posed.plan, *decided],
        "origin": origin.tolist(),
        "exposure_estimated": estimated,
        "stated_exposure": _stated(task, posed.frames),
        **_upward(surface, views, said),
        **({"held_out": held} if held else {}),
        **({"added_faces": added} if added else {}),
    }
    has_truth = any(frame.truth for frame in posed.frames)
    writer.finish(task.source.kind, task.settings.dynamic_range, has_truth, said, task.inputs.response, facts)
    for note in said:
        job.log.info("%s", note)


def _upward(surface: mesh.Mesh, views: list[View], said: list[str]) -> dict[str, list[float]]:
    """Return `up`, an entry of capture.json, where the capture leans in its coordinates, and say so. Else the reader takes the
    axis nearest to the cameras' (`CaptureReader.up`)."""
    poses = np.stack([view.world_from_camera for view in views])
    axis = up_axis(poses)
    up = upward(surface.vertices, surface.faces, poses, axis)
    if (up == axis).all():
        return {}
    angle = np.degrees(np.arccos(np.clip(up @ axis, -1.0, 1.0)))
    shown = ", ".join(f"{value:.3f}" for value in up)
    said.append(
        f"the room leans by {angle:.0f} degrees in its coordinates: up is ({shown}), by its level surface; exports stand upright"
    )
    return {"up": up.tolist()}


def _stated(task: _Task, frames: Sequence[Frame]) -> dict[str, float]:
    """Exposures t S / N^2 that the files of photographs through a response state, by the names of the views. A lens of unknown f
    number counts as f/1 where no photograph states one, as with telephones; otherwise such photographs state nothing."""
    if not task.encoded:
        return {}
    told = {frame.name: stated for frame in frames if (stated := images.header(frame.image).stated) is not None}
    if any(stated.number is not None for stated in told.values()):
        told = {name: stated for name, stated in told.items() if stated.number is not None}
    return {name: stated.time_speed / (stated.number or 1.0) ** 2 for name, stated in told.items()}


# ------------------------------------------------------------------------------------------------------------- alignment


def _checked_alignment(task: _Task, taken: _Taken) -> list[str]:
    """Return notes about how well photographs and mesh fit.

    Raises:
        InputError: they do not, and `source.alignment` is `check`.
    """
    mode, tolerance = task.source.alignment, alignment.TOLERANCE
    if mode == "off":
        return ["alignment was not checked (`source.alignment: off`)"]
    out, path = taken.aligned.notes(tolerance), task.inputs.cameras.path
    pairs = list(zip(taken.frames, taken.views, strict=True))
    alone = task.source.kind == "photographs"
    poor = "The photographs tell too little of the room: take more of them, closer to each other, and of things with texture"
    message = taken.aligned.refuse(path, tolerance, lambda: poor if alone else _better_depth(task, pairs))
    alignment.raise_or_note(message, mode, out)
    # Points by which the cameras themselves were found say more than edges, of which a mesh made from photographs has few.
    by_points = alone and 2 * len(taken.aligned.ratios) > len(taken.views)
    warning, better = "" if by_points else taken.aligned.edge_warning(tolerance), ""
    if warning and not taken.aligned.ratios:
        better = _better_edges(task, taken.trials, taken.aligned.report()["edge_correlation"])
    if better:
        message = f"{path}: photographs and mesh do not belong together as read: {better}. To continue anyway:"
        alignment.raise_or_note(f"{message} `source.alignment: warn`", mode, out)
    alignment.raise_or_note(warning, "warn", out)
    return out


def _sees_nothing(task: _Task, taken: _Taken) -> str:
    """Say that no camera sees the mesh, and which other convention would change that."""
    tried = task.spread(alignment.TRIAL_VIEWS)
    better = _better_depth(task, taken.blind)
    if not better:
        seen = [(f, v) for f, v in taken.blind if f.name in tried and v.split != "test"]
        better = _better_edges(task, [_trial(f, v, task.photograph(f, v, 1.0)) for f, v in seen], 0.0)
    listed = task.inputs.cameras
    return (
        f"{listed.path}: none of {len(listed.frames)} cameras sees {task.inputs.mesh.name} (rays that"
        f" hit it: {max(taken.dropped.values()):.1%} at most); "
        + (better or f"mesh and poses differ in frame or unit, or their axes ({task.conventions.axes}) are wrong")
        + " (docs/guide/own-data.md)"
    )


def _better_depth(task: _Task, seen: list[tuple[Frame, View]]) -> str:
    """Say which other convention fits the depth images or sparse points; empty without them."""
    pairs = [(f, pinhole(v)) for f, v in seen if f.depth is not None or (f.seen is not None and len(f.seen))]
    if not pairs:
        return ""
    listed, tolerance = task.inputs.cameras, alignment.TOLERANCE
    given = listed.known, listed.depth_unit, tolerance, task.room.size
    return alignment.explain(pairs, task.room.depth_along, task.conventions, *given)


def _better_edges(task: _Task, trials: list[alignment.Trial], now: float) -> str:
    """Say which other convention fits the edges of the photographs clearly better than the one in use, which has `now`."""
    return alignment.explain_edges(trials, task.room.along, task.conventions, task.inputs.cameras.known, now, task.room.size)
