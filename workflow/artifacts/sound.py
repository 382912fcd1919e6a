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
from workflow.artifacts import links, stamps
from workflow.artifacts import manifest as manifests
from workflow.artifacts.manifest import EARLIER_SCHEMA, MANIFEST, SCENE_SCHEMA, STAGE_SCHEMA
from workflow.registry import SHARED

MOST_LINES = 3
"""Largest number of faults of one folder that are listed; the number of the others is added."""


@lru_cache(None)
def stage_faults(results: Path, scene: str, stage: str, fingerprint: str) -> tuple[str, ...]:
    """Return what is wrong with a finished stage, a line for each file; nothing if it is not finished.

    Args:
        results: folder of the results.
        scene, stage: which.
        fingerprint: under which it is wanted. For one that was made under another, as after a change of settings, the line is
            empty: it is to be made again, and there is nothing to tell.

    Raises:
        InputError: it is of an earlier schema and would otherwise be what is wanted; or a link is where jobs of the scene write.
    """
    _without_links(results, scene)
    folder, noted = results / scene / stage, stamps.place(results, scene, stage)
    if not (folder / MANIFEST).is_file():
        if noted.is_file():  # a job that starts removes it
            return (f"{folder if not folder.is_dir() else folder / MANIFEST}: missing, although it was finished",)
        # What its last job left unfinished is tried again, also where what was made from an earlier one is still there.
        return ("",) if _ended_badly(results / scene / "logs" / f"{stage}.state.json", fingerprint) else ()
    return tuple(_faults(folder, noted, STAGE_SCHEMA, scene, stage, fingerprint))


def _ended_badly(state: Path, fingerprint: str) -> bool:
    """Whether the last job of a stage did not end well, and was planned as what is wanted or run by hand.

    Args:
        state: file that the job left (`workflow/runtime/job_state.py`); a job that ends well deletes it.
        fingerprint: under which the stage is wanted.
    """
    try:
        document = json.loads(io.read_record(state))
        return document["state"] in ("started", "failed") and document["fingerprint"] in ("", fingerprint)
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return False


def _faults(folder: Path, noted: Path, schema: str, scene: str, stage: str, fingerprint: str) -> Iterator[str]:
    known = stamps.load(noted)
    own = known is not None and (known.scene, known.stage) == (scene, stage)
    different = stamps.touched(folder, known) if known and own else None
    if known and different == []:
        yield from _broken_chain(folder, known.inputs) if known.fingerprint == fingerprint else [""]
        return
    seen = stamps.look(folder, [MANIFEST])
    try:
        document, digest = manifests.load(folder / MANIFEST, schema)
    except manifests.Broken as error:
        yield "" if _is_earlier(folder, fingerprint) else f"{folder / MANIFEST}: {error}"
        return
    found = document.get("scene"), document.get("stage", stage)
    if found != (scene, stage):
        owner = f"stage {found[1]} of scene {found[0]}" if stage else f"scene {found[0]}"
        yield f"{folder / MANIFEST}: it belongs to {owner}, and was put here"
        return
    if document.get("fingerprint") != fingerprint:
        put = known and own and known.fingerprint == fingerprint
        yield f"{folder / MANIFEST}: it belongs to other settings, inputs or code, and was put here" if put else ""
        return
    some = None  # whose contents are compared: all
    if known and different and (MANIFEST not in different or digest == known.manifest):
        some = [name for name in different if name != MANIFEST]  # Snakemake touches a manifest when its job has ended
        seen = {**known.files, **seen, **stamps.look(folder, some)}
    else:
        seen |= stamps.look(folder, document["files"])
    problems = list(wrong_files(folder, document, some))
    yield from problems
    if not problems:
        stamps.note(noted, folder, document, seen, digest, flushed=False)
        yield from _broken_chain(folder, {k: (v.get("scene", ""), v.get("manifest_sha256", "")) for k, v in _inputs(document)})


def _is_earlier(folder: Path, fingerprint: str) -> bool:
    """Whether the manifest is of the earlier schema and of other settings than are wanted; one of the same is refused."""
    try:
        document = json.loads(io.read_record(folder / MANIFEST))
        if document["schema"] != EARLIER_SCHEMA:
            return False
        same = document["fingerprint"] == fingerprint
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return False
    if same:
        raise InputError(
            f"{folder / MANIFEST}: schema {EARLIER_SCHEMA!r}, this version reads {STAGE_SCHEMA!r}. `python -m workflow upgrade"
            f" {folder.parent.name}` checks what is there and brings it up to date; or move {folder.parent} away to make it again"
        )
    return True


