"""In the place of stage `affines`, where `affines.model` is not `objects`: the material models of earlier methods.

All read the same light and cached shading as `objects` and write the same artefacts. Where an original method would do worse for
reasons unrelated to its idea, it is given what `objects` has (lab/docs/published.md#earlier-methods-on-the-same-light).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from iif_core.camera.pixels import pixel_gains
from iif_core.camera.response import Response, response, response_facts, response_from_facts
from iif_core.fitting.cell_pixels import AlbedoSums, PixelRows
from iif_core.fitting.problem import Kinds
from iif_core.light.base_scene import BaseScene
from iif_core.reflectance.material import CHANNELS, IDENTITY, NEUTRAL, NUMBERS_OF
from lab.baselines.adam import solve_adam
from lab.baselines.camera import fit_camera
from lab.baselines.direct import solve_direct
from lab.baselines.loss import FIPT, IRIS, CellFit, albedo_deviation, fill_unknown, object_means
from lab.baselines.problem import CellSums
from lab.baselines.texture import blocks_of, cell_albedo
from workflow.artifacts.store import ids_from_disk, split_rgb
from workflow.fitting.affine_files import kind_columns
from workflow.fitting.cell_pixels import CellPixels
from workflow.fitting.inputs import cells_of, roughness_levels
from workflow.runtime.job import Job
from workflow.scene.base_scene import base_maps, read_gains, read_lit_scene
from workflow.scene.cached_light import read_diffuse
from workflow.scene.decoded import DecodedViews
from workflow.scene.named import object_names
from workflow.scene.normal_form import CaptureReader, View
from workflow.scene.recovered import write_response

BLOCK_FOOTPRINTS = 1.6
"""Edge, in median pixel footprints, of the blocks of cells that share roughness, metallic and diffuse light."""
CAMERA_PIXELS = 200_000
"""Approximate number of pixels, of whole blocks, that the camera response is fitted to."""
_STREAM = 0x626C6E
"""Random stream of this module."""
MODEL_NAMES = {
    "base": "identity",
    "object_mean": "mean of the predictions",
    "texture_average": "mean of the photographs",
    "fipt": "free cells (FIPT)",
    "iris": "free cells (IRIS)",
}


@dataclass(frozen=True)
class _Result:
    """Materials of cells (C, 5) and of objects (O, 5), the cells' uncertainty (C,), and facts for affines.json."""

    cells: np.ndarray
    objects: np.ndarray
    uncertainty: np.ndarray
    curve: Response
    pixels: np.ndarray
    facts: dict[str, Any]


def run(job: Job) -> None:
    """Write the artefacts of stage `affines` for the model that the settings name."""
    model = job.settings.affines.model
    capture, (scene, light) = CaptureReader(job.read("capture")), read_lit_scene(job)
    mixed = light.emits | scene.is_sheer
    if model == "texture_average":
        result = _texture_average(job, capture, scene, mixed)
    elif model in ("fipt", "iris"):
        result = _free_cells(job, capture, scene, mixed, model)
    else:
        result = _given(job, capture, scene, model)
    _write_objects(job, scene, result, model)
    if not capture.is_hdr:
        write_response(job, result.curve)
    _write_cells(job, result)
    _write_maps(job, capture, scene, result, per_pixel=model == "base")
    facts = {"model": model, "light_scale": 1.0, "converged": True, "history": [0.0], "residual": 0.0, "plan": []}
    job.writer.json(
        "affines.json", {**facts, "pixels": int(result.pixels.sum()), "response": response_facts(result.curve), **result.facts}
    )


# ------------------------------------------------------------------------------------------------------ without a fit


