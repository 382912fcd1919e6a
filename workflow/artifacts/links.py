"""Symbolic links where the workflow writes: what is behind one would be overwritten or removed with what is made there.

`results`, `scenes` and the like (`KEPT`) may be links to another disk; nothing below them that jobs write to may be one.
"""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import IO, Any

from iif_core.errors import InputError
from workflow.intake.names import shown

KEPT = ("results", "scenes", "plan", "bench", "relight", "compare", "score")
"""Folders of the working folder that may be links themselves."""
RECORDS = ("benchmarks", "locks", "logs", "parts", "stamps")
"""Folders of a scene whose files are written in place by jobs, by Snakemake or by the shell. Stages put whole files in the place
of links (`write_atomically`), and `inside` refuses a folder of theirs that leads out."""


def found(results: Path, scene: str) -> list[Path]:
    """Return the links among the folder of a scene, what lies in it and in its records, and its deliverable."""
    home, scenes = results / scene, results.parent / "scenes"
    places = [home, *(scenes / name for name in (scene, f".{scene}.tmp", f".{scene}.old"))]
    links = [str(place) for place in places if place.is_symlink()]
    if home.is_symlink():
        return [Path(link) for link in links]
    for folder in (home, *(home / name for name in RECORDS)):
        try:
            with os.scandir(folder) as entries:
                links += [entry.path for entry in entries if entry.is_symlink()]
        except (FileNotFoundError, NotADirectoryError):  # whoever writes there reports what is in the way
            continue
    return sorted({Path(link) for link in links})


def refuse(results: Path, scene: str) -> None:
    """Refuse to work on a scene, or on another folder of the results, with a link where jobs write.

    Raises:
        InputError: there is one; the message says which, and what to do.
    """
    for link in found(results, scene):
        raise refused(link)


def check_folders(results: Path, scene: str, *stages: str) -> None:
    """Look at the folder of a scene, of its deliverable, of its records and of some stages, as `check_folder`.

    Raises:
        InputError: as `check_folder`.
    """
    home = results / scene
    for folder in (results.parent / "scenes" / scene, home, *(home / name for name in (*RECORDS, *stages))):
        check_folder(str(folder))


def check_folder(folder: str) -> None:
    """Refuse a file in the place of a folder, which Snakemake would take for the finished folder, and a link, behind which it
    would remove and write.

    Raises:
        InputError: there is one.
    """
    if os.path.islink(folder):
        raise refused(Path(folder))
    if os.path.lexists(folder) and not os.path.isdir(folder):
        raise InputError(f"{folder}: a file, where the workflow makes a folder. Move it away.")


def refused(link: Path) -> InputError:
    """Return the error that names a link, and what to do."""
    try:
        target = f" to {shown(os.readlink(link))}"
    except OSError:  # it has just been removed
        target = ""
    top = next((part for part in link.parts if part in KEPT), "results")
    return InputError(
        f"{link}: a symbolic link{target}, and what is behind it would be overwritten or removed. Remove the link, or put what it"
        f" leads to in its place; to keep it on another disk, make `{top}` itself a link"
    )


def open_there(path: Path | str, mode: str) -> IO[Any]:
    """Open a text file for writing, not through a link.

    Raises:
        InputError: it is a link.
        OSError: as `open`.
    """
    try:
        return open(path, mode, opener=lambda name, flags: os.open(name, flags | os.O_NOFOLLOW, 0o666))
    except OSError as error:
        if error.errno != errno.ELOOP:
            raise
        raise refused(Path(path)) from None
