"""Surface that lets light through, such as curtains and blinds, and photographs of what lies behind it
(docs/method/light.md#surface-that-lets-light-through)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from iif_core.camera.view import View
from iif_core.light.base_scene import BaseScene
from iif_core.light.emission.photographs import Photographs, ViewRecord
from iif_core.light.emission.translucent import TRANSMITTANCE, is_brighter_where_open


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
    behind = photos.tracer.behind(sheer)
    objects, opens, brightness = [], [], []
    for view in photos.views:
        pixels = photos.records[view].pixels
        own = np.flatnonzero(pixels.valid & pixels.interior & behind.sheer[pixels.face])
        radiance, _ = photos.radiance(view, pixels.value[own], pixels.index[own])
        objects.append(scene.object_id[pixels.face[own]])
        opens.append(behind.is_open(_eye(view), -pixels.wo[own]))
        brightness.append(radiance.mean(1))
    parts = (np.concatenate(part) for part in (objects, opens, brightness))
    return some & is_brighter_where_open(*parts, scene.n_objects, photos.options.min_observations)


def seen_through(photos: Photographs, sheer: np.ndarray) -> Photographs:
    """Return the photographs of a scene in which the objects `sheer` (n_objects,) bool let light through: their pixels show
    the light from outside where nothing lies behind them, and nothing elsewhere."""
    scene = replace(photos.scene, transmittance=np.where(sheer, np.float32(TRANSMITTANCE), np.float32(0.0)))
    return replace(photos, scene=scene, tracer=photos.tracer.of(scene), records=_SeenThrough(photos, scene))


class _SeenThrough:
    """Records in which pixels on surface that lets light through are no pixels of that surface, but of the light from outside
    where they look at it, and of nothing elsewhere."""

    def __init__(self, photos: Photographs, scene: BaseScene):
        self.share, self._records, self._scene = photos.records.share, photos.records, scene
        self._behind = photos.tracer.behind(scene.passes > 0)
        self._escaping: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def __getitem__(self, view: View) -> ViewRecord:
        record = self._records[view]
        pixels = record.pixels
        if view.view_id not in self._escaping:
            own = np.flatnonzero(pixels.valid & pixels.interior & self._behind.sheer[pixels.face])
            out = own[self._behind.is_open(_eye(view), -pixels.wo[own])].astype(np.int32)
            share = self._scene.passes[pixels.face[out]] ** self._behind.sheets(_eye(view), -pixels.wo[out])
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


def _eye(view: View) -> np.ndarray:
    return view.world_from_camera[:3, 3]
