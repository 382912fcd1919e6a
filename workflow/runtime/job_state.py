"""How the last run of a job ended, kept beside its log, so that the next attempt, the end of a run and the summary of a batch can
give the reason.

`results/<scene>/logs/<stage>.state.json` exists from the start of a job until it ends well. The file of a job that was killed
says `started`; that of a job that failed says `failed` and why. With them stand the number of the attempt, the Slurm job and what
it asked for, the memory that the process had when it was last seen, and how the attempts before ended. A job that needed several
attempts leaves `<stage>.attempts.json` also when it ends well.
"""

from __future__ import annotations

import json
import logging
import resource
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

from workflow.artifacts.files import write_json
from workflow.runtime import slurm

LOOK = 5.0
"""Seconds between two looks at the memory of a job."""
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
        self._facts: dict[str, Any] = {}
        self._lock, self._ended = threading.Lock(), threading.Event()

    def started(self) -> None:
        """Note that the job runs. If an earlier attempt did not end well, log how that ended, and what this one asks for."""
        if self.fingerprint:
            self._facts = _facts(_read(self.path), self.fingerprint)
            self._tell()
            threading.Thread(target=self._watch, name="watch", daemon=True).start()
        self._write("started", "")

    def failed(self, reason: str) -> None:
        self._ended.set()
        self._write("failed", reason)

    def done(self) -> None:
        self._ended.set()
        with self._lock:
            self.path.unlink(missing_ok=True)

    def _write(self, state: str, reason: str) -> None:
        with self._lock:
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
        """Note the largest memory of this process whenever it has grown, for the case that it is killed without a word."""
        noted, path = 0.0, self.path.absolute()
        while not self._ended.wait(LOOK):
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024  # Linux counts in kB
            if peak < noted * GROWTH:
                continue
            noted = peak
            with self._lock, suppress(OSError):  # a full disk will be told of by the stage
                if not self._ended.is_set() and path.exists():  # it is removed with its results
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


def killed(document: dict[str, Any]) -> str:
    """Return in words why a job says `started` and does not run any more, as far as that can be known."""
    number, own = document.get("attempt", 1), document.get("slurm")
    if not own and number == 1 and not document.get("peak_mb"):
        return "started and did not end: killed, or still running"
    parts = [*document.get("earlier", []), f"attempt {number}{_place(document)} {ending(document)}"]
    return "; ".join(parts) + ("" if own else "; or it still runs")


def reasons(since: float, root: Path = Path(".")) -> list[str]:
    """Return one message for every job that failed or was killed after `since` (seconds, as `time.time`), oldest first."""
    found = []
    for path in (root / "results").glob("*/logs/*.state.json"):
        new = _read_new(path, since)
        if new is None:
            continue
        changed, document = new
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
    except (OSError, ValueError):
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
