"""affines: one affine map for each object and the camera response, fitted to the photographs (Eq. M.1, M.14)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from iif_core.camera.gains import CameraGains
from iif_core.camera.response import Response, response_from_facts
from iif_core.fitting.clusters import patches
from iif_core.fitting.direct import fit_affines
from iif_core.fitting.gauge import Gauge, apply_gauge
from iif_core.fitting.object_levels import prediction_scatter
from iif_core.fitting.problem import FitOptions, FitProblem, FitResult, SgdOptions
from iif_core.fitting.published import PublishedOptions, PublishedState, fit_published
from iif_core.fitting.reference_loss import reference_loss
from iif_core.fitting.sgd import fit_affines_sgd
from iif_core.light.base_scene import BaseScene
from workflow.artifacts.scratch import Joined
from workflow.decisions import materials
from workflow.fitting import baselines
from workflow.fitting.affine_files import plan_of_fit, write_cells, write_facts, write_maps, write_objects
from workflow.fitting.asked import Places, find_gauge, given_materials
from workflow.fitting.cell_textures import CellTextures
from workflow.fitting.fit_pixels import FitPixels, count_eligible
from workflow.fitting.inputs import balanced, cells_of, exposure_and_balance, prediction_errors, roughness_levels
from workflow.runtime.job import Job
from workflow.scene.base_scene import base_maps, read_base, read_gains, read_lit_scene, sensor_bounds
from workflow.scene.cached_light import has_lobes, read_diffuse, read_specular
from workflow.scene.decoded import DecodedViews
from workflow.scene.named import object_names
from workflow.scene.normal_form import CaptureReader
from workflow.scene.recovered import write_response


def run(job: Job) -> None:
    """Write objects.parquet, camera_response.parquet (LDR), cells.parquet, maps/<view>.exr and affines.json."""
    if job.settings.affines.model != "objects":
        return baselines.run(job)
    capture, (scene, light) = CaptureReader(job.read("capture")), read_lit_scene(job)
    names = object_names(job.read("segmentation"), scene.n_objects)
    gauge, given = find_gauge(job, capture, names), given_materials(job, names)  # wrong settings stop the stage before any work
    mixed = light.emits | scene.is_sheer
    problem, places = _problem(job, capture, scene, mixed, read_gains(job))
    problem = replace(problem, given=given)
    start, prior, calibration = _starting_response(job)
    job.log.info("%d pixels of %d objects", len(problem.object_id), len(np.unique(problem.object_id)))
    textures = CellTextures.of(job, capture, scene, mixed)
    fit, free = _fitted(job, problem, start, prior, places, gauge)
    for o in range(scene.n_objects):
        job.log.debug("%s: %s, residual %.4f", names[o], fit.model[o], fit.residual[o])
    write_objects(job, names, fit, given)
    if not capture.is_hdr:
        write_response(job, fit.response)
    albedo = textures.albedo(fit) if textures is not None else None
    write_cells(job, fit, albedo)
    write_maps(job, capture, fit, albedo)
    metals = job.settings.override.components.metallic
    plan = plan_of_fit(problem, fit, calibration, capture.facts["dynamic_range"], metals)
    if given is not None:
        plan.append(materials.given_by_hand(names, given))
    loss = reference_loss(problem, free.affine, free.response)
    write_facts(job, fit, loss.__dict__, plan)


def _fitted(
    job: Job,
    problem: FitProblem,
    start: Response,
    prior: tuple[np.ndarray, np.ndarray] | None,
    places: Places,
    gauge: Callable[[FitProblem, Places], Gauge],
) -> tuple[FitResult, FitResult]:
    """Return the fit in its gauge, and in the gauge of the given light."""
    with job.timed("solve"):
        free = _solver(job, prior)(problem, start)
    return apply_gauge(problem, free, gauge(problem, places)), free


def _solver(job: Job, prior: tuple[np.ndarray, np.ndarray] | None) -> Callable[[FitProblem, Response], FitResult]:
    """Return the solver that the settings name; `prior` is mean and precision of the response."""
    settings = job.settings.affines
    if settings.solver == "direct":
        options = FitOptions(
            iterations=settings.iterations,
            population=settings.population,
            robust_width=settings.robust_width,
            response_prior=prior,
            # This prior read the brightness of objects from the same photographs.
            base_tells_levels=job.settings.prior.kind != "retinex",
            lobes=has_lobes(job),
            metals=job.settings.override.components.metallic != "off",
            prediction_errors=prediction_errors(job),
            threads=job.threads,
        )
        return lambda problem, start: fit_affines(problem, start, options)
    if settings.solver == "published":
        rate = PublishedOptions.rate if settings.rate is None else settings.rate
        published = PublishedOptions(rate, epochs=settings.epochs, batch=settings.batch, seed=job.seed)
        kept = job.kept_state("descent")
        at = kept and PublishedState(**kept[0], step=kept[1]["step"], loss=tuple(kept[1]["loss"]))

        def keep(state: PublishedState) -> None:
            facts = {"step": state.step, "loss": list(state.loss)}
            job.keep_state("descent", {"affine": state.affine, "params": state.params}, facts)

        return lambda problem, start: fit_published(problem, start, published, at, keep)
    own = SgdOptions(settings.solver, settings.rate, settings.epochs, settings.batch, seed=job.seed)
    return lambda problem, start: fit_affines_sgd(problem, start, own)


# -------------------------------------------------------------------------------------------------------------- input


def _starting_response(job: Job) -> tuple[Response, tuple[np.ndarray, np.ndarray] | None, dict[str, Any]]:
    """Return the response of stage emission with parameters for each channel, its prior, and the facts of its calibration."""
    facts = job.read("emission").json("emission.json")["response"]
    start, known = response_from_facts(facts), facts["calibration"]
    if not start.names:
        return start, None, known
    start = start if start.params.ndim == 2 else start.with_params(np.tile(start.params, (3, 1)))
    return start, (start.params.ravel(), np.linalg.inv(np.asarray(known["covariance"], np.float64))), known


def _problem(
    job: Job, capture: CaptureReader, scene: BaseScene, mixed: np.ndarray, gains: CameraGains
) -> tuple[FitProblem, Places]:
    """Draw the pixels of the fit evenly over objects and read their cached shading (docs/method/fitting.md#which-pixels)."""
    decoded = DecodedViews(capture, job.read("segmentation"))
    views, asked, published = capture.used, job.settings.affines.pixels, job.settings.affines.solver == "published"
    if published and asked == "all":
        drawn = FitPixels.every(scene.n_objects, mixed)
    else:
        counts = np.zeros(max(scene.n_objects, 1), np.int64)
        for view in views:
            counts += count_eligible(decoded.pixels(view, scene.normals), mixed, scene.n_objects)
        drawn = FitPixels.evenly(counts, int(counts.sum()) if asked == "all" else asked, mixed, job.seed)
    levels = roughness_levels(job)
    rows: dict[str, list[np.ndarray]] = {name: [] for name in ("object", "value", "exposure", "view", "index", "cell")}
    # What grows with pixels x levels is joined on disk; the published fit takes the mean of the halves.
    folder = job.writer.directory
    base, cached = Joined(folder), [[Joined(folder) for _ in range(3)] for _ in range(1 if published else 2)]
    for done, view in enumerate(views):
        pixels, specular = decoded.pixels(view, scene.normals), read_specular(job, view)
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
        for layers, half in zip(cached, (slice(None),) if published else (slice(1), slice(1, 2)), strict=True):
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
        None if published else _patches(scene, object_id, joined["cell"].astype(np.int64)),
        _scatter(job, scene.n_objects),
    )
    return problem, Places(joined["view"], joined["index"])


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
