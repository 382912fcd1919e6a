"""emission: which faces shine and how brightly, and the radiance cache of everything else (METHOD 2.0, 2.4-2.6, 7a)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from iif_core import plan
from iif_core.emission.cache import RadianceSums, RadianceVoxels
from iif_core.emission.candidates import (
    FaceStatistics,
    emitter_candidates,
    face_statistics,
    radiance_threshold,
    with_thin_objects,
)
from iif_core.emission.direct import EmissionSolution, solve_families
from iif_core.emission.environment import Sky, SkySums, cosine_directions
from iif_core.emission.groups import EmitterGroups, group_emitters
from iif_core.emission.problem import PixelRows, assemble, initial_radiance, white_surface
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
WHITE = (1.0, 1.0, 1.0, 1.0, 0.0)
"""Base material of the brightest surface that only reflects."""
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
    """Write emitters.parquet, emitter_faces.parquet, radiance_cache.parquet, environment_texels.parquet and emission.json."""
    capture, scene = CaptureReader(job.read("capture")), read_base_scene(job)
    views = [view for view in capture.views if view.split != "test"] or list(capture.views)
    family = family_for(job.settings.affines.response, capture.facts["dynamic_range"])
    notes: list[str] = []
    exposures, exposure_plan = _exposures(capture, views, notes)
    sensor = Sensor(response(family), capture.is_hdr, job.settings.emission.saturation)
    photos = _calibrated(_Photographs(job, capture, scene, views, sensor, exposures), notes)
    statistics, threshold = _statistics(photos)
    adjacency, least = face_adjacency(scene.faces), job.settings.emission.min_observations
    candidate = emitter_candidates(statistics, adjacency, scene.areas, threshold, least)
    groups = group_emitters(candidate, statistics, adjacency, scene.normals, scene.areas, min_observations=least)
    job.log.info("%d candidate faces in %d groups (%d left out)", candidate.sum(), groups.size, len(groups.dropped))
    cache, sums, escape, brightness = _radiance_cache(photos, groups)
    secondary = _secondary_escape(photos)
    environment = plan.environment(job.settings.emission.environment, escape, secondary, brightness)
    outside = sums.groups() if environment["included"] else None
    pruned = _trial(photos, groups, cache, outside)
    lit = pruned.kept[: groups.size]
    candidates, left_out = groups.size + len(groups.dropped), groups.select(~lit)
    reasons = [reason for reason, keep in zip(pruned.reason, pruned.kept, strict=True) if not keep]
    groups = groups.select(lit)
    if left_out.size:
        cache = _radiance_cache(photos, groups)[0]
    solution = _solve(photos, groups, cache, outside)
    table = _table(groups, left_out, reasons, solution, outside)
    _write(job, groups, table, cache, outside)
    kept = int(np.count_nonzero(table["kept"] & (table["kind"] == "area")))
    job.log.info("%d of %d groups kept; residual %.3f, condition %.3g", kept, candidates, solution.residual, solution.condition)
    for faces, area, reason in groups.dropped[:20]:
        notes.append(f"candidate of {faces} faces, {area:.2g} m^2, left out before the solve: {reason}")
    if not kept and not environment["included"]:
        notes.append("no emitter and no environment: light comes from the radiance cache alone, re-renderings will be dark")
    decisions = [environment, exposure_plan, plan.emitters(kept, candidates - kept, candidates)]
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


# -------------------------------------------------------------------------------------------------------------- cache


def _radiance_cache(photos: _Photographs, groups: EmitterGroups) -> tuple[RadianceVoxels, SkySums, float, float | None]:
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


def _choose_rows(photos: _Photographs, groups: EmitterGroups, thin: int = 1) -> tuple[ViewPixels, np.ndarray, PixelRows]:
    """A fixed number of pixels, evenly over views (one in `thin`), plus enough on every emitter; their materials (n, 5)."""
    rng = np.random.default_rng([photos.job.seed, _SEEDS, 1])
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


def _trial(photos: _Photographs, groups: EmitterGroups, voxels: RadianceVoxels, sky: Sky | None) -> PrunedEmission:
    """Which groups shine, from half of the rows."""
    pixels, base, rows = _choose_rows(photos, groups, 2)
    own = rows.group >= 0
    halves = _trace(photos, pixels, base, groups, voxels, sky, 0)
    paint = np.tile(np.float32(WHITE), (int(own.sum()), 1))
    white = _trace(photos, pixels.take(own), paint, groups, voxels, sky, 1)
    seen, initial = _initial(photos, groups, rows, sky)
    n_groups = len(initial)
    trial = assemble(rows, halves, n_groups, white, sky).with_gains(initial)
    area, protected = np.r_[groups.area, np.zeros(n_groups - groups.size)], np.arange(n_groups) >= groups.size
    evidence = white_surface(rows, np.concatenate([seen, np.zeros((n_groups - groups.size, 3))]), white)
    share = photos.job.settings.emission.prune
    return prune_groups(trial.rows, initial, area, evidence, ~trial.anchor, protected, share)


def _initial(photos: _Photographs, groups: EmitterGroups, rows: PixelRows, sky: Sky | None) -> tuple[np.ndarray, np.ndarray]:
    """Radiance seen on the groups, and with the environment's."""
    seen = initial_radiance(rows, groups.observed, photos.sensor.is_hdr)
    return seen, seen if sky is None else np.concatenate([seen, sky.radiance])


