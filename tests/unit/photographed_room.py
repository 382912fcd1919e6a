"""Photographs of a planted room in memory, as the search for its light is given them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from iif_core.camera.gains import CameraGains
from iif_core.camera.pixels import ViewMaps
from iif_core.camera.response import response
from iif_core.camera.view import View
from iif_core.light.base_scene import BaseScene
from iif_core.light.emission.options import EmissionOptions, Log
from iif_core.light.emission.photographs import Photographs, ViewRecord
from iif_core.light.emission.sensor import Sensor
from iif_core.light.tracer import Tracer
from iif_core.surface.cells import grid_origin, voxel_indices
from iif_core.surface.segments import face_adjacency
from iif_core.surface.triangles import face_geometry
from tests.workflow.light_room import CELL, Room

OPTIONS = EmissionOptions(seed=0, min_observations=8, cache_edge=0.06, rows=3000, samples=16, max_bounces=6, prune=0.01)


class Kept(dict):
    """Records of all pixels of the views, by their numbers."""

    share = 1.0

    def __getitem__(self, view: View) -> ViewRecord:
        return super().__getitem__(view.view_id)


def base_scene(room: Room) -> BaseScene:
    """The room with its true materials, one cell for each face; objects have the mean of their faces."""
    normals, areas = face_geometry(room.vertices, room.faces)
    middle, count = room.vertices[room.faces].mean(1), len(room.names)
    origin = grid_origin(room.vertices[room.faces.ravel()], CELL)
    ijk = voxel_indices(middle, CELL, origin)
    first = np.unique(np.column_stack([ijk, room.object_id]), axis=0, return_index=True)[1]
    means = np.stack([room.material[room.object_id == o].mean(0) for o in range(count)]).astype(np.float32)
    return BaseScene(
        vertices=room.vertices.astype(np.float32),
        faces=room.faces,
        object_id=room.object_id,
        normals=normals,
        areas=areas,
        n_objects=count,
        cell_edge=CELL,
        cell_origin=origin,
        cell_ijk=ijk[first],
        cell_object=room.object_id[first],
        cell_values=room.material[first],
        object_values=means,
    )


def photographed(
    room: Room, views: int = 4, size: int = 24, samples: int = 32, sky: float = 0.0
) -> tuple[Photographs, list[str]]:
    """Linear photographs of a room under its light, and the list that fills with what is said about them."""
    from iif_core.light.transport.emitters import Emitters
    from iif_core.light.transport.geometry import build_geometry, trace
    from iif_core.light.transport.render import render
    from iif_core.light.transport.scene import PathOptions, Scene
    from tests.oracles.face_materials import FaceMaterials

    geometry = build_geometry(room.vertices, room.faces, room.object_id, room.transmittance)
    scanned = build_geometry(room.vertices, room.faces, room.object_id)
    world = Scene(
        geometry, FaceMaterials(room.material), Emitters(geometry, room.emission, room.side, environment=np.full(3, sky))
    )
    scene, cameras, records, said = base_scene(room), room.views(views, size, np.ones(views)), Kept(), []
    for view in cameras:
        origin, rays = view.world_from_camera[:3, 3], view.directions().reshape(-1, 3)
        face, depth = trace(scanned, origin, rays)
        photo = render(world, origin, rays, PathOptions(samples, 10, 1000 + view.view_id)).reshape(size, size, 3)
        met = face.reshape(size, size)
        objects = np.where(met >= 0, room.object_id[met], -1)
        inner = np.ones((size, size), bool)
        for axis, shift in ((0, 1), (0, -1), (1, 1), (1, -1)):
            inner &= np.roll(objects, shift, axis) == objects
        maps = ViewMaps(
            camera=view,
            value=photo,
            valid=np.ones((size, size), bool),
            depth=np.where(met >= 0, depth.reshape(size, size), 0),
            face=met,
            object_id=objects,
            interior=inner,
        )
        base = np.where((face >= 0)[:, None], room.material[face], 0)
        records[view.view_id] = ViewRecord.of(maps, scene.normals, base)
    photos = Photographs(
        views=cameras,
        every=cameras,
        scene=scene,
        names=room.names,
        tracer=Tracer(scene),
        sensor=Sensor(response("identity"), True, 0.99),
        gains=CameraGains.plain(np.ones(views)),
        records=records,
        options=OPTIONS,
        log=Log(said.append),
    )
    return photos, said


def neighbours(photos: Photographs) -> np.ndarray:
    """(E, 2) pairs of neighbouring faces."""
    return face_adjacency(photos.scene.faces, photos.scene.vertices)


def of_views(photos: Photographs, change: Callable[[ViewRecord], ViewRecord], views: Sequence[int] | None = None) -> Photographs:
    """The photographs with other records of some views, None = all."""
    records = Kept(photos.records)
    for number in records if views is None else views:
        records[number] = change(records[photos.views[number]])
    return replace(photos, records=records)
