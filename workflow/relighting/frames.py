"""The frames of a relighting, each a sum of pictures of single lamps or path-traced."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from iif_core.light.relighting import sum_of_lamps
from workflow.artifacts.store import rgb, split_rgb
from workflow.models.denoise import require_denoiser
from workflow.relighting.camera import Flight
from workflow.relighting.inserts import light_of, load_insert
from workflow.relighting.lamp_files import lamp_pictures
from workflow.relighting.tracing import Studio, trace_picture
from workflow.relighting.video import require_codec
from workflow.relighting.world import AS_FOUND, World, lamp_weights
from workflow.settings.relight import all_files_of, key_of, lamp_basis, recombines

Array = np.ndarray


@dataclass
class Frames:
    """A relighting that was checked: what it starts from, its settings, its camera, and the lamps that it is a sum of."""

    studio: Studio
    entry: dict[str, Any]
    flight: Flight
    basis: dict[str, Any] | None
    before: dict[str, Any]
    before_basis: dict[str, Any] | None
    worlds: dict[tuple[str, float], World] = field(default_factory=dict)

    @staticmethod
    def checked(studio: Studio, bases: dict[str, dict[str, Any]], entry: dict[str, Any]) -> Frames:
        """Check a relighting.

        Args:
            studio: the room.
            bases: key -> what stage lamp_images says of the pictures that it made.
            entry: the dumped relighting.

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
        return Frames(studio, entry, flight, basis, before, bases.get(key_of(lamp_basis(before))))

    def __len__(self) -> int:
        return len(self.flight.poses)

    def picture(self, frame: int) -> Array:
        """Return a frame of the relighting, (H, W, 3) float32 radiance."""
        return self._made(self.basis, self.entry, "frame", frame)

    def picture_before(self, frame: int) -> Array:
        """Return the room as it was found, from the camera of a frame."""
        return self._made(self.before_basis, self.before, "before", frame)

    def _made(self, basis: dict[str, Any] | None, entry: dict[str, Any], name: str, frame: int) -> Array:
        if basis:
            return self._summed(basis, entry, frame)
        return self._traced(f"{self.entry['name']}/{name}_{frame:04d}.exr", entry, frame)

    def _summed(self, basis: dict[str, Any], entry: dict[str, Any], frame: int) -> Array:
        job, columns = self.studio.job, basis["columns"]
        with job.timed("sums of lamps"):
            channels = job.read("lamp_images").exr(f"{basis['key']}/frame_{frame:04d}.exr")
            level, found = (np.asarray(basis[name], np.float64) for name in ("level", "found"))
            weights = lamp_weights(entry, self.studio.inventory, columns, level, found)
            return sum_of_lamps(lamp_pictures(channels, len(columns)), weights)

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
