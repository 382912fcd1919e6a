"""A test that hangs is ended and named. After `LIMIT` seconds, the processes that it started are reported and killed, so a test
that waits for one of them continues, and fails. If the test itself hangs, `faulthandler_timeout` of pyproject.toml ends its
process."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

LIMIT = 300.0
"""Seconds, of a test with the fixtures that it is the first to use; the longest takes 100 on two free cores."""
COLUMNS = "pid,ppid,stat,etimes,cputimes,wchan:30,args"


def descendants(pid: int) -> list[int]:
    """Return the processes that a process started, and those that these started, parents first."""
    children = []
    for place in Path(f"/proc/{pid}/task").glob("*/children"):
        with suppress(OSError):  # that thread has just ended
            children += [int(word) for word in place.read_text().split()]
    return children + [one for child in children for one in descendants(child)]


def end_all(pid: int, tell: Callable[[str], object], patience: float = 5.0) -> None:
    """Kill all that a process started, and `tell` a table of it beforehand, because the test that waits for it fails at once.
    With SIGABRT at first, by which Python tells where it was if the variable PYTHONFAULTHANDLER is set."""
    found = descendants(pid)
    if not found:
        tell("it has started no process")
        return
    tell(subprocess.run(["ps", "-ww", "-o", COLUMNS, "-p", ",".join(map(str, found))], capture_output=True, text=True).stdout)
    for number, wait in ((signal.SIGABRT, patience), (signal.SIGKILL, 0.0)):
        for one in found:
            with suppress(ProcessLookupError):
                os.kill(one, number)
        time.sleep(wait)
