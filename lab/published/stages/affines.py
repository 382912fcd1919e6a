"""Stage affines by other solvers than ours: the published descent to the letter, and descents on the paper's loss."""

from __future__ import annotations

from functools import partial

import numpy as np

from iif_core.camera.response import Response
from iif_core.fitting.problem import FitProblem, FitResult
from iif_core.light.base_scene import BaseScene
from lab.published.fitting.descent import PublishedOptions, PublishedState, fit_published
from lab.published.fitting.sgd import SgdOptions, fit_affines_sgd
from lab.published.state import keep_state, kept_state
from workflow.fitting.fit_pixels import PixelDraw
from workflow.runtime.job import Job
from workflow.scene.decoded import DecodedViews
from workflow.stages import affines


def run(job: Job) -> None:
    """Write what stage affines writes."""
    settings = job.settings.affines
    if settings.solver == "published":
        draw = _every if settings.pixels == "all" else None
        affines.fit(job, lambda job, prior: partial(_published, job), "published", draw, merged=True)
    else:
        own = SgdOptions(settings.solver, settings.rate, settings.epochs, settings.batch, seed=job.seed, steps=settings.steps)
        affines.fit(job, lambda job, prior: partial(fit_affines_sgd, options=own), settings.solver)


def _every(job: Job, decoded: DecodedViews, scene: BaseScene, mixed: np.ndarray) -> PixelDraw:
    return every_pixel(scene.n_objects, mixed)


def every_pixel(n_objects: int, mixed: np.ndarray) -> PixelDraw:
    """Take all pixels of the objects, those along their borders too; `mixed` as in `PixelDraw`."""
    count = max(n_objects, 1)
    return PixelDraw(mixed, np.ones(count, bool), np.ones(count), 0)


def _published(job: Job, problem: FitProblem, start: Response) -> FitResult:
    """Run the published descent, from where an earlier run of the same job was killed."""
    settings = job.settings.affines
    rate = PublishedOptions.rate if settings.rate is None else settings.rate
    options = PublishedOptions(rate, epochs=settings.epochs, batch=settings.batch, seed=job.seed, steps=settings.steps)
    kept = kept_state(job.writer, "descent")
    at = kept and PublishedState(**kept[0], step=kept[1]["step"], loss=tuple(kept[1]["loss"]))

    def keep(state: PublishedState) -> None:
        facts = {"step": state.step, "loss": list(state.loss)}
        keep_state(job.writer, "descent", {"affine": state.affine, "params": state.params}, facts)

    return fit_published(problem, start, options, at, keep)
