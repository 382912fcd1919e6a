"""How the last run of a job ended, kept beside its log, so that the next attempt, the end of a run and the summary of a batch can
give the reason.

`results/<scene>/logs/<stage>.state.json` exists from the start of a job until it ends well. The file of a job that was killed
says `started`; that of a job that failed says `failed` and why. With them stand the number of the attempt, the Slurm job and what
it asked for, the memory that the process had when it was last seen, and how the attempts before ended. A job that needed several
attempts leaves `<stage>.attempts.json` also when it ends well. `since` is when it came into that state, `host` and `pid` say
where it runs; with these and the time stamp of the file, which a running job renews, a running job is told from a killed one.
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

from workflow.artifacts.files import write_json
from workflow.runtime import alive, events, slurm

LOOK = 5.0
"""Seconds between two looks at the memory of a job; it is a part of `alive.BEAT`."""
GROWTH = 1.1
"""Factor by which its memory must have grown to be noted again."""
REMEMBERED = 3
"""Earlier attempts that are told of."""
GUESS = "out of memory, or over its time limit?"


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
        self._begun = time.monotonic()
        self._lock, self._ended = threading.Lock(), threading.Event()

    def started(self) -> None:
        """Note that the job runs. If an earlier attempt did not end well, log how that ended, and what this one asks for."""
        self._begun = time.monotonic()
        if self.fingerprint:
            self._facts = _facts(_read(self.path), self.fingerprint)
            self._tell()
        self._write("started", "")
        threading.Thread(target=self._watch, name="watch", daemon=True).start()
        events.tell("started", *self._job)

    def failed(self, reason: str) -> None:
        self._ended.set()
        events.tell("failed", *self._job, seconds=self._seconds(), reason=reason, **events.taken())
        self._write("failed", reason)

    def done(self) -> None:
        self._ended.set()
        with self._lock:
            self.path.unlink(missing_ok=True)
        events.tell("finished", *self._job, seconds=self._seconds(), **events.taken())

    def _seconds(self) -> float:
        return round(time.monotonic() - self._begun, 3)

    def _write(self, state: str, reason: str) -> None:
        with self._lock:
            since = datetime.now(UTC).isoformat(timespec="seconds")
            self._facts |= {"since": since, **alive.identity()}
            write_json(self.path, {"state": state, "reason": reason, "fingerprint": self.fingerprint, **self._facts})

    def _tell(self) -> None:
        """Say what is known of earlier attempts: in the log, and in a file for the end of the run."""
        kept = _attempts_file(self.path)
        earlier = self._facts.get("earlier")
        if not earlier:
            kept.unlink(missing_ok=True)
            return
        asks = _asks(self._facts.get("slurm", {}))
        line = f"attempt {self._facts['attempt']}{f', which asks for {asks}' if asks else ''}: {'; '.join(earlier)}"
        write_json(kept, {"told": line}, settled=False)
        logging.getLogger("attempts").warning("%s", line)

    def _watch(self) -> None:
        """As long as the job runs, renew the time stamp of the file, for those who cannot ask for its process, and note the
        largest memory of this process whenever it has grown, for the case that it is killed without a word."""
        path = self.path.absolute()
        noted, touched = 0.0, time.monotonic()
        while not self._ended.wait(min(LOOK, alive.BEAT)):
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024  # Linux counts in kB
            grown = bool(self.fingerprint) and peak >= noted * GROWTH
            if not grown and time.monotonic() - touched < alive.BEAT:
                continue
            touched = time.monotonic()
            with self._lock, suppress(OSError):  # a full disk will be told of by the stage
                if self._ended.is_set() or not path.exists():  # removed with its results
                    return
                if not grown:
                    os.utime(path)
                    continue
                noted = peak
                self._facts["peak_mb"] = round(peak)
                document = {"state": "started", "reason": "", "fingerprint": self.fingerprint, **self._facts}
                write_json(path, document, settled=False)


def _facts(before: dict[str, Any], fingerprint: str) -> dict[str, Any]:
    """Return what is noted of an attempt: its number, its Slurm job, how those before it ended."""
    own = slurm.own()
    facts: dict[str, Any] = {"attempt": 1}
    if own:
        facts["slurm"] = own._asdict()
    if before.get("fingerprint") == fingerprint:
        number = before.get("attempt", 1)
        facts["attempt"] = number + 1
        ended = f"attempt {number}{_place(before)} {ending(before, own)}"
        facts["earlier"] = [*before.get("earlier", [])[1 - REMEMBERED :], ended]
    return facts


def _place(document: dict[str, Any]) -> str:
    own = document.get("slurm")
    return f" (Slurm job {own['job']} on {own['node']})" if own else ""


def _asks(own: dict[str, Any]) -> str:
    """Return in words what a Slurm job asks for; empty outside of Slurm."""
    memory, minutes = own.get("memory_mb"), own.get("minutes")
    limit = minutes and f"{minutes:,} minute{'s' if minutes > 1 else ''}"
    return " and ".join(filter(None, (memory and f"{memory:,} MB", limit)))


def ending(document: dict[str, Any], now: slurm.Own | None = None) -> str:
    """Return in words how an attempt ended that did not end well.

    Args:
        document: its state file.
        now: the Slurm job of the process that asks; Slurm gives a job that it starts again the same number.
    """
    if document.get("state") == "failed":
        return f"failed: {document.get('reason', '')}"
    own, peak = document.get("slurm"), document.get("peak_mb")
    seen = f"this process had {peak:,} MB when last seen" if peak else ""
    if not own:
        return f"was killed without a word ({GUESS}{f' {seen}' if seen else ''})"
    if now and now.job == own["job"]:
        if now.restarts > own["restarts"]:
            return "was put back into the queue by Slurm (its node failed, or it was preempted or requeued)"
        return f"was killed, but not its Slurm job ({GUESS}{f' {seen}' if seen else ''})"
    asked = _asks(own)
    had = "; ".join(filter(None, (asked and f"it had asked for {asked}", seen)))
    state = slurm.state_of(own["job"])
    if state in slurm.ALIVE:
        return f"has not ended: Slurm says {state}"
    cause = state if state in slurm.KILLED and state != "CANCELLED" else slurm.said_in(own["log"], own["job"]) or state
    if cause in slurm.KILLED:
        return slurm.KILLED[cause] + (f": {had}" if had else "")
    full = own.get("memory_mb") and peak and peak > 0.8 * own["memory_mb"]
    guess = "for its memory?" if full else GUESS
    says = f"; Slurm says {state}" if state else ""
    return f"was killed without a word ({guess}{f' {had}' if had else ''}{says})"


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


def killed(document: dict[str, Any]) -> str:
    """Return in words why a job says `started` and does not run any more, as far as that can be known."""
    number, own = document.get("attempt", 1), document.get("slurm")
    if not own and number == 1 and not document.get("peak_mb"):
        return "started and did not end, and its process is gone"
    return "; ".join([*document.get("earlier", []), f"attempt {number}{_place(document)} {ending(document)}"])


def slurm_ended(document: dict[str, Any]) -> bool:
    """Return whether Slurm says of a job on another machine that it has ended, which its state file tells minutes later."""
    own = document.get("slurm")
    if not own or alive.lives(document):
        return False
    state = slurm.state_of(own["job"])
    return bool(state) and state not in slurm.ALIVE


def reasons(since: float, root: Path = Path(".")) -> list[str]:
    """Return one message for every job that failed or was killed after `since` (seconds, as `time.time`), oldest first."""
    found = []
    for path in (root / "results").glob("*/logs/*.state.json"):
        new = _read_new(path, since)
        if new is None:
            continue
        changed, document = new
        if document.get("state") == "started":
            if alive.lives(document):
                continue  # of another run
            changed = _moment(document.get("since"), changed)  # it was touched since
        if changed < int(since):
            continue
        owner, name = path.parents[1].name, path.name.removesuffix(".state.json")
        log = path.with_name(f"{name}.log")
        reason = document.get("reason") or _reason_of_killed(document)
        found.append((changed, f"error: {owner}: {name} failed ({log}): {reason}"))
    return [message for _, message in sorted(found)]


def _reason_of_killed(document: dict[str, Any]) -> str:
    if "slurm" not in document and not document.get("earlier"):
        peak = f"; it had {document['peak_mb']:,} MB when last seen" if document.get("peak_mb") else ""
        return f"it was killed ({GUESS}{peak})"
    return killed(document)


def retold(since: float, root: Path = Path(".")) -> list[str]:
    """Return one line for every job that needed several attempts and was started again after `since`, oldest first."""
    found = []
    for path in (root / "results").glob("*/logs/*.attempts.json"):
        new = _read_new(path, since)
        if new and new[1].get("told"):
            found.append((new[0], f"{path.parents[1].name}: {path.name.removesuffix('.attempts.json')}: {new[1]['told']}"))
    return [line for _, line in sorted(found)]


def _read_new(path: Path, since: float) -> tuple[float, dict[str, Any]] | None:
    """Return the time of change and the content of a file that was changed after `since`; None if there is no such."""
    try:
        changed = path.stat().st_mtime
    except OSError:  # its job has just ended well
        return None
    document = _read(path)
    return (changed, document) if changed >= since and document else None


def _read(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_text())
    except (OSError, ValueError, RecursionError):
        return {}
    if not isinstance(document, dict):
        return {}
    own, earlier = document.get("slurm"), document.get("earlier")
    if not (isinstance(own, dict) and own.keys() >= set(slurm.Own._fields)):
        document.pop("slurm", None)
    if not (isinstance(earlier, list) and all(isinstance(line, str) for line in earlier)):
        document.pop("earlier", None)
    if not isinstance(document.get("attempt"), int):
        document.pop("attempt", None)
    return document
