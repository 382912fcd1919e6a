"""Photographs in which light is looked for, and their pixels as statistics of faces, radiance cache and rows of the linear
system."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from iif_core.camera.gains import CameraGains
from iif_core.camera.pinhole import direction_derivatives
from iif_core.camera.pixels import ViewMaps, ViewPixels, pixel_gains, pixels_of_view
from iif_core.camera.view import View
from iif_core.light.base_scene import BaseScene, cache_origin
from iif_core.light.emission.cache import RadianceVoxels, VoxelPixels
from iif_core.light.emission.candidates import (
    FaceStatistics,
    face_statistics,
    glowing_pieces,
    radiance_threshold,
    with_thin_objects,
)
from iif_core.light.emission.environment import SkySums, cosine_directions
from iif_core.light.emission.gains import PRIOR_LEVEL_ERROR
from iif_core.light.emission.groups import EmitterGroups
from iif_core.light.emission.options import EmissionOptions, Log
from iif_core.light.emission.pixels import ANCHOR_PIXELS, EmissionPixels, choose_pixels, row_tile, tile_of
from iif_core.light.emission.sensor import Sensor
from iif_core.light.tracer import Tracer

STATISTICS_PIXELS = 20_000_000
"""Photographs are thinned to about this many pixels for the statistics of faces."""
COVERAGE_GRID = 6
"""Rays across a pixel on an emitter, in both directions, by which its share of the pixel is counted."""
SEEDS = 0x656D69  # keeps these random streams apart from those of other stages


@dataclass(frozen=True, kw_only=True)
class ViewRecord:
    """Everything that is read of one view, decoded.

    Attributes:
        pixels: the pixels that hit the mesh, with their base; without it for a held-out view.
        median_depth: metres, of the pixels with depth; None without any.
        counted: number of valid pixels of the whole photograph.
        escaping: (k,) flattened indices of the valid pixels that meet no surface.
        escaping_value, escaping_direction: (k, 3) what these pixels show, and their directions in the world.
        escaping_share: (k,) share of the light from outside that reaches these pixels; 1 but behind curtains.
        seen: faces that valid pixels of the whole photograph show; None = those of `pixels`, which are all.
    """

    pixels: ViewPixels
    median_depth: float | None
    counted: int
    escaping: np.ndarray
    escaping_value: np.ndarray
    escaping_direction: np.ndarray
    escaping_share: np.ndarray
    seen: np.ndarray | None = None

    @classmethod
    def of(cls, maps: ViewMaps, normals: np.ndarray, base: np.ndarray | None, among: np.ndarray | None = None) -> ViewRecord:
        """Collect what is read of a view.

        Args:
            maps: of the view, with objects and interior.
            normals: (m, 3) of the faces, 0 for degenerate ones.
            base: (H * W, 5) base albedo, roughness and metallic; None for a held-out view.
            among: (H, W) bool, pixels that are looked at; None = all.
        """
        seen = None
        if among is not None:
            seen = np.unique(maps.face[maps.valid & maps.hit & np.isfinite(maps.value).all(-1)])
        pixels = pixels_of_view(maps, normals, among, base)
        values = maps.value.reshape(-1, 3)
        counted = (maps.valid if among is None else maps.valid & among).ravel()
        out = counted & np.isfinite(values).all(1)
        out[pixels.index] = False
        direction = maps.camera.directions().reshape(-1, 3)[out]
        deep = maps.depth[maps.hit]
        return cls(
            pixels=pixels,
            median_depth=np.median(deep) if deep.size else None,
            counted=int(counted.sum()),
            escaping=np.flatnonzero(out),
            escaping_value=values[out],
            escaping_direction=direction,
            escaping_share=np.ones(int(out.sum()), np.float32),
            seen=seen,
        )


class Records(Protocol):
    """Records of views, decoded when they are asked for.

    Attributes:
        share: of the pixels of every photograph that the records hold.
    """

    share: float

    def __getitem__(self, view: View) -> ViewRecord: ...


@dataclass(frozen=True, kw_only=True)
class Photographs:
    """The views that are used, and what turns them into radiance."""

    views: list[View]
    every: list[View]  # of the capture, in order; the held-out ones too
    scene: BaseScene
    names: Sequence[str]  # of the objects
    tracer: Tracer  # of the scene
    sensor: Sensor
    gains: CameraGains  # of `every`
    records: Records
    options: EmissionOptions
    log: Log
    base_level_error: float = PRIOR_LEVEL_ERROR  # of the logarithm of the level of the base
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)  # in the world

    @cached_property
    def cache_pixels(self) -> tuple[VoxelPixels, np.ndarray]:
        """The valid interior pixels of all views with their voxels of the radiance cache, and their faces (n,)."""
        edge = self.options.cache_edge
        parts = []
        for done, view in enumerate(self.views):
            pixels = self.records[view].pixels
            radiance, bound = self.radiance(view, pixels.value, pixels.index)
            use = pixels.valid & pixels.interior & np.isfinite(radiance).all(1)
            parts.append((pixels.points[use], radiance[use], bound[use].any(1), pixels.face[use]))
            self.log.progress(done + 1, len(self.views), "views cached")
        points, radiance, bound, face = (np.concatenate(part) for part in zip(*parts, strict=True))
        return VoxelPixels.of(edge, cache_origin(self.scene, edge), points, radiance, bound), face

    def forget(self) -> None:
        """Let go of what is as large as the scene; it is made again when it is asked for."""
        self.tracer.forget()
        self.__dict__.pop("cache_pixels", None)

    def number(self, view: View) -> int:
        """Return the place of a view in the capture."""
        return next(i for i, other in enumerate(self.every) if other.view_id == view.view_id)

    def radiance(self, view: View, value: np.ndarray, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Turn sensor values (n, 3) of pixels `index` (n,) into radiance, and say where it is a bound."""
        number = self.number(view)
        if self.gains.is_plain:
            return self.sensor.radiance(value, float(self.gains.gain[number, 0]))
        return self.sensor.radiance(value, pixel_gains(self.gains, number, view, index))


