"""Stage base by the paper's optimiser, on the paper's loss, or as a part of the method (docs/method/fusion.md).

In the place of the stage where `base` sets `solver: sgd`, a `variant`, `objective: distribution` or `judge`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from iif_core.fusion.options import FusionOptions
from iif_core.fusion.problem import FusionProblem, FusionResult
from lab.published.fusion.direct import describe_fit, solve_distribution
from lab.published.fusion.matching import REGULARISER
from lab.published.fusion.reference_loss import loss_of_result
from lab.published.fusion.sgd.options import preset_grid, sgd_options
from lab.published.fusion.sgd.solve import SgdFit, SgdState, converged, solve_sgd
from lab.published.fusion.variants import solve_variant
from lab.published.state import keep_state, kept_state
from workflow.artifacts.scratch import Scratch
from workflow.artifacts.store import split_rgb
from workflow.runtime.job import Job
from workflow.scene.base_files import write_base
from workflow.scene.fusion_input import read_inputs
from workflow.scene.normal_form import View
from workflow.scene.predictions import Predictions, StoredPredictions
from workflow.settings.options import options_of
from workflow.stages.base import MEMORY_BYTES

KEPT_EVERY = 30.0
"""Seconds between two states of a descent that are written; each has 335 MB with the paper's hash grid."""


def run(job: Job) -> None:
    """Write what stage base writes."""
    fuse(job, StoredPredictions(job.read("prior")))


def fuse(job: Job, prior: Predictions) -> None:
    """Fuse predictions as the settings say, and write what stage base writes."""
    settings = job.settings.base
    raw = settings.variant == "raw"
    found = read_inputs(job, prior, 1 if raw else None)
    if settings.variant == "image_affine":
        found = replace(found, problem=one_segment_per_view(found.problem))
    with job.timed("solve"):
        result, fit = _solve(job, found.problem)
    seen = {view.view_id for view in found.views}
    write_base(
        job,
        found,
        result,
        solver=settings.solver,
        variant=settings.variant,
        calibrated=settings.solver == "direct" and settings.variant == "full" and settings.objective == "least_squares",
        facts={"reference_loss": _judged(job, found.problem, result, fit)} if settings.judge else None,
        over=(lambda view, surface: _raw_maps(prior, view, surface) if view.view_id in seen else {}) if raw else None,
    )


def one_segment_per_view(problem: FusionProblem) -> FusionProblem:
    """Return the problem with one affine map per photograph instead of one per object and photograph (an ablation)."""
    segments = [
        np.where(np.asarray(segment) >= 0, view, -1).astype(np.int32) for view, segment in enumerate(problem.segment_of_pixel)
    ]
    # A whole photograph belongs to no single object, hence -1.
    return replace(problem, segment_of_pixel=segments, object_of_segment=np.full(len(segments), -1, np.int32))


def _solve(job: Job, problem: FusionProblem) -> tuple[FusionResult, SgdFit | None]:
    """Return the result, and the fit of the paper's optimiser if that solved."""
    settings = job.settings.base
    if settings.solver == "sgd":
        fit = _descended(job, problem)
        texture = fit.value, fit.scale, fit.corrections, fit.alpha
        return describe_fit(problem, *texture, fit.history, job.threads, MEMORY_BYTES), fit
    progress = partial(job.progress, what="passes over the views")
    options = options_of(FusionOptions, settings, memory=MEMORY_BYTES, spill=Scratch(job.writer.directory))
    if settings.objective == "distribution":
        return solve_distribution(problem, options, progress, job.threads, settings.polish), None
    variant = {"raw": "texel_mean", "image_affine": "full"}.get(settings.variant, settings.variant)
    return solve_variant(problem, variant, options, progress, job.threads), None


def _descended(job: Job, problem: FusionProblem) -> SgdFit:
    """Run the paper's optimiser, from where an earlier run of the same job was killed."""
    settings = job.settings.base
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
        kept = kept_state(job.writer, "descent")
        if kept is None:
            return None
        job.log.info("the descent continues from step %d", kept[1]["step"])
        return SgdState(*kept)

    def keep(state_of: Callable[[], SgdState]) -> None:
        nonlocal last
        if time.monotonic() - last >= KEPT_EVERY:
            state = state_of()
            keep_state(job.writer, "descent", state.arrays, state.facts)
            last = time.monotonic()

    return solve_sgd(problem, chosen, partial(job.progress, what="steps"), job.threads, load, keep)


def _judged(job: Job, problem: FusionProblem, result: FusionResult, fit: SgdFit | None) -> dict[str, dict[str, float]]:
    """Return the paper's loss of the result, and for `sgd` also the loss of `direct` at the same selection.

    Every pixel counts 1, as in the paper. `direct` solves with `border_weight`, which must be 1 for an exact comparison.
    """
    problem = replace(problem, weight=[(np.asarray(w) > 0).astype(np.float32) for w in problem.weight])  # the paper's pool
    judged = {job.settings.base.solver: loss_of_result(problem, result if fit is None else fit)}
    if fit is not None:
        options, polish = FusionOptions(memory=MEMORY_BYTES), job.settings.base.polish
        with job.timed("direct_at_the_same_selection"):
            twin = solve_distribution(problem, options, threads=job.threads, polish=polish, chosen=fit.alpha.argmax(1))
        judged["direct_at_the_same_selection"] = loss_of_result(problem, twin)
    out = {}
    for name, loss in judged.items():
        regulariser = REGULARISER * (loss.regulariser_albedo + loss.regulariser_roughness + loss.regulariser_metallic)
        out[name] = {"data": loss.data, "regulariser": regulariser, "total": loss.data + regulariser}
    if fit is not None:
        out["sgd"]["converged"] = converged(fit.history)
    return out


def _raw_maps(prior: Predictions, view: View, surface: np.ndarray) -> dict[str, np.ndarray]:
    """Return channels of the first usable prediction of a view, unchanged, where there is surface."""
    maps = prior.maps(view, prior.samples)
    good = np.isfinite(maps).mean((1, 2, 3)) > 0.99
    first = np.where(surface[..., None], maps[int(np.argmax(good))], 0).astype(np.float32)
    return {**split_rgb(first[..., :3], "albedo"), "roughness": first[..., 3], "metallic": first[..., 4]}
