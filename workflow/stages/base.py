"""Stage base: the predictions of all views fused into one material per surface cell (docs/method/fusion.md)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from iif_core.fusion.direct import solve_direct
from iif_core.fusion.gauge import parts_per_object
from iif_core.fusion.options import CellOptions, FusionOptions
from iif_core.fusion.problem import FusionProblem, FusionResult, with_every_object
from iif_core.surface.cell_grid import CellGrid, CellValues
from iif_core.surface.cells import neighbour_pairs
from workflow.artifacts.scratch import Scratch
from workflow.artifacts.store import ids_from_disk
from workflow.decisions import numerics
from workflow.runtime.job import Job
from workflow.scene.base_files import maps_of_view, write_cells, write_segments
from workflow.scene.decoded import DecodedViews
from workflow.scene.fusion_input import cells_of_views, points_of_views, tangents_of_views, weights_and_segments
from workflow.scene.normal_form import CaptureReader, View
from workflow.scene.predictions import Predictions, StoredPredictions
from workflow.settings.options import options_of

MEMORY_BYTES = 1 << 30
"""Predictions that stay in memory between sweeps; those of further views are mapped from a file without a name."""


def run(job: Job) -> None:
    """Write cells, object means, segments, selection, maps of every view and base.json."""
    fuse(job, StoredPredictions(job.read("prior")))


def fuse(job: Job, prior: Predictions) -> None:
    """Fuse predictions, and write what stage base writes; the job has the settings `base` and `seed`, and capture and
    segmentation upstream."""
    found = read_inputs(job, prior)
    options = options_of(FusionOptions, job.settings.base, memory=MEMORY_BYTES, spill=Scratch(job.writer.directory))
    with job.timed("solve"):
        result = solve_direct(found.problem, options, partial(job.progress, what="passes over the views"), job.threads)
    write(job, found, result)


@dataclass(frozen=True)
class Inputs:
    """What is fused: the problem, and what its numbers stand for.

    Attributes:
        problem: predictions on cells; used: predictions of each view.
        decoded: photographs and what belongs to them; views: those with predictions.
        grid: of the cells; segment_id: (S,) of the segments of the problem; n_objects: of the scene.
    """

    problem: FusionProblem
    used: int
    decoded: DecodedViews
    views: list[View]
    grid: CellGrid
    segment_id: np.ndarray
    n_objects: int


def read_inputs(job: Job, prior: Predictions, most: int | None = None) -> Inputs:
    """Put predictions on cells; at most the first `most` of each view, None = as many as the settings say."""
    capture = CaptureReader(job.read("capture"))
    segmentation, options = job.read("segmentation"), options_of(CellOptions, job.settings.base)
    views = [view for view in capture.used if prior.has(view)]
    decoded = DecodedViews(capture, segmentation)
    grid, cell_maps = cells_of_views(job, options, decoded, views)
    weights, segment_maps = weights_and_segments(options, decoded, views)
    segments = segmentation.table("segments.parquet")
    n_objects = int(segmentation.table("objects.parquet")["object_id"].max(initial=-1)) + 1
    used = min(prior.samples, most or options.predictions or prior.samples)
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
        neighbours=neighbour_pairs(grid.keys) if options_of(FusionOptions, job.settings.base).seams else None,
        scale=lambda position: prior.scale(views[position]),
    )
    return Inputs(problem, used, decoded, views, grid, segments["segment_id"], n_objects)


def write(
    job: Job,
    found: Inputs,
    result: FusionResult,
    *,
    solver: str = "direct",
    variant: str = "full",
    calibrated: bool = True,
    facts: Mapping[str, Any] | None = None,
    over: Callable[[View, np.ndarray], dict[str, np.ndarray]] | None = None,
) -> None:
    """Write the artefacts of stage base.

    Args:
        job: the job; found: what was fused; result: of it.
        solver, variant: how; calibrated: whether `uncertainty_*` are errors, or only rank cells.
        facts: further ones for base.json.
        over: channels of a view, from the pixels (H, W) bool that show a cell, that replace those of the cells.
    """
    result = with_every_object(result, found.n_objects)
    for dropped in result.dropped:
        if dropped.k < 0:
            job.log.warning("view %s: %s", found.views[dropped.view].name, dropped.reason)
    write_cells(job, found.grid, found.n_objects, result)
    write_segments(job, result, found.segment_id, found.problem.object_of_segment)
    every = np.concatenate([result.value, result.scale, result.uncertainty], 1)
    unseen = np.quantile(every[:, 5:], 0.9, axis=0)  # scale and uncertainty of surface that no prediction shows
    values, views = CellValues(found.grid, every), found.decoded.capture.views
    for done, view in enumerate(views):
        maps = maps_of_view(found.decoded, values, unseen, result, view)
        if over is not None:
            maps |= over(view, ids_from_disk(maps["cell.id"]) >= 0)
        job.writer.exr(f"maps/{view.name}.exr", maps)
        job.progress(done + 1, len(views), "maps")
    grid, problem = found.grid, found.problem
    job.writer.json(
        "base.json",
        {
            "cell_edge_m": grid.edge,
            "origin": [float(x) for x in grid.origin],
            "cells": len(grid),
            "predictions": found.used,
            "solver": solver,
            "variant": variant,
            "sweeps": len(result.history),
            "history": [{name: round(float(value), 8) for name, value in entry.items()} for entry in result.history],
            "objects_in_separate_parts": {
                str(name): count for name, count in parts_per_object(grid.object_id, result.part_of_cell).items()
            },
            "filled_share": float((result.coverage == 0).mean()),
            "seen_once_share": float((result.views == 1).mean()),
            "uncertainty_calibrated": calibrated,
            "numerics": numerics.of_base(result, found.used * len(problem.cell_of_pixel)),
            **(facts or {}),
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
