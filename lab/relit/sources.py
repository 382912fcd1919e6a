"""Sources whose room is known, under new light: the truth of scored relighting."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from iif_core.errors import InputError
from workflow import plugins

if TYPE_CHECKING:
    from lab.relit.new_light import NewLight
    from workflow.runtime.job import Job
    from workflow.scene.normal_form import CaptureReader, View

KINDS = ("builtin", "mitsuba")
"""Kinds of sources that can be rendered under new light."""


class Room(Protocol):
    """The room of a source."""

    def relit(self, light: NewLight, view: View, samples: int, max_bounces: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
        """Render a view under new light: radiance (H, W, 3), and which pixels have one (H, W)."""
        ...


def _refuse_others(kind: str) -> None:
    if kind not in KINDS:
        raise InputError(
            f"`source.kind: {kind}`: its room cannot be rendered under new light, because its lamps and surfaces are not given;"
            f" scored relighting needs a source of kind {' or '.join(KINDS)}"
        )


def raw_inputs(document: dict[str, Any]) -> list[Path]:
    """Return the files of the source.

    Raises:
        InputError: the source has no room that can be rendered, or a file is missing.
    """
    kind = document["source"]["kind"]
    _refuse_others(kind)
    return importlib.import_module(plugins.implementation("source", kind)).raw_inputs(document)


def open_room(job: Job, capture: CaptureReader) -> Room:
    """Read the room of the source of a job; Dr.Jit is started."""
    from workflow.runtime import device, native

    kind = job.settings.source.kind
    _refuse_others(kind)
    native.prepare()
    device.mitsuba()
    native.limit_threads(job.threads)
    if kind == "builtin":
        from lab.relit import rooms

        return rooms.room(job, capture)
    from lab.relit import mitsuba_scene

    return mitsuba_scene.room(job, capture)
