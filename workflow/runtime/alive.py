"""Whether the process of a job still runs, asked from another process, perhaps on another machine.

Where the kernel is the same, the kernel is asked: a process is named by its number and by the time at which it was started,
because numbers are given again. On another machine, or in another container, nothing can be asked; there the file of the job's
state tells, which a running job touches every `BEAT` seconds.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

BEAT = 30.0
"""Seconds after which a running job touches the file of its state again."""
SILENCE = 300.0
"""Seconds without a touch after which a job of another machine counts as killed: ten of them, because clocks differ and disks of
the network show a new time stamp up to a minute late."""
_START = 19
"""Place of the time of start in /proc/<pid>/stat, counted from the state, which follows the name in brackets."""
_USER, _SYSTEM = 11, 12


class Usage(NamedTuple):
    """What a process has taken so far: CPU seconds, and the most memory that it had at once, in MB."""

    cpu_seconds: float
    max_rss_mb: float


def identity() -> dict[str, Any]:
    """Return what names this process: `host`, `pid`, `kernel` (the running system and its namespace of numbers) and `start`, in
    clock ticks since that system was started."""
    fields = _stat(os.getpid())
    return {
        "host": platform.node(),
        "pid": os.getpid(),
        "kernel": kernel(),
        "start": int(fields[_START]) if fields else None,
    }


@lru_cache(None)
def kernel() -> str:
    """Return what two processes have in common if and only if they see the same process under the same number; empty where that
    is unknown."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        return f"{boot} {os.readlink('/proc/self/ns/pid')}"
    except OSError:
        return ""


def lives(document: Mapping[str, Any]) -> bool | None:
    """Return whether the process that `identity` named still runs; None if this process cannot know that."""
    pid, start = document.get("pid"), document.get("start")
    if not kernel() or document.get("kernel") != kernel() or not _is_number(pid) or not _is_number(start):
        return None
    fields = _stat(pid)
    if fields:
        return fields[0] not in "ZX" and fields[_START] == str(start)  # a zombie has ended
    try:
        os.kill(pid, 0)  # asks and sends nothing; /proc may hide the processes of others
    except ProcessLookupError:
        return False
    except OSError:
        pass
    return None


def runs(document: Mapping[str, Any], touched: float, now: float) -> bool:
    """Return whether a job whose state says `started` is running.

    Args:
        document: its state, with what `identity` gave.
        touched: time stamp of the file of that state, in seconds as `time.time`.
        now: the present time.
    """
    known = lives(document)
    return now - touched < SILENCE if known is None else known


def usage(document: Mapping[str, Any]) -> Usage | None:
    """Return what a running job has taken so far; None where this process cannot know it."""
    if not lives(document):
        return None
    try:
        fields = _stat(document["pid"])
        cpu = (int(fields[_USER]) + int(fields[_SYSTEM])) / os.sysconf("SC_CLK_TCK")
        lines = Path(f"/proc/{document['pid']}/status").read_text(errors="replace").splitlines()
        peak = next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM:"))
        return Usage(cpu, peak)
    except (OSError, ValueError, IndexError, StopIteration):  # it has just ended
        return None


def _is_number(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 < value < 1 << 62


def _stat(pid: int) -> list[str]:
    """Return the fields of /proc/<pid>/stat from the state on; empty if there is no such process."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text(errors="replace")
    except OSError:
        return []
    fields = text.rpartition(")")[2].split()
    return fields if len(fields) > _START else []
