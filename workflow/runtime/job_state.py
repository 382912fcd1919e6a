"""How the last run of a job ended. The file lies next to the log of the job; the next attempt, the end of a run and the summary
of a batch read the reason from it.

`results/<scene>/logs/<stage>.state.json` exists from the start of a job until it ends well. It says `started` for a job that was
killed, and `failed` and why for a job that failed. `since` is when the job came into that state; `host` and `pid` say where it
runs. These and the time stamp of the file, which a running job renews, distinguish a running job from a killed one. The file also
holds the facts of the attempts (`attempts.py`) and the memory that the process had when it was last seen (`peak_mb`). A job that
needed several attempts leaves `<stage>.attempts.json` also when it ends well.
"""

from __future__ import annotations

import json
import logging
import os
import resource
import threading
import time
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from workflow.artifacts.files import read_record, write_json
from workflow.runtime import alive, attempts, events

LOOK = 5.0
"""Seconds between two looks at the memory of a job."""
GROWTH = 1.1
"""Factor by which its memory must have grown to be noted again."""


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
        self._facts: dict[str, Any] = {}
        self._begun, self._since = time.monotonic(), ""
        self._lock, self._ended = threading.Lock(), threading.Event()

    def started(self) -> None:
        """Note that the job runs. If an earlier attempt did not end well, log how that ended, and what this one asks for."""
        self._begun = time.monotonic()
        if self.fingerprint:
            self._facts = attempts.facts_of(_read(self.path), self.fingerprint, os.environ.get(attempts.RUN, ""))
            self._tell()
        self._write("started", "")
        threading.Thread(target=self._watch, name="watch", daemon=True).start()
        events.tell("started", *self._job, attempt=self._attempt())

    def failed(self, reason: str) -> None:
        self._ended.set()
        events.tell("failed", *self._job, seconds=self._seconds(), reason=reason, attempt=self._attempt(), **events.taken())
        self._write("failed", reason)

    def done(self) -> None:
        self._ended.set()
        with self._lock:
            self.path.unlink(missing_ok=True)
        events.tell("finished", *self._job, seconds=self._seconds(), attempt=self._attempt(), **events.taken())

    def _attempt(self) -> int | None:
        return self._facts.get("attempt")

    def _seconds(self) -> float:
        return round(time.monotonic() - self._begun, 3)

    def _write(self, state: str, reason: str) -> None:
        self._since = datetime.now(UTC).isoformat(timespec="seconds")
        with self._lock:
            self._write_facts(self.path, state, reason)

    def _write_facts(self, path: Path, state: str, reason: str, settled: bool = True) -> None:
        named = {"since": self._since, **alive.identity()}
        document = {"state": state, "reason": reason, "fingerprint": self.fingerprint, **named, **self._facts}
        write_json(path, document, settled=settled)

    def _tell(self) -> None:
        """Say what is known of earlier attempts: in the log, and in a file for the end of the run."""
        kept, line = _attempts_file(self.path), attempts.told(self._facts)
        if line:
            write_json(kept, {"told": line}, settled=False)
            logging.getLogger("attempts").warning("%s", line)
        else:
            kept.unlink(missing_ok=True)

    def _watch(self) -> None:
        """As long as the job runs, note the largest memory of this process whenever it has grown, for the case that it is killed
        without a word, and renew the time stamp of the file, for those who cannot ask for its process."""
        noted, renewed, path = 0.0, time.monotonic(), self.path.absolute()
        while not self._ended.wait(LOOK):
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024  # Linux counts in kB
            grown = peak >= noted * GROWTH
            if not grown and time.monotonic() < renewed + alive.BEAT:
                continue
            renewed = time.monotonic()
            with self._lock, suppress(OSError):  # the stage will report a full disk
                if self._ended.is_set() or not path.exists():  # it is removed with its results
                    continue
                if grown:
                    noted = peak
                    self._facts["peak_mb"] = round(peak)
                    self._write_facts(path, "started", "", settled=False)
                else:
                    os.utime(path)


def state_file(owner: str, name: str, root: Path = Path(".")) -> Path:
    """Return where the state of a job is kept."""
    return root / "results" / owner / "logs" / f"{name}.state.json"


def _attempts_file(state: Path) -> Path:
    return state.with_name(state.name.removesuffix(".state.json") + ".attempts.json")


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

    def is_of(self, fingerprint: str) -> bool:
        """Return whether the job was planned as `fingerprint`, or run by hand: then its last run counts, whatever it was."""
        return self.document.get("fingerprint") in ("", fingerprint)


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
    since = attempts.moment(document.get("since"))
    return Noted(state, touched if since is None else since, document)


def reasons(since: float, root: Path = Path(".")) -> list[str]:
    """Return one message for every job that failed or was killed after `since` (seconds, as `time.time`), oldest first."""
    found = []
    for path in (root / "results").glob("*/logs/*.state.json"):
        new = _read_new(path)
        if new is None:
            continue
        changed, document = new
        if document.get("state") == "started":
            if alive.lives(document):
                continue  # of another run
            changed = attempts.moment(document.get("since")) or changed  # it was touched since
        if changed < int(since):
            continue
        owner, name = path.parents[1].name, path.name.removesuffix(".state.json")
        log = path.with_name(f"{name}.log")
        reason = document.get("reason") or attempts.killed(document)
        found.append((changed, f"error: {owner}: {name} failed ({log}): {reason}"))
    return [attempts.written_out(message) for _, message in sorted(found)]


def retold(since: float, root: Path = Path(".")) -> list[str]:
    """Return one line for every job that needed several attempts and was started again after `since`, oldest first."""
    found = []
    for path in (root / "results").glob("*/logs/*.attempts.json"):
        new = _read_new(path)
        if new and new[0] >= since and new[1].get("told"):
            found.append((new[0], f"{path.parents[1].name}: {path.name.removesuffix('.attempts.json')}: {new[1]['told']}"))
    return [attempts.written_out(line) for _, line in sorted(found)]


def _read_new(path: Path) -> tuple[float, dict[str, Any]] | None:
    """Return the time of change and the content of a file; None if there is nothing in it."""
    try:
        changed = path.stat().st_mtime
    except OSError:  # its job has just ended well
        return None
    document = _read(path)
    return (changed, document) if document else None


def _read(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(read_record(path))
    except (OSError, ValueError, RecursionError):
        return {}
    return attempts.sound(document) if isinstance(document, dict) else {}
