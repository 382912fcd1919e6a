"""Stage base: the predictions of all views fused into one material per surface cell (docs/method/fusion.md)."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from iif_core.fusion.direct import describe_fit, solve_direct
from iif_core.fusion.gauge import parts_per_object
from iif_core.fusion.matching import REGULARISER
from iif_core.fusion.options import FusionOptions
from iif_core.fusion.problem import FusionProblem, FusionResult, one_segment_per_view, with_every_object
from iif_core.fusion.reference_loss import loss_of_result
from iif_core.fusion.sgd.options import preset_grid, sgd_options
from iif_core.fusion.sgd.solve import SgdFit, SgdState, converged, solve_sgd
from iif_core.surface.cell_grid import CellGrid, CellValues
from iif_core.surface.cells import neighbour_pairs
from workflow.artifacts.scratch import Scratch
from workflow.artifacts.store import ids_from_disk
from workflow.decisions import numerics
from workflow.runtime.job import Job
from workflow.scene.base_files import maps_of_view, raw_maps, write_cells, write_segments
from workflow.scene.decoded import DecodedViews
from workflow.scene.fusion_input import cells_of_views, points_of_views, tangents_of_views, weights_and_segments
from workflow.scene.normal_form import CaptureReader
from workflow.scene.predictions import Predictions, StoredPredictions

MEMORY_BYTES = 1 << 30
"""Predictions that stay in memory between sweeps; those of further views are mapped from a file without a name."""

KEPT_EVERY = 30.0
"""Seconds between two states of a descent that are written; each has 335 MB with the paper's hash grid."""


def run(job: Job) -> None:
    """Write cells, object means, segments, selection, maps of every view and base.json."""
    fuse(job, StoredPredictions(job.read("prior")))


def fuse(job: Job, prior: Predictions) -> None:
    """Fuse predictions, and write what stage base writes; the job has the settings `base` and `seed`, and capture and
    segmentation upstream."""
    capture = CaptureReader(job.read("capture"))
    segmentation, settings = job.read("segmentation"), job.settings.base
    views = [view for view in capture.used if prior.has(view)]
    decoded = DecodedViews(capture, segmentation)
    grid, cell_maps = cells_of_views(job, decoded, views)
    weights, segment_maps = weights_and_segments(job, decoded, views)
    segments = segmentation.table("segments.parquet")
    n_objects = int(segmentation.table("objects.parquet")["object_id"].max(initial=-1)) + 1
    used = 1 if settings.variant == "raw" else min(prior.samples, settings.predictions or prior.samples)
    problem = FusionProblem(
        lambda position: prior.maps(views[position], used),
        cell_maps,
        segment_maps,
        len(grid),
        grid.object_id,
        segments["object_id"].astype(np.int32),
        weights,
        point=points_of_views(decoded, views),
        tangent=tangents_of_views(decoded, views),
        neighbours=neighbour_pairs(grid.keys) if settings.seams else None,
        scale=lambda position: prior.scale(views[position]),
    )
    if settings.variant == "image_affine":
        problem = one_segment_per_view(problem)
    with job.timed("solve"):
        result, fit = _solve(job, problem)
    result = with_every_object(result, n_objects)
    for dropped in result.dropped:
        if dropped.k < 0:
            job.log.warning("view %s: %s", views[dropped.view].name, dropped.reason)
    write_cells(job, grid, n_objects, result)
    write_segments(job, result, segments["segment_id"], problem.object_of_segment)
    every = np.concatenate([result.value, result.scale, result.uncertainty], 1)
    unseen = np.quantile(every[:, 5:], 0.9, axis=0)  # scale and uncertainty of surface that no prediction shows
    values = CellValues(grid, every)
    for done, view in enumerate(capture.views):
        maps = maps_of_view(decoded, values, unseen, result, view)
        if settings.variant == "raw" and view in views:
            maps |= raw_maps(prior, view, ids_from_disk(maps["cell.id"]) >= 0)
        job.writer.exr(f"maps/{view.name}.exr", maps)
        job.progress(done + 1, len(capture.views), "maps")
    _write_facts(job, grid, problem, result, fit, used)


