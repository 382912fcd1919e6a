"""prior: K material predictions of every view, from whichever prior the scene names."""

from __future__ import annotations

import importlib

import numpy as np

from iif_core.base.problem import prediction_faults
from iif_core.errors import InputError
from workflow.artifacts.store import split_rgb
from workflow.job import Job
from workflow.normal_form import CaptureReader


def run(job: Job) -> None:
    """Write maps/<view>.exr with the usable predictions of each view (but test views), and predictions.parquet.

    Raises:
        InputError: not a single prediction can be used.
    """
    capture = CaptureReader(job.read("capture"))
    prior = importlib.import_module(f"workflow.priors.{job.settings.prior.kind}")
    views = capture.used
    seed = job.seed if job.settings.prior.seed is None else job.settings.prior.seed
    rows: list[tuple[int, int, bool, str]] = []
    for done, view in enumerate(views):
        job.progress(done, len(views), "views predicted")
        maps = prior.predict(view, job.settings, capture, seed)
        expected = (job.settings.prior.samples, view.height, view.width, 5)
        if maps.shape != expected:
            raise InputError(f"view {view.name}: the prior made {maps.shape}, needed {expected}; please report it")
        channels: dict[str, np.ndarray] = {}
        for k, fault in enumerate(prediction_faults(maps)):
            if not fault:
                filled, count = fill_from_neighbours(maps[k])
                channels |= _channels(k, filled)
                note = f"{count} pixels without a finite value, filled from their neighbours" if count else ""
            rows.append((view.view_id, k, not fault, fault or note))
        if channels:
            job.writer.exr(f"maps/{view.name}.exr", channels)
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
    job.progress(len(views), len(views), "views predicted")


def fill_from_neighbours(maps: np.ndarray) -> tuple[np.ndarray, int]:
    """(H, W, 5) with every pixel that is not finite replaced by the nearest one that is, and how many there were."""
    from scipy.ndimage import distance_transform_edt

    lost = ~np.isfinite(maps).all(-1)
    if not lost.any():
        return maps, 0
    rows, columns = distance_transform_edt(lost, return_distances=False, return_indices=True)
    return maps[rows, columns], int(lost.sum())


def _channels(k: int, maps: np.ndarray) -> dict[str, np.ndarray]:
    layer = f"prior.{k:03d}"
    return {
        **split_rgb(maps[..., :3], f"{layer}.albedo", np.float16),
        f"{layer}.roughness": maps[..., 3].astype(np.float16),
        f"{layer}.metallic": maps[..., 4].astype(np.float16),
    }
