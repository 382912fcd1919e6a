"""affines: one affine map for each object and the camera response, fitted to the photographs (Eq. M.1, M.14)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from iif_core.camera.gains import CameraGains
from iif_core.camera.response import Response, response_facts, response_from_facts
from iif_core.errors import InputError
from iif_core.fitting.clusters import patches
from iif_core.fitting.direct import fit_affines
from iif_core.fitting.gauge import Gauge, apply_gauge
from iif_core.fitting.object_levels import level_deviation, prediction_scatter
from iif_core.fitting.predictions import PredictionErrors
from iif_core.fitting.problem import FitOptions, FitProblem, FitResult, albedo_uncertainty
from iif_core.reflectance.material import CHANNELS, NUMBERS_OF, apply_affines
from workflow.artifacts.scratch import Joined
from workflow.artifacts.store import ids_from_disk, split_rgb
from workflow.decisions import camera, materials, numerics
from workflow.decisions.record import Decision
from workflow.fitting.cell_textures import CellTextures
from workflow.fitting.fit_pixels import FitPixels, count_eligible
from workflow.fitting.inputs import balanced, cells_of, exposure_and_balance, roughness_levels
from workflow.runtime.job import Job
from workflow.scene.base_scene import (
    BaseScene,
    base_maps,
    read_base,
    read_gains,
    read_lit_scene,
    sensor_bounds,
    view_pixels,
)
from workflow.scene.cached_light import has_lobes, read_diffuse, read_specular
from workflow.scene.named import object_number
from workflow.scene.normal_form import CaptureReader
from workflow.scene.recovered import object_names, write_response
from workflow.settings import scene_origin
from workflow.settings.affines import KnownLamp

Solver = Callable[[FitProblem, Response], FitResult]
"""From the problem and the response of stage emission to the fit, in the gauge of the given light."""


def run(job: Job) -> None:
    """Write objects.parquet, camera_response.parquet (LDR), cells.parquet, maps/<view>.exr and affines.json."""
    fit(job, _direct)


def fit(
    job: Job,
    solver: Callable[[Job, tuple[np.ndarray, np.ndarray] | None], Solver],
    name: str = "direct",
    draw: Callable[[Job, CaptureReader, BaseScene, np.ndarray], FitPixels] | None = None,
    merged: bool = False,
) -> None:
    """Fit one affine map for each object and write the artefacts of the stage.

    Args:
        job: the job.
        solver: makes the solver from the settings, and mean and precision of the response; name: of it, for affines.json.
        draw: chooses the pixels, given the faces (m,) bool whose pixels are left out; None: evenly over the objects.
        merged: read the mean of the two halves of the light, for a solver that does not ask how far they are apart.
    """
    capture, (scene, light) = CaptureReader(job.read("capture")), read_lit_scene(job)
    names = object_names(job, scene.n_objects)
    find_gauge, given = _gauge(job, capture, names), _given(job, names)  # wrong settings stop the stage before any work
    mixed = light.emits | scene.is_sheer
    drawn = (draw or _drawn)(job, capture, scene, mixed)
    problem, places = _problem(job, capture, scene, drawn, read_gains(job), merged)
    problem = replace(problem, given=given)
    start, prior, calibration = _starting_response(job)
    job.log.info("%d pixels of %d objects", len(problem.object_id), len(np.unique(problem.object_id)))
    textures = CellTextures.of(job, capture, scene, mixed)
    with job.timed("solve"):
        free = solver(job, prior)(problem, start)
    found = apply_gauge(problem, free, find_gauge(problem, places))
    for o in range(scene.n_objects):
        job.log.debug("%s: %s, residual %.4f", names[o], found.model[o], found.residual[o])
    _write_objects(job, names, found, given)
    if not capture.is_hdr:
        write_response(job, found.response)
    albedo = textures.albedo(found) if textures is not None else None
    _write_cells(job, found, albedo)
    _write_maps(job, capture, found, albedo)
    metals = job.settings.components.metallic
    plan = _plan(problem, found, calibration, capture.facts["dynamic_range"], metals)
    if given is not None:
        plan.append(materials.given_by_hand(names, given))
    _write_facts(job, name, found, plan)


def _direct(job: Job, prior: tuple[np.ndarray, np.ndarray] | None) -> Solver:
    settings = job.settings.affines
    options = FitOptions(
        iterations=settings.iterations,
        population=settings.population,
        robust_width=settings.robust_width,
        response_prior=prior,
        # This prior read the brightness of objects from the same photographs.
        base_tells_levels=job.settings.prior.kind != "retinex",
        lobes=has_lobes(job),
        metals=job.settings.components.metallic != "off",
        prediction_errors=_prediction_errors(job),
        threads=job.threads,
    )
    return lambda problem, start: fit_affines(problem, start, options)


def _prediction_errors(job: Job) -> PredictionErrors | None:
    """Return how the predictions err, where the prior states it."""
    prior = job.read("prior")
    stated = prior.json("model.json").get("object_errors") if prior.has("model.json") else None
    if stated is None:
        return None
    errors = PredictionErrors.from_facts(stated, str(prior.path("model.json")))
    return errors.of_second_look() if read_base(job).stage == "second_look" else errors


def _write_facts(job: Job, solver: str, fit: FitResult, plan: list[Decision]) -> None:
    """Write affines.json."""
    spread = np.sqrt(np.clip(np.diagonal(fit.response_covariance), 0.0, None))
    weight = np.maximum(fit.pixels, 1e-9)
    facts = dict(fit.facts)
    job.writer.json(
        "affines.json",
        {
            "solver": solver,
            "light_scale": float(fit.light_scale),
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


# -------------------------------------------------------------------------------------------------------------- gauge


@dataclass(frozen=True)
class _Places:
    """View id and index into the flattened image of each pixel of the problem, (n,)."""

    view: np.ndarray
    index: np.ndarray


def _gauge(job: Job, capture: CaptureReader, names: list[str]) -> Callable[[FitProblem, _Places], Gauge]:
    """Check `affines.scale` and return a function that makes the gauge once the pixels of the problem are known."""
    scale = job.settings.affines.scale
    if isinstance(scale, str):
        gauge = Gauge(scale)
        if capture.is_hdr or scale == "found":
            stated = _prediction_errors(job)
            gauge = Gauge("found", error=_light_error(job))
            gauge = gauge if stated is None else replace(gauge, prior_error=stated.level)
        return lambda problem, places: gauge
    if getattr(scale, "mean_albedo", None) is not None:
        return lambda problem, places: Gauge("mean_albedo", scale.mean_albedo)
    if getattr(scale, "lamp", None) is not None:
        return _lamp_gauge(job, scale.lamp)
    patch = scale.white_patch
    if patch.object is not None:
        if patch.object not in names:
            near = ", ".join(sorted(names)[:20])
            raise InputError(
                f"affines.scale.white_patch.object: no object {patch.object!r}; there are {near} (segmentation/objects.parquet)"
            )
        number = names.index(patch.object)
        return lambda problem, places: Gauge("white_patch", patch.albedo, problem.object_id == number)
    known = {view.name: view for view in capture.used}
    if patch.view not in known:
        raise InputError(f"affines.scale.white_patch.view: no view {patch.view!r}; there are {', '.join(sorted(known)[:20])}")
    view, (left, top, right, bottom) = known[patch.view], patch.box
    if not (0 <= left < right <= view.width and 0 <= top < bottom <= view.height):
        raise InputError(
            f"affines.scale.white_patch.box: {list(patch.box)}; [left, top, right, bottom] must lie within the"
            f" {view.width} x {view.height} pixels of view {patch.view}"
        )

    def inside(problem: FitProblem, places: _Places) -> Gauge:
        x, y = places.index % view.width, places.index // view.width
        chosen = (places.view == view.view_id) & (x >= left) & (x < right) & (y >= top) & (y < bottom)
        return Gauge("white_patch", patch.albedo, chosen)

    return inside


def _light_error(job: Job) -> float:
    """Return the standard error of the logarithm of the level of the light; infinite if the photographs do not determine it."""
    error = job.read("emission").json("emission.json")["level_error"]
    return float("inf") if error is None else float(error)


def _lamp_gauge(job: Job, lamp: KnownLamp) -> Callable[[FitProblem, _Places], Gauge]:
    """Return the gauge of a lamp of known radiance, which must be among the emitters that were kept."""
    table = job.read("emission").table("emitters.parquet")
    row = np.flatnonzero((table["emitter_id"] == lamp.emitter_id) & table["kept"].astype(bool))
    if not len(row):
        kept = table["emitter_id"][table["kept"].astype(bool)].tolist()
        raise InputError(
            f"affines.scale.lamp.emitter_id: no emitter {lamp.emitter_id} was kept; there are {kept} (emission/emitters.parquet)"
        )
    found = float(np.mean([table[f"radiance_{c}"][row[0]] for c in "rgb"]))
    return lambda problem, places: Gauge("lamp", factor=float(np.mean(lamp.radiance)) / max(found, 1e-30))


def _given(job: Job, names: list[str]) -> np.ndarray | None:
    """Return roughness and metallic (O, 2) that `materials` gives, NaN = fitted; None if it gives nothing.

    Raises:
        InputError: no object has this name or id, two entries mean the same object, or the model has no specular lobes.
    """
    wanted: dict[str, Any] = vars(job.settings.materials)
    if not wanted:
        return None
    where = f"{scene_origin(job.scene)}: `materials`"
    if not has_lobes(job):
        raise InputError(
            f"{where}: found materials given by hand, but this scene is fitted without specular lobes, so they would change"
            " nothing; set `components: {specular: on}`, or remove them"
        )
    given = np.full((len(names), 2), np.nan)
    for key, entry in wanted.items():
        number = object_number(key, names, where)
        if not np.isnan(given[number]).all():
            raise InputError(f"{where}: {key}: object {names[number]!r} is there twice, by its name and by its id; remove one")
        given[number] = [np.nan if value is None else value for value in (entry.roughness, entry.metallic)]
    return given


# -------------------------------------------------------------------------------------------------------------- input


def _starting_response(job: Job) -> tuple[Response, tuple[np.ndarray, np.ndarray] | None, dict[str, Any]]:
    """Return the response of stage emission with parameters for each channel, its prior, and the facts of its calibration."""
    facts = job.read("emission").json("emission.json")["response"]
    start, known = response_from_facts(facts), facts["calibration"]
    if not start.names:
        return start, None, known
    start = start if start.params.ndim == 2 else start.with_params(np.tile(start.params, (3, 1)))
    return start, (start.params.ravel(), np.linalg.inv(np.asarray(known["covariance"], np.float64))), known


def _drawn(job: Job, capture: CaptureReader, scene: BaseScene, mixed: np.ndarray) -> FitPixels:
    """Draw the pixels of the fit evenly over the objects (docs/method/fitting.md#which-pixels)."""
    asked, counts = job.settings.affines.pixels, np.zeros(max(scene.n_objects, 1), np.int64)
    for view in capture.used:
        counts += count_eligible(view_pixels(job, capture, scene, view), mixed, scene.n_objects)
    return FitPixels.evenly(counts, int(counts.sum()) if asked == "all" else asked, mixed, job.seed)


def _problem(
    job: Job, capture: CaptureReader, scene: BaseScene, drawn: FitPixels, gains: CameraGains, merged: bool
) -> tuple[FitProblem, _Places]:
    """Read the pixels of the fit with their cached shading."""
    views = capture.used
    levels = roughness_levels(job)
    rows: dict[str, list[np.ndarray]] = {name: [] for name in ("object", "value", "exposure", "view", "index", "cell")}
    # What grows with pixels x levels is joined on disk.
    folder, halves = job.writer.directory, (slice(None),) if merged else (slice(1), slice(1, 2))
    base, cached = Joined(folder), [[Joined(folder) for _ in range(3)] for _ in halves]
    for done, view in enumerate(views):
        pixels, specular = view_pixels(job, capture, scene, view), read_specular(job, view)
        pixels = pixels.take(drawn.of(pixels, view))
        index = pixels.index
        rows["object"].append(pixels.object_id)
        base.add(base_maps(job, view)[index])
        rows["value"].append(pixels.value)
        exposure, balance = exposure_and_balance(capture, gains, view, index)
        rows["exposure"].append(exposure)
        rows["view"].append(np.full(len(index), view.view_id, np.int32))
        rows["index"].append(index.astype(np.int32))
        rows["cell"].append(cells_of(job, view)[index])
        specular, diffuse = specular.at(index), read_diffuse(job, view).reshape(2, -1, 3)[:, index]
        for layers, half in zip(cached, halves, strict=True):
            for layer, part in zip(layers, (diffuse, specular.s0, specular.s1), strict=True):
                layer.add(balanced(part[half].mean(0), balance))
        job.progress(done + 1, len(views), "views read")
    joined = {name: np.concatenate(rows.pop(name)) for name in list(rows)}
    value, saturated = sensor_bounds(np.asarray(joined["value"], np.float32), capture.is_hdr, job.settings.emission.saturation)
    d, s0, s1 = (tuple(layer.array() for layer in layers) for layers in zip(*cached, strict=True))
    object_id = joined["object"].astype(np.int32)
    problem = FitProblem(
        object_id,
        scene.n_objects,
        base.array(),
        d,
        s0,
        s1,
        levels,
        value,
        joined["exposure"],
        saturated,
        None if merged else _patches(scene, object_id, joined["cell"].astype(np.int64)),
        _scatter(job, scene.n_objects),
    )
    return problem, _Places(joined["view"], joined["index"])


def _patches(scene: BaseScene, object_id: np.ndarray, cell: np.ndarray) -> np.ndarray:
    """Number the patches of surface whose pixels err together, (n,); pixels without a cell share one place."""
    position = np.zeros((len(cell), 3))
    if len(scene.cell_ijk):
        position = np.where((cell >= 0)[:, None], scene.cell_ijk[np.maximum(cell, 0)], -1)
    return patches(object_id, position)


def _scatter(job: Job, n_objects: int) -> np.ndarray:
    """Return how far the predictions of each object are apart, (O,)."""
    base = read_base(job)
    chosen, means = base.table("selection.parquet"), base.table("objects.parquet")
    owner = base.table("segments.parquet")["object_id"].astype(np.int64)
    affine = np.stack(chosen["affine_albedo"]) if len(chosen["k"]) else np.zeros((0, 12))
    samples = int(np.max(chosen["k"], initial=0)) + 1
    weight = np.asarray(chosen["weight_albedo"]).reshape(-1, samples).sum(1)
    mean = np.stack([means[f"albedo_{c}"] for c in "rgb"], 1)[:n_objects]
    seen = owner >= 0
    return prediction_scatter(affine.reshape(-1, samples, 3, 4)[seen], weight[seen], owner[seen], mean)


# ------------------------------------------------------------------------------------------------------------- output


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
    job.writer.table("objects.parquet", columns, {"residual": "sensor value"})


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
        values, maps = base_maps(job, view), base.exr(file)
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


# --------------------------------------------------------------------------------------------------------------- plan


def _plan(
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
