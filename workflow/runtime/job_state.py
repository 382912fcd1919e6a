"""How the last run of a job ended, kept beside its log, so that the end of a run and the summary of a batch can give the reason.

`results/<scene>/logs/<stage>.state.json` exists from the start of a job until it ends well. The file of a job that was killed
says `started`; that of a job that failed says `failed` and why.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from workflow.artifacts.files import write_json


class JobState:
    """Records the state of one job.

    Args:
        owner: folder of results/ that the job belongs to: a scene, or `studies` or `weights`.
        name: stage of the scene, or name of the study.
        fingerprint: what the job was planned as; None when it is run by hand.
    """

    def __init__(self, owner: str, name: str, fingerprint: str | None = None):
        self.path, self.fingerprint = state_file(owner, name), fingerprint or ""

    def started(self) -> None:
        self._write("started", "")

    def failed(self, reason: str) -> None:
        self._write("failed", reason)

    def done(self) -> None:
        self.path.unlink(missing_ok=True)

    def _write(self, state: str, reason: str) -> None:
        write_json(self.path, {"state": state, "reason": reason, "fingerprint": self.fingerprint})


def state_file(owner: str, name: str, root: Path = Path(".")) -> Path:
    """Return where the state of a job is kept."""
    return root / "results" / owner / "logs" / f"{name}.state.json"


def read_state(scene: str, stage: str, fingerprint: str, root: Path = Path(".")) -> dict[str, Any]:
    """Return how a job ended.

    Args:
        scene, stage: which job.
        fingerprint: what the job would be planned as now.
        root: the working folder.

    Returns:
        `state` and `reason` of a job that did not end well; empty if it did, or if it ran under another fingerprint.
    """
    document = _read(state_file(scene, stage, root))
    return document if document.get("fingerprint") == fingerprint else {}


def reasons(since: float, root: Path = Path(".")) -> list[str]:
    """Return one message for every job that failed or was killed after `since` (seconds, as `time.time`), oldest first."""
    found = []
    for path in (root / "results").glob("*/logs/*.state.json"):
        try:
            changed = path.stat().st_mtime
        except OSError:  # its job has just ended well
            continue
        document = _read(path)
        if changed < since or not document:
            continue
        owner, name = path.parents[1].name, path.name.removesuffix(".state.json")
        log = path.with_name(f"{name}.log")
        reason = document.get("reason") or "it was killed (out of memory, or over its time limit?)"
        found.append((changed, f"error: {owner}: {name} failed ({log}): {reason}"))
    return [message for _, message in sorted(found)]


def _read(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    return document if isinstance(document, dict) else {}