def _given(job: Job, capture: CaptureReader, scene: BaseScene, model: str) -> _Result:
    """Return materials without a fit: those of the base, or one constant for each object."""
    cells = job.read("base").table("cells.parquet")
    deviation = np.stack([cells[f"uncertainty_albedo_{c}"] for c in "rgb"], 1).mean(1)
    objects = scene.object_values if model == "base" else _object_means(job, capture, scene)
    values = scene.cell_values if model == "base" else objects[scene.cell_object]
    return _Result(values, objects, deviation, _start(job), np.zeros(scene.n_objects), {})


def _object_means(job: Job, capture: CaptureReader, scene: BaseScene) -> np.ndarray:
    """Return the mean over views, pixels and predictions of each object, (O, 5), or its base where it has no prediction."""
    used = int(job.read("base").json("base.json")["predictions"])
    sums = np.zeros((scene.n_objects, 6))
    for view in capture.views:
        file = f"maps/{view.name}.exr"
        if not job.read("prior").has(file):
            continue
        channels = job.read("prior").exr(file)
        numbers = sorted({int(name.split(".")[1]) for name in channels if name.startswith("prior.")})[:used]
        object_id = ids_from_disk(job.read("segmentation").exr(file)["object.id"]).ravel()
        seen = object_id >= 0
        for k in numbers:
            names = [*(f"albedo.{c}" for c in "RGB"), "roughness", "metallic"]
            for i, name in enumerate(names):
                value = channels[f"prior.{k:03d}.{name}"].ravel()[seen].astype(np.float64)
                sums[:, i] += np.bincount(object_id[seen], value, scene.n_objects)
            sums[:, 5] += np.bincount(object_id[seen], minlength=scene.n_objects)
    return np.where(sums[:, 5:] > 0, sums[:, :5] / np.maximum(sums[:, 5:], 1), scene.object_values)


def _texture_average(job: Job, capture: CaptureReader, scene: BaseScene, mixed: np.ndarray) -> _Result:
    """Take the mean radiance that photographs show of every cell as its albedo, without gloss (Eq. M.55).

    Cells that no photograph shows have the mean of their object. One gain for all cells makes albedo times diffuse light match
    the radiance in least squares. Stage emission gives the response; saturated values are used as they are.
    """
    curve, gains, decoded = _start(job), read_gains(job), DecodedViews(capture, job.read("segmentation"))
    cells, objects = np.zeros((len(scene.cell_object), 4)), np.zeros((scene.n_objects, 4))
    lit: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for number, view in enumerate(capture.views):
        if view.split == "test":
            continue
        pixels = decoded.pixels(view, scene.normals)
        cell = cells_of(job, view)[pixels.index]
        use = pixels.valid & (cell >= 0) & ~mixed[pixels.face]
        pixels, cell = pixels.take(use), cell[use]
        radiance = np.asarray(pixels.value, np.float64)
        if not capture.is_hdr:
            radiance = curve.inverse(np.clip(radiance, 0, 1)) / pixel_gains(gains, number, view, pixels.index)
        for sums, row in ((cells, cell), (objects, scene.cell_object[cell])):
            for c in range(3):
                sums[:, c] += np.bincount(row, radiance[:, c], len(sums))
            sums[:, 3] += np.bincount(row, minlength=len(sums))
        lit.append((cell, read_diffuse(job, view).mean(0).reshape(-1, 3)[pixels.index], radiance))
    of_object = objects[:, :3] / np.maximum(objects[:, 3:], 1)
    of_cell = np.where(cells[:, 3:] > 0, cells[:, :3] / np.maximum(cells[:, 3:], 1), of_object[scene.cell_object])
    across = sum(float((of_cell[cell] * light * radiance).sum()) for cell, light, radiance in lit)
    square = sum(float(((of_cell[cell] * light) ** 2).sum()) for cell, light, _ in lit)
    gain = across / square if square > 0 else 1.0

    def material(albedo: np.ndarray) -> np.ndarray:
        rest = np.tile(np.float64(NEUTRAL[3:]), (len(albedo), 1))
        return np.concatenate([np.clip(gain * albedo, 0, 1), rest], 1)

    return _Result(material(of_cell), material(of_object), np.zeros(len(of_cell)), curve, objects[:, 3], {"gain": gain})