def statistics_of_faces(photos: Photographs, adjacency: np.ndarray) -> tuple[FaceStatistics, float, np.ndarray]:
    """Return the statistics of all faces, the radiance from which a face may shine, and the pieces that glow as a whole, (F,).

    `adjacency`: (E, 2) pairs of neighbouring faces.
    """
    scene, views, least = photos.scene, photos.views, photos.options.min_observations
    total = photos.records.share * sum(view.width * view.height for view in views)
    stride = max(1, round(total / STATISTICS_PIXELS))
    parts = []
    for done, view in enumerate(views):
        pixels = photos.records[view].pixels
        pixels = pixels.take(np.flatnonzero(pixels.valid)[::stride])
        radiance, bound = photos.radiance(view, pixels.value, pixels.index)
        number = np.full(len(pixels.face), done)
        parts.append((pixels.face, radiance.astype(np.float32), bound, pixels.from_front, pixels.interior, number))
        photos.log.progress(done + 1, len(views), "views searched for emitters")
    face, radiance, bound, front, inside, view = (np.concatenate(part) for part in zip(*parts, strict=True))
    every = face_statistics(face, radiance, front, len(scene.faces), bound)
    inner = face_statistics(face[inside], radiance[inside], front[inside], len(scene.faces), bound[inside])
    threshold = radiance_threshold(every)
    bright = (radiance.max(1) >= threshold) | bound.any(1)
    statistics = with_thin_objects(inner, every, scene.object_id, face, bright, inside, least)
    pixels = face[inside], view[inside], radiance[inside].max(1)
    glowing = glowing_pieces(statistics, adjacency, scene.object_id, pixels, least)
    return statistics, float(threshold), glowing


def radiance_cache(photos: Photographs, groups: EmitterGroups) -> RadianceVoxels:
    """Build the cache of interior pixels that are on no emitter."""
    pixels, face = photos.cache_pixels
    return pixels.cache(groups.of_face[face] < 0)


def escaping_light(photos: Photographs) -> tuple[SkySums, float, float | None]:
    """Return the sums of what camera rays see that miss the mesh, the share of such rays, and their mean brightness relative to
    the other rays."""
    sky, total, mean_hit, hits = SkySums(), 0, 0.0, 0
    for done, view in enumerate(photos.views):
        record = photos.records[view]
        pixels = record.pixels
        radiance, _ = photos.radiance(view, pixels.value, pixels.index)
        mean_hit += float(radiance[pixels.valid].mean(1).sum())
        hits += int(pixels.valid.sum())
        light, bound = photos.radiance(view, record.escaping_value, record.escaping)
        sky.add(record.escaping_direction, light, bound, record.escaping_share)
        total += record.counted
        photos.log.progress(done + 1, len(photos.views), "views searched for light from outside")
    brightness = float(sky.mean().mean() / max(mean_hit / max(hits, 1), 1e-12)) if sky.pixels else None
    return sky, sky.pixels / max(total, 1), brightness


