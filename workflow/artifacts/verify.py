"""Compare every artefact under `results/` and `scenes/` with its manifest."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from workflow.artifacts import files as io
from workflow.artifacts import links
from workflow.artifacts import manifest as manifests
from workflow.artifacts.kept import OF_SNAKEMAKE
from workflow.artifacts.manifest import MANIFEST, SCENE_SCHEMA, STAGE_SCHEMA
from workflow.artifacts.sound import forget, made_from_another, of_another, wrong_files
from workflow.artifacts.stamps import place
from workflow.artifacts.store import PARTS, chosen, command, quality_in
from workflow.registry import SHARED, STAGES


def with_artefacts(root: Path = Path(".")) -> list[str]:
    """Return the scenes of which `results/` or `scenes/` holds something, sorted."""
    results = {path.parent.name for path in root.glob("results/*/*") if path.name in STAGES}
    return sorted(results | {path.name for path in root.glob("scenes/*") if "." not in path.name})


def damaged(root: Path = Path("."), scenes: list[str] | None = None) -> Iterator[str]:
    """Yield one line for each file that is not what was written, is missing or unlisted, for each symbolic link in its place, and
    for each broken link of the chain: a stage that is missing although others were made from it, and one that is not the one from
    which others were made.

    Every content is hashed, whatever time stamps say.
    """
    forget()
    for scene in with_artefacts(root) if not scenes else scenes:
        results, harmed = root / "results", False
        if of := _kept_copy_of(root, scene):
            yield from _copy(root / "scenes" / scene, of)
            continue
        for line in _of_results(results, scene):
            harmed = True
            yield line
        yield from (str(links.refused(link)) for link in links.found(results, scene))
        first = "repair results/ first (the lines above), then " if harmed else ""
        yield from _published(root, scene, first)


def _kept_copy_of(root: Path, scene: str) -> str:
    """Return the scene whose deliverable the user keeps under another name, of which nothing was made; "" if this is none."""
    owner = _document(root / "scenes" / scene / MANIFEST, SCENE_SCHEMA).get("scene", "")
    return "" if owner == scene or (root / "results" / scene).exists() else owner


def _copy(folder: Path, scene: str) -> Iterator[str]:
    """Yield one line for each file of a kept copy that is not what its own manifest says."""
    for line in wrong_files(folder, _document(folder / MANIFEST, SCENE_SCHEMA)):
        yield f"{line}; {folder} is a copy of scenes/{scene}, which no command makes again: copy it anew, or remove it"


def _of_results(results: Path, scene: str) -> Iterator[str]:
    needed = _needed(results, scene)
    if needed and not (results / scene).is_dir():
        made, quality = next(iter(needed.values()))
        again = command(scene, "publish", quality)
        yield f"{results / scene}: missing, although {made} was made from it; rebuild with: {again}"
        return
    for stage in STAGES:
        folder = results / scene / stage
        if (folder / MANIFEST).is_file():
            yield from _folder(folder, STAGE_SCHEMA, {"scene": scene, "stage": stage})
        elif place(results, scene, stage).is_file():
            needed.setdefault(folder, (folder, None))
    for stage, (made, quality) in sorted(needed.items()):
        if not (stage / MANIFEST).is_file():
            again = f"snakemake --cores 2 results/{stage.parent.name}/{stage.name}/{MANIFEST}{chosen(quality)}"
            again = command(scene, "publish", quality) if stage.name == "publish" else again
            why = "it was finished" if made == stage else f"{made} was made from it"
            yield f"{stage / MANIFEST}: missing, although {why}; rebuild with: {again}"


def _needed(results: Path, scene: str) -> dict[Path, tuple[Path, str | None]]:
    """Return each stage from which something that is there was made: what that is, and its quality."""
    found = {}
    folder = results.parent / "scenes" / scene
    if document := _document(folder / MANIFEST, SCENE_SCHEMA):
        # Variants of a study share equal stages; what each of them was made from is looked for stage by stage.
        stages = ["publish"] if "--" in scene else [*document.get("fingerprints", {}), "publish"]
        found = {results / scene / stage: (folder, document.get("quality")) for stage in stages}
    for path in sorted((results / scene).glob(f"*/{MANIFEST}"), reverse=True):
        document = _document(path)
        for name, facts in document.get("inputs", {}).items():
            found[results / facts["scene"] / name.removeprefix(SHARED)] = path.parent, document.get("quality")
    return found


def _document(path: Path, schema: str = STAGE_SCHEMA) -> dict[str, Any]:
    """Return the content of a manifest; nothing if there is none, or a damaged one, of which its own folder tells."""
    try:
        return manifests.read(path, schema)
    except manifests.Broken:
        return {}


def _folder(folder: Path, schema: str, owner: dict[str, str], first: str = "") -> Iterator[str]:
    """Yield one line for each fault of the folder of a stage, or of a deliverable."""
    stage = owner.get("stage", "publish")
    try:
        document = manifests.read(folder / MANIFEST, schema)
    except manifests.Broken as error:
        again = command(owner["scene"], stage, quality_in(folder / MANIFEST))
        yield f"{folder / MANIFEST}: {error}; {first}rebuild with: {again}"
        return
    again = f"; {first}rebuild with: {command(owner['scene'], stage, document.get('quality'))}"
    if found := of_another(document, owner):
        yield f"{folder / MANIFEST}: {found}{again}"
        return
    lines = [*wrong_files(folder, document), *made_from_another(folder, document)]
    if "stage" in owner:
        lines += _parts(folder / PARTS, document)
    yield from (line + again for line in lines)
    listed = {MANIFEST, PARTS if "stage" in owner else OF_SNAKEMAKE, *document["files"]}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_dir() and not path.is_symlink():
            continue
        if name not in listed:
            if "stage" not in owner:
                continue  # of the user, and carried over when this is made again
            lost = "move it away, or it is lost when this is made again"
            yield f"{path}: not written by rule {stage} (not in {folder / MANIFEST}); {lost}"
        elif path.is_symlink():
            yield f"{path}: a symbolic link in the place of a file{again}"


def _parts(path: Path, document: dict[str, Any]) -> Iterator[str]:
    """Yield a line if the notes of parts that later jobs take over are not those of the stage. If they are gone, that costs time
    alone."""
    if not path.exists():
        return
    try:
        noted = manifests.sealed(io.read_record(path)).get("parts")
        notes = [manifests.part(note) for note in noted.values()] if isinstance(noted, dict) else []
    except (OSError, manifests.Broken) as error:
        yield f"{path}: {error}"
        return
    files = document["files"]
    if not notes or any(
        files.get(name, {}).get("sha256") != facts["sha256"] for note in notes for name, facts in note["files"].items()
    ):
        yield f"{path}: it lists other files than the manifest"


def _published(root: Path, scene: str, first: str) -> Iterator[str]:
    """Yield one line for each fault of `scenes/<scene>`."""
    folder, results = root / "scenes" / scene, root / "results" / scene
    record = results / "publish/published.json"
    if folder.is_dir() and (folder / MANIFEST).is_file():
        yield from _folder(folder, SCENE_SCHEMA, {"scene": scene}, first)
        if problem := _other_than_made(folder / MANIFEST, results, record):
            yield f"{problem}; {first}rebuild with: {command(scene, 'publish', quality_in(folder / MANIFEST))}"
    elif folder.is_dir():
        yield f"{folder / MANIFEST}: missing; rebuild with: {command(scene, 'publish', None)}"
    elif folder.exists():
        yield f"{folder}: a file where the folder of a scene belongs; move it away"
    elif (results / "publish" / MANIFEST).is_file():
        aside = folder.with_name(f".{scene}.old")
        kept = f" (an earlier one is in {aside})" if aside.is_dir() else ""
        again = command(scene, "publish", quality_in(results / "publish" / MANIFEST))
        yield f"{folder}: missing, although it was published{kept}; {first}rebuild with: {again}"


def _other_than_made(manifest: Path, results: Path, record: Path) -> str:
    """Return what is wrong if a deliverable was not made from the stages that are there, or is not the one that was published."""
    for stage, digest in sorted(_document(manifest, SCENE_SCHEMA).get("manifests", {}).items()):
        up = results / stage / MANIFEST
        if _document(up) and io.sha256_of(up) != digest:
            return f"{manifest.parent}: it was made from another {up.parent} than is there now"
    own = io.facts_in(record).get("manifest_sha256")
    return "" if own in (None, io.sha256_of(manifest)) else f"{manifest}: it is not the one that {results / 'publish'} wrote"
