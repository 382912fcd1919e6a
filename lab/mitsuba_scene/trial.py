"""A separate process loads a scene file first: Mitsuba ends its process on some files, such as a bitmap without a file."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

from iif_core.errors import InputError

_LOADING = """
import sys, drjit, mitsuba as mi
mi.set_variant(sys.argv[1])
drjit.set_thread_count(max(drjit.thread_count(), 2))  # with one, Mitsuba waits for ever for the blocks of an EXR file
config = mi.parser.ParserConfig(sys.argv[1])
mi.file_resolver().prepend(sys.argv[2].rpartition("/")[0] or ".")
state = mi.parser.parse_file(config, sys.argv[2])
mi.parser.transform_all(config, state)
mi.parser.instantiate(config, state)
"""


def check(xml: Path, variant: str) -> None:
    """Load a scene in another process, with a variant of Mitsuba. Errors that Mitsuba tells are left to whoever loads it next.

    Raises:
        InputError, MemoryError: as `judge`.
    """
    command = [sys.executable, "-c", _LOADING, variant, str(xml.resolve())]
    judge(xml, subprocess.run(command, capture_output=True).returncode)


def judge(xml: Path, code: int) -> None:
    """Raise what a process that loaded a scene died of; `code` is its exit code, below 0 for a signal.

    Raises:
        MemoryError: somebody else killed it, as the kernel does where memory runs out.
        InputError: it crashed.
    """
    if code == -signal.SIGKILL:
        raise MemoryError(f"a process that loaded {xml} was killed")
    if code < 0:
        raise InputError(
            f"{xml}: Mitsuba crashes when it loads this file ({signal.Signals(-code).name}); a bitmap without a file can cause"
            " that, and so can a damaged mesh or texture. Remove or repair what it names, part by part, until `mitsuba` loads it"
        )