def _solve(photos: _Photographs, groups: EmitterGroups, voxels: RadianceVoxels, sky: Sky | None) -> EmissionSolution:
    """Emission of the groups that shine, which are black from here on, and of the environment."""
    pixels, base, rows = _choose_rows(photos, groups)
    halves = _trace(photos, pixels, base, groups, voxels, sky, 3)
    initial = _initial(photos, groups, rows, sky)[1]
    problem = assemble(rows, halves, len(initial), None, sky).with_gains(initial)
    # Parts of one object shine alike, more or less; the environment knows no such thing.
    face = np.flatnonzero(groups.of_face >= 0)
    family = -1 - np.arange(len(initial))
    family[groups.of_face[face]] = photos.scene.object_id[face]
    return solve_families(problem.rows, initial, family)


def _trace(
    photos: _Photographs,
    pixels: ViewPixels,
    base: np.ndarray,
    groups: EmitterGroups,
    voxels: RadianceVoxels,
    sky: Sky | None,
    stream: int,
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
    samples, seed = max(1, settings.samples // 2), ((job.seed << 32) | _SEEDS) * 8 + 2 * stream
    halves = []
    for half in range(2):
        job.progress(half, 2, "halves of the transport matrix traced")
        columns = (groups.of_face, groups.size + (sky.size if sky else 0), side)
        paths = (samples, settings.max_bounces, seed + half, cache, sky.columns + groups.size if sky else None)
        halves.append(transport_matrix(geometry, material, *surface, *columns, *paths))
    job.progress(2, 2, "halves of the transport matrix traced")
    return halves


# ------------------------------------------------------------------------------------------------------------ writing


def _table(
    groups: EmitterGroups, left_out: EmitterGroups, reasons: list[str], solution: EmissionSolution, sky: Sky | None
) -> dict[str, Any]:
    """Emitters, the environment, and the groups that turned out to reflect."""
    outside, out = sky.size if sky else 0, left_out.size
    sides = [[_side_of(g, i) for i in range(g.size)] for g in (groups, left_out)]
    pixels = sky.pixels if sky else np.zeros(0)
    radiance, error = (np.r_[values, np.zeros((out, 3))] for values in (solution.radiance, solution.error))
    return {
        "emitter_id": np.arange(groups.size + outside + out, dtype=np.int32),
        "kind": np.array(["area"] * groups.size + ["environment"] * outside + ["area"] * out, dtype=str),
        "faces": np.r_[groups.faces, np.zeros(outside), left_out.faces].astype(np.int32),
        "area_m2": np.r_[groups.area, np.zeros(outside), left_out.area].astype(np.float64),
        "side": np.array([*sides[0], *[0] * outside, *sides[1]], np.int32),
        **{f"radiance_{c}": radiance[:, i].astype(np.float32) for i, c in enumerate("rgb")},
        **{f"error_{c}": error[:, i].astype(np.float32) for i, c in enumerate("rgb")},
        "observations": np.r_[groups.count, pixels, left_out.count].astype(np.int64),
        "kept": np.arange(groups.size + outside + out) < groups.size + outside,
        "reason": np.array([""] * (groups.size + outside) + reasons, dtype=str),
    }


def _side_of(groups: EmitterGroups, group: int) -> int:
    sides = groups.side[groups.of_face == group]
    return int(sides[0]) if len(sides) and (sides == sides[0]).all() else 0


def _write(job: Job, groups: EmitterGroups, table: dict[str, Any], cache: RadianceVoxels, sky: Sky | None) -> None:
    units = {"area_m2": "m^2", "radiance_r": "relative", "error_r": "relative"}
    job.writer.table("emitters.parquet", table, units)
    face = np.flatnonzero(groups.of_face >= 0)
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
    if sky:
        row, column = np.indices(sky.columns.shape).astype(np.int32)
        ids = (sky.columns + groups.size).astype(np.int32)
        texels = {"row": row.ravel(), "column": column.ravel(), "emitter_id": ids.ravel()}
        job.writer.table("environment_texels.parquet", texels)
