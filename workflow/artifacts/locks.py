"""One process at a time for each stage of a scene: two would remove one another's temporary files and mix their results.

The kernel holds the lock (`flock`), so the lock ends with its process, however that ends. Its file stays:
`results/<scene>/locks/<stage>`.
"""

from __future__ import annotations

import errno
import fcntl
import json
import logging
import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import IO, Any

from iif_core.errors import InputError
from workflow.artifacts import links

_HELD = (errno.EAGAIN, errno.EACCES)
_UNSUPPORTED = (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS, errno.EINVAL, errno.EBADF)


def place(results: Path, scene: str, stage: str) -> Path:
    """Return the file whose lock a process holds while it makes a stage."""
    return results / scene / "locks" / stage


@contextmanager
def alone(results: Path, scene: str, stage: str) -> Iterator[None]:
    """Hold the lock of a stage of a scene. On a disk without locks, such as some network disks, log a warning and continue.

    Raises:
        InputError: another process holds it; the message says which, where and since when. Or a link is where the job writes.
    """
    links.refuse(results, scene)
    path = place(results, scene, stage)
    path.parent.mkdir(parents=True, exist_ok=True)
    with links.open_there(path, "a+") as file:  # what its holder has written is not to be lost by looking
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in _HELD:
                raise InputError(f"{path}: {_who(file, scene, stage)}") from None
            if error.errno not in _UNSUPPORTED:
                raise
            logging.getLogger(stage).warning(
                "%s: this disk has no locks (%s); do not start a stage twice at once here", path, error.strerror
            )
        now = datetime.now().astimezone().isoformat(" ", "seconds")
        _write(file, json.dumps({"pid": os.getpid(), "host": platform.node(), "since": now}))
        try:
            yield
        finally:
            _write(file, "")


def _write(file: IO[str], text: str) -> None:
    file.truncate(0)
    file.write(text)
    file.flush()


def _who(file: IO[str], scene: str, stage: str) -> str:
    """Return a sentence on the holder of the lock."""
    file.seek(0)
    try:
        found: dict[str, Any] = json.loads(file.read())
        holder = f"process {found['pid']} on {found['host']} since {found['since']}"
        end = f"end it (on {found['host']}: kill {found['pid']})"
    except (ValueError, KeyError, TypeError):  # it is about to write them
        holder, end = "another process", "end it"
    return f"stage {stage} of {scene} is being made by {holder}. Wait until it is done, or {end}; then run the same command again"
