"""The photographs as stage emission reads them: views decoded once, exposure and response, and pixels as statistics of faces,
radiance cache and rows of the linear system."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from iif_core.camera.calibration.choice import (
    CalibratedResponse,
    calibrate_response,
    candidates,
    gain_rows,
    given_response,
    needs_rows,
)
from iif_core.camera.gains import CameraGains, choose_gains, radius_squared, with_held_out_views
from iif_core.camera.overlap import PatchRows, join_rows, no_rows, patch_edge, patch_numbers, patch_rows
from iif_core.camera.pinhole import direction_derivatives
from iif_core.camera.pixels import ViewPixels, pixel_gains, pixels_of_view
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
from iif_core.light.emission.groups import EmitterGroups
from iif_core.light.emission.pixels import ANCHOR_PIXELS, EmissionPixels, choose_pixels, row_tile, tile_of
from iif_core.light.emission.sensor import Sensor
from iif_core.surface.cells import grid_origin
from workflow.decisions import camera as decisions
from workflow.runtime import device
from workflow.runtime.job import Job
from workflow.scene.base_scene import base_maps, decode_view
from workflow.scene.normal_form import CaptureReader, View
from workflow.scene.response_file import read_response_file

if TYPE_CHECKING:
    from iif_core.light.transport.geometry import Geometry
    from iif_core.light.transport.materials import CellMaterials

VIEW_MEMORY_MB = 1024.0
"""Megabytes of decoded views that are kept in memory; every pass over the photographs decodes the others again."""
STATISTICS_PIXELS = 20_000_000
"""Photographs are thinned to about this many pixels for the statistics of faces."""
COVERAGE_GRID = 6
"""Rays across a pixel on an emitter, in both directions, by which its share of the pixel is counted."""
SEEDS = 0x656D69  # keeps the random streams of this stage apart from those of others


@dataclass(frozen=True)
class ViewRecord:
    """Everything that the stage reads of one view, decoded.

    Attributes:
        pixels: the pixels that hit the mesh, n of them.
        base: (n, 5) float32 base albedo, roughness and metallic of these pixels; empty for a held-out view.
        median_depth: metres, of the pixels with depth; None without any.
        counted: number of valid pixels of the whole photograph.
        escaping: (k,) flattened indices of the valid pixels that meet no surface.
        escaping_value, escaping_direction: (k, 3) what these pixels show, and their directions in the world.
        escaping_share: (k,) share of the light from outside that reaches these pixels; 1 but behind curtains.
        seen: faces that valid pixels of the whole photograph show; None = those of `pixels`, which are all.
    """

    pixels: ViewPixels
    base: np.ndarray
    median_depth: float | None
    counted: int
    escaping: np.ndarray
    escaping_value: np.ndarray
    escaping_direction: np.ndarray
    escaping_share: np.ndarray
    seen: np.ndarray | None = None

    @property
    def megabytes(self) -> float:
        arrays = [value for value in (*self.__dict__.values(), *self.pixels.__dict__.values()) if isinstance(value, np.ndarray)]
        return sum(array.nbytes for array in arrays) / 1e6


class ViewRecords:
    """Records of views, read from disk once as far as they fit into VIEW_MEMORY_MB.

    Where the photographs have more pixels than `emission.pixels`, a record is of a random choice of those of its view, the same
    share of every view; nothing but `seen` and `median_depth` is then of the whole view.

    Passes visit the views in the same order, so the first views are kept and the later ones are decoded again.
    """

    def __init__(self, job: Job, capture: CaptureReader, scene: BaseScene):
        self.job, self.capture, self.scene = job, capture, scene
        self.share = min(1.0, job.settings.emission.pixels / max(sum(view.width * view.height for view in capture.used), 1))
        self._kept: dict[int, ViewRecord] = {}
        self._megabytes = 0.0

    def __getitem__(self, view: View) -> ViewRecord:
        record = self._kept.get(view.view_id)
        if record is None:
            record = self._decoded(view)
            if self._megabytes + record.megabytes <= VIEW_MEMORY_MB:
                self._kept[view.view_id] = record
                self._megabytes += record.megabytes
        return record

    def _decoded(self, view: View) -> ViewRecord:
        decoded, among, seen = decode_view(self.job, self.capture, view), None, None
        if self.share < 1:
            rng = np.random.default_rng([self.job.seed, SEEDS, 5, view.view_id])
            among = rng.random(decoded.face.size) < self.share
            shown = decoded.valid & (decoded.face >= 0) & (decoded.depth > 0) & np.isfinite(decoded.photo).all(-1)
            seen = np.unique(decoded.face[shown])
        pixels = pixels_of_view(view, decoded, self.scene.normals, among)
        base = np.zeros((0, 5), np.float32) if view.split == "test" else base_maps(self.job, view)[pixels.index]
        values = decoded.photo.reshape(-1, 3)
        counted = decoded.valid.ravel() if among is None else decoded.valid.ravel() & among
        out = counted & np.isfinite(values).all(1)
        out[pixels.index] = False
        direction = view.directions().reshape(-1, 3)[out]
        deep = decoded.depth[decoded.depth > 0]
        median = np.median(deep) if deep.size else None
        outside = np.flatnonzero(out), values[out], direction, np.ones(int(out.sum()), np.float32)
        return ViewRecord(pixels, base, median, int(counted.sum()), *outside, seen)


@dataclass(frozen=True)
class Photographs:
    """The views that are used, and what turns them into radiance."""

    job: Job
    capture: CaptureReader
    scene: BaseScene
    views: list[View]
    sensor: Sensor
    gains: CameraGains  # of the views of the capture, in order
    records: ViewRecords

    @cached_property
    def world(self) -> tuple[Geometry, CellMaterials]:
        """Geometry and materials on the device, made once."""
        device.mitsuba()
        return self.scene.traceable()

    @cached_property
    def cache_pixels(self) -> tuple[VoxelPixels, np.ndarray]:
        """The valid interior pixels of all views with their voxels of the radiance cache, and their faces (n,)."""
        edge = self.job.settings.emission.cache_edge
        parts = []
        for done, view in enumerate(self.views):
            pixels = self.records[view].pixels
            radiance, bound = self.radiance(view, pixels.value, pixels.index)
            use = pixels.valid & pixels.interior & np.isfinite(radiance).all(1)
            parts.append((pixels.points[use], radiance[use], bound[use].any(1), pixels.face[use]))
            self.job.progress(done + 1, len(self.views), "views cached")
        points, radiance, bound, face = (np.concatenate(part) for part in zip(*parts, strict=True))
        return VoxelPixels.of(edge, cache_origin(self.scene, edge), points, radiance, bound), face

    def forget(self) -> None:
        """Let go of `world` and `cache_pixels`, which are as large as the scene and are made again when they are asked for."""
        for name in ("world", "cache_pixels"):
            self.__dict__.pop(name, None)

    def number(self, view: View) -> int:
        """Return the place of a view in the capture."""
        return next(i for i, other in enumerate(self.capture.views) if other.view_id == view.view_id)

    def radiance(self, view: View, value: np.ndarray, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Turn sensor values (n, 3) of pixels `index` (n,) into radiance, and say where it is a bound."""
        number = self.number(view)
        if self.gains.is_plain:
            return self.sensor.radiance(value, float(self.gains.gain[number, 0]))
        return self.sensor.radiance(value, pixel_gains(self.gains, number, view, index))


