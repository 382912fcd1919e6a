"""What was found of files, kept for as long as nobody touches them: hashes of artefacts and of inputs, digests of code.

A fact of a file holds while its size, its inode and its time stamps stay as they were when the fact was found. The time of the
last change of the inode (ctime) is among them, because a program can set the other one back, and not this one. Stamps are taken
before a file is read, so a change during the reading shows the next time.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from workflow.artifacts import files as io
from workflow.artifacts import manifest as manifests

DELIVERABLE = "deliverable"

Stamp = tuple[int, int, int, int]
_held = 0


def place(results: Path, scene: str, of: str) -> Path:
    """Return the file that has the stamps of a stage or of the deliverable, outside of the manifests: no two runs have the same
    time stamps."""
    return results / scene / "stamps" / f"{of}.json"


def stamp_of(path: Path | str) -> Stamp | None:
    """Return (bytes, time stamp of the content in ns, time stamp of the inode in ns, inode); None if there is no such file."""
    try:
        status = os.stat(path)
    except (OSError, ValueError):  # a name with a zero byte
        return None
    return status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino


@contextmanager
def unsaved() -> Iterator[None]:
    """Save nothing within the block; what was found is saved by whatever looks next."""
    global _held
    _held += 1
    try:
        yield
    finally:
        _held -= 1


class Stamps:
    """Facts of files.

    Args:
        place: file that keeps them for other processes; None = they are for this process alone. One that is damaged, or that
            another version made, counts as empty: everything is found anew.
        find: what is found of a file, as JSON can hold it; by default its SHA-256.
        by: what facts depend on besides the files.
    """

    def __init__(self, place: Path | None = None, find: Callable[[Path], Any] | None = None, by: str = ""):
        self._place, self._find, self._by = place, find, by
        self._facts: dict[str, Any] = {}  # path -> [stamp, fact]
        self._changed, self._lock = False, threading.Lock()
        try:
            document = manifests.sealed(io.read_record(place)) if place else {}
            files = document.get("files")
            if document.get("by") == by and isinstance(files, dict):
                self._facts = {path: kept for path, kept in files.items() if isinstance(kept, list) and len(kept) == 2}
        except (OSError, ValueError):
            pass

    def known(self, path: Path | str) -> Any:
        """Return what was found of a file that nobody touched since; None of any other."""
        kept, stamp = self._facts.get(str(path)), stamp_of(path)
        return kept[1] if kept and stamp and kept[0] == [*stamp] else None

    def of(self, path: Path | str) -> Any:
        """Return the fact of a file, found now if it is not known.

        Raises:
            OSError: the file cannot be read.
        """
        found = self.known(path)
        if found is None:
            stamp, found = stamp_of(path), (self._find or io.sha256_of)(Path(path))
            self.note(path, stamp, found)
        return found

    def note(self, path: Path | str, stamp: Stamp | None, found: Any) -> None:
        """Keep the fact of a file that had this stamp before it was read."""
        with self._lock:
            self._facts[str(path)], self._changed = [stamp and [*stamp], found], True

    def save(self, place: Path | None = None, flushed: bool = False) -> None:
        """Write the facts down if any is new, at their place or at another.

        Without `flushed` a power cut may take them, and they are found anew.
        """
        place = place or self._place
        with self._lock:  # stages read from several threads
            if self._changed and not _held and place is not None:
                text = manifests.text_of({"by": self._by, "files": self._facts})
                io.write_atomically(place, lambda temporary: temporary.write_text(text), settled=flushed, flushed=flushed)
                self._changed = False


IN_THIS_PROCESS = Stamps()
"""Hashes of the artefacts that this process has read: each is read once to compare it, however often it is opened."""
