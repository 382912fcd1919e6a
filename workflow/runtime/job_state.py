"""How the last run of a job ended, kept beside its log, so that the end of a run and the summary of a batch can give the reason.

`results/<scene>/logs/<stage>.state.json` exists from the start of a job until it ends well. The file of a job that was killed
says `started`; that of a job that failed says `failed` and why. `since` is when it came into that state, `host` and `pid` say
where it runs; with these and the time stamp of the file, which a running job renews, a running job is told from a killed one.
"""

from __future__ import annotations

import json
import os
import threading
import time
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from workflow.artifacts.files import write_json
from workflow.runtime import alive, events


class JobState:
    """Records the state of one job.

    Args:
        owner: folder of results/ that the job belongs to: a scene, or `studies` or `weights`.
        name: stage of the scene, or name of the study.
        fingerprint: what the job was planned as; None when it is run by hand.
    """

    def __init__(self, owner: str, name: str, fingerprint: str | None = None):
        self.path, self.fingerprint = state_file(owner, name), fingerprint or ""
        self._job = (owner, name, self.fingerprint)
        self._begun, self._ended = time.monotonic(), threading.Event()

    def started(self) -> None:
        self._begun = time.monotonic()
        self._write("started", "")
        threading.Thread(target=self._beat, daemon=True).start()
        events.tell("started", *self._job)

    def failed(self, reason: str) -> None:
        self._ended.set()
        events.tell("failed", *self._job, seconds=self._seconds(), reason=reason, **events.taken())
        self._write("failed", reason)

    def done(self) -> None:
        self._ended.set()
        self.path.unlink(missing_ok=True)
        events.tell("finished", *self._job, seconds=self._seconds(), **events.taken())

    def _seconds(self) -> float:
        return round(time.monotonic() - self._begun, 3)

    def _beat(self) -> None:
        """Renew the time stamp of the file as long as the job runs, for those who cannot ask for its process."""
        path = self.path.absolute()
        while not self._ended.wait(alive.BEAT):
            with suppress(OSError):
                os.utime(path)

    def _write(self, state: str, reason: str) -> None:
        since = datetime.now(UTC).isoformat(timespec="seconds")
        facts = {"since": since, **alive.identity()}
        write_json(self.path, {"state": state, "reason": reason, "fingerprint": self.fingerprint, **facts})


def state_file(owner: str, name: str, root: Path = Path(".")) -> Path:
    """Return where the state of a job is kept."""
    return root / "results" / owner / "logs" / f"{name}.state.json"


class Noted(NamedTuple):
    """The state of a job that has not ended well.

    Attributes:
        state: `running`, `failed` or `killed`.
        since: when it came into this state, in seconds as `time.time`.
        document: what the file says.
    """

    state: str
    since: float
    document: dict[str, Any]


def noted(path: Path, now: float) -> Noted | None:
    """Return what a state file says; None if there is none, or nothing that can be read. Never raises, whatever it holds."""
    try:
        touched = os.stat(path).st_mtime
    except OSError:  # its job has just ended well
        return None
    document = _read(path)
    state = document.get("state")
    if state not in ("started", "failed"):
        return None
    if state == "started":
        state = "running" if alive.runs(document, touched, now) else "killed"
    return Noted(state, _moment(document.get("since"), touched), document)


def _moment(text: Any, otherwise: float) -> float:
    try:
        return datetime.fromisoformat(text).timestamp()
    except (TypeError, ValueError, OverflowError, OSError):
        return otherwise


def reasons(since: float, root: Path = Path(".")) -> list[str]:
    """Return one message for every job that failed or was killed after `since` (seconds, as `time.time`), oldest first."""
    found = []
    for path in (root / "results").glob("*/logs/*.state.json"):
        try:
            changed = path.stat().st_mtime
        except OSError:  # its job has just ended well
            continue
        document = _read(path)
        if document.get("state") == "started":
            if alive.lives(document):
                continue  # of another run
            changed = _moment(document.get("since"), changed)  # it was touched since
        if changed < int(since) or not document:
            continue
        owner, name = path.parents[1].name, path.name.removesuffix(".state.json")
        log = path.with_name(f"{name}.log")
        reason = document.get("reason") or "it was killed (out of memory, or over its time limit?)"
        found.append((changed, f"error: {owner}: {name} failed ({log}): {reason}"))
    return [message for _, message in sorted(found)]


def _read(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_text())
    except (OSError, ValueError, RecursionError):
        return {}
    return document if isinstance(document, dict) else {}
