"""Whether what a plan takes for finished is what was written: compared when Snakemake plans, by time stamps where they suffice.

`workflow.artifacts.verify` compares every content, whatever the time stamps say.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

from iif_core.errors import InputError
from workflow.artifacts import files as io
from workflow.artifacts import links
from workflow.artifacts import manifest as manifests
from workflow.artifacts.manifest import MANIFEST, SCENE_SCHEMA, STAGE_SCHEMA
from workflow.artifacts.stamps import DELIVERABLE, Stamps, place, stamp_of
from workflow.registry import SHARED

MOST_LINES = 3
"""Largest number of faults of one folder that are listed; the number of the others is added."""


@lru_cache(None)
def stage_faults(results: Path, scene: str, stage: str, fingerprint: str) -> tuple[str, ...]:
    """Return what is wrong with a finished stage, a line for each file; nothing if it never was finished.

    Args:
        results: folder of the results.
        scene, stage: which.
        fingerprint: under which it is wanted. For one that was made under another, as after a change of settings, the line is
            empty: it is to be made again, and there is nothing to tell.

    Raises:
        InputError: a link is where jobs of the scene write.
    """
    _without_links(results, scene)
    folder = results / scene / stage
    if not (folder / MANIFEST).is_file():  # a job that makes it again and is killed leaves the stamps as well
        gone = folder / MANIFEST if folder.is_dir() else folder
        return (f"{gone}: missing, although it was finished",) if place(results, scene, stage).is_file() else ()
    return tuple(_faults(folder, _noted(results, scene, stage), STAGE_SCHEMA, {"scene": scene, "stage": stage}, fingerprint))


@lru_cache(None)
def deliverable_faults(folder: Path, results: Path, scene: str, fingerprint: str) -> tuple[str, ...]:
    """Return what is wrong with `scenes/<scene>`, a line for each file; nothing if there is no such folder.

    Args:
        folder: of the deliverable.
        results: folder of the results.
        scene: which.
        fingerprint: of stage `publish` under which it is wanted, as for `stage_faults`.

    Raises:
        InputError: a link is where jobs of the scene write.
    """
    _without_links(results, scene)
    if not folder.is_dir():
        return ()
    if not (folder / MANIFEST).is_file():
        return (f"{folder / MANIFEST}: missing",)
    noted = _noted(results, scene, DELIVERABLE)
    return tuple(_faults(folder, noted, SCENE_SCHEMA, {"scene": scene}, fingerprint))


def _faults(folder: Path, noted: Stamps, schema: str, owner: dict[str, str], fingerprint: str) -> Iterator[str]:
    try:
        document, _ = _manifest(folder / MANIFEST, noted, schema)
    except manifests.Broken as error:
        yield f"{folder / MANIFEST}: {error}"
        return
    if found := of_another(document, owner):
        yield f"{folder / MANIFEST}: {found}"
    elif document.get("fingerprint") != fingerprint:
        yield ""
    elif problems := list(wrong_files(folder, document, noted)):
        yield from problems
    else:
        yield from made_from_another(folder, document)
    noted.save()


def _manifest(path: Path, noted: Stamps, schema: str) -> tuple[dict[str, Any], str]:
    """Return the content and the SHA-256 of a manifest. The seal of one that nobody touched is not compared again."""
    if known := noted.known(path):
        return json.loads(io.read_record(path)), known
    stamp = stamp_of(path)
    document, digest = manifests.load(path, schema)
    noted.note(path, stamp, digest)
    return document, digest


def of_another(document: dict[str, Any], owner: dict[str, str]) -> str:
    """Return whose manifest it is, if it is not the manifest of `owner` (scene and, for a stage, stage); else an empty text."""
    found = {key: document.get(key) for key in owner}
    if found == owner:
        return ""
    return f"it belongs to {' of '.join(f'{key} {found[key]}' for key in reversed(owner))}, and was put here"


def wrong_files(folder: Path, document: dict[str, Any], noted: Stamps | None = None) -> Iterator[str]:
    """Yield a line for each listed file that is missing or has another content.

    Args:
        folder: with the files.
        document: its manifest.
        noted: hashes of those that nobody touched; the others are read. None = all are read.
    """
    for name, facts in sorted(document["files"].items()):
        path = f"{folder}/{name}"
        if noted and noted.known(path) == facts["sha256"]:
            continue
        try:
            fault = io.fault_of(io.inside(folder, name), facts, noted.of if noted else io.sha256_of)
        except InputError as error:
            yield str(error)
            continue
        if fault:
            yield f"{path}: {fault}"


def made_from_another(folder: Path, document: dict[str, Any]) -> Iterator[str]:
    """Yield a line if a stage that is there is not the one from which that of `folder` was made."""
    results = folder.parent.parent
    for name, facts in document.get("inputs", {}).items():
        source = results / facts["scene"] / name.removeprefix(SHARED)
        found = _digest_of(results, facts["scene"], name.removeprefix(SHARED))
        if found is not None and found != facts["manifest_sha256"]:
            yield f"{folder}: it was made from another {source} than is there now"
            return


@lru_cache(None)
def _digest_of(results: Path, scene: str, stage: str) -> str | None:
    """Return the SHA-256 of the manifest of a stage; None if it is not there or damaged, as its own stage reports."""
    path, noted = results / scene / stage / MANIFEST, _noted(results, scene, stage)
    try:
        return noted.known(path) or _manifest(path, noted, STAGE_SCHEMA)[1]
    except manifests.Broken:
        return None


@lru_cache(None)
def copy_faults(folder: Path, results: Path, scene: str, stage: str) -> tuple[str, ...]:
    """Return what is wrong with a folder that is a copy of a stage, a line for each file; nothing if one of both is not there.

    Raises:
        InputError: a link is where jobs of the scene write.
    """
    _without_links(results, scene)
    source, noted = results / scene / stage / MANIFEST, _noted(results, scene, f"{stage} {folder.name}")
    if not folder.is_dir() or not source.is_file():
        return ()
    try:
        document, _ = _manifest(source, noted, STAGE_SCHEMA)
    except manifests.Broken:
        return ()  # the stage itself reports this
    problems = tuple(wrong_files(folder, document, noted))
    noted.save()
    return problems


@lru_cache(64)
def _noted(results: Path, scene: str, of: str) -> Stamps:
    """Return the stamps of a folder; those of a scene are kept while its stages are compared with one another."""
    return Stamps(place(results, scene, of))


@lru_cache(None)
def _without_links(results: Path, scene: str) -> None:
    """Look for links once in a plan, before it notes anything."""
    links.refuse(results, scene)


def forget() -> None:
    """Compare anew what was compared: the results are kept for one plan."""
    for compared in (stage_faults, deliverable_faults, copy_faults, _digest_of, _noted, _without_links):
        compared.cache_clear()


def told(lines: tuple[str, ...], again: str) -> str:
    """Return the faults of a folder in one text for people, with what is done about them."""
    lines = tuple(line for line in lines if line)
    if not lines:
        return ""
    shown = [*lines[:MOST_LINES], *([f"and {len(lines) - MOST_LINES} more"] if len(lines) > MOST_LINES else [])]
    return "\n".join(shown) + f"\n{again}"
