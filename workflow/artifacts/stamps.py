"""What a plan compares instead of contents: size and time stamps of every artefact, as they were when its hash was last right.

`results/<scene>/stamps/<stage>.json` has them for a stage, `deliverable.json` for `scenes/<scene>`. They lie outside of the
manifests, because no two runs have the same time stamps. Where a file has another size or time stamp than is noted there, or
nothing is noted, its content is hashed and compared with the manifest. So a plan reads no artefact that nobody touched. The time
of the last change of the inode (ctime) is among the stamps, because a program can set the other one back, and not this one.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from workflow.artifacts import files as io
from workflow.artifacts import manifest as manifests
from workflow.artifacts.manifest import MANIFEST

DELIVERABLE = "deliverable"

Stamp = tuple[int, int, int]
NEVER: Stamp = (0, 0, 0)
"""What no file has."""


def stamp_of(status: os.stat_result) -> Stamp:
    """Return (bytes, time stamp of the content in ns, time stamp of the inode in ns)."""
    return status.st_size, status.st_mtime_ns, status.st_ctime_ns


@dataclass(frozen=True)
class Stamps:
    """What is noted of a folder.

    Attributes:
        scene, stage, fingerprint: of its manifest.
        manifest: SHA-256 of its manifest.
        inputs: stage -> (scene, SHA-256 of the manifest) from which it was made.
        files: name -> `stamp_of` the file, its manifest among them.
    """

    scene: str
    stage: str
    fingerprint: str
    manifest: str
    inputs: Mapping[str, tuple[str, str]]
    files: Mapping[str, Stamp]


def place(results: Path, scene: str, of: str) -> Path:
    """Return the file that has the stamps of a stage or of the deliverable."""
    return results / scene / "stamps" / f"{of}.json"


def load(path: Path) -> Stamps | None:
    """Return what is noted; None if nothing is, or nothing that can be read: the contents are compared then."""
    try:
        document = json.loads(io.read_record(path))
        inputs = {str(stage): (str(scene), str(digest)) for stage, (scene, digest) in document["inputs"].items()}
        files = {str(name): (int(size), int(mtime), int(ctime)) for name, (size, mtime, ctime) in document["files"].items()}
        words = (str(document[key]) for key in ("scene", "stage", "fingerprint", "manifest"))
        return Stamps(*words, inputs, files)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
        return None


def look(folder: Path, names: Iterable[str]) -> dict[str, Stamp]:
    """Return the stamps of files, `NEVER` of one that is not there.

    Look before the content is read: a file that changes after that has another stamp than is noted, and is read again.
    """
    out = {}
    for name in names:
        try:
            out[name] = stamp_of(os.stat(folder / name))
        except OSError:
            out[name] = NEVER
    return out


def note(
    path: Path,
    folder: Path,
    document: dict[str, Any],
    seen: Mapping[str, Stamp] | None = None,
    manifest: str = "",
    copy: bool = False,
    flushed: bool = True,
) -> None:
    """Note the sizes and time stamps of a folder whose files are what its manifest says.

    Args:
        path: where they are noted.
        folder: with the files.
        document: its manifest.
        seen: stamps that the files had before they were hashed; None = what they have now.
        manifest: SHA-256 of its manifest when `document` was read; empty = of what is there now.
        copy: whether the folder is a copy, which does not have its own manifest.
        flushed: as in `write_atomically`. A plan notes thousands of folders, and the next one compares the contents of those
            whose notes a power cut has taken.
    """
    names = [*([] if copy else [MANIFEST]), *document["files"]]
    seen = look(folder, names) if seen is None else seen
    inputs = document.get("inputs", {})
    io.write_json(
        path,
        {
            "scene": document.get("scene", ""),
            "stage": document.get("stage", ""),
            "fingerprint": document.get("fingerprint", ""),
            "manifest": manifest or io.sha256_of(folder / MANIFEST),
            "inputs": {stage: [facts.get("scene", ""), facts.get("manifest_sha256", "")] for stage, facts in inputs.items()},
            "files": {name: seen.get(name, NEVER) for name in names},
        },
        settled=flushed,
        flushed=flushed,
    )


def stamp_stage(results: Path, scene: str, stage: str, seen: Mapping[str, Stamp] | None = None) -> None:
    """Note the stamps of a stage that has just been written; `seen` is as in `note`."""
    folder = results / scene / stage
    note(place(results, scene, stage), folder, manifests.read(folder / MANIFEST), seen)


def touched(folder: Path, stamps: Stamps) -> list[str]:
    """Return the names of the files that are gone, or have another size or time stamp than is noted."""
    out = []
    prefix = f"{folder}/"
    for name, noted in stamps.files.items():
        try:
            status = os.stat(prefix + name)
        except OSError:
            out.append(name)
            continue
        if stamp_of(status) != noted:
            out.append(name)
    return out
