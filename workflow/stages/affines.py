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
from iif_core.fitting.gauge import apply_gauge
from iif_core.fitting.object_levels import prediction_scatter
from iif_core.fitting.problem import FitOptions, FitProblem, FitResult
from iif_core.light.base_scene import BaseScene
from workflow.artifacts.scratch import Joined
from workflow.decisions import materials
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
from workflow.settings.options import options_of

Solver = Callable[[FitProblem, Response], FitResult]
"""From the problem and the response of stage emission to the fit, in the gauge of the given light."""


def run(job: Job) -> None:
    """Write objects.parquet, camera_response.parquet (LDR), cells.parquet, maps/<view>.exr and affines.json."""
    fit(job, _direct)


def fit(
    job: Job,
    solver: Callable[[Job, tuple[np.ndarray, np.ndarray] | None], Solver],
    name: str = "direct",
    draw: Callable[[Job, DecodedViews, BaseScene, np.ndarray], FitPixels] | None = None,
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
    names = object_names(job.read("segmentation"), scene.n_objects)
    gauge, given = find_gauge(job, capture, names), given_materials(job, names)  # wrong settings stop the stage before any work
    mixed = light.emits | scene.is_sheer
    decoded = DecodedViews(capture, job.read("segmentation"))
    drawn = (draw or _drawn)(job, decoded, scene, mixed)
    problem, places = _problem(job, decoded, scene, drawn, read_gains(job), merged)
    del decoded  # the solver needs the memory
    problem = replace(problem, given=given)
    start, prior, calibration = _starting_response(job)
    job.log.info("%d pixels of %d objects", len(problem.object_id), len(np.unique(problem.object_id)))
    textures = CellTextures.of(job, capture, scene, mixed)
    with job.timed("solve"):
        free = solver(job, prior)(problem, start)
    found = apply_gauge(problem, free, gauge(problem, places))
    for o in range(scene.n_objects):
        job.log.debug("%s: %s, residual %.4f", names[o], found.model[o], found.residual[o])
    write_objects(job, names, found, given)
    if not capture.is_hdr:
        write_response(job, found.response)
    albedo = textures.albedo(found) if textures is not None else None
    write_cells(job, found, albedo)
    write_maps(job, capture, found, albedo)
    metals = job.settings.components.metallic
    plan = plan_of_fit(problem, found, calibration, capture.facts["dynamic_range"], metals)
    if given is not None:
        plan.append(materials.given_by_hand(names, given))
    write_facts(job, name, found, plan)


def _direct(job: Job, prior: tuple[np.ndarray, np.ndarray] | None) -> Solver:
    options = options_of(
        FitOptions,
        job.settings.affines,
        response_prior=prior,
        # This prior read the brightness of objects from the same photographs.
        base_tells_levels=job.settings.prior.kind != "retinex",
        lobes=has_lobes(job),
        metals=job.settings.components.metallic != "off",
        prediction_errors=prediction_errors(job),
        threads=job.threads,
    )
    return lambda problem, start: fit_affines(problem, start, options)


# -------------------------------------------------------------------------------------------------------------- input


def _starting_response(job: Job) -> tuple[Response, tuple[np.ndarray, np.ndarray] | None, dict[str, Any]]:
    """Return the response of stage emission with parameters for each channel, its prior, and the facts of its calibration."""
    facts = job.read("emission").json("emission.json")["response"]
    start, known = response_from_facts(facts), facts["calibration"]
    if not start.names:
        return start, None, known
    start = start if start.params.ndim == 2 else start.with_params(np.tile(start.params, (3, 1)))
    return start, (start.params.ravel(), np.linalg.inv(np.asarray(known["covariance"], np.float64))), known


def _drawn(job: Job, decoded: DecodedViews, scene: BaseScene, mixed: np.ndarray) -> FitPixels:
    """Draw the pixels of the fit evenly over the objects (docs/method/fitting.md#which-pixels)."""
    asked, counts = job.settings.affines.pixels, np.zeros(max(scene.n_objects, 1), np.int64)
    for view in decoded.capture.used:
        counts += count_eligible(decoded.pixels(view, scene.normals), mixed, scene.n_objects)
    return FitPixels.evenly(counts, int(counts.sum()) if asked == "all" else asked, mixed, job.seed)


def _problem(
    job: Job, decoded: DecodedViews, scene: BaseScene, drawn: FitPixels, gains: CameraGains, merged: bool
) -> tuple[FitProblem, Places]:
    """Read the pixels of the fit with their cached shading."""
    capture, views = decoded.capture, decoded.capture.used
    levels = roughness_levels(job)
    rows: dict[str, list[np.ndarray]] = {name: [] for name in ("object", "value", "exposure", "view", "index", "cell")}
    # What grows with pixels x levels is joined on disk.
    folder, halves = job.writer.directory, (slice(None),) if merged else (slice(1), slice(1, 2))
    base, cached = Joined(folder), [[Joined(folder) for _ in range(3)] for _ in halves]
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
        for layers, half in zip(cached, halves, strict=True):
            for layer, part in zip(layers, (diffuse, specular.s0, specular.s1), strict=True):
                layer.add(balanced(part[half].mean(0), balance))
        job.progress(done + 1, len(views), "views read")
    joined = {name: np.concatenate(rows.pop(name)) for name in list(rows)}
    value, saturated = sensor_bounds(np.asarray(joined["value"], np.float32), capture.is_hdr)
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
