"""relight: renders the recovered scene under other light, edited, and along other camera paths
(docs/method/light.md#relighting)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from iif_core.camera.response import Response, response
from iif_core.light.relighting import exposure_for, sum_of_lamps
from iif_core.numerics.color import to_uint8
from workflow.artifacts.store import rgb, split_rgb
from workflow.models.denoise import require_denoiser
from workflow.relighting import sheet
from workflow.relighting.camera import Flight, photograph_exposure
from workflow.relighting.check import blamed_on_plan
from workflow.relighting.inserts import light_of, load_insert
from workflow.relighting.tracing import Studio, trace_picture
from workflow.relighting.video import encoded, require_codec
from workflow.relighting.world import AS_FOUND, World, lamp_weights
from workflow.runtime.job import Job
from workflow.scene.base_scene import read_gains
from workflow.scene.recovered import read_response
from workflow.settings import require_relighting
from workflow.settings.relight import all_files_of, key_of, lamp_basis, recombines
from workflow.stages.lamp_images import channel

Array = np.ndarray


def run(job: Job) -> None:
    """Write <name>/frame_<i>.exr and .png of every relighting, before_<i>.exr and .png, video.mp4, contact_sheet.png and
    relight.json."""
    wanted = require_relighting({"relight": job.settings.relight}, job.scene)
    studio = Studio.open(job)
    bases = {one["key"]: one for one in job.read("lamp_images").json("lamp_images.json")["bases"]}
    with blamed_on_plan(job.scene):
        prepared = [_prepare(studio, bases, entry) for entry in wanted]  # whatever is wrong stops the stage before any work
    curve = response("srgb") if studio.capture.is_hdr else read_response(job.read("affines"))
    facts, rows = [], []
    for one in prepared:
        made, row = _relight(one, curve)
        facts.append(made)
        rows.append(row)
    job.writer.bytes("contact_sheet.png", sheet.png(sheet.contact_sheet(rows, job.settings.relight_title)))
    job.writer.json("relight.json", {"title": job.settings.relight_title, "relightings": facts, "up": studio.up.tolist()})


@dataclass
class _Prepared:
    """A relighting that was checked: what it starts from, its settings, its frames, and the lamps that it is a sum of."""

    studio: Studio
    entry: dict[str, Any]
    flight: Flight
    basis: dict[str, Any] | None
    before: dict[str, Any]
    before_basis: dict[str, Any] | None
    worlds: dict[tuple[str, float], World] = field(default_factory=dict)

    def picture(self, frame: int) -> Array:
        """Return a frame of the relighting, (H, W, 3) float32 radiance."""
        name, entry = f"{self.entry['name']}/frame_{frame:04d}.exr", self.entry
        return self._summed(self.basis, entry, frame) if self.basis else self._traced(name, entry, frame)

    def picture_before(self, frame: int) -> Array:
        """Return the room as it was found, from the camera of a frame."""
        name, entry = f"{self.entry['name']}/before_{frame:04d}.exr", self.before
        return self._summed(self.before_basis, entry, frame) if self.before_basis else self._traced(name, entry, frame)

    def _summed(self, basis: dict[str, Any], entry: dict[str, Any], frame: int) -> Array:
        job = self.studio.job
        with job.timed("sums of lamps"):
            channels = job.read("lamp_images").exr(f"{basis['key']}/frame_{frame:04d}.exr")
            level, found = (np.asarray(basis[name], np.float64) for name in ("level", "found"))
            weights = lamp_weights(entry, self.studio.inventory, basis["columns"], level, found)
            lamps = range(len(basis["columns"]))
            pictures = [np.stack([channels[channel(lamp, c)] for c in "RGB"], -1).astype(np.float32) for lamp in lamps]
            return sum_of_lamps(np.stack(pictures), weights)

    def _traced(self, name: str, entry: dict[str, Any], frame: int) -> Array:
        """Trace a frame, or take over the file that an earlier job wrote of it."""
        job, state, time = self.studio.job, lamp_basis(entry), float(self.flight.times[frame])
        lights = {key: entry[key] for key in ("emitters", "lamps", "environment", "environment_turn")}
        part = name.removesuffix(".exr").replace("/", ".")
        by = self.studio.depends_on([state, lights, frame], all_files_of(entry))
        if job.writer.part_kept(part, by) is not None:
            return rgb(job.writer.channels(name))
        with job.timed("paths"):
            moves = bool(state["sphere"] and state["sphere"]["path_to"])
            at = (key_of(state), time if moves else 0.0)
            if at not in self.worlds:
                self.worlds = {at: self.studio.world(state, at[1])} if moves else {**self.worlds, at: self.studio.world(state)}
            world = self.worlds[at]
            weights = lamp_weights(entry, self.studio.inventory, world.columns, world.level, world.found)
            radiance = trace_picture(world, weights, self.flight, frame, state, self.studio.seed(state, frame))
        job.writer.exr(name, split_rgb(radiance), "relative")
        job.writer.part_done(part, [name], {}, by)
        return radiance


def _prepare(studio: Studio, bases: dict[str, dict[str, Any]], entry: dict[str, Any]) -> _Prepared:
    """Check a relighting.

    Raises:
        InputError: a lamp, an object, a view or a codec does not exist, the way of the camera leads through surface, or the
            denoiser does not load.
    """
    studio.inventory.check(entry)
    flight = studio.flight(entry)
    if entry["denoise"]:
        require_denoiser()
    for insert in entry["insert"]:
        mesh = load_insert(Path(insert["file"]))
        light_of(mesh, insert)
        if mesh.left_out and insert["material"] is None:
            left_out = " and ".join(mesh.left_out)
            studio.job.log.warning("relighting %s: %s of %s are left out", entry["name"], left_out, insert["file"])
    if len(flight.poses) > 1 and entry["video"]:
        require_codec(entry["video"]["codec"], entry["name"])
    before = {**entry, **AS_FOUND}
    basis = bases[key_of(lamp_basis(entry))] if recombines(entry) else None
    return _Prepared(studio, entry, flight, basis, before, bases.get(key_of(lamp_basis(before))))


def _relight(one: _Prepared, curve: Response) -> tuple[dict[str, Any], sheet.Row]:
    """Write all frames of a relighting; returns its facts and its row of the contact sheet."""
    job, entry, flight = one.studio.job, one.entry, one.flight
    name, frames, shown = entry["name"], len(flight.poses), sheet.shown_frames(len(flight.poses))
    before = {frame: one.picture_before(frame) for frame in shown}
    display = _display(one, curve, before[shown[0]])
    pairs, is_dark = [], True

    def pictures() -> Iterator[Array]:
        nonlocal is_dark
        for frame in range(frames):
            job.progress(frame, frames, f"frames of {name}")
            radiance = one.picture(frame)
            picture = display(radiance)
            _write(job, f"{name}/frame_{frame:04d}", radiance, picture)
            is_dark &= not picture.any()
            if frame in before:
                was = display(before[frame])
                _write(job, f"{name}/before_{frame:04d}", before[frame], was)
                pairs.append(sheet.Pair(was, picture, f"frame {frame}" if frames > 1 else ""))
            yield picture

    if frames > 1 and entry["video"]:
        video = entry["video"]
        job.writer.bytes(f"{name}/video.mp4", encoded(pictures(), video["fps"], video["codec"]))
    else:
        for _ in pictures():
            pass
    job.progress(frames, frames, f"frames of {name}")
    facts = {
        "name": name,
        "changes": sheet.described(entry),
        "frames": frames,
        "method": "recombined" if one.basis else "path traced",
        "exposure": float(np.exp(np.mean(np.log(display.factor)))),
        "white_balance": (display.factor / np.exp(np.mean(np.log(display.factor)))).tolist(),
        "exposure_of": display.source,
        "poses": flight.poses.reshape(-1, 16).tolist(),
    }
    if is_dark:
        facts["note"] = "black: no light is on, or none reaches the room"
        job.log.warning("relighting %s is %s", name, facts["note"])
    return facts, sheet.Row(f"{name}: {sheet.described(entry)} (exposure {display.source})", pairs)


def _write(job: Job, name: str, radiance: Array, picture: Array) -> None:
    if f"{name}.exr" not in job.writer.files:
        job.writer.exr(f"{name}.exr", split_rgb(radiance), "relative")
    job.writer.bytes(f"{name}.png", sheet.png(picture))


@dataclass(frozen=True)
class _Display:
    """Turns radiance into pictures: factor (3,), then the curve. `source`: text that says where the exposure is from."""

    factor: Array
    curve: Response
    source: str

    def __call__(self, radiance: Array) -> Array:
        return to_uint8(self.curve(np.clip(self.factor * radiance, 0, 1)))


def _display(one: _Prepared, curve: Response, before: Array) -> _Display:
    """Return how the pictures of a relighting are shown; `before` is the first frame of the room as it was found.

    All frames share one exposure. That of a photograph includes its white balance where the pictures go through the response of
    the camera; `before` takes the place of linear photographs, which have no exposure.
    """
    wanted, studio = one.entry["exposure"], one.studio
    taken = photograph_exposure(studio.capture, read_gains(studio.job), one.flight.view)
    own = one.entry["response"] == "srgb"
    curve = response("srgb") if own else curve
    level = None if taken is None else float(np.exp(np.mean(np.log(taken))))
    balance = np.ones(3) if own or taken is None else taken / level
    if wanted == "auto":
        return _Display(exposure_for(one.picture(0)) * balance, curve, "by the first frame")
    if wanted != "photograph":
        return _Display(float(wanted) * balance, curve, f"{wanted:g}")
    if taken is None:
        return _Display(np.full(3, exposure_for(before)), curve, "by the room as found")
    return _Display(level * balance, curve, f"of photograph {one.flight.view.name}")