def rays_from_surface(photos: Photographs) -> np.ndarray:
    """Return the faces that cosine-distributed rays from visible surface meet, (n,) int, -1 = they leave the mesh."""
    rng = np.random.default_rng([photos.options.seed, SEEDS])
    origins, directions = [], []
    for view in photos.views:
        pixels = photos.records[view].pixels
        if not len(pixels.index):
            continue
        pixels = pixels.take(rng.integers(0, len(pixels.index), max(1, 65536 // len(photos.views))))
        normal = pixels.normals.astype(np.float64)
        directions.append(cosine_directions(normal, rng))
        origins.append(pixels.points + 1e-3 * normal)
    if not origins:
        return np.full(1, -1)
    return np.asarray(photos.tracer.meets(np.concatenate(origins), np.concatenate(directions))[0])


def choose_rows(
    photos: Photographs, groups: EmitterGroups, rest: float, thin: int = 1, tile_edge: int | None = None
) -> tuple[ViewPixels, EmissionPixels]:
    """Draw the pixels of the linear system: a fixed number, evenly over views (one in `thin`), plus enough on every emitter.

    `rest` is the radiance from which surface may be an emitter; pixels of one object in a tile of `tile_edge`, None = `row_tile`,
    will be averaged. Returns the pixels twice: as surface points, and as what they show.
    """
    elsewhere, per_view = (-(-photos.options.rows // (t * len(photos.views))) for t in (thin, 1))
    per_group = max(-(-ANCHOR_PIXELS // len(photos.views)), 4)
    parts: list[tuple[ViewPixels, EmissionPixels]] = []
    for view in photos.views:
        pixels = photos.records[view].pixels
        group = groups.of_face[pixels.face]
        side = groups.side[pixels.face]
        dark_side = (group >= 0) & (side != 0) & ((side > 0) != pixels.from_front)
        usable = pixels.valid & ~dark_side & (pixels.interior | (group >= 0))
        rng, of_parts = (np.random.default_rng([photos.options.seed, SEEDS, 1, view.view_id, turn]) for turn in range(2))
        choice = choose_pixels(group, usable, pixels.interior, elsewhere, per_group, rng)
        part = pixels.take(choice)
        radiance, bound = photos.radiance(view, part.value, part.index)
        covered = _coverage(photos, groups, view, part.index, group[choice], of_parts)
        tile = tile_of(part.index, view.width, tile_edge or row_tile(view.width * view.height, per_view))
        rows = EmissionPixels(
            radiance=radiance,
            bound=bound,
            object_id=part.object_id,
            view=np.full(len(choice), view.view_id),
            tile=tile,
            group=group[choice],
            coverage=covered,
        )
        parts.append((part, rows))
    pixels, rows = (list(part) for part in zip(*parts, strict=True))
    every, shown = ViewPixels.joined(pixels), EmissionPixels.joined(rows)
    # Border pixels mix the emitter with its surroundings; they are used only for emitters that have no other pixels.
    group = shown.group
    inner = np.bincount(group[every.interior & (group >= 0)], minlength=groups.size) > 0
    use = (group < 0) | every.interior | ~np.append(inner, False)[group]
    # The same holds for pixels that an emitter fills only in part.
    whole = (group >= 0) & ~shown.partial & ~shown.bound.any(1)
    enough = np.bincount(group[whole & use], minlength=groups.size) >= photos.options.min_observations
    use &= ~(shown.partial & np.append(enough, False)[group])
    return every.take(use), replace(shown.take(use).with_majority(), rest=rest)


def _coverage(
    photos: Photographs, groups: EmitterGroups, view: View, index: np.ndarray, group: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """(n, G) share of rays through each pixel on an emitter that meet each group; 0 for other pixels."""
    share, own = np.zeros((len(index), groups.size), np.float32), np.flatnonzero(group >= 0)
    if not len(own):
        return share
    du, dv = direction_derivatives(view.fx, view.fy, view.world_from_camera)
    middle = view.directions().reshape(-1, 3)[index[own]]
    cell = np.stack(np.indices((COVERAGE_GRID, COVERAGE_GRID)), 0).reshape(2, 1, -1, 1)
    offset = (cell + rng.random((2, len(own), COVERAGE_GRID**2, 1))) / COVERAGE_GRID - 0.5
    way = middle[:, None] + offset[0] * du + offset[1] * dv
    face, _ = photos.tracer.meets(view.world_from_camera[:3, 3], way.reshape(-1, 3))
    met = np.append(groups.of_face, -1)[face].reshape(len(own), -1)
    pixel, ray = np.nonzero(met >= 0)
    np.add.at(share, (own[pixel], met[pixel, ray]), np.float32(1.0 / met.shape[1]))
    return share
