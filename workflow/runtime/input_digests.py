"""Digests of input files for fingerprints, without reading gigabytes while Snakemake plans.

A file of at most `WHOLE` bytes is identified by its content. A larger one (the photographs and meshes of a batch can be hundreds
of gigabytes) is identified by its size and three samples; the job that reads it anyway records the digest of its whole content
(`remember`). When the size, a time stamp or the inode of such a file changes, its whole content decides: a file that was touched
or copied is the same, an edited one is different, even if size and samples agree, and even if its time stamp was set back,
because that changes the time stamp of the inode. The digests are kept in `results/.input-digests.json`.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from workflow.artifacts import locks
from workflow.artifacts.files import read_record, sha256_of, write_atomically

WHOLE = 1 << 20
SAMPLE = 1 << 12
CACHE = Path("results/.input-digests.json")
LOCK = CACHE.with_suffix(".lock")


Stamp = tuple[int, int, int, int]


def _stamp(path: Path) -> Stamp:
    status = path.stat()
    return status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino


class Known(NamedTuple):
    """A file as it was last seen: `stat`, digest for fingerprints, digest of the whole content ("" = not computed)."""

    size: int
    mtime_ns: int
    ctime_ns: int
    inode: int
    digest: str
    whole: str

    @property
    def stamp(self) -> Stamp:
        return self[:4]


_known: dict[str, Known] = {}
_new: dict[str, Known] = {}
_read_at: tuple[Path, int] | None = None  # which file, and its time stamp, `_known` was read from
_held = False


def digests(paths: Iterable[Path], named: Callable[[Path], str] = str) -> list[str]:
    """Return `name:digest` of every file, sorted by path; `named` gives the name, which is the path without it."""
    _recall()
    out = [f"{named(path)}:{_digest(path)}" for path in sorted(paths)]
    _save()
    return out


def remember(paths: Iterable[Path]) -> None:
    """Record the whole content of large files that a job has just read, except those that changed since their fingerprint."""
    _recall()
    for path in paths:
        entry = _known.get(str(path))
        if entry and not entry.whole and entry.stamp == _stamp(path):
            whole = sha256_of(path)
            if entry.stamp == _stamp(path):  # otherwise it was replaced while it was read
                _note(path, entry._replace(whole=whole))
    _save()


def rehash() -> list[Path]:
    """Read every known file whole, whatever `stat` says of it, and return those whose content is another than was known."""
    _recall()
    changed = []
    for name, before in list(_known.items()):
        path = Path(name)
        if not path.is_file():
            continue
        stamp = _stamp(path)
        now = _look(path, stamp, before)
        if before.whole == "":
            now = now._replace(whole=sha256_of(path))
        if now.digest != before.digest:
            changed.append(path)
        _note(path, now)
    _save()
    return changed


@contextmanager
def saved_once() -> Iterator[None]:
    """Save the digests only once, at the end of the block: the file has an entry for every photograph of a batch."""
    try:
        with unsaved():
            yield
    finally:
        _save()


@contextmanager
def unsaved() -> Iterator[None]:
    """Write nothing within the block; what was found is saved by whatever looks next."""
    global _held
    _held = True
    try:
        yield
    finally:
        _held = False


def _digest(path: Path) -> str:
    stamp, entry = _stamp(path), _known.get(str(path))
    if entry is None or entry.stamp != stamp:
        _note(path, entry := _look(path, stamp, entry))
    return entry.digest


def _look(path: Path, stamp: Stamp, before: Known | None) -> Known:
    if stamp[0] <= WHOLE:
        content = sha256_of(path)
        return Known(*stamp, content, content)
    if before is None or not before.whole:
        return Known(*stamp, _samples(path, stamp[0]), "")
    whole = sha256_of(path)
    return Known(*stamp, before.digest if whole == before.whole else whole, whole)


def _samples(path: Path, size: int) -> str:
    """Return the digest of size, beginning, middle and end."""
    out = hashlib.sha256(f"{size}\n".encode())
    with open(path, "rb", buffering=0) as handle:
        for start in (0, (size - SAMPLE) // 2, size - SAMPLE):
            handle.seek(start)
            out.update(handle.read(SAMPLE))
    return out.hexdigest()


def _note(path: Path, entry: Known) -> None:
    _known[str(path)] = _new[str(path)] = entry


def _recall() -> None:
    """Read the file again if another process has written it or the working folder has changed."""
    global _read_at
    path = CACHE.absolute()
    try:
        now = (path, path.stat().st_mtime_ns)
    except OSError:
        now = (path, 0)
    if now != _read_at:
        if _read_at and _read_at[0] != path:
            _new.clear()
        _known.clear()
        _known.update(_stored())
        _known.update(_new)
        _read_at = now


def _stored() -> dict[str, Known]:
    try:
        document = json.loads(read_record(CACHE))
        # Earlier versions kept (size, time stamp, digest, whole): without the rest of the stamp, the content is compared once.
        entries = {path: [*entry[:2], 0, 0, *entry[2:]] if len(entry) == 4 else entry for path, entry in document.items()}
        return {path: Known(*entry) for path, entry in entries.items() if len(entry) == len(Known._fields)}
    except (OSError, ValueError, AttributeError, TypeError, RecursionError):
        return {}


def _save() -> None:
    """Add new digests to the file, and keep those that other processes have written meanwhile."""
    global _read_at
    if _held or not _new:
        return
    with locks.briefly(LOCK):
        entries = _stored()
        for path, entry in _new.items():
            other = entries.get(path)
            if not (other and other.whole and not entry.whole and other.stamp == entry.stamp):  # it has read more of the file
                entries[path] = entry
        text = json.dumps(entries, sort_keys=True, separators=(",", ":"))
        write_atomically(CACHE, lambda temporary: temporary.write_text(text))
        _read_at = (CACHE.absolute(), CACHE.stat().st_mtime_ns)
    _new.clear()
    _known.update(entries)
