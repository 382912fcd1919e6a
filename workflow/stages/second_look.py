"""Stage second_look: predicts and fuses once more, now that the light is known (docs/method/priors.md#a-second-look)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from iif_core.numerics.parallel import map_in_order
from workflow.artifacts.scratch import Scratch
from workflow.priors import learned, members, seed_of
from workflow.priors.pooled import member_settings
from workflow.runtime.job import Job
from workflow.scene.base_scene import SECOND_LOOK
from workflow.scene.cached_light import read_diffuse
from workflow.scene.normal_form import CaptureReader, View
from workflow.scene.predictions import Predictions, StoredPredictions
from workflow.stages.base import fuse


def run(job: Job, fuse: Callable[[Job, Predictions], None] = fuse) -> None:
    """Write second_look.json and, with prior `learned`, everything that stage base writes, from new predictions. The predictions
    themselves are not kept.

    fuse: puts predictions together and writes the files of stage base."""
    kinds = [own.kind for own in members(job.settings.prior)]
    if "learned" not in kinds or not job.settings.second_look.enabled:
        why = "second_look: {enabled: false}" if "learned" in kinds else f"prior {' and '.join(kinds)} does not use the light"
        job.writer.json(SECOND_LOOK, {"made": False, "reason": why})
        return
    capture = CaptureReader(job.read("capture"))
    with job.timed("predict"):
        predictions = _Predictions(job, capture)
    fuse(job, predictions)
    job.writer.json(SECOND_LOOK, {"made": True, "reason": "prior learned divides the photographs by their light"})


class _Predictions:
    """New predictions of every view, kept in a scratch file while the job runs; those of other priors that are pooled with them
    are those of stage prior."""

    def __init__(self, job: Job, capture: CaptureReader):
        pool = members(job.settings.prior)
        place = [one.kind for one in pool].index("learned")
        own = pool[place]
        self.samples = sum(one.samples for one in pool)
        first = sum(one.samples for one in pool[:place])
        self._new = slice(first, first + own.samples)
        self._first = StoredPredictions(job.read("prior")) if len(pool) > 1 else None
        seed = seed_of(own, job.seed)
        views = capture.used
        # A scratch file holds what the network needs of the views; it is deleted when the network ends.
        gathered = Scratch(job.writer.directory)
        settings = member_settings(job.settings, own)
        predict = learned.prepare(
            settings, capture, seed, gathered, job.threads, light=lambda view: read_diffuse(job, view).mean(0)
        )
        keep = Scratch(job.writer.directory)
        self._of: dict[int, tuple[np.ndarray, np.ndarray | None]] = {}
        predicted = map_in_order(lambda i: predict(views[i]), len(views), job.threads)
        for done, (view, made) in enumerate(zip(views, predicted, strict=True), 1):
            scale = None if made.scale is None else keep(made.scale.astype(np.float16))
            self._of[view.view_id] = keep(np.clip(made.maps, 0, 1).astype(np.float16)), scale
            job.progress(done, len(views), "views predicted")

    def has(self, view: View) -> bool:
        return view.view_id in self._of

    def maps(self, view: View, samples: int) -> np.ndarray:
        new = self._of[view.view_id][0]
        if self._first is None:
            return new[:samples]
        out = self._first.maps(view, self.samples)
        out[self._new] = new
        return out[:samples]

    def scale(self, view: View) -> np.ndarray | None:
        return self._of[view.view_id][1]
