"""Compare every artefact under `results/` and `scenes/` with its manifest."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from iif_core.errors import InputError
from workflow.artifacts import files as io
from workflow.artifacts import links, stamps
from workflow.artifacts import manifest as manifests
from workflow.artifacts.manifest import MANIFEST, SCENE_SCHEMA
from workflow.artifacts.sound import wrong_files
from workflow.artifacts.store import PARTS, UNFINISHED, StageReader, chosen, command
from workflow.registry import SHARED, STAGES

OF_SNAKEMAKE = ".snakemake_timestamp"
"""What Snakemake leaves in a folder that is an output."""


def damaged(root: Path = Path("."), scenes: list[str] | None = None) -> Iterator[str]:
    """Yield one line for each file that is not what was written, is missing or unlisted, for each symbolic link in its place, and
    for each broken link of the chain: a folder that is missing although others were made from it, a stage whose manifest is
    missing, and a stage that is not the one from which others were made.

    Every content is hashed, whatever time stamps say.
    """
    upstream: set[str] = set()  # scenes with damaged results, which must be repaired before publishing
    for manifest in sorted(root.glob(f"results/*/*/{MANIFEST}")):
        stage, scene = manifest.parent.name, manifest.parent.parent.name
        if scenes and scene not in scenes:
            continue
        for line in _stage(manifest.parent, stage, scene):
            upstream.add(scene)
            yield line
    for scene in with_artefacts(root):
        if scenes and scene not in scenes:
            continue
        yield from (str(links.refused(link)) for link in links.found(root / "results", scene))
        for line in _gone(root, scene):
            upstream.add(scene)
            yield line
    for scene in with_artefacts(root):
        if scenes and scene not in scenes:
            continue
        yield from _published(root, scene, scene in upstream)


def _stage(folder: Path, stage: str, scene: str) -> Iterator[str]:
    try:
        reader = StageReader(folder, stage, scene)
    except InputError as error:
        yield str(error)
        return
    quality = reader.manifest.get("quality")
    for name in reader.names():
        try:
            reader.path(name)
        except InputError as error:
            yield str(error)
    yield from _parts(folder, reader, quality)
    listed = set(reader.names()) | {MANIFEST, PARTS}
    for path, name in _entries(folder):
        if name not in listed:
            yield f"{path}: not written by rule {stage} (not in its manifest); remove it"
        elif path.is_symlink():
            yield f"{path}: a symbolic link in the place of a file; rebuild with: {command(scene, stage, quality)}"
    results = folder.parent.parent
    for name, facts in sorted(reader.manifest.get("inputs", {}).items()):
        up = results / facts["scene"] / name.removeprefix(SHARED) / MANIFEST
        if up.is_file() and io.sha256_of(up) != facts["manifest_sha256"] and not _is_broken(up):
            again = command(scene, stage, quality)
            yield f"{folder}: it was made from another {up.parent} than is there now; rebuild with: {again}"


def _is_broken(manifest: Path) -> bool:
    """Whether a manifest was changed. Its own stage reports that, and not each stage that was made from it."""
    try:
        manifests.read(manifest)
    except manifests.Broken:
        return True
    return False


def _entries(folder: Path) -> Iterator[tuple[Path, str]]:
    """Yield path and name of every file and every link below a folder, sorted."""
    for path in sorted(folder.rglob("*")):
        if path.is_symlink() or not path.is_dir():
            yield path, path.relative_to(folder).as_posix()


def _parts(folder: Path, reader: StageReader, quality: str | None) -> Iterator[str]:
    """Yield a line if the notes of parts that later jobs take over are not those of the stage. If they are gone, that costs time
    alone."""
    path = folder / PARTS
    if not path.exists():
        return
    try:
        noted = manifests.sealed(io.read_record(path)).get("parts")
        notes = [manifests.part(note) for note in noted.values()] if isinstance(noted, dict) else []
        problem = "" if notes else "it has no notes of parts"
    except (OSError, manifests.Broken) as error:
        notes, problem = [], str(error)
    written = reader.manifest["files"]
    if any(written.get(name, {}).get("sha256") != facts["sha256"] for note in notes for name, facts in note["files"].items()):
        problem = "it lists other files than the manifest"
    if problem:
        yield f"{path}: {problem}; rebuild with: {command(reader.scene, reader.stage, quality)}"


def with_artefacts(root: Path = Path(".")) -> list[str]:
    """Return the scenes of which `results/` or `scenes/` holds something, sorted."""
    results = {path.parent.name for path in root.glob("results/*/*") if path.name in STAGES}
    return sorted(results | {path.name for path in root.glob("scenes/*") if "." not in path.name})


def _gone(root: Path, scene: str) -> Iterator[str]:
    """Yield one line for each stage without a manifest that was finished, or from which something that is there was made."""
    results, folder = root / "results", root / "scenes" / scene
    own = results / scene
    needed: dict[Path, tuple[Path, str | None]] = {}  # folder of a stage -> what was made from it, and at which quality
    for path in sorted(own.glob(f"*/{MANIFEST}")):
        document = _document(path)
        inputs = document.get("inputs")
        for name, facts in (inputs if isinstance(inputs, dict) else {}).items():
            home = facts.get("scene") if isinstance(facts, dict) else None
            needed.setdefault(
                results / (home if isinstance(home, str) else scene) / name.removeprefix(SHARED),
                (path.parent, _quality(document.get("quality"))),
            )
    if document := _document(folder / MANIFEST):
        made_from = document.get("fingerprints")
        for stage in [*(made_from if isinstance(made_from, dict) else ()), "publish"]:
            needed.setdefault(_home(results, scene, stage, document), (folder, _quality(document.get("quality"))))
    if (root / "relight" / scene).is_dir() and not any(root.glob(f"results/{scene}--relight-*/relight/{MANIFEST}")):
        needed.setdefault(own / "relight", (root / "relight" / scene, None))
    if needed and not own.is_dir():
        made, quality = next(iter(needed.values()))
        yield f"{own}: missing, although {made} was made from it; rebuild with: {command(scene, 'publish', quality)}"
        return
    for stage in STAGES:
        if _lost(own, stage):
            needed.setdefault(own / stage, (own / stage, None))
    for home, (made, quality) in sorted(needed.items()):
        if (home / MANIFEST).is_file():
            continue
        again = f"snakemake --cores 2 results/{home.parent.name}/{home.name}/{MANIFEST}{chosen(quality)}"
        again = command(scene, "publish", quality) if home.name == "publish" else again
        why = "it was finished" if made == home else f"{made} was made from it"
        yield f"{home / MANIFEST}: missing, although {why}; rebuild with: {again}"


def _home(results: Path, scene: str, stage: str, document: dict[str, Any]) -> Path:
    """Return the folder of the stage that a deliverable was made from. Variants of a study share equal results: if this one has
    no manifest, it is the folder of the variant whose manifest the deliverable names."""
    own, listed = results / scene / stage, document.get("manifests")
    digest = listed.get(stage) if isinstance(listed, dict) else None
    if "--" in scene and digest and not (own / MANIFEST).is_file():
        base = scene.split("--")[0]
        for path in sorted([*results.glob(f"{base}/{stage}/{MANIFEST}"), *results.glob(f"{base}--*/{stage}/{MANIFEST}")]):
            if io.sha256_of(path) == digest:
                return path.parent
    return own


def _lost(own: Path, stage: str) -> bool:
    """Whether a stage without a manifest was finished: its stamps are there, or files that no job left unfinished. A job that did
    not end well leaves the file of its state, and one that made a part its note."""
    if (own / stage / MANIFEST).is_file():
        return False
    if stamps.place(own.parent, own.name, stage).is_file():
        return True
    unfinished = (own / "logs" / f"{stage}.state.json").exists() or (own / stage / UNFINISHED).exists()
    return not unfinished and any(True for _ in _entries(own / stage))


def _published(root: Path, scene: str, damaged_results: bool) -> Iterator[str]:
    """Yield one line for each fault of `scenes/<scene>`."""
    folder, results = root / "scenes" / scene, root / "results" / scene
    if folder.is_dir():
        if (folder / MANIFEST).is_file():
            yield from _deliverable(folder / MANIFEST, scene, results, damaged_results)
        else:
            yield f"{folder / MANIFEST}: missing; rebuild with: {command(scene, 'publish', None)}"
    elif folder.exists():
        yield f"{folder}: a file where the folder of a scene belongs; move it away"
    else:
        finished = results / "publish" / MANIFEST
        if not finished.is_file():  # if only the page of a scene was asked for, nothing was published
            finished = results / "report" / MANIFEST if (results / "logs/publish.log").is_file() else finished
        if finished.is_file():
            again = command(scene, "publish", _document(finished).get("quality"))
            aside = folder.with_name(f".{scene}.old")
            kept = f" (an earlier one is in {aside})" if aside.is_dir() else ""
            yield f"{folder}: missing, although it was published{kept}; {_first(damaged_results)}rebuild with: {again}"


def _document(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(io.read_record(path))
    except (OSError, ValueError, RecursionError):
        return {}
    return document if isinstance(document, dict) else {}


def _first(damaged_results: bool) -> str:
    return "repair results/ first (the lines above), then " if damaged_results else ""


def _deliverable(manifest: Path, scene: str, results: Path, damaged_results: bool) -> Iterator[str]:
    first, folder = _first(damaged_results), manifest.parent
    try:
        document = manifests.read(manifest, SCENE_SCHEMA)
    except manifests.Broken as error:
        again = command(scene, "publish", _quality(_document(manifest).get("quality")))
        yield f"{manifest}: {error}; {first}rebuild with: {again}"
        return
    again = f"{first}rebuild with: {command(scene, 'publish', document.get('quality'))}"
    if document.get("scene") != scene:
        yield f"{manifest}: it belongs to scene {document.get('scene')}, and was put here; {again}"
        return
    for line in wrong_files(folder, document):
        yield f"{line}; {again}"
    for path, name in _entries(folder):
        if path.is_symlink() and name in (MANIFEST, *document["files"]):
            yield f"{path}: a symbolic link in the place of a file; {again}"
        elif name not in (MANIFEST, OF_SNAKEMAKE, *document["files"]):
            yield f"{path}: not published (not in {manifest}); move it away, or it is lost when the scene is published again"
    for stage, digest in sorted(document.get("manifests", {}).items()):
        up = results / stage / MANIFEST
        if up.is_file() and io.sha256_of(up) != digest and not _is_broken(up):
            yield f"{folder}: it was made from another {up.parent} than is there now; {again}"
            return
    for name, stage in _copied(results, document):
        yield f"{folder / name}: it is not what rule {stage} wrote, {results / stage / name}; {again}"
    own = _document(results / "publish/published.json").get("manifest_sha256")
    if own is not None and own != io.sha256_of(manifest):
        yield f"{manifest}: it is not the one that {results / 'publish'} wrote; {again}"


def _copied(results: Path, document: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield (name, stage) for each file of a deliverable that differs from the file of the same name in every stage."""
    listed: dict[str, dict[str, str]] = {}
    for stage in document.get("manifests", {}):
        made = _document(results / stage / MANIFEST).get("files")
        for name, facts in (made if isinstance(made, dict) else {}).items():
            if name in document["files"] and isinstance(facts, dict):
                listed.setdefault(name, {})[stage] = str(facts.get("sha256"))
    for name, digests in sorted(listed.items()):
        if document["files"][name]["sha256"] not in digests.values():
            yield name, next(iter(digests))


def _quality(found: Any) -> str | None:
    return found if isinstance(found, str) and found.isidentifier() else None
