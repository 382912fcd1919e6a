"""emission: which faces shine and how brightly, and the radiance cache of everything else (docs/method/light.md)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from iif_core.camera.calibration.choice import calibration_facts
from iif_core.camera.response import response, response_facts
from iif_core.light.emission.cache import RadianceVoxels
from iif_core.light.emission.candidates import emitter_candidates
from iif_core.light.emission.direct import EmissionSolution
from iif_core.light.emission.environment import Sky
from iif_core.light.emission.groups import EmitterGroups, GroupingOptions, group_emitters
from iif_core.light.emission.pruning import CERTAIN_EXCESS, CERTAIN_EXCESS_OPEN
from iif_core.light.emission.sensor import Sensor
from iif_core.surface.segments import face_adjacency
from workflow import decisions
from workflow.runtime.job import Job
from workflow.scene.base_scene import read_base_scene
from workflow.scene.emission_pixels import (
    Photographs,
    ViewRecords,
    calibrated,
    gain_plan,
    radiance_cache,
    rays_from_surface,
    statistics_of_faces,
    view_exposures,
)
from workflow.scene.emission_solve import reliable, search_emitters, solve_with_saturated_surface, trial
from workflow.scene.normal_form import CaptureReader

if TYPE_CHECKING:
    pass


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
    met = rays_from_surface(photos)
    secondary = float((met < 0).mean())
    environment = decisions.environment(job.settings.emission.environment, escape, secondary, brightness)
    is_open = secondary > decisions.ESCAPE_OPEN
    outside = (sums.directions() if is_open else sums.groups()) if environment["included"] else None
    if outside is not None and is_open:
        notes.append(
            f"{secondary:.0%} of the rays from the surface leave the mesh: light from twelve directions, as the room shows it"
        )
    certain = CERTAIN_EXCESS_OPEN if outside is not None and outside.is_unseen else CERTAIN_EXCESS
    pruned, gain = trial(photos, groups, cache, outside, certain, threshold)
    reasons = np.array(pruned.reason[: groups.size], dtype=object)
    # What was dropped for giving little light, and not for being no brighter than a white surface, may be needed after all.
    offered = pruned.kept[: groups.size] | (pruned.excess[: groups.size] >= certain)
    hits = np.bincount(met[met >= 0], minlength=len(scene.faces))
    lit = pruned.kept[: groups.size][offered]
    excess, some = pruned.excess[: groups.size][offered], groups.select(offered)
    found, shines, changes = search_emitters(photos, gain, some, lit, excess, outside, threshold, hits)
    for change in changes:
        job.log.info("emitters: %s", change)
    notes.extend(changes)
    reasons[np.flatnonzero(offered)[lit & ~shines]] = "the photographs are explained better without it"
    reasons[np.flatnonzero(offered)[shines]] = ""
    left_out, emitters = groups.select(reasons != ""), found.groups
    candidates = groups.size + len(groups.dropped) + int(emitters.is_hidden.sum())
    found, solution, loss = solve_with_saturated_surface(photos, gain, found, outside, threshold)
    gain = reliable(found.gains) if len(found.prior.initial) else gain  # without emitters those of the trial stay
    table = _table(emitters, left_out, [reason for reason in reasons if reason], solution, outside)
    _write(job, emitters, table, found.cache, outside)
    gains = {f"gain_{c}": gain[:, i].astype(np.float32) for i, c in enumerate("rgb")}
    job.writer.table("object_gains.parquet", {"object_id": np.arange(len(gain), dtype=np.int32), **gains})
    kept = int(np.count_nonzero(table["kept"] & (table["kind"] == "area")))
    job.log.info("%d of %d groups kept; residual %.3f, condition %.3g", kept, candidates, solution.residual, solution.condition)
    for why in sorted({reason for _, _, reason in groups.dropped}):
        areas = [area for _, area, reason in groups.dropped if reason == why]
        notes.append(f"{len(areas)} candidates (the largest {max(areas):.2g} m^2) left out before the solve: {why}")
    if not kept and not environment["included"]:
        notes.append("no emitter and no environment: light comes from the radiance cache alone, re-renderings will be dark")
    level_error, level_raised = found.gains.level_error, found.gains.level_raised
    if level_raised > 0:
        raised = f"light raised {np.exp(level_raised):.2f} times so that albedos are at most 1"
        notes.append(f"{raised}; the error of its level does not contain that")
    plan = [environment, *gain_plan(capture, photos.gains), decisions.emitters(kept, candidates - kept, candidates)]
    active_set = {"rounds": solution.iterations, "converged": solution.converged, "violated": solution.violated}
    job.writer.json(
        "emission.json",
        {
            "cache_edge_m": found.cache.edge,
            "cache_origin": [float(x) for x in found.cache.origin],
            "condition": solution.condition,
            "residual": solution.residual,
            "solver": job.settings.emission.solver,
            "reference_loss": loss,
            "level_error": level_error if np.isfinite(level_error) else None,
            "level_raised": level_raised,
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
