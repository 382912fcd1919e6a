"""The photographs as stage emission reads them: exposure, response, and pixels as statistics, cache and rows."""

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
from iif_core.camera.gains import CameraGains, choose_gains, follow, radius_squared
from iif_core.camera.overlap import PatchRows, join_rows, no_rows, patch_edge, patch_numbers, patch_rows
from iif_core.light.emission.cache import RadianceSums, RadianceVoxels
from iif_core.light.emission.candidates import FaceStatistics, face_statistics, radiance_threshold, with_thin_objects
from iif_core.light.emission.environment import SkySums, cosine_directions
from iif_core.light.emission.groups import EmitterGroups
from iif_core.light.emission.problem import PixelRows
from iif_core.light.emission.sensor import Sensor
from iif_core.surface.cells import grid_origin
from workflow import decisions
from workflow.runtime.job import Job
from workflow.scene.base_scene import BaseScene, ViewPixels, base_maps, cache_origin, pixel_gains, view_pixels
from workflow.scene.normal_form import CaptureReader, View
from workflow.scene.response_file import read_response_file

if TYPE_CHECKING:
    from iif_core.light.transport.geometry import Geometry
    from iif_core.light.transport.materials import CellMaterials

TILE = 8
"""Pixels of one object in one tile of this edge are averaged into one row (COMPUTE 4)."""
STATISTICS_PIXELS = 20_000_000
"""Photographs are thinned to about this many pixels for the statistics of faces."""
ANCHOR_PIXELS = 64
"""At least this many directly seen pixels a group enter the solve."""
SEEDS = 0x656D69  # keeps the random streams of this stage apart from those of others


