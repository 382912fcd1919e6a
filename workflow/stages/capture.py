"""Stage capture: writes photographs, cameras and mesh of any source in the normal form."""

from __future__ import annotations

import importlib

from workflow.runtime.job import Job


def run(job: Job) -> None:
    """Call the source that the scene names, `workflow/sources/<kind>.py`."""
    source = importlib.import_module(f"workflow.sources.{job.settings.source.kind}")
    source.capture(job)