# --------------------------------------------------------------------------------------------------------- free cells


def _free_cells(job: Job, capture: CaptureReader, scene: BaseScene, mixed: np.ndarray, model: str) -> _Result:
    """Fit roughness and metallic of blocks of cells, then the albedo of every cell (Eq. M.51, M.54)."""
    levels = roughness_levels(job)
    options = FIPT if model == "fipt" else IRIS
    edge = max(1, round(BLOCK_FOOTPRINTS * _footprint(capture) / scene.cell_edge))
    block_of, owner = blocks_of(scene.cell_ijk, scene.cell_object, edge)
    prior = _object_means(job, capture, scene) if model == "iris" else None
    goal = prior[owner, :3] if prior is not None else None
    views = CellPixels(job, DecodedViews(capture, job.read("segmentation")), scene, mixed, block_of, len(owner))
    sums = CellSums(owner, scene.n_objects, levels)
    curve, camera = (response("srgb") if not capture.is_hdr else response("identity")), []
    if goal is not None and not capture.is_hdr:
        share = min(1.0, CAMERA_PIXELS / max(views.count, 1))
        chosen = np.random.default_rng([job.seed, _STREAM]).random(len(owner)) < share
        rows = PixelRows.joined([rows.take(np.flatnonzero(chosen[rows.cell])) for rows, _ in views])
        with job.timed("solve"):
            fitted = fit_camera(rows, sums, _start(job), goal, options, dark=views.dark)
        curve, camera = fitted.response, fitted.history
        del rows
    for rows, _ in views:
        with job.timed("solve"):
            sums.add(rows, curve, views.dark)
    problem = sums.problem()
    with job.timed("solve"):
        solve = solve_direct if job.settings.affines.solver == "direct" else solve_adam
        fit = solve(problem, options, goal)
    unseen = prior if prior is not None else np.tile(np.float64(NEUTRAL), (scene.n_objects, 1))
    blocks = fill_unknown(fit, problem, unseen)
    job.log.info("%d of %d blocks seen, loss %s", fit.known.sum(), len(fit.known), fit.history[-1:])
    fine = AlbedoSums(len(block_of))
    for rows, cell in views:
        own = blocks[rows.cell]
        with job.timed("solve"):
            fine.add(replace(rows, cell=cell), levels, own[:, 3], own[:, 4], curve, views.dark)
    values = blocks[block_of]
    towards = {"prior": goal[block_of] / max(fit.scale, 1e-6), "weight": options.prior * fit.scale**2} if goal is not None else {}
    values[:, :3] = cell_albedo(fine, values[:, :3], **towards)
    pixels = np.bincount(owner, problem.pixels, scene.n_objects)
    facts = {"history": fit.history, "camera_history": camera, "residual": _residual(fit), "prior_scale": fit.scale}
    facts |= {"blocks": len(owner), "blocks_seen": int(fit.known.sum()), "solver": job.settings.affines.solver}
    deviation = albedo_deviation(problem, blocks)[block_of]
    return _Result(values, object_means(problem, blocks, unseen), deviation, curve, pixels, facts)


def _residual(fit: CellFit) -> float:
    """Return the root of the last loss."""
    return float(np.sqrt(max(fit.history[-1], 0.0))) if fit.history else 0.0


def _footprint(capture: CaptureReader) -> float:
    """Return the median over the views of the median size of a pixel on the surface, m; 0 if no pixel shows surface."""
    sizes = []
    for view in capture.views:
        depth = capture.gbuffer(view)[0]
        if (depth > 0).any():
            sizes.append(float(np.median(depth[depth > 0])) / view.fx)
    return float(np.median(sizes)) if sizes else 0.0


