"""Stage second_look: predicts and fuses once more, now that the light is known (docs/method/priors.md#a-second-look)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from iif_core.numerics.filters import fill_from_neighbours
from iif_core.numerics.parallel import map_in_order
from workflow.artifacts.scratch import Scratch
from workflow.priors import learned
from workflow.runtime.job import Job
from workflow.scene.base_scene import SECOND_LOOK
from workflow.scene.cached_light import read_diffuse
from workflow.scene.normal_form import CaptureReader, View
from workflow.settings.prior import looks_again
from workflow.stages.base import fuse


def run(job: Job) -> None:
    """Write second_look.json and, where the prior predicts better under a known light, everything that stage base writes, from
    new predictions. These are not kept: stage prior has the first ones, and a second look takes seconds."""
    kind = job.settings.prior.kind
    if not job.settings.second_look.enabled or not looks_again(kind):
        why = f"prior {kind} does not use the light" if job.settings.second_look.enabled else "second_look: {enabled: false}"
        job.writer.json(SECOND_LOOK, {"made": False, "reason": why})
        return
    capture = CaptureReader(job.read("capture"))
    with job.timed("predict"):
        predictions = _Predictions(job, capture)
    fuse(job, predictions)
    job.writer.json(SECOND_LOOK, {"made": True, "reason": f"prior {kind} divides the photographs by their light"})


class _Predictions:
    """New predictions of every view, in a file without a name while the job runs."""

    def __init__(self, job: Job, capture: CaptureReader):
        self.samples = job.settings.prior.samples
        keep = Scratch(job.writer.directory)
        seed = job.seed if job.settings.prior.seed is None else job.settings.prior.seed
        views = capture.used
        predict = learned.prepare(
            job.settings, capture, seed, keep, job.threads, light=lambda view: read_diffuse(job, view).mean(0)
        )
        self._of: dict[int, tuple[np.ndarray, np.ndarray | None]] = {}
        found: Iterator = map_in_order(lambda i: predict(views[i]), len(views), job.threads)
        for done, (view, made) in enumerate(zip(views, found, strict=True)):
            job.progress(done, len(views), "views predicted")
            maps = np.stack([fill_from_neighbours(one)[0] for one in made.maps])
            scale = None if made.scale is None else keep(made.scale.astype(np.float16))
            self._of[view.view_id] = keep(np.clip(maps, 0, 1).astype(np.float16)), scale
        job.progress(len(views), len(views), "views predicted")

    def has(self, view: View) -> bool:
        return view.view_id in self._of

    def maps(self, view: View, samples: int) -> np.ndarray:
        return self._of[view.view_id][0][:samples]

    def scale(self, view: View) -> np.ndarray | None:
        return self._of[view.view_id][1]
