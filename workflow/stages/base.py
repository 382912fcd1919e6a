"""Stage base: the predictions of all views fused into one material per surface cell (docs/method/fusion.md)."""

from __future__ import annotations

from functools import partial

from iif_core.fusion.direct import solve_direct
from iif_core.fusion.options import FusionOptions
from workflow.artifacts.scratch import Scratch
from workflow.runtime.job import Job
from workflow.scene.base_files import write_base
from workflow.scene.fusion_input import read_inputs
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
    write_base(job, found, result)
