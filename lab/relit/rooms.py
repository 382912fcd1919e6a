"""A built-in room under new light, with its own geometry and textures."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from iif_core.camera.pinhole import direction_derivatives
from lab import rooms
from lab.relit.new_light import NewLight
from lab.rooms.patterns import MaterialTable
from lab.rooms.room import EMITTER_MATERIAL
from workflow.scene.normal_form import CaptureReader, View

if TYPE_CHECKING:
    from iif_core.light.transport.scene import Scene
    from workflow.runtime.job import Job

Array = np.ndarray


def room(job: Job, capture: CaptureReader) -> _Room:
    """Build the room that the settings name."""
    return _Room(rooms.build(job.settings.source.scene, job.settings.source.quarterings))


class _Room:
    def __init__(self, built: rooms.room.Room):
        self._room = built
        self._material = MaterialTable((*built.materials.materials, EMITTER_MATERIAL)).drjit()
        self._last: tuple[NewLight, Scene] | None = None

    def relit(self, light: NewLight, view: View, samples: int, max_bounces: int, seed: int) -> tuple[Array, Array]:
        from iif_core.light.transport.render import render
        from iif_core.light.transport.scene import PathOptions

        if self._last is None or self._last[0] != light:
            self._last = light, self._world(light)
        steps = direction_derivatives(view.fx, view.fy, view.world_from_camera)
        paths = PathOptions(samples, max_bounces, seed)
        image = render(self._last[1], view.world_from_camera[:3, 3], view.directions().reshape(-1, 3), paths, jitter=steps)
        return image.reshape(view.height, view.width, 3), np.ones((view.height, view.width), bool)

    def _world(self, light: NewLight) -> Scene:
        from iif_core.light.transport.emitters import Emitters
        from iif_core.light.transport.geometry import build_geometry
        from iif_core.light.transport.scene import Scene

        built = self._room
        vertices, faces, object_id = built.vertices, built.faces, built.object_id
        owner = np.zeros_like(object_id) if built.one_object else object_id
        own = (built.emission > 0).any(1) & (owner == light.lamp)
        radiance, extra = np.where(own[:, None], built.emission, 0), light.glowing_mesh()
        if light.shift is not None:
            extra = vertices + np.float32(light.shift), faces[own], radiance[own]
            faces, object_id, radiance = faces[~own], object_id[~own], radiance[~own]
        if extra is not None:
            faces = np.concatenate([faces, extra[1] + len(vertices)])
            vertices = np.concatenate([vertices, extra[0]])
            object_id = np.concatenate([object_id, np.full(len(extra[1]), len(built.materials.materials), np.int32)])
            radiance = np.concatenate([radiance, extra[2]])
        geometry = build_geometry(vertices.astype(np.float32), faces.astype(np.int32), object_id)
        outside = light.environment or (0.0, 0.0, 0.0)
        emitters = Emitters(geometry, radiance.astype(np.float32), np.ones(len(faces), np.int8), outside)
        return Scene(geometry, self._material, emitters)
