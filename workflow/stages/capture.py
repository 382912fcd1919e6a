"""Stage capture: writes photographs, cameras and mesh of any source in the normal form."""

from __future__ import annotations

import importlib

from workflow import plugins
from workflow.runtime.job import Job


def run(job: Job) -> None:
    """Call the source that the scene names."""
    source = importlib.import_module(plugins.implementation("source", job.settings.source.kind))
    source.capture(job)
