"""emission: which faces shine and how brightly, and the radiance cache of everything else (docs/method/light.md)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from iif_core.camera.calibration.choice import CalibratedResponse, calibration_facts
from iif_core.camera.response import response, response_facts
from iif_core.light.emission.candidates import emitter_candidates
from iif_core.light.emission.direct import EmissionSolution
from iif_core.light.emission.environment import Sky
from iif_core.light.emission.groups import EmitterGroups, GroupingOptions, group_emitters
from iif_core.light.emission.pruning import CERTAIN_EXCESS, CERTAIN_EXCESS_OPEN, SIGNIFICANT
from iif_core.light.emission.sensor import Sensor
from iif_core.surface.segments import face_adjacency
from workflow.decisions import light as decisions
from workflow.decisions import numerics
from workflow.decisions.plan import environment as from_outside
from workflow.decisions.plan import included
from workflow.decisions.record import SETTLED
from workflow.runtime.job import Job
from workflow.scene.base_scene import read_base_scene
from workflow.scene.emission_pixels import (
    Photographs,
    ViewRecords,
    calibrated,
    escaping_light,
    gain_plan,
    radiance_cache,
    rays_from_surface,
    statistics_of_faces,
    view_exposures,
)
from workflow.scene.emission_solve import (
    Traced,
    in_doubt,
    reliable,
    search_emitters,
    solve_with_saturated_surface,
    traced,
    trial,
)
from workflow.scene.light_files import emitter_columns, write_light
from workflow.scene.normal_form import CaptureReader
from workflow.scene.recovered import object_names
from workflow.scene.see_through import seen_through, translucent_objects
from workflow.scene.sun_search import find_sun


@dataclass(frozen=True)
class FoundLight:
    """All light of a scene under one assumption about which surface lets light through.

    Attributes:
        photos: with that assumption; transmittance: (n_objects,) share of the light that passes straight through each object.
        found: the problem; solution: of it.
        left_out, reasons: candidate groups that turned out to reflect, and why.
        candidates: number of groups that were looked at; dropped: [(faces, area, reason)] without a solve.
        gain: (n_objects, 3) of the albedos.
        outside, environment: the sky, None = none, and the decision about it; sun: the decision about that, None = not asked.
        escape: share of camera rays and of rays from surface that leave the mesh; threshold: radiance of candidates.
        notes: what a person should know.
    """

    photos: Photographs
    found: Traced
    solution: EmissionSolution
    left_out: EmitterGroups
    reasons: list[str]
    candidates: int
    dropped: list[tuple[int, float, str]]
    gain: np.ndarray
    outside: Sky | None
    environment: decisions.Decision
    sun: decisions.Decision | None
    escape: tuple[float, float]
    threshold: float
    notes: list[str]

    @property
    def is_open(self) -> bool:
        """So much of the surface faces holes of the mesh that light from outside is twelve directions (`SkySums.directions`)."""
        return self.outside is not None and self.outside.direction is None

    def misfit(self, without: np.ndarray) -> float:
        """Return the misfit (Eq. L.40) over the rows of other objects than `without`, (n_objects,) bool; inf without rows."""
        problem = self.found.problem
        rows = problem.take(~np.append(without, False)[problem.owner])
        return rows.misfit(self.solution.radiance) if (~rows.anchor).any() else np.inf

    @property
    def transmittance(self) -> np.ndarray:
        scene = self.photos.scene
        return np.zeros(scene.n_objects, np.float32) if scene.transmittance is None else scene.transmittance


def run(job: Job) -> None:
    """Write emitters.parquet, emitter_faces.parquet, object_gains.parquet, radiance_cache.parquet, environment_texels.parquet
    and emission.json."""
    capture, scene = CaptureReader(job.read("capture")), read_base_scene(job)
    notes: list[str] = []
    known = view_exposures(capture, notes)
    unknown = Sensor(response("identity"), capture.is_hdr, job.settings.emission.saturation)
    records = ViewRecords(job, capture, scene)
    photos, camera = calibrated(Photographs(job, capture, scene, capture.used, unknown, known, records))
    notes.extend([camera.gauge] if camera.gauge else [])
    adjacency = face_adjacency(scene.faces, scene.vertices)
    light, glowing = _light(photos, adjacency)
    plan: list[decisions.Decision] = []
    sheer = translucent_objects(photos, glowing)
    if sheer.any():
        names = ", ".join(object_names(job, scene.n_objects)[o] for o in np.flatnonzero(sheer))
        job.log.info("%s: does it shine, or does light pass through it?", names)
        photos.forget()  # so that both assumptions need no more memory than one
        through, _ = _light(seen_through(photos, sheer), adjacency)
        same_kind = through.outside is not None and through.is_open <= light.is_open
        decision = decisions.transmission(names, light.misfit(sheer), through.misfit(sheer), same_kind)
        light = through if decision["included"] else light
        plan, notes = [decision], [*notes, decision["reason"]]
        job.log.info("%s", decision["reason"])
    table = _table(light)
    _write(job, light, table)
    _write_facts(job, light, table, camera, plan, notes + light.notes)


def _light(photos: Photographs, adjacency: np.ndarray) -> tuple[FoundLight, np.ndarray]:
    """Find the light of the scene; also return the pieces of surface that glow as a whole, (F,)."""
    job, scene, least = photos.job, photos.scene, photos.job.settings.emission.min_observations
    statistics, threshold, glowing = statistics_of_faces(photos, adjacency)
    candidate = emitter_candidates(statistics, adjacency, scene.areas, threshold, least, glowing)
    options = GroupingOptions(min_observations=least)
    groups = group_emitters(candidate, statistics, adjacency, scene.normals, scene.areas, options, glowing)
    job.log.info("%d candidate faces in %d groups (%d left out)", candidate.sum(), groups.size, len(groups.dropped))
    cache = radiance_cache(photos, groups)
    sums, escape, brightness = escaping_light(photos)
    met = rays_from_surface(photos)
    secondary = float((met < 0).mean())
    planned = included(job.read("plan").json("plan.json")["plan"], "environment")
    # Where light passes through surface, the mesh is another one than the plan was made for.
    is_planned = planned["status"] == SETTLED and scene.transmittance is None
    setting = job.settings.emission.environment
    environment = planned if is_planned else from_outside(setting, escape, secondary, brightness)
    is_open = secondary > decisions.ESCAPE_OPEN
    outside = (sums.directions() if is_open else sums.groups()) if environment["included"] else None
    notes: list[str] = []
    sun = None
    if outside is not None and not is_open:
        outside, sun = find_sun(photos, outside, threshold)
    elif outside is not None:
        notes.append(
            f"{secondary:.0%} of the rays from the surface leave the mesh: light from twelve directions, as the room shows it"
        )
    certain = CERTAIN_EXCESS_OPEN if outside is not None and outside.is_unseen else CERTAIN_EXCESS
    pruned, gain = trial(photos, groups, cache, outside, certain, threshold)
    unseen = scene.with_gains(gain).repainted(photos.world[1])
    reasons = np.array(pruned.reason[: groups.size], dtype=object)
    hits = np.bincount(met[met >= 0], minlength=len(scene.faces))
    found, shines, changes = search_emitters(photos, unseen, groups, pruned, certain, outside, threshold, hits)
    for change in changes:
        job.log.info("emitters: %s", change)
    notes.extend(changes)
    reasons[pruned.kept[: groups.size] & ~shines] = "the photographs are explained better without it"
    reasons[shines] = ""
    candidates = groups.size + len(groups.dropped) + int(found.groups.is_hidden.sum())
    found, solution = solve_with_saturated_surface(photos, unseen, found, outside, threshold)
    weak = in_doubt(photos, found, solution)
    if weak.any() and (outside is not None or not weak.all()):  # without light from outside something in the room has to shine
        job.log.info("%d groups radiate no more than their error allows, and are taken out", weak.sum())
        visible = np.flatnonzero(shines)
        reasons[visible[weak[: len(visible)]]] = f"its radiance is within {SIGNIFICANT:.0f} standard errors of zero"
        found = traced(photos, unseen, found.groups.select(~weak), outside, threshold)
        found, solution = solve_with_saturated_surface(photos, unseen, found, outside, threshold)
    gain = reliable(found.gains) if len(found.prior.initial) else gain  # without emitters those of the trial stay
    left_out, why = groups.select(reasons != ""), [reason for reason in reasons if reason]
    light = (found, solution, left_out, why, candidates, groups.dropped, gain, outside, environment)
    return FoundLight(photos, *light, sun, (escape, secondary), threshold, notes), glowing


def _write_facts(
    job: Job,
    light: FoundLight,
    table: dict[str, Any],
    camera: CalibratedResponse,
    plan: list[decisions.Decision],
    notes: list[str],
) -> None:
    """Write emission.json; `plan` and `notes`: what was decided and noted before."""
    found, solution, photos = light.found, light.solution, light.photos
    kept, candidates = int(np.count_nonzero(table["kept"] & (table["kind"] == "area"))), light.candidates
    job.log.info("%d of %d groups kept; residual %.3f, condition %.3g", kept, candidates, solution.residual, solution.condition)
    for why in sorted({reason for _, _, reason in light.dropped}):
        areas = [area for _, area, reason in light.dropped if reason == why]
        notes.append(f"{len(areas)} candidates (the largest {max(areas):.2g} m^2) left out before the solve: {why}")
    if not kept and not light.environment["included"]:
        notes.append("no emitter and no environment: light comes from the radiance cache alone, re-renderings will be dark")
    level_error, level_raised = found.gains.level_error, found.gains.level_raised
    if level_raised > 0:
        raised = f"light raised {np.exp(level_raised):.2f} times so that albedos are at most 1"
        notes.append(f"{raised}; the error of its level does not contain that")
    found_emitters = decisions.emitters(kept, candidates - kept, candidates)
    outside = [light.environment, *([light.sun] if light.sun else [])]
    plan = [*outside, *plan, *gain_plan(photos.capture, photos.gains), found_emitters]
    active_set = {"rounds": solution.iterations, "converged": solution.converged, "violated": solution.violated}
    job.writer.json(
        "emission.json",
        {
            "cache_edge_m": found.cache.edge,
            "cache_origin": [float(x) for x in found.cache.origin],
            "condition": solution.condition,
            "residual": solution.residual,
            "misfit": found.misfit,
            "solver": "direct",
            "level_error": level_error if np.isfinite(level_error) else None,
            "level_raised": level_raised,
            "colour_moved": list(found.gains.colour_moved),
            "active_set": active_set,
            "escape_share": {"primary": light.escape[0], "secondary": light.escape[1]},
            "threshold": light.threshold if np.isfinite(light.threshold) else None,
            "exposure": photos.gains.exposure.tolist(),
            "gain": photos.gains.gain.tolist(),
            "vignetting": photos.gains.vignetting.tolist(),
            "response": {**response_facts(camera.response), "calibration": calibration_facts(camera)},
            "numerics": numerics.of_emission(solution.condition, solution.converged),
            "plan": plan,
            "notes": notes,
        },
    )


# ------------------------------------------------------------------------------------------------------------ writing


def _table(light: FoundLight) -> dict[str, Any]:
    """Columns of emitters.parquet: emitters, the environment, and the groups that turned out to reflect."""
    groups, left_out, solution, sky = light.found.groups, light.left_out, light.solution, light.outside
    outside, out = sky.size if sky else 0, left_out.size
    sides = [[_side_of(g, i) for i in range(g.size)] for g in (groups, left_out)]
    pixels = sky.pixels if sky else np.zeros(0)
    return emitter_columns(
        faces=np.r_[groups.faces, np.zeros(outside), left_out.faces],
        area=np.r_[groups.area, np.zeros(outside), left_out.area],
        radiance=np.r_[solution.radiance, np.zeros((out, 3))],
        error=np.r_[solution.error, np.zeros((out, 3))],
        observations=np.r_[groups.count, pixels, left_out.count],
        kept=np.arange(groups.size + outside + out) < groups.size + outside,
        reason=[""] * (groups.size + outside) + light.reasons,
        kind=["area"] * groups.size + ["environment"] * outside + ["area"] * out,
        side=np.array([*sides[0], *[0] * outside, *sides[1]]),
    )


def _side_of(groups: EmitterGroups, group: int) -> int:
    sides = groups.side[groups.of_face == group]
    return int(sides[0]) if len(sides) and (sides == sides[0]).all() else 0


def _write(job: Job, light: FoundLight, table: dict[str, Any]) -> None:
    groups, sky = light.found.groups, light.outside
    face = np.flatnonzero(groups.of_face >= 0)
    lit = table, face, groups.of_face[face], groups.side[face]
    write_light(job, *lit, light.gain, light.transmittance, light.found.cache)
    if sky:
        row, column = np.indices(sky.columns.shape).astype(np.int32)
        ids = (sky.columns + groups.size).astype(np.int32)
        texels = {"row": row.ravel(), "column": column.ravel(), "emitter_id": ids.ravel()}
        job.writer.table("environment_texels.parquet", texels)
