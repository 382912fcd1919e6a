"""The files in which stage affines writes its fit, and the decisions that follow from it (docs/reference/artefacts.md)."""

from __future__ import annotations

from typing import Any

import numpy as np

from iif_core.camera.response import response_facts
from iif_core.fitting.object_levels import level_deviation
from iif_core.fitting.problem import FitProblem, FitResult, Kinds, albedo_uncertainty
from iif_core.reflectance.material import CHANNELS, NUMBERS_OF, apply_affines
from workflow.artifacts.store import ids_from_disk, split_rgb
from workflow.decisions import camera, materials, numerics
from workflow.decisions.record import Decision
from workflow.fitting.fit_input import FitInputs
from workflow.runtime.job import Job
from workflow.scene.base_scene import base_channels, read_base
from workflow.scene.normal_form import CaptureReader
from workflow.scene.recovered import write_response


def write_fit(job: Job, inputs: FitInputs, fit: FitResult, solver: str, interreflection: float = 1.0) -> None:
    """Write the artefacts of stage affines; `solver`: the name of what fitted; `interreflection`: see there."""
    names, capture, given = inputs.names, inputs.capture, inputs.problem.given
    for o, name in enumerate(names):
        job.log.debug("%s: %s, residual %.4f", name, fit.model[o], fit.residual[o])
    _write_objects(job, names, fit, given)
    if not capture.is_hdr:
        write_response(job, fit.response)
    albedo = inputs.textures.albedo(fit) if inputs.textures is not None else None
    _write_cells(job, fit, albedo)
    _write_maps(job, capture, fit, albedo)
    plan = _plan_of_fit(inputs.problem, fit, inputs.calibration, capture.facts["dynamic_range"], job.settings.components.metallic)
    if given is not None:
        plan.append(materials.given_by_hand(names, given))
    _write_facts(job, solver, fit, plan, interreflection)


def _write_facts(job: Job, solver: str, fit: FitResult, plan: list[Decision], interreflection: float) -> None:
    """Write affines.json."""
    spread = np.sqrt(np.clip(np.diagonal(fit.response_covariance), 0.0, None))
    weight = np.maximum(fit.pixels, 1e-9)
    facts = dict(fit.facts)
    job.writer.json(
        "affines.json",
        {
            "solver": solver,
            "light_scale": float(fit.light_scale * interreflection),
            "interreflection": interreflection,
            "numerics": numerics.of_affines(facts.pop("numerics", {}), bool(fit.converged)),
            **facts,
            "history": [float(x) for x in fit.history],
            "converged": bool(fit.converged),
            "iterations": int(fit.iterations),
            "stopped": fit.reason,
            "pixels": int(fit.pixels.sum()),
            "residual": float(np.sqrt(np.average(fit.residual**2, weights=weight))) if len(fit.pixels) else 0.0,
            "response": {**response_facts(fit.response), "std": spread.tolist(), "covariance": fit.response_covariance.tolist()},
            "plan": plan,
        },
    )


def _write_objects(job: Job, names: list[str], fit: FitResult, given: np.ndarray | None) -> None:
    """Write objects.parquet: numbers, standard deviations and model of every object."""
    spread = np.sqrt(np.clip(np.diagonal(fit.covariance, axis1=1, axis2=2), 0.0, None))
    columns: dict[str, Any] = {
        "object_id": np.arange(len(names), dtype=np.int32),
        "name": np.array(names, dtype=str),
        "pixels": fit.pixels,
    }
    columns |= {f"T_{name}": fit.affine[:, part] for name, part in NUMBERS_OF.items()}
    columns |= {f"std_{name}": spread[:, part] for name, part in NUMBERS_OF.items()}
    means = read_base(job).table("objects.parquet")
    mean = np.stack([means[f"albedo_{c}"] for c in "rgb"], 1)[: len(names)]
    columns |= {
        "std_level": level_deviation(fit.affine, fit.covariance, mean),
        "covariance_trace": np.trace(fit.covariance, axis1=1, axis2=2),
        "residual": fit.residual,
        "light_gain": np.ones(len(names)) if fit.light_gain is None else fit.light_gain,
        "model": np.array(fit.model, dtype=str),
        "given": np.array(materials.given_words(len(names), given), dtype=str),
    }
    columns |= kind_columns(fit.kinds or Kinds.unknown(len(names)))
    job.writer.table("objects.parquet", columns, {"residual": "sensor value"})