def _inputs(document: dict[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    inputs = document.get("inputs", {})
    return list(inputs.items()) if isinstance(inputs, dict) else []


def wrong_files(folder: Path, document: dict[str, Any], names: list[str] | None = None) -> Iterator[str]:
    """Yield a line for each listed file that is missing or has another content.

    Args:
        folder: with the files.
        document: its manifest.
        names: which to look at; None = all.
    """
    for name, facts in sorted(document["files"].items()):
        if names is not None and name not in names:
            continue
        path = folder / name
        try:
            io.inside(folder, name)
        except InputError as error:
            yield str(error)
            continue
        try:
            if not path.is_file():
                yield f"{path}: missing"
            elif (size := path.stat().st_size) != facts["bytes"]:
                yield f"{path}: {size} bytes on disk, {facts['bytes']} were written"
            elif io.sha256_of(path) != facts["sha256"]:
                yield f"{path}: its content changed since it was written (sha256 differs)"
        except FileNotFoundError:  # a job that makes it again has removed it meanwhile
            yield f"{path}: missing"


def _broken_chain(folder: Path, inputs: Any) -> Iterator[str]:
    """Yield a line if a stage that is there is not the one from which this one was made."""
    results = folder.parent.parent
    for name, (scene, digest) in inputs.items():
        stage = name.removeprefix(SHARED)
        found = _digest_of(results, scene, stage)
        if found is not None and found != digest:
            yield f"{folder}: it was made from another {results / scene / stage} than is there now"
            return


@lru_cache(None)
def _digest_of(results: Path, scene: str, stage: str) -> str | None:
    """Return the SHA-256 of the manifest of a stage; None if it is not finished."""
    path = results / scene / stage / MANIFEST
    try:
        status = path.stat()
    except OSError:
        return None
    if not path.is_file():
        return None
    known = stamps.load(stamps.place(results, scene, stage))
    if known and known.files.get(MANIFEST) == stamps.stamp_of(status):
        return known.manifest
    return io.sha256_of(path)


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
    return tuple(_faults(folder, stamps.place(results, scene, stamps.DELIVERABLE), SCENE_SCHEMA, scene, "", fingerprint))


@lru_cache(None)
def copy_faults(folder: Path, results: Path, scene: str, stage: str) -> tuple[str, ...]:
    """Return what is wrong with a folder that is a copy of a stage, a line for each file; nothing if one of both is not there.

    Raises:
        InputError: a link is where jobs of the scene write.
    """
    _without_links(results, scene)
    source = results / scene / stage / MANIFEST
    if not folder.is_dir() or not source.is_file():
        return ()
    noted = stamps.place(results, scene, f"{stage} {folder.name}")
    known = stamps.load(noted)
    if known and known.manifest == _digest_of(results, scene, stage) and not stamps.touched(folder, known):
        return ()
    try:
        document, digest = manifests.load(source)
    except manifests.Broken:
        return ()  # the stage itself reports this
    seen = stamps.look(folder, document["files"])
    problems = tuple(wrong_files(folder, document))
    if not problems:
        stamps.note(noted, folder, document, seen, digest, copy=True, flushed=False)
    return problems


@lru_cache(None)
def _without_links(results: Path, scene: str) -> None:
    """Look for links once in a plan, before it notes anything."""
    links.refuse(results, scene)


def forget() -> None:
    """Compare anew what was compared: the results are kept for one plan."""
    for compared in (stage_faults, deliverable_faults, copy_faults, _digest_of, _without_links):
        compared.cache_clear()


def told(lines: tuple[str, ...], again: str) -> str:
    """Return the faults of a folder in one text for people, with what is done about them."""
    lines = tuple(line for line in lines if line)
    if not lines:
        return ""
    shown = [*lines[:MOST_LINES], *([f"and {len(lines) - MOST_LINES} more"] if len(lines) > MOST_LINES else [])]
    return "\n".join(shown) + f"\n{again}"
