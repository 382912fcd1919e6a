"""emission: which faces shine and how brightly, and the radiance cache of everything else (METHOD 2.0, 2.4-2.6, 7a)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from iif_core import plan
from iif_core.emission.cache import RadianceSums, RadianceVoxels
from iif_core.emission.candidates import FaceStatistics, emitter_candidates, face_statistics, hdr_threshold, with_thin_objects
from iif_core.emission.direct import EmissionSolution, solve_emission
from iif_core.emission.environment import cosine_directions
from iif_core.emission.groups import EmitterGroups, group_emitters
from iif_core.emission.problem import PixelRows, Sky, assemble, initial_radiance, seen_radiance
from iif_core.emission.pruning import PrunedEmission, prune_groups
from iif_core.emission.sensor import Sensor
from iif_core.exposure import calibrate_response
from iif_core.response import family_for, response
from iif_core.segments import face_adjacency
from workflow.artifacts.store import ids_from_disk
from workflow.base_scene import BaseScene, ViewPixels, base_maps, cache_origin, read_base_scene, view_pixels
from workflow.job import Job
from workflow.normal_form import CaptureReader, View

TILE = 8
"""Pixels of one object in one tile of this edge are averaged into one row (COMPUTE 4)."""
STATISTICS_PIXELS = 20_000_000
"""Photographs are thinned to about this many pixels for the statistics of faces."""
ANCHOR_PIXELS = 64
"""At least this many directly seen pixels a group enter the solve."""
METAL = 0.9
"""Predicted metalness from which a surface counts as metal in the solve."""
_SEEDS = 0x656D69  # keeps the random streams of this stage apart from those of others


@dataclass(frozen=True)
class _Photographs:
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


def run(job: Job) -> None:
    """Write emitters.parquet, emitter_faces.parquet, radiance_cache.parquet and emission.json."""
    capture, scene = CaptureReader(job.read("capture")), read_base_scene(job)
    views = [view for view in capture.views if view.split != "test"] or list(capture.views)
    family = family_for(job.settings.affines.response, capture.facts["dynamic_range"])
    notes: list[str] = []
    exposures, exposure_plan = _exposures(capture, views, notes)
    sensor = Sensor(response(family), capture.is_hdr, job.settings.emission.saturation)
    photos = _calibrated(_Photographs(job, capture, scene, views, sensor, exposures), notes)
    statistics, threshold = _statistics(photos)
    groups, candidates = _groups(job, scene, statistics, threshold)
    cache, sky, escape, brightness = _radiance_cache(photos, groups)
    secondary = _secondary_escape(photos)
    environment = plan.environment(job.settings.emission.environment, escape, secondary, brightness)
    solution, table = _solve(photos, groups, cache, sky, environment["included"])
    _write(job, groups, table, cache)
    kept = int(np.count_nonzero(table["kept"] & (table["kind"] == "area")))
    for faces, area, reason in groups.dropped[:20]:
        notes.append(f"candidate of {faces} faces, {area:.2g} m^2, left out before the solve: {reason}")
    if not kept and not environment["included"]:
        notes.append("no emitter and no environment: light comes from the radiance cache alone, re-renderings will be dark")
    decisions = [environment, exposure_plan, plan.emitters(kept, groups.size - kept + len(groups.dropped), candidates)]
    active_set = {"rounds": solution.iterations, "converged": solution.converged, "violated": solution.violated}
    job.writer.json(
        "emission.json",
        {
            "cache_edge_m": cache.edge,
            "cache_origin": [float(x) for x in cache.origin],
            "condition": solution.condition,
            "residual": solution.residual,
            "active_set": active_set,
            "escape_share": {"primary": escape, "secondary": secondary},
            "threshold": threshold if np.isfinite(threshold) else None,
            "response": {"family": family, "parameters": photos.sensor.curve.params.tolist()},
            "plan": decisions,
            "notes": notes,
        },
    )


# ----------------------------------------------------------------------------------------------------------- exposure


def _exposures(capture: CaptureReader, views: list[View], notes: list[str]) -> tuple[dict[int, float], plan.Decision]:
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


def _calibrated(photos: _Photographs, notes: list[str]) -> _Photographs:
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


def _shared_surface(photos: _Photographs) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
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


# ------------------------------------------------------------------------------------------------------------- groups


def _statistics(photos: _Photographs) -> tuple[FaceStatistics, float]:
    """Statistics of the faces, and the threshold in units of the photograph."""
    scene, views, least = photos.scene, photos.views, photos.job.settings.emission.min_observations
    total = sum(view.width * view.height for view in views)
    stride = max(1, round(total / STATISTICS_PIXELS))
    parts: dict[str, list[np.ndarray]] = {name: [] for name in ("face", "value", "front", "interior")}
    for done, view in enumerate(views):
        pixels = photos.pixels(view)
        pixels = pixels.take(np.flatnonzero(pixels.valid)[::stride])
        parts["face"].append(pixels.face)
        parts["value"].append(pixels.value.astype(np.float32))
        parts["front"].append(pixels.from_front)
        parts["interior"].append(pixels.interior)
        photos.job.progress(done + 1, len(views), "views searched for emitters")
    face, value, front, inside = (np.concatenate(part) for part in parts.values())
    every = face_statistics(face, value, front, len(scene.faces))
    inner = face_statistics(face[inside], value[inside], front[inside], len(scene.faces))
    threshold = hdr_threshold(every) if photos.sensor.is_hdr else photos.sensor.saturation
    bright = value.max(1) >= threshold
    return with_thin_objects(inner, every, scene.object_id, face, bright, inside, least), float(threshold)


def _groups(job: Job, scene: BaseScene, statistics: FaceStatistics, threshold: float) -> tuple[EmitterGroups, int]:
    """Groups, and the number of candidate groups."""
    adjacency = face_adjacency(scene.faces)
    least = job.settings.emission.min_observations
    candidate = emitter_candidates(statistics, adjacency, scene.areas, threshold, least)
    groups = group_emitters(candidate, statistics, adjacency, scene.normals, scene.areas, min_observations=least)
    job.log.info("%d candidate faces in %d groups (%d left out)", candidate.sum(), groups.size, len(groups.dropped))
    return groups, groups.size + len(groups.dropped)


# -------------------------------------------------------------------------------------------------------------- cache


def _radiance_cache(photos: _Photographs, groups: EmitterGroups) -> tuple[RadianceVoxels, Sky, float, float | None]:
    """The cache of interior pixels that are not on an emitter; what the camera rays see that miss the mesh, their share,
    and their brightness relative to the others'."""
    edge = photos.job.settings.emission.cache_edge
    sums = RadianceSums(edge, cache_origin(photos.scene, edge))
    missed, bounded, total, mean_hit, hits, sky = 0, 0, 0, 0.0, 0, np.zeros(3)
    for done, view in enumerate(photos.views):
        pixels = photos.pixels(view)
        radiance, bound = photos.radiance(view, pixels.value)
        use = pixels.valid & pixels.interior & (groups.of_face[pixels.face] < 0)
        sums.add(pixels.points[use], radiance[use], bound[use].any(1))
        mean_hit += float(radiance[pixels.valid].mean(1).sum())
        hits += int(pixels.valid.sum())
        photo, valid = photos.capture.photo(view)
        out = valid.ravel().copy()
        out[pixels.index] = False
        values = photo.reshape(-1, 3)[out]
        values = values[np.isfinite(values).all(1)]
        outside, outside_bound = photos.radiance(view, values)
        sky += outside.sum(0)
        missed += len(values)
        bounded += int(outside_bound.any(1).sum())
        total += int(valid.sum())
        photos.job.progress(done + 1, len(photos.views), "views cached")
    sky = sky / max(missed, 1)
    brightness = float(sky.mean() / max(mean_hit / max(hits, 1), 1e-12)) if missed else None
    return sums.finish(), Sky(missed, sky, 2 * bounded > missed), missed / max(total, 1), brightness


