"""Pictures of a world: of all light together, or of every lamp by itself; what was traced before is taken over."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from iif_core.errors import InputError
from workflow.models.denoise import denoise, require_denoiser
from workflow.relighting.camera import Flight, check_way, plan_flight
from workflow.relighting.inventory import Inventory, check_places
from workflow.relighting.world import World, build_world
from workflow.runtime import device
from workflow.runtime.fingerprint import raw_digest
from workflow.runtime.job import Job
from workflow.scene.named import new_names
from workflow.scene.normal_form import CaptureReader
from workflow.scene.recovered import Recovered, read_recovered
from workflow.settings.relight import key_of

Array = np.ndarray
_SEEDS = 0x72656C69  # keeps the random streams of relightings apart from those of other stages


@dataclass
class Studio:
    """What every relighting of a job starts from.

    Attributes:
        capture, room, inventory: the photographs, the recovered room, and what can be named in it.
        up: (3,) unit vector.
    """

    job: Job
    capture: CaptureReader
    room: Recovered
    inventory: Inventory
    up: Array

    @staticmethod
    def open(job: Job) -> Studio:
        """Read what stages before left; the job needs capture, segmentation, base, emission and affines upstream."""
        capture, room = CaptureReader(job.read("capture")), read_recovered(job)
        inventory = Inventory.read(job.read("segmentation"), job.read("emission"), new_names(job))
        return Studio(job, capture, room, inventory, capture.up / np.linalg.norm(capture.up))

    def flight(self, entry: dict[str, Any]) -> Flight:
        """Return the frames of a dumped relighting, whose way is free.

        Raises:
            InputError: a view does not exist, something is far from the room, or the way leads through surface.
        """
        corners = self.room.surface.vertices[self.room.surface.faces.ravel()]
        check_places(entry, corners.min(0), corners.max(0))
        flight = plan_flight(self.capture, entry, self.up)
        if entry["camera"]["frames"] > 1 and not entry["camera"]["through_surface"]:
            device.mitsuba()
            geometry, _ = self.room.surface.traceable()
            check_way(flight, geometry, self.room.surface.object_id, self.room.object_names, entry)
        return flight

    def world(self, state: dict[str, Any], time: float = 0.0) -> World:
        """Return the world of a relighting (`build_world`)."""
        return build_world(self.room, self.inventory, state, self.up, time)

    def seed(self, state: dict[str, Any], frame: int) -> int:
        """Return the seed of a frame, which depends on nothing that does not change it."""
        return (((self.job.seed << 32) | _SEEDS) << 48 | int(key_of(state), 16)) << 32 | frame

    def depends_on(self, what: Any, files: Iterable[Path]) -> str:
        """Return the digest of all that a picture depends on: `what`, the contents of `files`, the room and the code."""
        made = self.job.writer.provenance
        inputs = {name: one["fingerprint"] for name, one in made.get("inputs", {}).items() if name != "lamp_images"}
        facts = {
            "what": what,
            "files": raw_digest(list(files)),
            "code": made.get("code"),
            "inputs": inputs,
            "seed": self.job.seed,
        }
        return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:16]


def trace_picture(world: World, weights: Array, flight: Flight, frame: int, state: dict[str, Any], seed: int) -> Array:
    """Path-trace one frame, (H, W, 3) float32 radiance.

    Args:
        world: the room; weights: (L, 3) factors on the white light of its lamps.
        flight: the camera; frame: of it.
        state: `samples`, `max_bounces` and `denoise` of the relighting; seed: any integer >= 0.
    """
    from iif_core.light.transport.render import render
    from iif_core.light.transport.scene import PathOptions

    eye, directions, jitter = flight.rays(frame)
    paths = PathOptions(state["samples"], state["max_bounces"], seed)
    radiance = render(world.scene(weights), eye, directions, paths, jitter).reshape(flight.height, flight.width, 3)
    return _cleaned(radiance[None], world, flight, frame, state)[0]


def trace_lamps(world: World, flight: Flight, frame: int, state: dict[str, Any], seed: int) -> Array:
    """Path-trace one frame for every lamp by itself, (L, H, W, 3) float32 radiance of its white light; arguments as in
    `trace_picture`."""
    from iif_core.light.transport.lamps import render_lamps
    from iif_core.light.transport.scene import PathOptions

    eye, directions, jitter = flight.rays(frame)
    paths = PathOptions(state["samples"], state["max_bounces"], seed)
    lamps = len(world.columns)
    found = render_lamps(world.scene(), world.lamp_of_face, lamps, eye, directions, paths, jitter, world.environment_lamp)
    return _cleaned(found.transpose(1, 0, 2).reshape(lamps, flight.height, flight.width, 3), world, flight, frame, state)


def _cleaned(pictures: Array, world: World, flight: Flight, frame: int, state: dict[str, Any]) -> Array:
    """Denoise pictures (n, H, W, 3) of one frame where that is wanted."""
    if not np.isfinite(pictures).all():
        raise InputError(f"relighting, frame {frame}: radiance is not finite; please report it with the scene")
    if not state["denoise"]:
        return pictures
    from iif_core.light.transport.render import first_hits

    require_denoiser()
    eye, directions, _ = flight.rays(frame)
    albedo, normals, _ = first_hits(world.geometry, world.material, eye, directions)
    guides = albedo.reshape(pictures.shape[1:]), normals.reshape(pictures.shape[1:])
    return np.stack([denoise(picture, *guides) if picture.any() else picture for picture in pictures])
