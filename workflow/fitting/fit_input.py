"""What stage affines reads: pixels with their cached light, response, gauge and what is known of the objects."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from iif_core.camera.response import Response, response_from_facts
from iif_core.fitting.clusters import patches
from iif_core.fitting.gauge import Gauge
from iif_core.fitting.object_levels import prediction_scatter
from iif_core.fitting.problem import FitProblem
from iif_core.light.base_scene import BaseScene
from workflow.artifacts.scratch import Joined
from workflow.fitting.asked import Places, find_gauge, given_materials
from workflow.fitting.cell_textures import CellTextures
from workflow.fitting.fit_pixels import PixelDraw, count_eligible
from workflow.fitting.inputs import balanced, cells_of, exposure_and_balance, roughness_levels
from workflow.runtime.job import Job
from workflow.scene.base_scene import base_maps, read_base, read_gains, read_lit_scene, sensor_bounds
from workflow.scene.cached_light import read_diffuse, read_specular
from workflow.scene.decoded import DecodedViews
from workflow.scene.named import object_names
from workflow.scene.normal_form import CaptureReader

Draw = Callable[[Job, DecodedViews, BaseScene, np.ndarray], PixelDraw]
"""Chooses the pixels of the fit, given the faces (m,) bool whose pixels are left out."""


@dataclass(frozen=True, kw_only=True)
class FitInputs:
    """What is fitted, and what its numbers stand for.

    Attributes:
        problem: pixels with their cached light; names: of the objects; capture: of the photographs.
        start: response of stage emission, with parameters for each channel; prior: mean and precision of them, None = none;
            calibration: facts of it.
        gauge: what fixes the level of all albedos; textures: cells that get the texture of the photographs, None = none.
    """

    problem: FitProblem
    names: list[str]
    capture: CaptureReader
    start: Response
    prior: tuple[np.ndarray, np.ndarray] | None
    calibration: dict[str, Any]
    gauge: Gauge
    textures: CellTextures | None


def read_fit(job: Job, draw: Draw | None = None, merged: bool = False) -> FitInputs:
    """Read what is fitted.

    Args:
        job: the job.
        draw: chooses the pixels; None: evenly over the objects.
        merged: read the mean of the two halves of the light, for a solver that does not ask how far they are apart.
    """
    capture, (scene, light) = CaptureReader(job.read("capture")), read_lit_scene(job)
    names = object_names(job.read("segmentation"), scene.n_objects)
    gauge, given = find_gauge(job, capture, names), given_materials(job, names)  # wrong settings stop the stage before any work
    mixed = light.emits | scene.is_sheer
    decoded = DecodedViews(capture, job.read("segmentation"))
    drawn = (draw or _drawn)(job, decoded, scene, mixed)
    problem, places = _problem(job, decoded, scene, drawn, given, merged)
    start, prior, calibration = _starting_response(job)
    job.log.info("%d pixels of %d objects", len(problem.object_id), len(np.unique(problem.object_id)))
    return FitInputs(
        problem=problem,
        names=names,
        capture=capture,
        start=start,
        prior=prior,
        calibration=calibration,
        gauge=gauge(problem, places),
        textures=CellTextures.of(job, decoded, scene, mixed),
    )


def _starting_response(job: Job) -> tuple[Response, tuple[np.ndarray, np.ndarray] | None, dict[str, Any]]:
    """Return the response of stage emission with parameters for each channel, its prior, and the facts of its calibration."""
    facts = job.read("emission").json("emission.json")["response"]
    start, known = response_from_facts(facts), facts["calibration"]
    if not start.names:
        return start, None, known
    start = start if start.params.ndim == 2 else start.with_params(np.tile(start.params, (3, 1)))
    return start, (start.params.ravel(), np.linalg.inv(np.asarray(known["covariance"], np.float64))), known


def _drawn(job: Job, decoded: DecodedViews, scene: BaseScene, mixed: np.ndarray) -> PixelDraw:
    """Draw the pixels of the fit evenly over the objects (docs/method/fitting.md#which-pixels)."""
    asked, counts = job.settings.affines.pixels, np.zeros(max(scene.n_objects, 1), np.int64)
    for view in decoded.capture.used:
        counts += count_eligible(decoded.pixels(view, scene.normals), mixed, scene.n_objects)
    return PixelDraw.evenly(counts, int(counts.sum()) if asked == "all" else asked, mixed, job.seed)


def _problem(
    job: Job, decoded: DecodedViews, scene: BaseScene, drawn: PixelDraw, given: np.ndarray | None, merged: bool
) -> tuple[FitProblem, Places]:
    """Read the pixels of the fit with their cached shading."""
    capture, views, gains = decoded.capture, decoded.capture.used, read_gains(job)
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
    diffuse, s0, s1 = (tuple(layer.array() for layer in layers) for layers in zip(*cached, strict=True))
    object_id = joined["object"].astype(np.int32)
    problem = FitProblem(
        object_id=object_id,
        n_objects=scene.n_objects,
        base=base.array(),
        diffuse=diffuse,
        s0=s0,
        s1=s1,
        levels=roughness_levels(job),
        value=value,
        exposure=joined["exposure"],
        saturated=saturated,
        cluster=None if merged else _patches(scene, object_id, joined["cell"].astype(np.int64)),
        scatter=_scatter(job, scene.n_objects),
        given=given,
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
