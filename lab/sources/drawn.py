"""Source `drawn`: a room of the generator of training rooms, photographed as source `builtin` does (lab/docs/drawn.md)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from workflow.runtime.job import Job


def raw_inputs(document: dict[str, Any]) -> list[Path]:
    """Return no files: the room is made, not read."""
    return []


def capture(job: Job) -> None:
    """Draw the room, photograph it, and write the normal form with ground truth."""
    from lab.prior import drawn
    from lab.sources.builtin import photograph_room

    photograph_room(job, drawn.build(job.settings.source.room))
