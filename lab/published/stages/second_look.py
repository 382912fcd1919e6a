"""Stage second_look, with the fusion of `lab.published.stages.base`."""

from lab.published.stages import base
from workflow.runtime.job import Job
from workflow.stages import second_look


def run(job: Job) -> None:
    """Write what stage second_look writes."""
    second_look.run(job, base.fuse)
