"""What several sections of the report read of a scene."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from workflow.artifacts.store import StageReader
from workflow.scene.normal_form import CaptureReader
from workflow.scene.recovered import Recovered


@dataclass(frozen=True)
class Reported:
    """What the stages of a scene wrote.

    Attributes:
        readers: stage -> its files; `base` is the texture that the fit started from.
        capture: photographs, cameras and mesh.
        recovered: geometry, fitted materials and light.
        summary: summary.json of stage metrics.
        objects: rows of objects.csv of stage export.
    """

    readers: Mapping[str, StageReader]
    capture: CaptureReader
    recovered: Recovered
    summary: Mapping[str, Any]
    objects: list[dict[str, str]]

    def document(self, stage: str) -> dict[str, Any]:
        """Return `<stage>.json` of a stage; empty if it wrote none."""
        reader, name = self.readers[stage], f"{stage}.json"
        return reader.json(name) if reader.has(name) else {}

    @property
    def prior(self) -> dict[str, Any]:
        """The settings of the prior that made the predictions; empty if its manifest has none."""
        return self.readers["prior"].manifest.get("settings", {}).get("prior", {})
