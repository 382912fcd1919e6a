"""Digests of input files for fingerprints: of their whole content, read once for as long as nobody touches a file.

They are kept in `results/.input-digests.json`, so a plan reads again only files whose size, inode or time stamps changed. A file
that was touched or copied is the same, an edited one is different, even if its time stamp was set back.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path

from workflow.artifacts.stamps import Stamps, unsaved

CACHE = Path("results/.input-digests.json")


@lru_cache(1)
def _kept(place: Path) -> Stamps:
    return Stamps(place)


def digests(paths: Iterable[Path], named: Callable[[Path], str] = str) -> list[str]:
    """Return `name:digest` of every file, sorted by path; `named` gives the name, which is the path without it."""
    kept, paths = _kept(CACHE.absolute()), sorted(paths)
    unknown = [path for path in paths if kept.known(path) is None]
    with ThreadPoolExecutor() as pool:  # hashing lets other threads run
        list(pool.map(kept.of, unknown))
    out = [f"{named(path)}:{kept.of(path)}" for path in paths]
    kept.save(flushed=True)
    return out


@contextmanager
def saved_once() -> Iterator[None]:
    """Save the digests only once, at the end of the block: the file has an entry for every photograph of a batch."""
    try:
        with unsaved():
            yield
    finally:
        _kept(CACHE.absolute()).save(flushed=True)