def view_exposures(capture: CaptureReader, notes: list[str]) -> CameraGains:
    """Return the exposures of the views as the source knows them."""
    exposures = capture.exposures()
    bad = [view.name for view in capture.views if not 0 < view.exposure < np.inf]
    if bad:  # docs/method/numerics.md#exposure-at-zero
        notes.append(f"exposure not positive, taken as 1: {', '.join(bad)}")
        exposures = np.where((exposures > 0) & (exposures < np.inf), exposures, 1.0)
    return CameraGains.plain(exposures)


def gain_plan(capture: CaptureReader, gains: CameraGains) -> list[decisions.Decision]:
    """Return the decisions about exposure, white balance and vignetting."""
    if not capture.facts.get("exposure_estimated"):
        return [decisions.exposure("given", np.zeros(0), 0)]
    found = [decisions.exposure("estimate", np.log(gains.exposure), int(gains.estimated.sum()))]
    for term, evidence in gains.evidence.items():
        found.append(decisions.camera_term(term, evidence))
    return found


def calibrated(photos: Photographs) -> tuple[Photographs, CalibratedResponse]:
    """Find the camera response (the measured curve, the family that is set, or the one that fits surface seen under different
    exposures best) and the gains that go with it; return the photographs with both, and how they were found. Held-out views
    take part only with gains that follow from the others."""
    settings, facts = photos.job.settings, photos.capture.facts
    setting, given = settings.affines.response, not photos.capture.facts.get("exposure_estimated", False)
    number = np.array([photos.number(view) for view in photos.views])
    exposure = photos.gains.exposure[number] if not given else photos.gains.gain[number, 0]
    measured = not isinstance(setting, str) and not photos.capture.is_hdr
    families = () if measured else candidates(setting, facts["dynamic_range"])
    estimated = not given and not photos.capture.is_hdr
    rows = _shared_surface(photos) if estimated or (families and needs_rows(families)) else no_rows()
    if measured:
        found = given_response(read_response_file(Path(setting.file)), f"measured: {setting.file}", exposure)
    else:
        moving = rows.take(np.isin(rows.view, number))
        moving = replace(moving, view=np.searchsorted(number, moving.view).astype(np.int32))
        found = calibrate_response(moving, exposure, families, settings.emission.saturation, given=given)
    photos.job.log.info("camera response: %s", found.reason)
    gains = _all_gains(photos.gains, number, found, rows) if estimated else photos.gains
    return replace(photos, sensor=replace(photos.sensor, curve=found.response), gains=gains), found


