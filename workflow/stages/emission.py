"""emission: which faces shine and how brightly, and the radiance cache of everything else (docs/method/light.md)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from iif_core.camera.calibration.choice import calibration_facts
from iif_core.camera.response import response, response_facts
from iif_core.light.emission.cache import RadianceVoxels
from iif_core.light.emission.candidates import emitter_candidates
from iif_core.light.emission.direct import FAMILY_WIDTH, OUTSIDE_WIDTH, EmissionPrior, EmissionSolution, solve_families
from iif_core.light.emission.environment import Sky, sky_prior
from iif_core.light.emission.gains import PRIOR_LEVEL_ERROR, ObjectGains
from iif_core.light.emission.groups import EmitterGroups, GroupingOptions, group_emitters
from iif_core.light.emission.loss import reference_loss
from iif_core.light.emission.pixels import EmissionPixels
from iif_core.light.emission.problem import assemble, expected_radiance, initial_radiance, white_surface
from iif_core.light.emission.pruning import CERTAIN_EXCESS, CERTAIN_EXCESS_OPEN, PrunedEmission, prune_groups
from iif_core.light.emission.rows import TracedTransport
from iif_core.light.emission.sensor import Sensor
from iif_core.light.emission.sgd import SgdOptions, solve_emission_sgd
from iif_core.surface.segments import face_adjacency
from workflow import decisions
from workflow.runtime.job import Job
from workflow.scene.base_scene import ViewPixels, read_base_scene
from workflow.scene.emission_pixels import (
    SEEDS,
    Photographs,
    ViewRecords,
    calibrated,
    choose_rows,
    escaping_share,
    gain_plan,
    radiance_cache,
    statistics_of_faces,
    view_exposures,
)
from workflow.scene.normal_form import CaptureReader

if TYPE_CHECKING:
    from iif_core.light.transport.materials import CellMaterials

WHITE = (1.0, 1.0, 1.0, 1.0, 0.0)
"""Material of the brightest surface that only reflects."""
METAL = 0.9
"""Predicted metalness above which a surface counts as metal in the solve."""


def run(job: Job) -> None:
    """Write emitters.parquet, emitter_faces.parquet, object_gains.parquet, radiance_cache.parquet, environment_texels.parquet
    and emission.json."""
    capture, scene = CaptureReader(job.read("capture")), read_base_scene(job)
    views = capture.used
    notes: list[str] = []
    known = view_exposures(capture, notes)
    unknown = Sensor(response("identity"), capture.is_hdr, job.settings.emission.saturation)
    records = ViewRecords(job, capture, scene)
    photos, camera = calibrated(Photographs(job, capture, scene, views, unknown, known, records))
    notes.extend([camera.gauge] if camera.gauge else [])
    adjacency, least = face_adjacency(scene.faces), job.settings.emission.min_observations
    statistics, threshold, glowing = statistics_of_faces(photos, adjacency)
    candidate = emitter_candidates(statistics, adjacency, scene.areas, threshold, least, glowing)
    options = GroupingOptions(min_observations=least)
    groups = group_emitters(candidate, statistics, adjacency, scene.normals, scene.areas, options, glowing)
    job.log.info("%d candidate faces in %d groups (%d left out)", candidate.sum(), groups.size, len(groups.dropped))
    cache, sums, escape, brightness = radiance_cache(photos, groups)
    secondary = escaping_share(photos)
    environment = decisions.environment(job.settings.emission.environment, escape, secondary, brightness)
    is_open = secondary > decisions.ESCAPE_OPEN
    outside = (sums.directions() if is_open else sums.groups()) if environment["included"] else None
    if outside is not None and is_open:
        notes.append(
            f"{secondary:.0%} of the rays from the surface leave the mesh: light from twelve directions, as the room shows it"
        )
    certain = CERTAIN_EXCESS_OPEN if outside is not None and outside.is_unseen else CERTAIN_EXCESS
    pruned, gain = _trial(photos, groups, cache, outside, certain, threshold)
    lit = pruned.kept[: groups.size]
    candidates, left_out = groups.size + len(groups.dropped), groups.select(~lit)
    reasons = [reason for reason, keep in zip(pruned.reason, pruned.kept, strict=True) if not keep]
    groups = groups.select(lit)
    if left_out.size:
        cache = radiance_cache(photos, groups)[0]
    solution, loss, found, gain = _solve(photos, gain, groups, cache, outside, threshold)
    table = _table(groups, left_out, reasons, solution, outside)
    _write(job, groups, table, cache, outside)
    gains = {f"gain_{c}": gain[:, i].astype(np.float32) for i, c in enumerate("rgb")}
    job.writer.table("object_gains.parquet", {"object_id": np.arange(len(gain), dtype=np.int32), **gains})
    kept = int(np.count_nonzero(table["kept"] & (table["kind"] == "area")))
    job.log.info("%d of %d groups kept; residual %.3f, condition %.3g", kept, candidates, solution.residual, solution.condition)
    for why in sorted({reason for _, _, reason in groups.dropped}):
        areas = [area for _, area, reason in groups.dropped if reason == why]
        notes.append(f"{len(areas)} candidates (the largest {max(areas):.2g} m^2) left out before the solve: {why}")
    if not kept and not environment["included"]:
        notes.append("no emitter and no environment: light comes from the radiance cache alone, re-renderings will be dark")
    if found.level_raised > 0:
        raised = f"light raised {np.exp(found.level_raised):.2f} times so that albedos are at most 1"
        notes.append(f"{raised}; the error of its level does not contain that")
    plan = [environment, *gain_plan(capture, photos.gains), decisions.emitters(kept, candidates - kept, candidates)]
    active_set = {"rounds": solution.iterations, "converged": solution.converged, "violated": solution.violated}
    job.writer.json(
        "emission.json",
        {
            "cache_edge_m": cache.edge,
            "cache_origin": [float(x) for x in cache.origin],
            "condition": solution.condition,
            "residual": solution.residual,
            "solver": job.settings.emission.solver,
            "reference_loss": loss,
            "level_error": found.level_error if np.isfinite(found.level_error) else None,
            "level_raised": found.level_raised,
            "active_set": active_set,
            "escape_share": {"primary": escape, "secondary": secondary},
            "threshold": threshold if np.isfinite(threshold) else None,
            "exposure": photos.gains.exposure.tolist(),
            "gain": photos.gains.gain.tolist(),
            "vignetting": photos.gains.vignetting.tolist(),
            "response": {**response_facts(camera.response), "calibration": calibration_facts(camera)},
            "plan": plan,
            "notes": notes,
        },
    )


# -------------------------------------------------------------------------------------------------------------- solve


def _trial(
    photos: Photographs, groups: EmitterGroups, voxels: RadianceVoxels, sky: Sky | None, certain: float, threshold: float
) -> tuple[PrunedEmission, np.ndarray]:
    """Find which groups emit light, and the albedo gains of objects (n_objects, 3), from half of the rows."""
    pixels, base, rows = choose_rows(photos, groups, threshold, 2)
    own = rows.group >= 0
    transport = _trace(photos, pixels, base, groups, voxels, sky, 0).without_lobes()
    paint = np.tile(np.float32(WHITE), (int(own.sum()), 1))
    white = _trace(photos, pixels.take(own), paint, groups, voxels, sky, 1).without_lobes()
    seen, prior = _prior(photos, groups, rows, sky)
    n_groups = len(prior.initial)
    problem = assemble(rows, transport, n_groups, white, sky)
    trial, gains = problem.solve_object_gains(prior, _albedo_limit(photos, sky), photos.scene.n_objects)
    family, protected = _families(photos, groups, n_groups), np.arange(n_groups) >= groups.size
    evidence = white_surface(rows, np.concatenate([seen, np.zeros((n_groups - groups.size, 3))]), white)
    share = photos.job.settings.emission.prune
    return prune_groups(trial.rows, prior, family, evidence, ~trial.anchor, protected, share, certain), _reliable(gains)


def _families(photos: Photographs, groups: EmitterGroups, n_groups: int) -> np.ndarray:
    """(n_groups,) int: parts of one object shine alike, more or less; each group of the environment is alone."""
    face = np.flatnonzero(groups.of_face >= 0)
    family = -1 - np.arange(n_groups)
    family[groups.of_face[face]] = photos.scene.object_id[face]
    return family


def _reliable(gains: ObjectGains) -> np.ndarray:
    """(n_objects, 3) gains, 1 where the level of the light, and so theirs, is no better known than from the prior."""
    return gains.gain if gains.level_error < PRIOR_LEVEL_ERROR else np.ones_like(gains.gain)


def _albedo_limit(photos: Photographs, sky: Sky | None) -> np.ndarray | None:
    """(n_objects, 3) base albedos that no gain may bring above 1, where light comes from where no camera looks: its level is
    the least certain. In a closed room the gains of single objects are less certain than the light: None."""
    return photos.scene.object_values[:, :3] if sky is not None and sky.is_unseen else None


def _prior(photos: Photographs, groups: EmitterGroups, rows: EmissionPixels, sky: Sky | None) -> tuple[np.ndarray, EmissionPrior]:
    """Radiance seen on the groups; and the prior of the groups, followed by those of the environment."""
    seen = initial_radiance(rows, groups.observed, photos.sensor.is_hdr)
    initial = expected_radiance(rows, seen)
    if sky is None:
        return seen, EmissionPrior.independent(initial)
    if sky.direction is None:
        return seen, EmissionPrior.independent(np.concatenate([initial, sky.radiance]))
    return seen, EmissionPrior.independent(initial).beside(sky_prior(sky))


def _solve(
    photos: Photographs, gain: np.ndarray, groups: EmitterGroups, voxels: RadianceVoxels, sky: Sky | None, threshold: float
) -> tuple[EmissionSolution, float, ObjectGains, np.ndarray]:
    """Solve for the groups that shine, which are black from here on, and for the environment.

    `gain` (n_objects, 3), from the trial, multiplies the albedo of surface that paths meet and no photograph shows. Returns the
    solution, its loss, the gains found with it, and those that other stages use.
    """
    pixels, base, rows = choose_rows(photos, groups, threshold)
    transport = _trace(photos, pixels, base, groups, voxels, sky, 3, photos.scene.with_gains(gain).materials())
    prior = _prior(photos, groups, rows, sky)[1]
    initial = prior.initial
    problem = assemble(rows, transport, len(initial), None, sky)
    problem, found = problem.solve_object_gains(prior, _albedo_limit(photos, sky), photos.scene.n_objects)
    family = _families(photos, groups, len(initial))
    width = np.full(len(initial), FAMILY_WIDTH)
    if sky is not None and sky.is_unseen:
        family[groups.size :], width[groups.size :] = -1 - len(initial), OUTSIDE_WIDTH
    settings = photos.job.settings.emission
    if settings.solver == "sgd":
        # Which groups emit is known by now, so `safe` has nothing to prune.
        prune = ((100, 0.0), (1000, 0.05)) if settings.preset == "paper" else ()
        options = SgdOptions(settings.preset, settings.iterations, prune=prune, seed=photos.job.seed)
        solution = solve_emission_sgd(problem.rows, initial, options)
    else:
        solution = solve_families(problem.rows, prior, family, width)
    solution = solution.with_level_error(np.minimum(found.error_of_group, PRIOR_LEVEL_ERROR))
    gain = _reliable(found) if len(initial) else gain  # without emitters those of the trial stay
    return solution, reference_loss(problem.rows, solution.radiance), found, gain


def _trace(
    photos: Photographs,
    pixels: ViewPixels,
    base: np.ndarray,
    groups: EmitterGroups,
    voxels: RadianceVoxels,
    sky: Sky | None,
    stream: int,
    unseen: CellMaterials | None = None,
) -> TracedTransport:
    """Two independent estimates of (A, h), by lobe.

    unseen: materials of surface that paths meet and no photograph shows; None = the base texture."""
    job, settings = photos.job, photos.job.settings.emission
    geometry, material = photos.world
    from iif_core.light.transport.cache import RadianceCache
    from iif_core.light.transport.matrix import transport_matrix
    from iif_core.light.transport.scene import EmitterColumns, PathOptions, Scene, ShadingPoints

    cache = RadianceCache(voxels.edge, voxels.origin, voxels.ijk, voxels.radiance)
    scene = Scene(geometry, material if unseen is None else unseen, None, cache)
    # A wrongly predicted metal would remove the diffuse light of a whole surface; only high values are believed.
    metallic = np.where(base[:, 4] > METAL, base[:, 4], 0.0)
    points = ShadingPoints(pixels.points, pixels.normals, pixels.wo, base[:, :3], base[:, 3], metallic)
    side = np.where(groups.of_face >= 0, groups.side, 0).astype(np.int8)
    texels = sky.columns + groups.size if sky else None
    columns = EmitterColumns(groups.of_face, groups.size + (sky.size if sky else 0), side, texels)
    samples, seed = max(1, settings.samples // 2), ((job.seed << 32) | SEEDS) * 8 + 2 * stream
    halves = []
    for half in range(2):
        job.progress(half, 2, "halves of the transport matrix traced")
        found = transport_matrix(scene, points, columns, PathOptions(samples, settings.max_bounces, seed + half))
        halves.append([_albedo_and_gloss(values, metallic == 0) for values in found])
    job.progress(2, 2, "halves of the transport matrix traced")
    return TracedTransport(*(np.stack(part) for part in zip(*halves, strict=True)))


def _albedo_and_gloss(values: np.ndarray, dielectric: np.ndarray) -> np.ndarray:
    """(2, n, ...) of (n, 2, ...) values by diffuse and specular lobe: what is proportional to the albedo, the specular lobe of
    metals included, and the gloss of dielectrics."""
    gloss = np.where(dielectric.reshape(-1, *[1] * (values.ndim - 2)), values[:, 1], 0.0)
    return np.stack([values[:, 0] + (values[:, 1] - gloss), gloss])


# ------------------------------------------------------------------------------------------------------------ writing


def _table(
    groups: EmitterGroups, left_out: EmitterGroups, reasons: list[str], solution: EmissionSolution, sky: Sky | None
) -> dict[str, Any]:
    """Columns of emitters.parquet: emitters, the environment, and the groups that turned out to reflect."""
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
