"""Compare every artefact under `results/` and `scenes/` with its manifest."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from iif_core.errors import InputError
from workflow.artifacts import files as io
from workflow.artifacts import manifest as manifests
from workflow.artifacts.manifest import MANIFEST, SCENE_SCHEMA
from workflow.artifacts.sound import wrong_files
from workflow.artifacts.store import PARTS, StageReader, chosen, command
from workflow.registry import SHARED


def damaged(root: Path = Path("."), scenes: list[str] | None = None) -> Iterator[str]:
    """Yield one line for each file that is not what was written, is missing or unlisted, and for each link of the chain that is
    broken: a folder that is gone although others were made from it, and a stage that is not the one from which they were made.

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
    listed = set(reader.names()) | {MANIFEST, PARTS}
    for path in sorted(folder.rglob("*")):
        if not path.is_dir() and str(path.relative_to(folder)) not in listed:
            yield f"{path}: not written by rule {stage} (not in its manifest); remove it"
    results = folder.parent.parent
    for name, facts in sorted(reader.manifest.get("inputs", {}).items()):
        up = results / facts["scene"] / name.removeprefix(SHARED) / MANIFEST
        if up.is_file() and io.sha256_of(up) != facts["manifest_sha256"]:
            again = command(scene, stage, quality)
            yield f"{folder}: it was made from another {up.parent} than is there now; rebuild with: {again}"


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
            needed.setdefault(stage, (path.parent, _quality(document.get("quality"))))
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
            yield from _deliverable(folder / MANIFEST, scene, results, damaged_results)
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
            aside = folder.with_name(f".{scene}.old")
            kept = f" (an earlier one is in {aside})" if aside.is_dir() else ""
            yield f"{folder}: missing, although it was published{kept}; {_first(damaged_results)}rebuild with: {again}"


def _document(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_text()) if path.is_file() else {}
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
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if not path.is_dir() and name != MANIFEST and name not in document["files"] and not name.startswith("."):
            yield f"{path}: not published (not in {manifest}); move it away, or it is lost when the scene is published again"
    for stage, digest in sorted(document.get("manifests", {}).items()):
        up = results / stage / MANIFEST
        if up.is_file() and io.sha256_of(up) != digest:
            yield f"{folder}: it was made from another {up.parent} than is there now; {again}"
            return
    own = _document(results / "publish/published.json").get("manifest_sha256")
    if own is not None and own != io.sha256_of(manifest):
        yield f"{manifest}: it is not the one that {results / 'publish'} wrote; {again}"


def _quality(found: Any) -> str | None:
    return found if isinstance(found, str) and found.isidentifier() else None
