"""capture: photographs, cameras and mesh of any source -> the normal form."""

from __future__ import annotations

import importlib

from workflow.runtime.job import Job


def run(job: Job) -> None:
    """Let the source that the scene names write its capture (`workflow/sources/<kind>.py`)."""
    source = importlib.import_module(f"workflow.sources.{job.settings.source.kind}")
    source.capture(job)