def _secondary_escape(photos: _Photographs) -> float:
    """Share of cosine-distributed directions from visible surface that leave the mesh (METHOD 8, epsilon_2)."""
    geometry, _ = photos.scene.traceable()
    from iif_core.transport import trace

    rng = np.random.default_rng([photos.job.seed, _SEEDS])
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


# -------------------------------------------------------------------------------------------------------------- solve


def _choose_rows(photos: _Photographs, groups: EmitterGroups) -> tuple[ViewPixels, np.ndarray, PixelRows]:
    """A fixed number of pixels, evenly over views, plus enough on every emitter; their materials (n, 5)."""
    rng = np.random.default_rng([photos.job.seed, _SEEDS, 1])
    per_view = -(-photos.job.settings.emission.rows // len(photos.views))
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
    pixels, base, rows = zip(*parts, strict=True)
    return _joined(pixels), np.concatenate(base), _joined(rows)


def _joined(parts: tuple[Any, ...]) -> Any:
    """Records of arrays, one after another."""
    return type(parts[0])(**{name: np.concatenate([getattr(p, name) for p in parts]) for name in parts[0].__dict__})


def _solve(
    photos: _Photographs, groups: EmitterGroups, voxels: RadianceVoxels, sky: Sky, with_environment: bool
) -> tuple[EmissionSolution, dict[str, Any]]:
    """Transport rows of a subset of pixels, twice; pruned non-negative least squares; the table of emitters."""
    job = photos.job
    pixels, base, rows = _choose_rows(photos, groups)
    n_groups = groups.size + int(with_environment)
    initial = initial_radiance(rows, groups.observed, photos.sensor.is_hdr)
    if with_environment:
        initial = np.concatenate([initial, sky.radiance[None]])
    halves = _trace(photos, pixels, base, groups, voxels, n_groups, groups.size if with_environment else None)
    area = np.r_[groups.area, np.zeros(n_groups - groups.size)]
    protected = np.arange(n_groups) >= groups.size
    outside = sky if with_environment else None
    problem = assemble(rows, halves, n_groups, True, outside).with_gains(initial)
    pruned = prune_groups(problem.rows, initial, area, seen_radiance(rows, n_groups), protected, job.settings.emission.prune)
    # What remains is treated as black from here on: its pixels show its emission alone.
    kept = pruned.kept
    final = assemble(rows, halves, n_groups, False, outside)
    final = replace(final, rows=final.rows.columns(kept)).with_gains(initial[kept])
    part = solve_emission(final.rows, initial[kept])
    radiance, error = np.zeros((n_groups, 3)), np.zeros((n_groups, 3))
    radiance[kept], error[kept] = part.radiance, part.error
    number, left = int(kept[: groups.size].sum()), (part.residual, part.condition)
    job.log.info("%d of %d groups kept; residual %.3f, condition %.3g", number, groups.size, *left)
    return replace(part, radiance=radiance, error=error), _table(groups, pruned, radiance, error, sky, n_groups)


def _trace(
    photos: _Photographs,
    pixels: ViewPixels,
    base: np.ndarray,
    groups: EmitterGroups,
    voxels: RadianceVoxels,
    n_groups: int,
    environment_group: int | None,
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Two independent estimates of (A, h)."""
    job, settings = photos.job, photos.job.settings.emission
    geometry, material = photos.scene.traceable()
    from iif_core.transport import RadianceCache, transport_matrix

    cache = RadianceCache(voxels.edge, voxels.origin, voxels.ijk, voxels.radiance)
    side = np.where(groups.of_face >= 0, groups.side, 0).astype(np.int8)
    # Predicted metalness is rarely right and would darken the diffuse light of half the room; only the certain is
    # believed.
    metallic = np.where(base[:, 4] > METAL, base[:, 4], 0.0)
    surface = (pixels.points, pixels.normals, pixels.wo, base[:, :3], base[:, 3], metallic)
    samples, seed = max(1, settings.samples // 2), ((job.seed << 32) | _SEEDS) * 2
    halves = []
    for half in range(2):
        job.progress(half, 2, "halves of the transport matrix traced")
        columns = (groups.of_face, n_groups, side)
        paths = (samples, settings.max_bounces, seed + half, cache, environment_group)
        halves.append(transport_matrix(geometry, material, *surface, *columns, *paths))
    job.progress(2, 2, "halves of the transport matrix traced")
    return halves


# ------------------------------------------------------------------------------------------------------------ writing


def _table(
    groups: EmitterGroups, pruned: PrunedEmission, radiance: np.ndarray, error: np.ndarray, sky: Sky, n_groups: int
) -> dict[str, Any]:
    extra = n_groups - groups.size
    sides = np.array([_side_of(groups, g) for g in range(groups.size)] + [0] * extra, np.int32)
    return {
        "emitter_id": np.arange(n_groups, dtype=np.int32),
        "kind": np.array(["area"] * groups.size + ["environment"] * extra, dtype=str),
        "faces": np.r_[groups.faces, np.zeros(extra)].astype(np.int32),
        "area_m2": np.r_[groups.area, np.zeros(extra)].astype(np.float64),
        "side": sides,
        **{f"radiance_{c}": radiance[:, i].astype(np.float32) for i, c in enumerate("rgb")},
        **{f"error_{c}": error[:, i].astype(np.float32) for i, c in enumerate("rgb")},
        "observations": np.r_[groups.count, np.full(extra, sky.pixels)].astype(np.int64),
        "kept": pruned.kept.astype(bool),
        "reason": np.array(pruned.reason, dtype=str),
    }


def _side_of(groups: EmitterGroups, group: int) -> int:
    sides = groups.side[groups.of_face == group]
    return int(sides[0]) if len(sides) and (sides == sides[0]).all() else 0


def _write(job: Job, groups: EmitterGroups, table: dict[str, Any], cache: RadianceVoxels) -> None:
    units = {"area_m2": "m^2", "radiance_r": "relative", "error_r": "relative"}
    job.writer.table("emitters.parquet", table, units)
    face = np.flatnonzero(groups.of_face >= 0)
    face = face[table["kept"][groups.of_face[face]]] if len(face) else face
    columns = {
        "face_id": face.astype(np.int32),
        "emitter_id": groups.of_face[face].astype(np.int32),
        "side": groups.side[face].astype(np.int32),
    }
    job.writer.table("emitter_faces.parquet", columns)
    voxels = {name: cache.ijk[:, axis] for axis, name in enumerate("ijk")}
    voxels |= {f"radiance_{c}": cache.radiance[:, i] for i, c in enumerate("rgb")}
    voxels |= {"samples": cache.samples, "censored": cache.censored}
    job.writer.table("radiance_cache.parquet", voxels, {"radiance_r": "relative"})