def kind_columns(kinds: Kinds) -> dict[str, np.ndarray]:
    """Return the columns of objects.parquet that say what the fit left open."""
    return {f"kind_{name}": value for name, value in vars(kinds).items()}


def _write_cells(job: Job, fit: FitResult, albedo: np.ndarray | None) -> None:
    """Write cells.parquet: corrected materials, with the given albedo (C, 3) instead if there is one."""
    deviations = [f"uncertainty_albedo_{c}" for c in "rgb"]
    cells = read_base(job).table("cells.parquet", ("cell_id", "object_id", *CHANNELS, *deviations))
    base = np.stack([cells[name] for name in CHANNELS], 1)
    deviation = np.stack([cells[name] for name in deviations], 1)
    object_id = cells["object_id"].astype(np.int64)
    fitted = apply_affines(fit.affine, object_id, base)
    spread = albedo_uncertainty(fit.affine, fit.covariance, object_id, base, deviation)
    if albedo is not None:
        fitted[:, :3] = albedo
    columns = {
        "cell_id": cells["cell_id"],
        **{name: fitted[:, i].astype(np.float32) for i, name in enumerate(CHANNELS)},
    }
    job.writer.table("cells.parquet", {**columns, "uncertainty": spread.astype(np.float32)})


def _write_maps(job: Job, capture: CaptureReader, fit: FitResult, albedo: np.ndarray | None) -> None:
    """Write the corrected materials of every view."""
    base, segmentation = read_base(job), job.read("segmentation")
    for done, view in enumerate(capture.views):
        file = f"maps/{view.name}.exr"
        object_id = ids_from_disk(segmentation.exr(file)["object.id"]).ravel().astype(np.int64)
        maps = base.exr(file)
        values = base_channels(maps)
        deviation = maps["uncertainty.albedo"].ravel().astype(np.float32)
        fitted = apply_affines(fit.affine, object_id, values).astype(np.float32)
        spread = albedo_uncertainty(fit.affine, fit.covariance, object_id, values, np.repeat(deviation[:, None], 3, 1))
        seen = object_id >= 0
        if albedo is not None:
            cell = ids_from_disk(maps["cell.id"]).ravel()
            fitted[cell >= 0, :3] = albedo[cell[cell >= 0]]
        fitted[~seen], spread[~seen] = 0.0, 0.0
        shape = (view.height, view.width)
        channels = {
            **split_rgb(fitted[:, :3].reshape(*shape, 3), "albedo"),
            "roughness": fitted[:, 3].reshape(shape),
            "metallic": fitted[:, 4].reshape(shape),
            "uncertainty": spread.astype(np.float32).reshape(shape),
        }
        job.writer.exr(file, channels)
        job.progress(done + 1, len(capture.views), "views written")


def _plan_of_fit(
    problem: FitProblem,
    fit: FitResult,
    calibration: dict[str, Any],
    dynamic_range: str,
    metals: str,
) -> list[Decision]:
    """Return the decisions of this stage with their measured reasons."""
    object_id = problem.object_id
    medians = np.zeros(problem.n_objects)
    order = np.argsort(object_id, kind="stable")
    bounds = np.searchsorted(object_id[order], np.arange(problem.n_objects + 1))
    for o in range(problem.n_objects):
        own = order[bounds[o] : bounds[o + 1]]
        if len(own):
            medians[o] = np.median(problem.base[own, 4])
    metal = np.any(fit.affine[:, 14:] != 0, 1)  # also objects whose metallic is as predicted, which is not fitted
    return [
        camera.camera_response(dynamic_range, calibration),
        materials.metallic(metal & fit.free.any(1), medians, metals),
        materials.affine_size(fit.model),
        materials.scale(**fit.facts["scale"]),
    ]
