"""Stage prior: writes K material predictions of every view, from the prior that the scene names."""

from __future__ import annotations

import importlib
from collections.abc import Iterator

import numpy as np

from iif_core.errors import InputError
from iif_core.fusion.problem import prediction_faults
from iif_core.numerics.filters import fill_from_neighbours
from iif_core.numerics.parallel import map_in_order
from iif_core.reflectance.material import PROPERTIES
from workflow import plugins
from workflow.artifacts.scratch import Scratch
from workflow.artifacts.store import StageWriter, rgb, split_rgb
from workflow.priors import Predicted, members, predictor, seed_of
from workflow.runtime.job import Job
from workflow.scene.normal_form import CaptureReader, View
from workflow.segmentations.surface import FOLDS

Row = tuple[int, int, bool, str]
"""view_id, k, whether the prediction is used, reason if not (or how it was repaired)."""


def run(job: Job) -> None:
    """Write maps/<view>.exr with the usable predictions of each view that is not held out, predictions.parquet and model.json.

    Only learned models have a model.json. A job that was interrupted continues after the last finished view if settings, inputs
    and code are unchanged.

    Raises:
        InputError: no prediction can be used.
    """
    capture = CaptureReader(job.read("capture"))
    rows = predicted(job, capture, capture.used)
    _write_table(job, rows)
    job.writer.table("faces.parquet", albedo_of_faces(job.writer, capture, {view_id for view_id, _, used, _ in rows if used}))
    prior = importlib.import_module(plugins.implementation("prior", job.settings.prior.kind))
    if hasattr(prior, "describe"):
        job.writer.json("model.json", prior.describe(job.settings))


def predicted(job: Job, capture: CaptureReader, views: list[View]) -> list[Row]:
    """Write the maps of views that no earlier run has written, and return the rows of predictions.parquet of all of them."""
    kept = [job.writer.part_kept(view.name) for view in views]
    rows: list[Row] = []
    left = [view for view, own in zip(views, kept, strict=True) if own is None]
    found: Iterator[Predicted] = iter(())
    if left:
        seed = seed_of(job.settings.prior, job.seed)
        predict = predictor(job.settings, capture, seed, Scratch(job.writer.directory), job.threads)
        threads = job.threads if getattr(predict, "concurrent", False) else 1
        found = map_in_order(lambda i: predict(left[i]), len(left), threads)
    for done, (view, own) in enumerate(zip(views, kept, strict=True)):
        job.progress(done, len(views), "views predicted")
        rows += _written(job, next(found), view) if own is None else map(tuple, own["rows"])
    job.progress(len(views), len(views), "views predicted")
    return rows


def _written(job: Job, found: Predicted, view: View) -> list[Row]:
    """Write the maps of a view, and return its rows of predictions.parquet."""
    maps, expected = found.maps, (sum(own.samples for own in members(job.settings.prior)), view.height, view.width, 5)
    if maps.shape != expected:
        raise InputError(f"view {view.name}: the prior made {maps.shape}, needed {expected}; please report it")
    rows: list[Row] = []
    channels: dict[str, np.ndarray] = {}
    for k, fault in enumerate(prediction_faults(maps)):
        note = ""
        if not fault:
            filled, count = fill_from_neighbours(maps[k])
            channels |= _channels(k, filled)
            note = f"{count} pixels without a finite value, filled from their neighbours" if count else ""
        rows.append((view.view_id, k, not fault, fault or note))
    name = f"maps/{view.name}.exr"
    if channels and found.scale is not None:
        channels |= {f"scale.{of}": found.scale[..., i].astype(np.float16) for i, of in enumerate(PROPERTIES)}
    if channels:
        job.writer.exr(name, channels)
    job.writer.part_done(view.name, [name] if channels else [], {"rows": rows})
    return rows


def _write_table(job: Job, rows: list[Row]) -> None:
    columns = [list(column) for column in zip(*rows, strict=True)] if rows else [[], [], [], []]
    view_id, k, used, reason = columns
    if not any(used):
        why = f"; the first: {reason[0]}" if reason else ": no view is left to predict"
        raise InputError(f"prior {job.settings.prior.kind}: none of {len(used)} predictions can be used{why}")
    if not all(used):
        job.log.warning("%d of %d predictions are not used (see predictions.parquet)", len(used) - sum(used), len(used))
    job.writer.table(
        "predictions.parquet",
        {
            "view_id": np.array(view_id, np.int32),
            "k": np.array(k, np.int32),
            "used": np.array(used, bool),
            "reason": np.array(reason, object),
        },
    )


def albedo_of_faces(writer: StageWriter, capture: CaptureReader, predicted_views: set[int]) -> dict[str, np.ndarray]:
    """Return the columns of faces.parquet: the albedo that the written predictions have on each face, for each of the FOLDS of
    views by itself."""
    count = len(capture.faces()["face_id"])
    pixels, total = np.zeros((FOLDS, count), np.int64), np.zeros((FOLDS, count, 3))
    for i, view in enumerate(capture.used):
        if view.view_id not in predicted_views:
            continue
        channels = writer.channels(f"maps/{view.name}.exr")
        layers = sorted(key.removesuffix(".albedo.R") for key in channels if key.endswith(".albedo.R"))
        albedo = np.mean([rgb(channels, f"{layer}.albedo") for layer in layers], 0, np.float32)
        face, shown = capture.gbuffer(view)[1], capture.photo(view)[1]
        use = (face >= 0) & shown
        pixels[i % FOLDS] += np.bincount(face[use], minlength=count)
        for c in range(3):
            total[i % FOLDS, :, c] += np.bincount(face[use], albedo[use][:, c], count)
    fold, seen = np.nonzero(pixels)
    mean = total[fold, seen] / pixels[fold, seen, None]
    columns = {"face_id": seen.astype(np.int32), "fold": fold.astype(np.int32), "pixels": pixels[fold, seen]}
    columns |= {f"albedo_{name}": mean[:, c].astype(np.float32) for c, name in enumerate("rgb")}
    return columns


def _channels(k: int, maps: np.ndarray) -> dict[str, np.ndarray]:
    layer = f"prior.{k:03d}"
    return {
        **split_rgb(maps[..., :3], f"{layer}.albedo", np.float16),
        f"{layer}.roughness": maps[..., 3].astype(np.float16),
        f"{layer}.metallic": maps[..., 4].astype(np.float16),
    }
