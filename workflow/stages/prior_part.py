"""A part of stage prior: a separate job, perhaps on another node, makes the predictions of some of the views.

Stage prior takes over what is on disk, as it does after a kill, so its result does not depend on whether there were parts. The
module of the stage does not import this one, so fingerprints do not depend on it.
"""

from __future__ import annotations

from workflow.runtime.job import Job
from workflow.scene.normal_form import CaptureReader
from workflow.stages.prior import predicted


def run(job: Job, number: int, count: int) -> None:
    """Write maps/<view>.exr of the views of one part that are not there yet, and a note for each that it is finished.

    Args:
        job: of stage prior; its folder is left unfinished.
        number: of the part, from 1.
        count: of parts. Views are dealt out in turn, so that parts differ by one view at most.
    """
    capture = CaptureReader(job.read("capture"))
    views = capture.used[number - 1 :: count]
    predicted(job.writer, capture, views, job.settings, job.seed, job.threads, job.progress)
