"""The files in which stage emission writes the light that it found, whatever the solver (docs/reference/artefacts.md)."""

from __future__ import annotations

from typing import Any

import numpy as np

from iif_core.camera.calibration.choice import CalibratedResponse, calibration_facts
from iif_core.camera.response import response_facts
from iif_core.light.emission.cache import RadianceVoxels
from iif_core.light.emission.find import FoundLight
from iif_core.light.emission.odds import DOUBTFUL, LampEvidence
from workflow.decisions import light as decisions
from workflow.decisions import numerics
from workflow.decisions.record import Decision
from workflow.runtime.job import Job
from workflow.scene.emission_views import gain_plan
from workflow.scene.named import OUTSIDE
from workflow.scene.normal_form import CaptureReader

UNKNOWN = -1.0
"""Probability of emitters of which nothing tells whether they are lamps."""


def emitter_columns(
    faces: np.ndarray,
    area: np.ndarray,
    radiance: np.ndarray,
    error: np.ndarray,
    observations: np.ndarray,
    kept: np.ndarray,
    reason: list[str],
    kind: list[str] | None = None,
    side: np.ndarray | None = None,
    evidence: LampEvidence | None = None,
    name: list[str] | None = None,
) -> dict[str, Any]:
    """Return the columns of emitters.parquet for n emitters: `faces`, `area` (m^2), `observations`, `kept`, `reason` and `side`
    (n,), `radiance` and `error` (n, 3); `kind`: None = all are faces; `evidence`: of the first of them, None = of none; `name`:
    None = numbers."""
    n = len(faces)
    told = {"probability": np.full(n, UNKNOWN), "needed": np.zeros(n)}
    told |= {name: np.zeros(n, bool) for name in ("is_likely", "is_saturated", "is_hidden")}
    if evidence is not None:
        for column, values in told.items():
            values[: len(evidence.needed)] = getattr(evidence, column)
    return {
        "emitter_id": np.arange(n, dtype=np.int32),
        "name": np.array([f"lamp {i}" for i in range(n)] if name is None else name, dtype=str),
        "kind": np.array(["area"] * n if kind is None else kind, dtype=str),
        "faces": np.asarray(faces, np.int32),
        "area_m2": np.asarray(area, np.float64),
        "side": np.zeros(n, np.int32) if side is None else np.asarray(side, np.int32),
        **{f"radiance_{c}": radiance[:, i].astype(np.float32) for i, c in enumerate("rgb")},
        **{f"error_{c}": error[:, i].astype(np.float32) for i, c in enumerate("rgb")},
        "observations": np.asarray(observations, np.int64),
        "kept": np.asarray(kept, bool),
        "reason": np.array(reason, dtype=str),
        **told,
    }


def write_light(
    job: Job,
    table: dict[str, Any],
    face: np.ndarray,
    emitter: np.ndarray,
    side: np.ndarray,
    gain: np.ndarray,
    transmittance: np.ndarray,
    cache: RadianceVoxels,
) -> None:
    """Write emitters.parquet (`table`), emitter_faces.parquet, object_gains.parquet and radiance_cache.parquet.

    face, emitter, side: (n,) faces that belong to emitters, and which side of them shines; gain (O, 3) and transmittance (O,) of
    the objects.
    """
    job.writer.table("emitters.parquet", table, {"area_m2": "m^2", "radiance_r": "relative", "error_r": "relative"})
    columns = {"face_id": face, "emitter_id": emitter, "side": side}
    job.writer.table("emitter_faces.parquet", {name: values.astype(np.int32) for name, values in columns.items()})
    gains = {f"gain_{c}": gain[:, i].astype(np.float32) for i, c in enumerate("rgb")}
    gains["transmittance"] = transmittance.astype(np.float32)
    job.writer.table("object_gains.parquet", {"object_id": np.arange(len(gain), dtype=np.int32), **gains})
    voxels = {name: cache.ijk[:, axis] for axis, name in enumerate("ijk")}
    voxels |= {f"radiance_{c}": cache.radiance[:, i] for i, c in enumerate("rgb")}
    voxels |= {"samples": cache.samples, "censored": cache.censored}
    job.writer.table("radiance_cache.parquet", voxels, {"radiance_r": "relative"})