def _all_gains(start: CameraGains, number: np.ndarray, found: CalibratedResponse, rows: PatchRows) -> CameraGains:
    """Gains of all views of the capture: of the views `number` that were used, and of the others, which follow from them."""
    moving = np.isin(np.arange(len(start.gain)), number)
    linear = gain_rows(rows, found.response)
    if found.gains is None:  # the curve is given, the gains are not
        own = choose_gains(linear.take(moving[linear.view]).thinned(), len(start.gain))
        ahead = replace(own, gain=np.where(own.estimated[:, None], own.gain, start.gain))
    else:
        gain, seen = start.gain.copy(), np.zeros(len(moving), bool)
        gain[number], seen[number] = found.gains.gain, found.gains.estimated
        ahead = replace(found.gains, gain=gain, estimated=seen)
    return with_held_out_views(linear, ahead, moving)


def _shared_surface(photos: Photographs) -> PatchRows:
    """Patches of interior surface as all views show them."""
    scene, views = photos.scene, photos.capture.views
    medians = [(photos.records[view].median_depth, view.fx) for view in views]
    apart = photos.records.share**-0.5  # pixels that are looked at, in pixels
    footprints = [apart * depth / focal for depth, focal in medians if depth is not None]
    extent = float(np.ptp(scene.vertices, axis=0).max())
    edge = patch_edge(float(np.median(footprints)), extent) if footprints else max(extent, 1.0)
    origin = grid_origin(scene.vertices[scene.faces.ravel()], edge)
    share = min(1.0, STATISTICS_PIXELS / max(photos.records.share * sum(view.width * view.height for view in views), 1))
    saturation = photos.job.settings.emission.saturation
    parts = [no_rows()]
    for number, view in enumerate(views):
        pixels = photos.records[view].pixels
        pixels = pixels.take(np.flatnonzero(pixels.valid & pixels.interior))
        patch = patch_numbers(pixels.points, pixels.object_id, edge, origin)
        radius2 = radius_squared(pixels.index, view.width, view.height)
        rows = (patch, pixels.normals, pixels.object_id, pixels.value, number)
        parts.append(patch_rows(*rows, saturation, share=share, radius2=radius2))
        photos.job.progress(number + 1, len(views), "views compared for the camera response")
    return join_rows(parts)


def statistics_of_faces(photos: Photographs, adjacency: np.ndarray) -> tuple[FaceStatistics, float, np.ndarray]:
    """Return the statistics of all faces, the radiance from which a face may shine, and the pieces that glow as a whole, (F,).

    `adjacency`: (E, 2) pairs of neighbouring faces.
    """
    scene, views, least = photos.scene, photos.views, photos.job.settings.emission.min_observations
    total = photos.records.share * sum(view.width * view.height for view in views)
    stride = max(1, round(total / STATISTICS_PIXELS))
    parts = []
    for done, view in enumerate(views):
        pixels = photos.records[view].pixels
        pixels = pixels.take(np.flatnonzero(pixels.valid)[::stride])
        radiance, bound = photos.radiance(view, pixels.value, pixels.index)
        number = np.full(len(pixels.face), done)
        parts.append((pixels.face, radiance.astype(np.float32), bound, pixels.from_front, pixels.interior, number))
        photos.job.progress(done + 1, len(views), "views searched for emitters")
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
        photos.job.progress(done + 1, len(photos.views), "views searched for light from outside")
    brightness = float(sky.mean().mean() / max(mean_hit / max(hits, 1), 1e-12)) if sky.pixels else None
    return sky, sky.pixels / max(total, 1), brightness


def rays_from_surface(photos: Photographs) -> np.ndarray:
    """Return the faces that cosine-distributed rays from visible surface meet, (n,) int, -1 = they leave the mesh."""
    geometry, _ = photos.world
    from iif_core.light.transport.geometry import trace

    rng = np.random.default_rng([photos.job.seed, SEEDS])
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
    return np.asarray(trace(geometry, np.concatenate(origins), np.concatenate(directions))[0])


