"""Compare every artefact under `results/` and `scenes/` with its manifest."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from iif_core.errors import InputError
from workflow.artifacts import files as io
from workflow.artifacts.store import MANIFEST, PARTS, StageReader, chosen, command


def damaged(root: Path = Path("."), scenes: list[str] | None = None) -> Iterator[str]:
    """Yield one line for each damaged, missing or unlisted file, and for each folder that is gone although others need it."""
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
        listed = set(reader.names()) | {MANIFEST, PARTS}
        for path in sorted(manifest.parent.rglob("*")):
            if path.is_file() and str(path.relative_to(manifest.parent)) not in listed:
                yield f"{path}: not written by rule {stage} (not in its manifest); remove it"
    for scene in with_artefacts(root):
        if scenes and scene not in scenes:
            continue
        for line in _gone(root, scene):
            upstream.add(scene)
            yield line
    for scene in with_artefacts(root):
        if scenes and scene not in scenes:
            continue
        yield from _published(root, scene, scene in upstream)


def with_artefacts(root: Path = Path(".")) -> list[str]:
    """Return the scenes of which `results/` or `scenes/` holds something, sorted."""
    results = {path.parents[1].name for path in root.glob(f"results/*/*/{MANIFEST}")}
    return sorted(results | {path.name for path in root.glob("scenes/*") if "." not in path.name})


def _gone(root: Path, scene: str) -> Iterator[str]:
    """Yield one line for each stage without a manifest from which something that is still there was made."""
    own = root / "results" / scene
    needed: dict[str, tuple[Path, str | None]] = {}  # stage -> what was made from it, and at which quality
    for path in [root / "scenes" / scene / MANIFEST, *sorted(own.glob(f"*/{MANIFEST}"))]:
        document = _document(path)
        made_from = document.get("inputs", document.get("fingerprints"))
        published = ["publish"] if path.parent.parent.name == "scenes" and document else []
        for stage in [*(made_from if isinstance(made_from, dict) else ()), *published]:
            needed.setdefault(stage, (path.parent, document.get("quality")))
    if (root / "relight" / scene).is_dir():
        needed.setdefault("relight", (root / "relight" / scene, None))
    if needed and not own.is_dir():
        made, quality = next(iter(needed.values()))
        yield f"{own}: missing, although {made} was made from it; rebuild with: {command(scene, 'publish', quality)}"
        return
    for stage, (made, quality) in sorted(needed.items()):
        path = own / stage / MANIFEST
        # Derived scenes of studies share equal results, and pictures of a scene may come from a plan of relightings.
        base = scene.split("--")[0]
        shared = [base, f"{base}--*"] if "--" in scene else [f"{scene}--relight-*"] if stage == "relight" else []
        if path.is_file() or any(any(root.glob(f"results/{name}/{stage}/{MANIFEST}")) for name in shared):
            continue
        again = f"snakemake --cores 2 results/{scene}/{stage}/{MANIFEST}{chosen(quality)}"
        again = command(scene, stage, quality) if stage == "publish" else again
        yield f"{path}: missing, although {made} was made from it; rebuild with: {again}"


def _published(root: Path, scene: str, damaged_results: bool) -> Iterator[str]:
    """Yield one line for each fault of `scenes/<scene>`."""
    folder, results = root / "scenes" / scene, root / "results" / scene
    if folder.is_dir():
        if (folder / MANIFEST).is_file():
            yield from _deliverable(folder / MANIFEST, scene, damaged_results)
        else:
            yield f"{folder / MANIFEST}: missing; rebuild with: {command(scene, 'publish', None)}"
    elif folder.exists():
        yield f"{folder}: a file where the folder of a scene belongs; move it away"
    else:
        finished = results / "publish" / MANIFEST
        if not finished.is_file():  # that of a scene of which the page alone was asked for was never published
            finished = results / "report" / MANIFEST if (results / "logs/publish.log").is_file() else finished
        if finished.is_file():
            again = command(scene, "publish", _document(finished).get("quality"))
            yield f"{folder}: missing, although it was published; {_first(damaged_results)}rebuild with: {again}"


def _document(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    return document if isinstance(document, dict) else {}


def _first(damaged_results: bool) -> str:
    return "repair results/ first (the lines above), then " if damaged_results else ""


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
    first = _first(damaged_results)
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
