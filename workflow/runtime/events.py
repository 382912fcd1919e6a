"""What jobs tell while they run, as lines of JSON for dashboards (docs/reference/events.md).

Nothing is written unless the variable `IIF_EVENTS` names a place; `--config events=<place>` sets it for the jobs of a run. A name
that ends in .jsonl is one file. Any other is a folder with one file for each machine, because lines that several machines append
to one file of a network disk can overwrite each other.
"""

from __future__ import annotations

import errno
import json
import logging
import os
import platform
import resource
import stat
import tempfile
import time
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import Any

from iif_core.errors import InputError

VARIABLE = "IIF_EVENTS"
VERSION = 1
EVERY = 30.0
"""Seconds between two events `progress` of a job."""
LONGEST = 4000
"""Bytes of a line: the kernel appends what fits into a page in one piece."""
_told = float("-inf")  # when this process last reported its progress


def place(named: str) -> Path:
    """Return the file for events of this machine."""
    return Path(named) if named.endswith(".jsonl") else Path(named) / f"{platform.node() or 'unknown'}.jsonl"


def checked(named: str, tried: bool = True) -> str:
    """Return a place for events as an absolute path, so that jobs find it from any folder.

    Args:
        named: as it was given.
        tried: whether to check that something can be written there. A job on a node runs without events where it cannot.

    Raises:
        InputError: nothing can be written there.
    """
    path = os.path.abspath(named) + (os.sep if named.endswith(os.sep) else "")
    if not tried:
        return path
    inner = os.path.relpath(path).split(os.sep)
    if not named.strip() or (inner[0] in ("results", "scenes") and len(inner) > 2 - (inner[0] == "scenes")):
        raise InputError(
            f"--config events={named}: name a file such as results/events.jsonl, or a folder; none in results/<scene> or scenes/,"
            " where everything that is not of the scene is removed"
        )
    kind = "a file" if named.endswith(".jsonl") else "a folder"
    if os.path.isdir(path) if kind == "a file" else os.path.isfile(path):
        raise InputError(f"--config events={named}: needed {kind}; a name that ends in .jsonl is a file, any other a folder")
    nearest = Path(path)
    while not os.path.lexists(nearest):
        nearest = nearest.parent
    if not _can_write(nearest, nearest == Path(path) and not nearest.is_dir()):
        raise InputError(f"--config events={named}: {nearest} is no folder that you may write to; name another place")
    return path


def _can_write(path: Path, is_file: bool) -> bool:
    """Return whether something can be written to a file, or made in a folder. It is tried, because a file system such as /proc
    refuses also whoever may write everywhere."""
    try:
        if is_file:
            _close_if_regular(os.open(path, os.O_WRONLY | os.O_APPEND | os.O_NONBLOCK | os.O_CLOEXEC))
        else:
            with tempfile.TemporaryFile(dir=path):
                pass
    except OSError:
        return False
    return True


def _close_if_regular(handle: int) -> None:
    """Close a file.

    Raises:
        OSError: it is none, but a pipe, whose reader may be gone when a job writes.
    """
    regular = stat.S_ISREG(os.fstat(handle).st_mode)
    os.close(handle)
    if not regular:
        raise OSError(errno.EINVAL, "not a regular file")


def tell(event: str, scene: str, stage: str, fingerprint: str, **facts: Any) -> None:
    """Append one event, if a place for events is named. A place that cannot be written to is a warning in the log, once.

    Args:
        event: `started`, `progress`, `finished` or `failed`.
        scene, stage, fingerprint: of the job.
        facts: whatever else is known; what is None is left out.
    """
    named = os.environ.get(VARIABLE)
    if not named:
        return
    now = datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
    document = {"v": VERSION, "time": now, "event": event, "scene": scene, "stage": stage, "fingerprint": fingerprint}
    document |= {"host": platform.node(), "pid": os.getpid()}
    document |= {key: value for key, value in facts.items() if value is not None}
    try:
        _append(place(named), line_of(document))
    except OSError as error:
        _warn(f"{named}: {error.strerror}; no events are written there (docs/reference/events.md)")


def line_of(document: dict[str, Any]) -> bytes:
    """Return an event as one line of at most `LONGEST` bytes; `reason`, which alone can be long, is cut to fit."""
    text = json.dumps(document)  # ASCII, and line breaks are escaped
    while len(text) >= LONGEST and document.get("reason"):
        reason = str(document["reason"])
        document = document | {"reason": reason[: max(0, len(reason) - max(len(text) - LONGEST, 64))].rstrip() + "..."}
        if len(document["reason"]) >= len(reason):
            document = document | {"reason": ""}
        text = json.dumps(document)
    return text.encode() + b"\n"


def due() -> bool:
    """Return whether this job reports its progress now: events are wanted, and its last report is `EVERY` seconds old."""
    global _told
    now = time.monotonic()
    if VARIABLE not in os.environ or now - _told < EVERY:
        return False
    _told = now
    return True


def taken() -> dict[str, float]:
    """Return what this process has taken since it began: CPU seconds over all threads, and the most memory, in MB."""
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024  # Linux counts in kB
    return {"cpu_seconds": round(time.process_time(), 3), "max_rss_mb": round(memory, 1)}


def _append(path: Path, line: bytes) -> None:
    """Append a line; of one that does not fit on the disk nothing stays, so that the next is not glued to its half.

    Raises:
        OSError: the line could not be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    handle = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NONBLOCK | os.O_CLOEXEC, 0o666)
    try:
        written = os.write(handle, line)  # one call, so that lines of several processes do not mix
        if written < len(line):
            end = os.lseek(handle, 0, os.SEEK_CUR)
            if os.fstat(handle).st_size == end:  # nobody has written since
                os.ftruncate(handle, end - written)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    finally:
        os.close(handle)


@lru_cache(None)
def _warn(message: str) -> None:
    logging.getLogger("events").warning("%s", message)
