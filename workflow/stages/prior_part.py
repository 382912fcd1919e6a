"""A part of stage prior: predictions of some of the views, made by a job of its own, perhaps on another node.

Stage prior takes over what is on disk, as it does after a kill, so its result does not depend on whether there were parts. This
module is apart from that of the stage so that fingerprints know nothing of it.
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
    predicted(job, capture, capture.used[number - 1 :: count])
