"""emission: which faces shine and how brightly, and the radiance cache of everything else (METHOD 2.0, 2.4-2.6, 7a)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from iif_core import plan
from iif_core.calibration import (
    CalibratedResponse,
    calibrate_response,
    calibration_facts,
    candidates,
    given_response,
    needs_rows,
)
from iif_core.cells import grid_origin
from iif_core.emitters import (
    EmitterGroups,
    FaceStatistics,
    RadianceSums,
    RadianceVoxels,
    emitter_candidates,
    face_adjacency,
    face_statistics,
    group_emitters,
    hdr_threshold,
)
from iif_core.nnls import (
    EmissionRows,
    EmissionSolution,
    PrunedEmission,
    block_rows,
    object_gains,
    prune_groups,
    scale_rows,
    solve_emission,
)
from iif_core.overlap import PatchRows, join_rows, no_rows, patch_edge, patch_numbers, patch_rows
from iif_core.response import Response, response_facts
from workflow.base_scene import BaseScene, ViewPixels, base_maps, cache_origin, read_base_scene, view_pixels
from workflow.job import Job
from workflow.normal_form import CaptureReader, View
from workflow.response_file import read_response_file

TILE = 8
"""Pixels of one object in one tile of this edge are averaged into one row (COMPUTE 4)."""
STATISTICS_PIXELS = 20_000_000
"""Photographs are thinned to about this many pixels for the statistics of faces."""
ANCHOR_PIXELS = 64
"""At least this many directly seen pixels a group enter the solve."""
ANCHOR_WEIGHT = 100.0
"""Weight of what is directly seen of a group relative to everything that its light does elsewhere: a face that is
looked at says what it emits; light it sends elsewhere also depends on albedos that the prior only guessed."""
METAL = 0.9
"""Predicted metalness from which a surface counts as metal in the solve."""
_SEEDS = 0x656D69  # keeps the random streams of this stage apart from those of others


@dataclass(frozen=True)
class _Light:
    """What turns photographs into radiance."""

    curve: Response
    is_hdr: bool
    saturation: float

    def radiance(self, value: np.ndarray, exposure: float) -> tuple[np.ndarray, np.ndarray]:
        """(n, 3) linear radiance and (n, 3) bool: only a lower bound."""
        if self.is_hdr:
            return np.maximum(value, 0.0), np.zeros(value.shape, bool)
        bound = value >= self.saturation
        return self.curve.inverse(np.clip(value, 0.0, self.saturation)) / exposure, bound


def run(job: Job) -> None:
    """Write emitters.parquet, emitter_faces.parquet, radiance_cache.parquet and emission.json."""
    capture, scene = CaptureReader(job.read("capture")), read_base_scene(job)
    views = [view for view in capture.views if view.split != "test"] or list(capture.views)
    notes: list[str] = []
    exposures, exposure_plan = _exposures(capture, views, notes)
    calibrated = _camera_response(job, capture, scene, views, exposures)
    job.log.info("camera response: %s", calibrated.reason)
    exposures |= {view.view_id: float(e) for view, e in zip(views, calibrated.exposure, strict=True)}
    notes.extend([calibrated.gauge] if calibrated.gauge else [])
    light = _Light(calibrated.response, capture.is_hdr, job.settings.emission.saturation)
    statistics, threshold = _statistics(job, capture, scene, views, light)
    groups, candidates = _groups(job, scene, statistics, threshold)
    cache, misses = _radiance_cache(job, capture, scene, views, light, exposures, groups)
    secondary = _secondary_escape(job, capture, scene, views)
    environment = plan.environment(
        job.settings.emission.environment,
        misses.share,
        secondary,
        misses.relative_brightness if misses.pixels else None,
    )
    solution, table = _solve(job, capture, scene, views, light, exposures, groups, cache, misses, environment["included"])
    _write(job, groups, table, cache)
    kept = int(np.count_nonzero(table["kept"] & (table["kind"] == "area")))
    for faces, area, reason in groups.dropped[:20]:
        notes.append(f"candidate of {faces} faces, {area:.2g} m^2, left out before the solve: {reason}")
    if not kept and not environment["included"]:
        notes.append("no emitter and no environment: light comes from the radiance cache alone, re-renderings will be dark")
    decisions = [environment, exposure_plan, plan.emitters(kept, groups.size - kept + len(groups.dropped), candidates)]
    job.writer.json(
        "emission.json",
        {
            "cache_edge_m": cache.edge,
            "cache_origin": [float(x) for x in cache.origin],
            "condition": solution.condition,
            "residual": solution.residual,
            "active_set": {
                "rounds": solution.iterations,
                "converged": solution.converged,
                "violated": solution.violated,
            },
            "escape_share": {"primary": misses.share, "secondary": secondary},
            "threshold": threshold if np.isfinite(threshold) else None,
            "exposure": [exposures[view.view_id] for view in capture.views],
            "response": {**response_facts(light.curve), "calibration": calibration_facts(calibrated)},
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


def _camera_response(
    job: Job, capture: CaptureReader, scene: BaseScene, views: list[View], exposures: dict[int, float]
) -> CalibratedResponse:
    """The measured curve, the family that is set, or the one that surface under different exposures speaks for."""
    setting = job.settings.affines.response
    exposure = np.array([exposures[view.view_id] for view in views])
    if not isinstance(setting, str) and not capture.is_hdr:
        return given_response(read_response_file(Path(setting.file)), f"measured: {setting.file}", exposure)
    families = candidates(setting, capture.facts["dynamic_range"])
    rows = _shared_surface(capture, scene, views, job) if needs_rows(families) else no_rows()
    return calibrate_response(
        rows, exposure, families, job.settings.emission.saturation, given=not capture.facts.get("exposure_estimated", False)
    )


def _shared_surface(capture: CaptureReader, scene: BaseScene, views: list[View], job: Job) -> PatchRows:
    """Patches of interior surface as the views show them."""
    footprints = [np.median(depth[depth > 0]) / view.fx for view in views if (depth := capture.gbuffer(view)[0]).any()]
    extent = float(np.ptp(scene.vertices, axis=0).max())
    edge = patch_edge(float(np.median(footprints)), extent) if footprints else max(extent, 1.0)
    origin = grid_origin(scene.vertices[scene.faces.ravel()], edge)
    share = min(1.0, STATISTICS_PIXELS / max(sum(view.width * view.height for view in views), 1))
    parts = [no_rows()]
    for number, view in enumerate(views):
        pixels = view_pixels(job, capture, scene, view)
        pixels = pixels.take(np.flatnonzero(pixels.valid & pixels.interior))
        patch = patch_numbers(pixels.points, pixels.object_id, edge, origin)
        saturation = job.settings.emission.saturation
        parts.append(patch_rows(patch, pixels.normals, pixels.object_id, pixels.value, number, saturation, share=share))
        job.progress(number + 1, len(views), "views compared for the camera response")
    return join_rows(parts)


# ------------------------------------------------------------------------------------------------------------- groups


def _statistics(
    job: Job, capture: CaptureReader, scene: BaseScene, views: list[View], light: _Light
) -> tuple[FaceStatistics, float]:
    """Statistics of the faces, and the threshold in units of the photograph.

    Pixels at the border of an object mix with what is beside it, so interior ones count. An object too thin to
    have any (a filament) is judged by all of its pixels, if nearly all of them are bright: the frame of a window
    is not.
    """
    total = sum(view.width * view.height for view in views)
    stride = max(1, round(total / STATISTICS_PIXELS))
    parts: dict[str, list[np.ndarray]] = {name: [] for name in ("face", "value", "front", "interior")}
    for done, view in enumerate(views):
        pixels = view_pixels(job, capture, scene, view)
        pixels = pixels.take(np.flatnonzero(pixels.valid)[::stride])
        parts["face"].append(pixels.face)
        parts["value"].append(pixels.value.astype(np.float32))
        parts["front"].append(pixels.from_front)
        parts["interior"].append(pixels.interior)
        job.progress(done + 1, len(views), "views searched for emitters")
    face, value, front, inside = (np.concatenate(part) for part in parts.values())
    every = face_statistics(face, value, front, len(scene.faces))
    inner = face_statistics(face[inside], value[inside], front[inside], len(scene.faces))
    threshold = hdr_threshold(every) if light.is_hdr else light.saturation
    owner = scene.object_id[face] + 1
    size = scene.n_objects + 1
    pixels_of = np.maximum(np.bincount(owner, minlength=size), 1)
    bright = np.bincount(owner, value.max(1) >= threshold, size) / pixels_of
    thin = np.bincount(owner, inside, size) < job.settings.emission.min_observations
    allow = (thin & (bright >= 0.9))[scene.object_id + 1] & (scene.object_id >= 0)
    merged = {
        name: np.where(allow.reshape(-1, *[1] * (getattr(every, name).ndim - 1)), getattr(every, name), getattr(inner, name))
        for name in ("count", "low", "mean", "front")
    }
    return FaceStatistics(**merged), float(threshold)


def _groups(job: Job, scene: BaseScene, statistics: FaceStatistics, threshold: float) -> tuple[EmitterGroups, int]:
    """Groups, and the number of candidate groups."""
    adjacency = face_adjacency(scene.faces)
    least = job.settings.emission.min_observations
    candidate = emitter_candidates(statistics, adjacency, scene.areas, threshold, least)
    groups = group_emitters(candidate, statistics, adjacency, scene.normals, scene.areas, min_observations=least)
    job.log.info("%d candidate faces in %d groups (%d left out)", candidate.sum(), groups.size, len(groups.dropped))
    return groups, groups.size + len(groups.dropped)


# -------------------------------------------------------------------------------------------------------------- cache


@dataclass(frozen=True)
class _Misses:
    """Camera rays that leave the mesh."""

    share: float
    pixels: int
    radiance: np.ndarray  # (3,) mean
    bounded: bool  # most of them are saturated
    relative_brightness: float


def _radiance_cache(
    job: Job,
    capture: CaptureReader,
    scene: BaseScene,
    views: list[View],
    light: _Light,
    exposures: dict[int, float],
    groups: EmitterGroups,
) -> tuple[RadianceVoxels, _Misses]:
    """Mean radiance per voxel of interior pixels that are not on an emitter; and what the rays see that miss the
    mesh."""
    edge = job.settings.emission.cache_edge
    sums = RadianceSums(edge, cache_origin(scene, edge))
    missed, bounded, total, mean_hit, hits, sky = 0, 0, 0, 0.0, 0, np.zeros(3)
    for done, view in enumerate(views):
        pixels = view_pixels(job, capture, scene, view)
        radiance, bound = light.radiance(pixels.value, exposures[view.view_id])
        use = pixels.valid & pixels.interior & (groups.of_face[pixels.face] < 0)
        sums.add(pixels.points[use], radiance[use], bound[use].any(1))
        mean_hit += float(radiance[pixels.valid].mean(1).sum())
        hits += int(pixels.valid.sum())
        photo, valid = capture.photo(view)
        out = valid.ravel().copy()
        out[pixels.index] = False
        values = photo.reshape(-1, 3)[out]
        values = values[np.isfinite(values).all(1)]
        outside, outside_bound = light.radiance(values, exposures[view.view_id])
        sky += outside.sum(0)
        missed += len(values)
        bounded += int(outside_bound.any(1).sum())
        total += int(valid.sum())
        job.progress(done + 1, len(views), "views cached")
    sky = sky / max(missed, 1)
    brightness = float(sky.mean() / max(mean_hit / max(hits, 1), 1e-12))
    return sums.finish(), _Misses(missed / max(total, 1), missed, sky, 2 * bounded > missed, brightness)


def _secondary_escape(job: Job, capture: CaptureReader, scene: BaseScene, views: list[View]) -> float:
    """Share of cosine-distributed directions from visible surface that leave the mesh (METHOD 8, epsilon_2)."""
    geometry, _ = scene.traceable()
    from iif_core.transport import trace

    rng = np.random.default_rng([job.seed, _SEEDS])
    origins, directions = [], []
    for view in views:
        pixels = view_pixels(job, capture, scene, view)
        if not len(pixels.index):
            continue
        pixels = pixels.take(rng.integers(0, len(pixels.index), max(1, 65536 // len(views))))
        normal = pixels.normals.astype(np.float64)
        sphere = rng.normal(size=normal.shape)
        sphere /= np.maximum(np.linalg.norm(sphere, axis=1, keepdims=True), 1e-12)
        # A uniform point on the sphere that touches the surface from above is cosine-distributed.
        way = normal + sphere
        way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-6)
        origins.append(pixels.points + 1e-3 * normal)
        directions.append(way)
    if not origins:
        return 1.0
    face, _ = trace(geometry, np.concatenate(origins), np.concatenate(directions))
    return float((face < 0).mean())


# -------------------------------------------------------------------------------------------------------------- solve


@dataclass(frozen=True)
class _Rows:
    """The pixels whose transport is traced."""

    pixels: ViewPixels
    base: np.ndarray  # (n, 5)
    radiance: np.ndarray  # (n, 3)
    bound: np.ndarray  # (n, 3)
    view: np.ndarray  # (n,)
    tile: np.ndarray  # (n,)
    group: np.ndarray  # (n,) emitter group that the pixel looks at, -1 = none


def _choose_rows(
    job: Job,
    capture: CaptureReader,
    scene: BaseScene,
    views: list[View],
    light: _Light,
    exposures: dict[int, float],
    groups: EmitterGroups,
) -> _Rows:
    """A fixed number of pixels, evenly over views, plus enough on every emitter."""
    rng = np.random.default_rng([job.seed, _SEEDS, 1])
    per_view = -(-job.settings.emission.rows // len(views))
    parts: list[_Rows] = []
    for view in views:
        pixels = view_pixels(job, capture, scene, view)
        group = groups.of_face[pixels.face]
        side = groups.side[pixels.face]
        away = (group >= 0) & (side != 0) & ((side > 0) != pixels.from_front)
        usable = pixels.valid & ~away & (pixels.interior | (group >= 0))
        on_emitter = np.flatnonzero(usable & (group >= 0))
        elsewhere = np.flatnonzero(usable & (group < 0))
        chosen = [rng.permutation(elsewhere)[:per_view]]
        quota = -(-ANCHOR_PIXELS // len(views))
        for g in np.unique(group[on_emitter]):
            own = on_emitter[group[on_emitter] == g]
            inner = own[pixels.interior[own]]
            chosen.append(rng.permutation(inner if len(inner) else own)[: max(quota, 4)])
        choice = np.sort(np.concatenate(chosen))
        part = pixels.take(choice)
        radiance, bound = light.radiance(part.value, exposures[view.view_id])
        row, column = part.index // view.width, part.index % view.width
        tile = (row // TILE) * (-(-view.width // TILE)) + column // TILE
        parts.append(
            _Rows(
                part,
                base_maps(job, view)[part.index],
                radiance,
                bound,
                np.full(len(choice), view.view_id),
                tile,
                group[choice],
            )
        )
    joined = {
        name: np.concatenate([getattr(p, name) for p in parts]) for name in ("base", "radiance", "bound", "view", "tile", "group")
    }
    fields = parts[0].pixels.__dict__
    pixels = ViewPixels(**{name: np.concatenate([getattr(p.pixels, name) for p in parts]) for name in fields})
    return _Rows(pixels, **joined)


def _solve(
    job: Job,
    capture: CaptureReader,
    scene: BaseScene,
    views: list[View],
    light: _Light,
    exposures: dict[int, float],
    groups: EmitterGroups,
    voxels: RadianceVoxels,
    misses: _Misses,
    with_environment: bool,
) -> tuple[EmissionSolution, dict[str, Any]]:
    """Transport rows of a subset of pixels, twice; pruned non-negative least squares; the table of emitters."""
    rows = _choose_rows(job, capture, scene, views, light, exposures, groups)
    environment = groups.size if with_environment else None
    n_groups = groups.size + int(with_environment)
    initial = _initial(light, groups, rows, misses, with_environment)
    halves = _trace(job, scene, rows, groups, voxels, n_groups, environment)
    area = np.r_[groups.area, np.zeros(n_groups - groups.size)]
    protected = np.arange(n_groups) >= groups.size
    system = _system(rows, halves, n_groups, environment, misses, reflecting=True).with_gains(initial)
    pruned = prune_groups(system.rows, initial, area, _observed(rows, n_groups), protected, job.settings.emission.prune)
    # What remains is treated as black from here on: its pixels show its emission alone.
    kept = pruned.kept
    final = _system(rows, halves, n_groups, environment, misses, reflecting=False)
    final = replace(final, rows=final.rows.columns(kept)).with_gains(initial[kept])
    part = solve_emission(final.rows, initial[kept])
    radiance, error = np.zeros((n_groups, 3)), np.zeros((n_groups, 3))
    radiance[kept], error[kept] = part.radiance, part.error
    job.log.info(
        "%d of %d groups kept; residual %.3f, condition %.3g",
        int(kept[: groups.size].sum()),
        groups.size,
        part.residual,
        part.condition,
    )
    return replace(part, radiance=radiance, error=error), _table(groups, rows, pruned, radiance, error, misses, n_groups)


def _initial(light: _Light, groups: EmitterGroups, rows: _Rows, misses: _Misses, with_environment: bool) -> np.ndarray:
    """Mean radiance seen on each group (a lower bound where saturated); the mean of the escaping rays for the
    environment."""
    out = np.zeros((groups.size, 3))
    for g in range(groups.size):
        own = rows.group == g
        if not own.any():
            out[g] = groups.observed[g] if light.is_hdr else 1.0
        else:
            # Of bounds at different exposures the high ones say most.
            out[g] = rows.radiance[own].mean(0) if light.is_hdr else np.quantile(rows.radiance[own], 0.9, axis=0)
    return np.concatenate([out, misses.radiance[None]]) if with_environment else out


def _trace(
    job: Job,
    scene: BaseScene,
    rows: _Rows,
    groups: EmitterGroups,
    voxels: RadianceVoxels,
    n_groups: int,
    environment_group: int | None,
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Two independent estimates of (A, h)."""
    geometry, material = scene.traceable()
    from iif_core.transport import RadianceCache, transport_matrix

    cache = RadianceCache(voxels.edge, voxels.origin, voxels.ijk, voxels.radiance)
    side = np.where(groups.of_face >= 0, groups.side, 0).astype(np.int8)
    # Predicted metalness is rarely right and would darken the diffuse light of half the room; only the certain is
    # believed.
    pixels, base = rows.pixels, rows.base
    metallic = np.where(base[:, 4] > METAL, base[:, 4], 0.0)
    halves = []
    for half in range(2):
        job.progress(half, 2, "halves of the transport matrix traced")
        halves.append(
            transport_matrix(
                geometry,
                material,
                pixels.points,
                pixels.normals,
                pixels.wo,
                base[:, :3],
                base[:, 3],
                metallic,
                groups.of_face,
                n_groups,
                side,
                max(1, job.settings.emission.samples // 2),
                job.settings.emission.max_bounces,
                ((job.seed << 32) | _SEEDS) * 2 + half,
                cache,
                environment_group,
            )
        )
    job.progress(2, 2, "halves of the transport matrix traced")
    return halves


@dataclass(frozen=True)
class _System:
    """Averaged rows with what they observed, the object that reflects (-1: emission itself), and which are anchors."""

    rows: EmissionRows
    observed: np.ndarray
    owner: np.ndarray
    anchor: np.ndarray

    def with_gains(self, initial: np.ndarray) -> _System:
        """Rows scaled by the albedo gains of the objects that go with the light."""
        # Cached radiance (h) is measured, so the light has a scale even where no emitter is seen unsaturated.
        pinned = bool(np.any(self.rows.target < self.observed)) or bool((self.anchor & ~self.rows.lower_bound.any(1)).any())
        gain = object_gains(self.rows, self.observed, self.owner, initial, pinned)
        of_row = np.ones(self.observed.shape)
        known = self.owner >= 0
        of_row[known] = gain[self.owner[known]]
        return replace(self, rows=scale_rows(self.rows, self.observed, of_row))


def _system(
    rows: _Rows,
    halves: list[tuple[np.ndarray, np.ndarray]],
    n_groups: int,
    environment_group: int | None,
    misses: _Misses,
    reflecting: bool,
) -> _System:
    """Averages over (view, tile, object) with their weights; directly seen emitters and sky as rows of their own.

    `reflecting`: emitters also reflect, and are not trusted more than other rows; otherwise they are black anchors.
    """
    on_emitter = rows.group >= 0
    direct = np.zeros((len(rows.group), n_groups, 3), np.float32)
    direct[np.flatnonzero(on_emitter), rows.group[on_emitter]] = 1.0
    reflects = np.ones(len(rows.group), np.float32) if reflecting else np.where(on_emitter, 0.0, 1.0).astype(np.float32)
    first, second = (direct + a * reflects[:, None, None] for a, _ in halves)
    targets = [rows.radiance - h * reflects[:, None] for _, h in halves]
    ones = np.ones((len(rows.group), 3))
    owner = np.where(on_emitter, -1, rows.pixels.object_id)
    keys, block = np.unique(np.stack([owner, rows.group, rows.view, rows.tile], 1), axis=0, return_inverse=True)
    system = block_rows(EmissionRows(first, second, *targets, ones, rows.bound), block.ravel())
    empty = direct[:, :0]
    # The same blocks again for y itself, and for the number of the block.
    seen = block_rows(EmissionRows(empty, empty, rows.radiance, rows.radiance, ones, rows.bound), block.ravel())
    number = np.repeat(block.ravel().astype(np.float64)[:, None], 3, 1)
    label = block_rows(EmissionRows(empty, empty, number, number, ones, rows.bound), block.ravel()).target[:, 0]
    key = keys[np.round(label).astype(np.int64)] if len(keys) else keys.reshape(0, 4)
    brightness = seen.target.mean(1, keepdims=True)
    floor = 0.05 * float(np.median(brightness)) if len(brightness) else 1.0
    weight = system.weight / np.maximum(brightness + floor, 1e-12) ** 2
    out = _System(replace(system, weight=weight), seen.target, key[:, 0].astype(np.int64), key[:, 1] >= 0)
    if environment_group is not None and misses.pixels:
        out = _with_sky(out, n_groups, environment_group, misses)
    return out if reflecting else replace(out, rows=_strengthen(out.rows, out.anchor))


def _with_sky(system: _System, n_groups: int, group: int, misses: _Misses) -> _System:
    """One more row: the mean of the camera rays that leave the mesh."""
    row = np.zeros((1, n_groups, 3), np.float32)
    row[0, group] = 1.0
    sky = misses.radiance[None]
    weight = np.full((1, 3), misses.pixels / max(float(sky.mean()), 1e-6) ** 2)
    old = system.rows
    added = EmissionRows(
        np.concatenate([old.first, row]),
        np.concatenate([old.second, row]),
        np.concatenate([old.target, sky]),
        np.concatenate([old.target_second, sky]),
        np.concatenate([old.weight, weight]),
        np.concatenate([old.lower_bound, np.full((1, 3), misses.bounded)]),
    )
    return _System(added, np.concatenate([system.observed, sky]), np.r_[system.owner, -1], np.r_[system.anchor, True])


def _strengthen(system: EmissionRows, anchor: np.ndarray) -> EmissionRows:
    """Anchors outweigh the rest of their column by ANCHOR_WEIGHT."""
    if not anchor.any():
        return system
    mean = 0.5 * (system.first + system.second)
    elsewhere = np.einsum("nc,ngc->gc", np.where(anchor[:, None], 0.0, system.weight), mean.astype(np.float64) ** 2)
    group = mean[anchor].max(2).argmax(1)
    weight = system.weight.copy()
    own = np.zeros(elsewhere.shape)
    np.add.at(own, group, weight[anchor])
    factor = np.maximum(1.0, ANCHOR_WEIGHT * elsewhere / np.maximum(own, 1e-300))
    weight[anchor] *= factor[group]
    return replace(system, weight=weight)


def _observed(rows: _Rows, n_groups: int) -> np.ndarray:
    """(G, 3) mean radiance of the pixels on each group that were not saturated; 0 without any."""
    out = np.zeros((n_groups, 3))
    clear = (rows.group >= 0) & ~rows.bound.any(1)
    count = np.bincount(rows.group[clear], minlength=n_groups)
    for c in range(3):
        out[:, c] = np.bincount(rows.group[clear], rows.radiance[clear, c], n_groups) / np.maximum(count, 1)
    return out


# ------------------------------------------------------------------------------------------------------------ writing


def _table(
    groups: EmitterGroups,
    rows: _Rows,
    pruned: PrunedEmission,
    radiance: np.ndarray,
    error: np.ndarray,
    misses: _Misses,
    n_groups: int,
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
        "observations": np.r_[groups.count, np.full(extra, misses.pixels)].astype(np.int64),
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