def _start(job: Job) -> Response:
    """Return the response of stage emission, with parameters for each channel."""
    start = response_from_facts(job.read("emission").json("emission.json")["response"])
    return start.with_params(np.tile(start.params, (3, 1))) if start.names and start.params.ndim == 1 else start


# ------------------------------------------------------------------------------------------------------------- output


def _write_objects(job: Job, scene: BaseScene, result: _Result, model: str) -> None:
    """Write affine maps that turn the object means of the base, which surface without cells has, into those of the model."""
    names = object_names(job.read("segmentation"), scene.n_objects)
    affine = np.tile(IDENTITY, (scene.n_objects, 1))
    if model != "base":
        affine[:] = 0.0
        affine[:, [3, 7, 11, 13, 15]] = result.objects
    columns: dict[str, Any] = {"object_id": np.arange(len(names), dtype=np.int32), "name": np.array(names, dtype=str)}
    columns["pixels"] = result.pixels.astype(np.int64)
    for name, part in NUMBERS_OF.items():
        columns[f"T_{name}"], columns[f"std_{name}"] = affine[:, part], np.zeros_like(affine[:, part])
    zeros = np.zeros(len(names))
    columns |= {"std_level": zeros, "covariance_trace": zeros, "residual": zeros, "light_gain": 1.0 + zeros}
    columns |= kind_columns(Kinds.unknown(len(names)))
    columns["model"] = np.array([MODEL_NAMES[model]] * len(names), dtype=str)
    columns["given"] = np.array([""] * len(names), dtype=str)  # `materials` needs the model of objects
    job.writer.table("objects.parquet", columns, {"residual": "sensor value"})


def _write_cells(job: Job, result: _Result) -> None:
    values = result.cells.astype(np.float32)
    columns = {"cell_id": job.read("base").table("cells.parquet")["cell_id"]}
    columns |= {name: values[:, i] for i, name in enumerate(CHANNELS)}
    job.writer.table("cells.parquet", {**columns, "uncertainty": result.uncertainty.astype(np.float32)})


def _write_maps(job: Job, capture: CaptureReader, scene: BaseScene, result: _Result, per_pixel: bool) -> None:
    """Write the material of the cell of every pixel, or of its object where it has no cell. `per_pixel`: the maps of the base."""
    base, segmentation = job.read("base"), job.read("segmentation")
    for done, view in enumerate(capture.views):
        file = f"maps/{view.name}.exr"
        maps = base.exr(file)
        cell = ids_from_disk(maps["cell.id"]).ravel()
        object_id = ids_from_disk(segmentation.exr(file)["object.id"]).ravel()
        seen = object_id >= 0
        value = base_maps(job, view) if per_pixel else _of_pixels(result, cell, object_id)
        deviation = np.where(cell >= 0, result.uncertainty[cell] if len(result.uncertainty) else 0.0, 1.0)
        if per_pixel:
            deviation = maps["uncertainty.albedo"].ravel()
        value, deviation = np.where(seen[:, None], value, 0.0).astype(np.float32), np.where(seen, deviation, 0.0)
        job.writer.exr(file, _channels(view, value, deviation.astype(np.float32)))
        job.progress(done + 1, len(capture.views), "views written")


def _of_pixels(result: _Result, cell: np.ndarray, object_id: np.ndarray) -> np.ndarray:
    value = np.zeros((len(cell), 5))
    if len(result.objects):
        value = np.where((object_id >= 0)[:, None], result.objects[object_id], value)
    if len(result.cells):
        value = np.where((cell >= 0)[:, None], result.cells[cell], value)
    return value


def _channels(view: View, value: np.ndarray, deviation: np.ndarray) -> dict[str, np.ndarray]:
    shape = (view.height, view.width)
    channels = split_rgb(value[:, :3].reshape(*shape, 3), "albedo")
    channels |= {"roughness": value[:, 3].reshape(shape), "metallic": value[:, 4].reshape(shape)}
    return channels | {"uncertainty": deviation.reshape(shape)}