def write_found_light(job: Job, light: FoundLight, camera: CalibratedResponse, plan: list[Decision], notes: list[str]) -> None:
    """Write all files of stage emission.

    Args:
        job: of the stage.
        light: that was found.
        camera: response of the camera, and how it was found.
        plan: decisions about light from outside and through surface.
        notes: what was noted before the light was looked for.
    """
    table = _table(light)
    groups, sky = light.found.groups, light.outside
    face = np.flatnonzero(groups.of_face >= 0)
    lit = table, face, groups.of_face[face], groups.side[face]
    write_light(job, *lit, light.gain, light.transmittance, light.found.cache)
    if sky:
        row, column = np.indices(sky.columns.shape).astype(np.int32)
        ids = (sky.columns + groups.size).astype(np.int32)
        texels = {"row": row.ravel(), "column": column.ravel(), "emitter_id": ids.ravel()}
        job.writer.table("environment_texels.parquet", texels)
    _write_facts(job, light, table, camera, plan, notes)


def _table(light: FoundLight) -> dict[str, Any]:
    """Columns of emitters.parquet: emitters, the environment, and the groups that turned out to reflect."""
    groups, left_out, solution, sky = light.found.groups, light.left_out, light.solution, light.outside
    outside, out = sky.size if sky else 0, left_out.size
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
        side=np.r_[groups.sides, np.zeros(outside, np.int32), left_out.sides],
        evidence=light.evidence,
        name=[*light.names, *[OUTSIDE] * outside, *light.left_on],
    )


def _write_facts(
    job: Job,
    light: FoundLight,
    table: dict[str, Any],
    camera: CalibratedResponse,
    plan: list[Decision],
    notes: list[str],
) -> None:
    """Write emission.json; `plan` and `notes`: what was decided and noted before."""
    found, solution, photos = light.found, light.solution, light.photos
    notes, capture = [*notes, *light.notes], CaptureReader(job.read("capture"))
    kept, candidates = int(np.count_nonzero(table["kept"] & (table["kind"] == "area"))), light.candidates
    job.log.info("%d of %d groups kept; residual %.3f, condition %.3g", kept, candidates, solution.residual, solution.condition)
    for why in sorted({reason for _, _, reason in light.look.groups.dropped}):
        areas = [area for _, area, reason in light.look.groups.dropped if reason == why]
        notes.append(f"{len(areas)} candidates (the largest {max(areas):.2g} m^2) left out before the solve: {why}")
    if not kept and light.outside is None:
        notes.append("no emitter and no environment: light comes from the radiance cache alone, re-renderings will be dark")
    level_error, level_raised = found.gains.level_error, found.gains.level_raised
    if level_raised > 0:
        raised = f"light raised {np.exp(level_raised):.2f} times so that albedos are at most 1"
        notes.append(f"{raised}; the error of its level does not contain that")
    doubtful = light.evidence.probability < DOUBTFUL if light.evidence else np.zeros(0, bool)
    if doubtful.any():
        area = f"{found.groups.area[doubtful].sum():.2g} m^2"
        what = "more likely surface that light falls on or passes through than lamps"
        notes.append(f"{doubtful.sum()} of {kept} emitters ({area}) are {what}")
    found_emitters = decisions.emitters(kept, candidates - kept, candidates)
    plan = [*plan, *gain_plan(capture, photos.gains), found_emitters]
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
            "level_moved": found.gains.level_moved,
            "colour_moved": list(found.gains.colour_moved),
            "active_set": active_set,
            "escape_share": {"primary": light.look.primary, "secondary": light.look.secondary},
            "threshold": light.look.threshold if np.isfinite(light.look.threshold) else None,
            "exposure": photos.gains.exposure.tolist(),
            "gain": photos.gains.gain.tolist(),
            "vignetting": photos.gains.vignetting.tolist(),
            "response": {**response_facts(camera.response), "calibration": calibration_facts(camera)},
            "numerics": numerics.of_emission(solution.condition, solution.converged),
            "plan": plan,
            "notes": notes,
        },
    )
