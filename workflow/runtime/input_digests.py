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

from workflow.artifacts import files as io
from workflow.artifacts import manifest as manifests
from workflow.artifacts.manifest import MANIFEST
from workflow.artifacts.stamps import Stamps, stamp_of, unsaved
from workflow.artifacts.store import command

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


def changed(scenes: Iterable[str], home: Path) -> Iterator[str]:
    """Yield one line for each input file whose content is not the one that the manifest of a stage names.

    Every content is hashed, whatever time stamps say, and what is found takes the place of what was kept, so that the next plan
    makes the stage again. A file that is gone is not compared: results outlive their inputs, and the next plan asks for it.

    Args:
        scenes: whose stages in results/ are compared.
        home: the checkout, from which the names of files of the program count.
    """
    kept, found = _kept(CACHE.absolute()), {}
    for scene in scenes:
        for path in sorted(Path("results", scene).glob(f"*/{MANIFEST}")):
            try:
                document = manifests.read(path)
            except manifests.Broken:  # of which `damaged` tells
                continue
            for name, digest in document.get("raw", {}).items():
                file = next((place for place in (Path(name), home / name) if place.is_file()), None)
                if file is None:
                    continue
                if file not in found:
                    stamp, found[file] = stamp_of(file), io.sha256_of(file)
                    kept.note(file, stamp, found[file])
                if found[file] != digest:
                    again = command(scene, document["stage"], document.get("quality"))
                    yield f"{file}: another content than {path.parent} was made from; rebuild with: {again}"
    kept.save(flushed=True)


@contextmanager
def saved_once() -> Iterator[None]:
    """Save the digests only once, at the end of the block: the file has an entry for every photograph of a batch."""
    try:
        with unsaved():
            yield
    finally:
        _kept(CACHE.absolute()).save(flushed=True)
