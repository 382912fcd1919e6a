"""How the last run of a job ended, kept beside its log, so that a batch can say why a scene is not there.

`results/<scene>/logs/<stage>.state.json` is there from the start of a job to its good end: what is left of one that was killed
says `started`, of one that failed `failed` and the reason.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from workflow.artifacts.files import write_json


class Outcome:
    """Keeps the state of one job. `fingerprint`: what the job was planned as ("" when run by hand)."""

    def __init__(self, scene: str, stage: str, fingerprint: str | None):
        self.path, self.fingerprint = state_file(scene, stage), fingerprint or ""

    def started(self) -> None:
        self._write("started", "")

    def failed(self, reason: str) -> None:
        self._write("failed", reason)

    def done(self) -> None:
        self.path.unlink(missing_ok=True)

    def _write(self, state: str, reason: str) -> None:
        write_json(self.path, {"state": state, "reason": reason, "fingerprint": self.fingerprint})


def state_file(scene: str, stage: str, root: Path = Path(".")) -> Path:
    """Where the state of a job is kept."""
    return root / "results" / scene / "logs" / f"{stage}.state.json"


def read_state(scene: str, stage: str, fingerprint: str, root: Path = Path(".")) -> dict[str, Any]:
    """`state` and `reason` of a job that did not end well; empty if it did, or if it ran as something else than `fingerprint`."""
    try:
        document = json.loads(state_file(scene, stage, root).read_text())
    except (OSError, ValueError):
        return {}
    same = isinstance(document, dict) and document.get("fingerprint") == fingerprint
    return document if same else {}
