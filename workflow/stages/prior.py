"""Stage prior: writes K material predictions of every view, from the prior that the scene names."""

from __future__ import annotations

import importlib
import logging
from collections.abc import Callable, Iterator
from types import SimpleNamespace

from iif_core.numerics.parallel import map_in_order
from workflow import plugins
from workflow.artifacts.scratch import Scratch
from workflow.artifacts.store import StageWriter
from workflow.priors import Predicted, members, predictor, seed_of
from workflow.priors.face_albedo import albedo_of_faces
from workflow.priors.usable import Row, prediction_columns, usable
from workflow.runtime.job import Job
from workflow.scene.normal_form import CaptureReader, View

Progress = Callable[[int, int, str], None]
LOG = logging.getLogger("prior")


def run(job: Job) -> None:
    """Write the predictions of all views that are not held out (`write`)."""
    write(job.writer, CaptureReader(job.read("capture")), job.settings, job.seed, job.threads, job.progress)


def write(
    writer: StageWriter,
    capture: CaptureReader,
    settings: SimpleNamespace,
    seed: int,
    threads: int = 1,
    progress: Progress = lambda *_: None,
) -> None:
    """Write maps/<view>.exr with the usable predictions of each view that is not held out, predictions.parquet, faces.parquet and
    model.json.

    Only learned models have a model.json. A job that was interrupted continues after the last finished view if settings, inputs
    and code are unchanged.

    Args:
        writer: of the stage.
        capture: the normal form.
        settings: the sections that stage prior reads.
        seed: of the scene.
        threads: that may be used.
        progress: called with views done, views in all, and what they are.

    Raises:
        InputError: no prediction can be used.
    """
    rows = predicted(writer, capture, capture.used, settings, seed, threads, progress)
    columns = prediction_columns(rows, settings.prior.kind)
    unused = len(rows) - int(columns["used"].sum())
    if unused:
        LOG.warning("%d of %d predictions are not used (see predictions.parquet)", unused, len(rows))
    writer.table("predictions.parquet", columns)
    writer.table("faces.parquet", albedo_of_faces(writer, capture, {view_id for view_id, _, used, _ in rows if used}))
    prior = importlib.import_module(plugins.implementation("prior", settings.prior.kind))
    if hasattr(prior, "describe"):
        writer.json("model.json", prior.describe(settings))


def predicted(
    writer: StageWriter,
    capture: CaptureReader,
    views: list[View],
    settings: SimpleNamespace,
    seed: int,
    threads: int,
    progress: Progress,
) -> list[Row]:
    """Write the maps of views that no earlier run has written, and return the rows of predictions.parquet of all of them;
    arguments as in `write`."""
    kept = [writer.part_kept(view.name) for view in views]
    left = [view for view, own in zip(views, kept, strict=True) if own is None]
    found: Iterator[Predicted] = iter(())
    if left:
        predict = predictor(settings, capture, seed_of(settings.prior, seed), Scratch(writer.directory), threads)
        found = map_in_order(lambda i: predict(left[i]), len(left), threads if getattr(predict, "concurrent", False) else 1)
    samples = sum(own.samples for own in members(settings.prior))
    rows: list[Row] = []
    for done, (view, own) in enumerate(zip(views, kept, strict=True)):
        progress(done, len(views), "views predicted")
        if own is not None:
            rows += map(tuple, own["rows"])
            continue
        name = f"maps/{view.name}.exr"
        channels, of_view = usable(next(found), view, samples)
        if channels:
            writer.exr(name, channels)
        writer.part_done(view.name, [name] if channels else [], {"rows": of_view})
        rows += of_view
    progress(len(views), len(views), "views predicted")
    return rows
