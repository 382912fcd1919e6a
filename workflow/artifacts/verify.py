"""Compare every artefact under `results/` and `scenes/` with its manifest."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

from iif_core.errors import InputError
from workflow.artifacts import files as io
from workflow.artifacts.store import MANIFEST, StageReader, command


def damaged(root: Path = Path("."), scenes: list[str] | None = None) -> Iterator[str]:
    """Yield one line for each damaged, missing or unlisted file."""
    upstream: set[str] = set()  # scenes with damaged results, which must be repaired before publishing
    for manifest in sorted(root.glob(f"results/*/*/{MANIFEST}")):
        stage, scene = manifest.parent.name, manifest.parent.parent.name
        if scenes and scene not in scenes:
            continue
        try:
            reader = StageReader(manifest.parent, stage, scene)
        except InputError as error:
            upstream.add(scene)
            yield str(error)
            continue
        for name in reader.names():
            try:
                reader.path(name)
            except InputError as error:
                upstream.add(scene)
                yield str(error)
        listed = set(reader.names()) | {MANIFEST}
        for path in sorted(manifest.parent.rglob("*")):
            if path.is_file() and str(path.relative_to(manifest.parent)) not in listed:
                yield f"{path}: not written by rule {stage} (not in its manifest); remove it"
    for manifest in sorted(root.glob(f"scenes/*/{MANIFEST}")):
        scene = manifest.parent.name
        if scenes and scene not in scenes:
            continue
        yield from _deliverable(manifest, scene, scene in upstream)
    for folder in sorted(root.glob("scenes/*")):
        if folder.is_dir() and (not scenes or folder.name in scenes) and not (folder / MANIFEST).is_file():
            yield f"{folder / MANIFEST}: missing; rebuild with: {command(folder.name, 'publish', None)}"


def absent(folder: Path, manifest: Path) -> list[str]:
    """Return the files of `folder` that are gone, sorted: those that `manifest` lists, or the manifest itself.

    Nothing is missing from a folder that does not exist. Only presence is checked; `damaged` compares contents.
    """
    if not folder.is_dir():
        return []
    try:
        listed = json.loads(manifest.read_text())["files"]
        return sorted(name for name in listed if not (folder / name).is_file())
    except (OSError, ValueError, KeyError, TypeError):
        return [manifest.name] if manifest.is_relative_to(folder) else []


def _deliverable(manifest: Path, scene: str, damaged_results: bool) -> Iterator[str]:
    first = "repair results/ first (the lines above), then " if damaged_results else ""
    try:
        document = json.loads(manifest.read_text())
        listed = document["files"]
    except (ValueError, KeyError, TypeError) as error:
        yield f"{manifest}: not readable ({error}); {first}rebuild with: {command(scene, 'publish', None)}"
        return
    again = f"{first}rebuild with: {command(scene, 'publish', document.get('quality'))}"
    for name, facts in sorted(listed.items()):
        path = manifest.parent / name
        if not path.is_file():
            yield f"{path}: missing; {again}"
        elif io.sha256_of(path) != facts["sha256"]:
            yield f"{path}: its content changed since it was published (sha256 differs); {again}"
