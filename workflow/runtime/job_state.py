"""How the last run of a job ended: the end of a run, the summary of a batch and `status` read the reason from it.

`results/<scene>/logs/<stage>.state.json` lies next to the log of the job, from its start until it ends well. It says `started`
for a job that was killed, and `failed` and why for a job that failed; Snakemake itself knows no more than that a job did not end
well. A running job renews the file every `BEAT` seconds, with the largest memory that its process had, for the case that it is
killed without a word. On the same machine the process itself is looked for; for other machines, the age of the file tells.
"""

from __future__ import annotations

import math
import os
import platform
import resource
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import psutil

from iif_core.errors import InputError
from workflow.artifacts.files import facts_in, write_json

BEAT = 15.0
"""Seconds after which a running job renews its file."""
SILENCE = 300.0
"""Age in seconds of the file from which on a job of another machine counts as killed: clocks differ, and disks of the network
show a new time stamp up to a minute late."""
FORMS = {
    **dict.fromkeys(("state", "reason", "fingerprint", "host", "slurm_job"), str),
    **dict.fromkeys(("since", "start"), float),
    **dict.fromkeys(("pid", "peak_mb"), int),
}
"""Keys of a state, and their types. Whatever else a file holds is not read."""


def written_out(text: str) -> str:
    """Return a text as messages have it: characters that could steer a terminal are written out, as `InputError` does."""
    return str(InputError(text))


class JobState:
    """Records the state of one job.

    Args:
        owner: folder of results/ that the job belongs to: a scene, or `studies` or `weights`.
        name: stage of the scene, or name of the study.
        fingerprint: what the job was planned as; None when it is run by hand.
    """

    def __init__(self, owner: str, name: str, fingerprint: str | None = None):
        self.path = state_file(owner, name).absolute()
        self._facts: dict[str, Any] = {"fingerprint": fingerprint or ""}
        self._lock, self._ended = threading.Lock(), threading.Event()

    def started(self) -> None:
        """Note that the job runs."""
        own = psutil.Process()
        self._facts |= {"host": platform.node(), "pid": own.pid, "start": own.create_time()}
        if job := os.environ.get("SLURM_JOB_ID"):
            self._facts["slurm_job"] = job
        self._write("started")
        threading.Thread(target=self._watch, name="watch", daemon=True).start()

    def failed(self, reason: str) -> None:
        self._ended.set()
        self._write("failed", reason=reason)

    def done(self) -> None:
        self._ended.set()
        with self._lock:
            self.path.unlink(missing_ok=True)

    def _write(self, state: str, **more: Any) -> None:
        self._facts |= {"state": state, "since": time.time(), **more}
        with self._lock:
            write_json(self.path, self._facts)

    def _watch(self) -> None:
        while not self._ended.wait(BEAT):
            self._facts["peak_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024  # Linux counts in kB
            with self._lock, suppress(OSError):  # the stage will report a full disk
                if not self._ended.is_set() and self.path.exists():  # it is removed with its results
                    write_json(self.path, self._facts, settled=False)


def state_file(owner: str, name: str, root: Path = Path(".")) -> Path:
    """Return where the state of a job is kept."""
    return root / "results" / owner / "logs" / f"{name}.state.json"


class Noted(NamedTuple):
    """The state of a job that has not ended well.

    Attributes:
        state: `running`, `failed` or `killed`.
        since: when it came into this state, in seconds as `time.time`.
        log: path of its log.
        document: what the file says.
    """

    state: str
    since: float
    log: str
    document: dict[str, Any]

    @property
    def reason(self) -> str:
        """Why it has not ended well, as far as that can be known; empty while it runs."""
        if self.state == "running":
            return ""
        return self.document.get("reason", "") if self.state == "failed" else _killed(self.document)

    def is_of(self, fingerprint: str) -> bool:
        """Return whether the job was planned as `fingerprint`, or run by hand: then its last run counts, whatever it was."""
        return self.document.get("fingerprint", "") in ("", fingerprint)


def noted(path: Path, silence: float = SILENCE) -> Noted | None:
    """Return what a state file says; None if there is none, or nothing that can be read. Never raises, whatever it holds.

    Args:
        path: of the file.
        silence: age of the file from which on a job of another machine counts as killed; 0 where no job can run any more.
    """
    document = facts_in(path)
    try:
        touched = os.stat(path).st_mtime
    except OSError:  # also where its job has just ended well
        return None
    if document.get("state") not in ("started", "failed"):
        return None
    document = {key: _sound(value) for key, value in document.items() if key in FORMS and type(value) is FORMS[key]}
    state = document["state"]
    if state == "started":
        known = _lives(document)
        state = "running" if (time.time() - touched < silence if known is None else known) else "killed"
    log = path.with_name(path.name.removesuffix(".state.json") + ".log")
    return Noted(state, document.get("since", touched), str(log), document)


def _sound(value: Any) -> Any:
    """Return a value without what could steer a terminal or is no number that a job writes."""
    if isinstance(value, str):
        return written_out(value)
    return value if math.isfinite(value) and 0 <= value < 1e11 else type(value)(0)


def process(document: dict[str, Any]) -> psutil.Process | None:
    """Return the process of a job; None if it has ended, or if it is of another machine. Numbers are given again, so a process is
    known by the time at which it was started, too."""
    try:
        found = psutil.Process(document["pid"])
        same = abs(found.create_time() - document["start"]) < 1 and found.status() != psutil.STATUS_ZOMBIE
        return found if same and document["host"] == platform.node() else None
    except (KeyError, psutil.Error, OverflowError, ValueError):
        return None


def _lives(document: dict[str, Any]) -> bool | None:
    """Return whether the process of a job still runs; None if it is of another machine."""
    return process(document) is not None if document.get("host") == platform.node() else None


def _killed(document: dict[str, Any]) -> str:
    peak, job = document.get("peak_mb"), document.get("slurm_job")
    seen = f" It had {peak:,} MB when last seen." if peak else ""
    asked = f" `sacct -j {job}` says more." if job else ""
    return f"it was killed: out of memory, or over its time limit?{seen}{asked}"


def reasons(since: float, root: Path = Path(".")) -> list[str]:
    """Return one message for every job that failed or was killed after `since` (seconds, as `time.time`), oldest first."""
    found = []
    for path in (root / "results").glob("*/logs/*.state.json"):
        job = noted(path, silence=0.0)
        if job and job.state != "running" and job.since >= int(since):
            name = path.name.removesuffix(".state.json")
            found.append((job.since, f"error: {path.parents[1].name}: {name} failed ({job.log}): {job.reason}"))
    return [written_out(message) for _, message in sorted(found)]
