"""Surface that lets light through, such as curtains and blinds, and photographs of what lies behind it
(docs/method/light.md#surface-that-lets-light-through)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from iif_core.light.base_scene import BaseScene
from iif_core.light.emission.translucent import TRANSMITTANCE, is_brighter_where_open
from workflow.runtime import device
from workflow.runtime.job import Job
from workflow.scene.emission_pixels import Photographs, ViewRecord, ViewRecords
from workflow.scene.normal_form import View

MAX_SHEETS = 16
"""Folds of a curtain that one ray crosses, at most; light through more of them would not be seen."""


def translucent_objects(photos: Photographs, glowing: np.ndarray) -> np.ndarray:
    """Return (n_objects,) bool: objects that may let light through. Most of their surface glows (`glowing` (F,), -1 = not),
    and they are much brighter where nothing but other such objects lies behind them than where something else does."""
    scene = photos.scene
    known, area = scene.object_id >= 0, scene.areas
    whole = np.bincount(scene.object_id[known], area[known], scene.n_objects)
    glows = known & (glowing >= 0)
    some = np.bincount(scene.object_id[glows], area[glows], scene.n_objects) > 0.5 * whole
    sheer = np.append(some, False)[scene.object_id]
    if not some.any() or not area[~sheer].any():
        return np.zeros_like(some)
    behind = _Behind(scene, sheer)
    objects, opens, brightness = [], [], []
    for view in photos.views:
        pixels = photos.records[view].pixels
        own = np.flatnonzero(pixels.valid & pixels.interior & behind.sheer[pixels.face])
        radiance, _ = photos.radiance(view, pixels.value[own], pixels.index[own])
        objects.append(scene.object_id[pixels.face[own]])
        opens.append(behind.is_open(view, -pixels.wo[own]))
        brightness.append(radiance.mean(1))
    parts = (np.concatenate(part) for part in (objects, opens, brightness))
    return some & is_brighter_where_open(*parts, scene.n_objects, photos.job.settings.emission.min_observations)


def seen_through(photos: Photographs, sheer: np.ndarray) -> Photographs:
    """Return the photographs of a scene in which the objects `sheer` (n_objects,) bool let light through: their pixels show
    the light from outside where nothing lies behind them, and nothing elsewhere."""
    scene = replace(photos.scene, transmittance=np.where(sheer, np.float32(TRANSMITTANCE), np.float32(0.0)))
    return replace(photos, scene=scene, records=_SeenThrough(photos.records, photos.job, scene))


class _SeenThrough(ViewRecords):
    """Records in which pixels on surface that lets light through are no pixels of that surface, but of the light from outside
    where they look at it, and of nothing elsewhere."""

    def __init__(self, records: ViewRecords, job: Job, scene: BaseScene):
        super().__init__(job, records.capture, scene)
        self._records, self._behind = records, _Behind(scene, scene.passes > 0)
        self._escaping: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def __getitem__(self, view: View) -> ViewRecord:
        record = self._records[view]
        pixels = record.pixels
        if view.view_id not in self._escaping:
            own = np.flatnonzero(pixels.valid & pixels.interior & self._behind.sheer[pixels.face])
            out = own[self._behind.is_open(view, -pixels.wo[own])].astype(np.int32)
            share = self.scene.passes[pixels.face[out]] ** self._behind.sheets(view, -pixels.wo[out])
            self._escaping[view.view_id] = out, share.astype(np.float32)
        out, share = self._escaping[view.view_id]
        return replace(
            record,
            pixels=replace(pixels, valid=pixels.valid & ~self._behind.sheer[pixels.face]),
            escaping=np.concatenate([record.escaping, pixels.index[out]]),
            escaping_value=np.concatenate([record.escaping_value, pixels.value[out]]),
            escaping_direction=np.concatenate([record.escaping_direction, -pixels.wo[out]]),
            escaping_share=np.concatenate([record.escaping_share, share]),
        )


class _Behind:
    """What camera rays meet behind the faces `sheer`, (m,) bool, of a scene."""

    def __init__(self, scene: BaseScene, sheer: np.ndarray):
        device.mitsuba()
        from iif_core.light.transport.geometry import build_geometry

        self.sheer = sheer
        self._rest, self._sheets = (
            build_geometry(scene.vertices, scene.faces[part], scene.object_id[part]) for part in (~sheer, sheer)
        )

    def is_open(self, view: View, towards: np.ndarray) -> np.ndarray:
        """(n,) bool: no other surface lies on the rays of the camera, of directions (n, 3)."""
        from iif_core.light.transport.geometry import trace

        return trace(self._rest, view.world_from_camera[:3, 3], towards)[0] < 0

    def sheets(self, view: View, towards: np.ndarray) -> np.ndarray:
        """(n,) how often each ray meets `sheer` surface, at least once."""
        import mitsuba

        from iif_core.light.transport.arrays import to_numpy, vectors
        from iif_core.light.transport.geometry import offset_from, trace

        start = np.tile(view.world_from_camera[:3, 3], (len(towards), 1))
        count, going = np.zeros(len(towards), np.int64), np.arange(len(towards))
        for _ in range(MAX_SHEETS):
            face, distance = trace(self._sheets, start[going], towards[going])
            met = face >= 0
            going = going[met]
            if not len(going):
                break
            count[going] += 1
            at = start[going] + distance[met, None] * towards[going]
            past = offset_from(vectors(mitsuba.Point3f, at), vectors(mitsuba.Vector3f, towards[going]))
            start[going] = to_numpy(past)
        return np.maximum(count, 1)
