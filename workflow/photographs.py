"""The photographs as stage emission reads them: exposure, response, and pixels as statistics, cache and rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from iif_core import plan
from iif_core.emission.cache import RadianceSums, RadianceVoxels
from iif_core.emission.candidates import FaceStatistics, face_statistics, radiance_threshold, with_thin_objects
from iif_core.emission.environment import SkySums, cosine_directions
from iif_core.emission.groups import EmitterGroups
from iif_core.emission.problem import PixelRows
from iif_core.emission.sensor import Sensor
from iif_core.exposure import calibrate_response
from workflow.artifacts.store import ids_from_disk
from workflow.base_scene import BaseScene, ViewPixels, base_maps, cache_origin, view_pixels
from workflow.job import Job
from workflow.normal_form import CaptureReader, View

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
    exposures: dict[int, float]

    def pixels(self, view: View) -> ViewPixels:
        return view_pixels(self.job, self.capture, self.scene, view)

    def radiance(self, view: View, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self.sensor.radiance(value, self.exposures[view.view_id])


def view_exposures(capture: CaptureReader, views: list[View], notes: list[str]) -> tuple[dict[int, float], plan.Decision]:
    """Exposure per view id, and whether the source estimated it."""
    exposures = {view.view_id: float(view.exposure) for view in capture.views}
    bad = [view.name for view in capture.views if not view.exposure > 1e-6]
    if bad:  # METHOD H31
        notes.append(f"exposure not positive, taken as 1: {', '.join(bad)}")
        exposures.update({view.view_id: 1.0 for view in capture.views if view.name in bad})
    if not capture.facts.get("exposure_estimated"):
        return exposures, plan.exposure("given", np.zeros(0), 0)
    logs = np.log([exposures[view.view_id] for view in views])
    return exposures, plan.exposure("estimate", logs, len(views))


def calibrated(photos: Photographs, notes: list[str]) -> Photographs:
    """The starting response, or the one that known exposures of shared surface imply (estimated ones assumed a response)."""
    sensor, views = photos.sensor, photos.views
    estimated = photos.capture.facts.get("exposure_estimated", False)
    if sensor.is_hdr or not sensor.curve.names or estimated or len(views) < 2:
        return photos
    exposure = np.array([photos.exposures[view.view_id] for view in views])
    found = calibrate_response(*_shared_surface(photos), exposure, sensor.curve, sensor.saturation)
    if not found.pairs:
        notes.append("exposures differ by less than a stop where views overlap: the response starts at the family's default")
        return photos
    notes.append(
        f"response from {found.pairs} pairs of differently exposed views of the same surface ({found.stops:.1f} stops):"
        f" they disagree by {found.after:.3f} in log radiance, {found.before:.3f} with the default curve"
    )
    photos.job.log.info(notes[-1])
    return replace(photos, sensor=replace(sensor, curve=found.response))


def _shared_surface(photos: Photographs) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Surface cell, number of the view and sensor value of the interior pixels."""
    cells, owners, values = [], [], []
    base = photos.job.read("base")
    for number, view in enumerate(photos.views):
        pixels = photos.pixels(view)
        cell = ids_from_disk(base.exr(f"maps/{view.name}.exr")["cell.id"]).ravel()[pixels.index]
        use = pixels.valid & pixels.interior & (cell >= 0)
        cells.append(cell[use])
        owners.append(np.full(int(use.sum()), number, np.int32))
        values.append(pixels.value[use].astype(np.float32))
    return np.concatenate(cells), np.concatenate(owners), np.concatenate(values)


def statistics_of_faces(photos: Photographs) -> tuple[FaceStatistics, float]:
    """Statistics of the faces, and the radiance from which one may shine."""
    scene, views, least = photos.scene, photos.views, photos.job.settings.emission.min_observations
    total = sum(view.width * view.height for view in views)
    stride = max(1, round(total / STATISTICS_PIXELS))
    parts = []
    for done, view in enumerate(views):
        pixels = photos.pixels(view)
        pixels = pixels.take(np.flatnonzero(pixels.valid)[::stride])
        radiance, bound = photos.radiance(view, pixels.value)
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
        radiance, bound = photos.radiance(view, pixels.value)
        use = pixels.valid & pixels.interior & (groups.of_face[pixels.face] < 0)
        sums.add(pixels.points[use], radiance[use], bound[use].any(1))
        mean_hit += float(radiance[pixels.valid].mean(1).sum())
        hits += int(pixels.valid.sum())
        photo, valid = photos.capture.photo(view)
        values = photo.reshape(-1, 3)
        out = valid.ravel() & np.isfinite(values).all(1)
        out[pixels.index] = False
        sky.add(photos.capture.directions(view).reshape(-1, 3)[out], *photos.radiance(view, values[out]))
        total += int(valid.sum())
        photos.job.progress(done + 1, len(photos.views), "views cached")
    brightness = float(sky.mean().mean() / max(mean_hit / max(hits, 1), 1e-12)) if sky.pixels else None
    return sums.finish(), sky, sky.pixels / max(total, 1), brightness


def escaping_share(photos: Photographs) -> float:
    """Share of cosine-distributed directions from visible surface that leave the mesh (METHOD 8, epsilon_2)."""
    geometry, _ = photos.scene.traceable()
    from iif_core.transport import trace

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
        rows = PixelRows(*photos.radiance(view, part.value), part.object_id, number, tile, group[choice])
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