def seen_faces(photos: Photographs) -> np.ndarray:
    """Return (F,) bool: a pixel shows the face, or light passes through it, so that no lamp can hide in it."""
    shown = photos.scene.passes > 0
    for view in photos.views:
        record = photos.records[view]
        shown[record.pixels.face[record.pixels.valid] if record.seen is None else record.seen] = True
    return shown


def choose_rows(
    photos: Photographs, groups: EmitterGroups, rest: float, thin: int = 1, tile_edge: int | None = None
) -> tuple[ViewPixels, np.ndarray, EmissionPixels]:
    """Draw the pixels of the linear system: a fixed number, evenly over views (one in `thin`), plus enough on every emitter.

    `rest` is the radiance from which surface may be an emitter; pixels of one object in a tile of `tile_edge`, None = `row_tile`,
    will be averaged. Returns the pixels three times: as surface points, as base materials (n, 5), and as what they show.
    """
    elsewhere, per_view = (-(-photos.job.settings.emission.rows // (t * len(photos.views))) for t in (thin, 1))
    per_group = max(-(-ANCHOR_PIXELS // len(photos.views)), 4)
    parts: list[tuple[ViewPixels, np.ndarray, EmissionPixels]] = []
    for view in photos.views:
        record = photos.records[view]
        pixels = record.pixels
        group = groups.of_face[pixels.face]
        side = groups.side[pixels.face]
        dark_side = (group >= 0) & (side != 0) & ((side > 0) != pixels.from_front)
        usable = pixels.valid & ~dark_side & (pixels.interior | (group >= 0))
        rng, of_parts = (np.random.default_rng([photos.job.seed, SEEDS, 1, view.view_id, turn]) for turn in range(2))
        choice = choose_pixels(group, usable, pixels.interior, elsewhere, per_group, rng)
        part = pixels.take(choice)
        shown, number = photos.radiance(view, part.value, part.index), np.full(len(choice), view.view_id)
        covered = _coverage(photos, groups, view, part.index, group[choice], of_parts)
        tile = tile_of(part.index, view.width, tile_edge or row_tile(view.width * view.height, per_view))
        rows = EmissionPixels(*shown, part.object_id, number, tile, group[choice], covered)
        parts.append((part, record.base[choice], rows))
    pixels, base, rows = (list(part) for part in zip(*parts, strict=True))
    every, shown = joined(pixels), joined(rows)
    # Border pixels mix the emitter with its surroundings; they are used only for emitters that have no other pixels.
    group = shown.group
    inner = np.bincount(group[every.interior & (group >= 0)], minlength=groups.size) > 0
    use = (group < 0) | every.interior | ~np.append(inner, False)[group]
    # The same holds for pixels that an emitter fills only in part.
    whole = (group >= 0) & ~shown.partial & ~shown.bound.any(1)
    enough = np.bincount(group[whole & use], minlength=groups.size) >= photos.job.settings.emission.min_observations
    use &= ~(shown.partial & np.append(enough, False)[group])
    return every.take(use), np.concatenate(base)[use], replace(shown.take(use), rest=rest)


def _coverage(
    photos: Photographs, groups: EmitterGroups, view: View, index: np.ndarray, group: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """(n, G) share of rays through each pixel on an emitter that meet each group; 0 for other pixels."""
    from iif_core.light.transport.geometry import trace

    share, own = np.zeros((len(index), groups.size), np.float32), np.flatnonzero(group >= 0)
    if not len(own):
        return share
    du, dv = direction_derivatives(view.fx, view.fy, view.world_from_camera)
    middle = view.directions().reshape(-1, 3)[index[own]]
    cell = np.stack(np.indices((COVERAGE_GRID, COVERAGE_GRID)), 0).reshape(2, 1, -1, 1)
    offset = (cell + rng.random((2, len(own), COVERAGE_GRID**2, 1))) / COVERAGE_GRID - 0.5
    way = middle[:, None] + offset[0] * du + offset[1] * dv
    face, _ = trace(photos.world[0], view.world_from_camera[:3, 3], way.reshape(-1, 3))
    met = np.append(groups.of_face, -1)[face].reshape(len(own), -1)
    pixel, ray = np.nonzero(met >= 0)
    np.add.at(share, (own[pixel], met[pixel, ray]), np.float32(1.0 / met.shape[1]))
    return share


def joined(parts: Sequence[Any]) -> Any:
    """Join records of arrays, one after another."""
    arrays = {name: value for name, value in parts[0].__dict__.items() if isinstance(value, np.ndarray)}
    return replace(parts[0], **{name: np.concatenate([getattr(p, name) for p in parts]) for name in arrays})