def _write_facts(job: Job, grid: CellGrid, problem: FusionProblem, result: FusionResult, fit: SgdFit | None, used: int) -> None:
    """Write base.json and a summary to the log; `used` predictions per view."""
    settings = job.settings.base
    job.writer.json(
        "base.json",
        {
            "cell_edge_m": grid.edge,
            "origin": [float(x) for x in grid.origin],
            "cells": len(grid),
            "predictions": used,
            "solver": settings.solver,
            "variant": settings.variant,
            "sweeps": len(result.history),
            "history": [{name: round(float(value), 8) for name, value in entry.items()} for entry in result.history],
            "objects_in_separate_parts": {
                str(name): count for name, count in parts_per_object(grid.object_id, result.part_of_cell).items()
            },
            "filled_share": float((result.coverage == 0).mean()),
            "seen_once_share": float((result.views == 1).mean()),
            "uncertainty_calibrated": _calibrated(job),
            "numerics": numerics.of_base(result, used * len(problem.cell_of_pixel)),
            **({"reference_loss": _judged(job, problem, result, fit)} if settings.judge else {}),
        },
    )
    job.log.info(
        "%d cells of %.1f mm (%.0f %% seen in one view), %d segments; %s",
        len(grid),
        1e3 * grid.edge,
        100 * (result.views == 1).mean(),
        len(np.unique(np.concatenate([np.unique(m[m >= 0]) for m in problem.segment_of_pixel]))),
        ", ".join(f"{name} {value:.4g}" for name, value in result.history[-1].items()),
    )


def _calibrated(job: Job) -> bool:
    """Whether uncertainty_* are calibrated for this way of solving; otherwise they only rank cells."""
    settings = job.settings.base
    return settings.solver == "direct" and settings.variant == "full" and settings.objective == "least_squares"


def _solve(job: Job, problem: FusionProblem) -> tuple[FusionResult, SgdFit | None]:
    """The result, and the fit of the paper's optimiser if that solved."""
    settings = job.settings.base

    def progress(done: int, total: int) -> None:
        job.progress(done, total, "passes over the views" if settings.solver == "direct" else "steps")

    if settings.solver == "sgd":
        own = {
            "texture": settings.texture or ("hashgrid" if settings.preset == "paper" else "cells"),
            "iterations": settings.iterations,
            "median_gradient": settings.median_gradient,
        }
        grid = preset_grid(settings.preset, settings.hash_levels, settings.hash_entries)
        given = {name: value for name, value in own.items() if value is not None}
        chosen = sgd_options(settings.preset, grid=grid, seed=job.seed, **given)
        last = time.monotonic()

        def load() -> SgdState | None:
            kept = job.kept_state("descent")
            if kept is None:
                return None
            job.log.info("the descent continues from step %d", kept[1]["step"])
            return SgdState(*kept)

        def keep(state_of: Callable[[], SgdState]) -> None:
            nonlocal last
            if time.monotonic() - last >= KEPT_EVERY:
                state = state_of()
                job.keep_state("descent", state.arrays, state.facts)
                last = time.monotonic()

        fit = solve_sgd(problem, chosen, progress, job.threads, load, keep)
        texture = fit.value, fit.scale, fit.corrections, fit.alpha
        return describe_fit(problem, *texture, fit.history, job.threads, MEMORY_BYTES), fit
    variant = {"raw": "texel_mean", "image_affine": "full"}.get(settings.variant, settings.variant)
    same = ("sweeps", "anneal", "ridge", "final_temperature", "robust", "objective", "polish", "seams")
    options = FusionOptions(
        variant,
        temperature=max(settings.temperature, settings.final_temperature),
        memory=MEMORY_BYTES,
        spill=Scratch(job.writer.directory),
        **{name: getattr(settings, name) for name in same},
    )
    return solve_direct(problem, options, progress, job.threads), None


def _judged(job: Job, problem: FusionProblem, result: FusionResult, fit: SgdFit | None) -> dict[str, dict[str, float]]:
    """The paper's loss of the result, and for `sgd` also the loss of `direct` with the same objective and selection.

    Every pixel counts 1, as in the paper. `direct` solves with `border_weight`, which must be 1 for an exact comparison.
    """
    problem = replace(problem, weight=[(np.asarray(w) > 0).astype(np.float32) for w in problem.weight])  # the paper's pool
    judged = {job.settings.base.solver: loss_of_result(problem, result if fit is None else fit)}
    if fit is not None:
        options = FusionOptions(objective="distribution", polish=job.settings.base.polish, memory=MEMORY_BYTES)
        with job.timed("direct_at_the_same_selection"):
            twin = solve_direct(problem, options, threads=job.threads, chosen=fit.alpha.argmax(1))
        judged["direct_at_the_same_selection"] = loss_of_result(problem, twin)
    out = {}
    for name, loss in judged.items():
        regulariser = REGULARISER * (loss.regulariser_albedo + loss.regulariser_roughness + loss.regulariser_metallic)
        out[name] = {"data": loss.data, "regulariser": regulariser, "total": loss.data + regulariser}
    if fit is not None:
        out["sgd"]["converged"] = converged(fit.history)
    return out