@dataclass(frozen=True)
class Photographs:
    """The views that are used, and what turns them into radiance."""

    job: Job
    capture: CaptureReader
    scene: BaseScene
    views: list[View]
    sensor: Sensor
    gains: CameraGains  # of the views of the capture, in order

    def pixels(self, view: View) -> ViewPixels:
        return view_pixels(self.job, self.capture, self.scene, view)

    @cached_property
    def world(self) -> tuple[Geometry, CellMaterials]:
        """Geometry and materials on the device, made once."""
        return self.scene.traceable()

    def number(self, view: View) -> int:
        """Place of a view in the capture."""
        return next(i for i, other in enumerate(self.capture.views) if other.view_id == view.view_id)

    def radiance(self, view: View, value: np.ndarray, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of sensor values (n, 3) of pixels `index` (n,): radiance, and where it is a bound."""
        number = self.number(view)
        if self.gains.is_plain:
            return self.sensor.radiance(value, float(self.gains.gain[number, 0]))
        return self.sensor.radiance(value, pixel_gains(self.gains, number, view, index))


def view_exposures(capture: CaptureReader, notes: list[str]) -> CameraGains:
    """Exposures of the views as the source knows them."""
    exposures = capture.exposures()
    bad = [view.name for view in capture.views if not view.exposure > 1e-6]
    if bad:  # METHOD H31
        notes.append(f"exposure not positive, taken as 1: {', '.join(bad)}")
        exposures = np.where(exposures > 1e-6, exposures, 1.0)
    return CameraGains.plain(exposures)


def gain_plan(capture: CaptureReader, gains: CameraGains) -> list[decisions.Decision]:
    """What was found about exposure, white balance and vignetting."""
    if not capture.facts.get("exposure_estimated"):
        return [decisions.exposure("given", np.zeros(0), 0)]
    found = [decisions.exposure("estimate", np.log(gains.exposure), int(gains.estimated.sum()))]
    for term, evidence in gains.evidence.items():
        found.append(decisions.camera_term(term, evidence))
    return found


def calibrated(photos: Photographs) -> tuple[Photographs, CalibratedResponse]:
    """The photographs with their camera response (the measured curve, the family that is set, or the one that surface under
    different exposures speaks for) and the gains that go with it; and how it was found. Views kept for testing follow."""
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
    """Gains of all views of the capture: of those `number` that were used, and of those that follow them."""
    moving = np.isin(np.arange(len(start.gain)), number)
    linear = gain_rows(rows, found.response)
    if found.gains is None:  # the curve is given, the gains are not
        own = choose_gains(linear.take(moving[linear.view]).thinned(), len(start.gain))
        ahead = replace(own, gain=np.where(own.estimated[:, None], own.gain, start.gain))
    else:
        gain, seen = start.gain.copy(), np.zeros(len(moving), bool)
        gain[number], seen[number] = found.gains.gain, found.gains.estimated
        ahead = replace(found.gains, gain=gain, estimated=seen)
    return follow(linear, ahead, moving)


def _shared_surface(photos: Photographs) -> PatchRows:
    """Patches of interior surface as the views show them."""
    capture, scene, views = photos.capture, photos.scene, photos.capture.views
    footprints = [np.median(depth[depth > 0]) / view.fx for view in views if (depth := capture.gbuffer(view)[0]).any()]
    extent = float(np.ptp(scene.vertices, axis=0).max())
    edge = patch_edge(float(np.median(footprints)), extent) if footprints else max(extent, 1.0)
    origin = grid_origin(scene.vertices[scene.faces.ravel()], edge)
    share = min(1.0, STATISTICS_PIXELS / max(sum(view.width * view.height for view in views), 1))
    saturation = photos.job.settings.emission.saturation
    parts = [no_rows()]
    for number, view in enumerate(views):
        pixels = photos.pixels(view)
        pixels = pixels.take(np.flatnonzero(pixels.valid & pixels.interior))
        patch = patch_numbers(pixels.points, pixels.object_id, edge, origin)
        radius2 = radius_squared(pixels.index, view.width, view.height)
        rows = (patch, pixels.normals, pixels.object_id, pixels.value, number)
        parts.append(patch_rows(*rows, saturation, share=share, radius2=radius2))
        photos.job.progress(number + 1, len(views), "views compared for the camera response")
    return join_rows(parts)


def statistics_of_faces(photos: Photographs) -> tuple[FaceStatistics, float]:
    """Statistics of the faces, and the radiance from which one may shine."""
    scene, views, least = photos.scene, photos.views, photos.job.settings.emission.min_observations
    total = sum(view.width * view.height for view in views)
    stride = max(1, round(total / STATISTICS_PIXELS))
    parts = []
    for done, view in enumerate(views):
        pixels = photos.pixels(view)
        pixels = pixels.take(np.flatnonzero(pixels.valid)[::stride])
        radiance, bound = photos.radiance(view, pixels.value, pixels.index)
        parts.append((pixels.face, radiance.astype(np.float32), bound, pixels.from_front, pixels.interior))
        photos.job.progress(done + 1, len(views), "views searched for emitters")
    face, radiance, bound, front, inside = (np.concatenate(part) for part in zip(*parts, strict=True))
    every = face_statistics(face, radiance, front, len(scene.faces), bound)
    inner = face_statistics(face[inside], radiance[inside], front[inside], len(scene.faces), bound[inside])
    threshold = radiance_threshold(every)
    bright = (radiance.max(1) >= threshold) | bound.any(1)
    return with_thin_objects(inner, every, scene.object_id, face, bright, inside, least), float(threshold)


def radiance_cache(photos: Photographs, groups: EmitterGroups) -> tuple[RadianceVoxels, SkySums, float, float | None]:
    """The cache of interior pixels that are not on an emitter; what the camera rays see that miss the mesh, their share,
    and their brightness relative to the others'."""
    edge = photos.job.settings.emission.cache_edge
    sums, sky = RadianceSums(edge, cache_origin(photos.scene, edge)), SkySums()
    total, mean_hit, hits = 0, 0.0, 0
    for done, view in enumerate(photos.views):
        pixels = photos.pixels(view)
        radiance, bound = photos.radiance(view, pixels.value, pixels.index)
        use = pixels.valid & pixels.interior & (groups.of_face[pixels.face] < 0)
        sums.add(pixels.points[use], radiance[use], bound[use].any(1))
        mean_hit += float(radiance[pixels.valid].mean(1).sum())
        hits += int(pixels.valid.sum())
        photo, valid = photos.capture.photo(view)
        values = photo.reshape(-1, 3)
        out = valid.ravel() & np.isfinite(values).all(1)
        out[pixels.index] = False
        sky.add(photos.capture.directions(view).reshape(-1, 3)[out], *photos.radiance(view, values[out], np.flatnonzero(out)))
        total += int(valid.sum())
        photos.job.progress(done + 1, len(photos.views), "views cached")
    brightness = float(sky.mean().mean() / max(mean_hit / max(hits, 1), 1e-12)) if sky.pixels else None
    return sums.finish(), sky, sky.pixels / max(total, 1), brightness


def escaping_share(photos: Photographs) -> float:
    """Share of cosine-distributed directions from visible surface that leave the mesh (METHOD 8, epsilon_2)."""
    geometry, _ = photos.world
    from iif_core.light.transport.geometry import trace

    rng = np.random.default_rng([photos.job.seed, SEEDS])
    origins, directions = [], []
    for view in photos.views:
        pixels = photos.pixels(view)
        if not len(pixels.index):
            continue
        pixels = pixels.take(rng.integers(0, len(pixels.index), max(1, 65536 // len(photos.views))))
        normal = pixels.normals.astype(np.float64)
        directions.append(cosine_directions(normal, rng))
        origins.append(pixels.points + 1e-3 * normal)
    if not origins:
        return 1.0
    face, _ = trace(geometry, np.concatenate(origins), np.concatenate(directions))
    return float((face < 0).mean())


def choose_rows(photos: Photographs, groups: EmitterGroups, thin: int = 1) -> tuple[ViewPixels, np.ndarray, PixelRows]:
    """A fixed number of pixels, evenly over views (one in `thin`), plus enough on every emitter; their materials (n, 5)."""
    rng = np.random.default_rng([photos.job.seed, SEEDS, 1])
    per_view = -(-photos.job.settings.emission.rows // (thin * len(photos.views)))
    quota = max(-(-ANCHOR_PIXELS // len(photos.views)), 4)
    parts: list[tuple[ViewPixels, np.ndarray, PixelRows]] = []
    for view in photos.views:
        pixels = photos.pixels(view)
        group = groups.of_face[pixels.face]
        side = groups.side[pixels.face]
        away = (group >= 0) & (side != 0) & ((side > 0) != pixels.from_front)
        usable = pixels.valid & ~away & (pixels.interior | (group >= 0))
        on_emitter = np.flatnonzero(usable & (group >= 0))
        elsewhere = np.flatnonzero(usable & (group < 0))
        chosen = [rng.permutation(elsewhere)[:per_view]]
        for g in np.unique(group[on_emitter]):
            own = on_emitter[group[on_emitter] == g]
            inner = own[pixels.interior[own]]
            chosen.append(rng.permutation(inner if len(inner) else own)[:quota])
        choice = np.sort(np.concatenate(chosen))
        part = pixels.take(choice)
        row, column = part.index // view.width, part.index % view.width
        tile = (row // TILE) * (-(-view.width // TILE)) + column // TILE
        number = np.full(len(choice), view.view_id)
        rows = PixelRows(*photos.radiance(view, part.value, part.index), part.object_id, number, tile, group[choice])
        parts.append((part, base_maps(photos.job, view)[part.index], rows))
    pixels, base, rows = (list(part) for part in zip(*parts, strict=True))
    joined, group = _joined(pixels), np.concatenate([part.group for part in rows])
    # Border pixels mix with what is beside the emitter: only for emitters that have no others.
    inner = np.bincount(group[joined.interior & (group >= 0)], minlength=groups.size) > 0
    use = (group < 0) | joined.interior | ~np.append(inner, False)[group]
    everything = _joined(rows)
    return joined.take(use), np.concatenate(base)[use], PixelRows(**{k: v[use] for k, v in everything.__dict__.items()})


def _joined(parts: Sequence[Any]) -> Any:
    """Records of arrays, one after another."""
    return type(parts[0])(**{name: np.concatenate([getattr(p, name) for p in parts]) for name in parts[0].__dict__})
