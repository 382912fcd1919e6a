"""Scenes that count as finished without having been computed: copies of one finished scene, each under its own fingerprints.

What a stage wrote is linked, so a thousand scenes take little more than the disk of one. Manifests, the digests by which each
names what it was made from, seals, stamps, the deliverable and Snakemake's records are those that a run would have left.
Contents are not those of its settings: a page says the name of the scene that was copied.
"""

from __future__ import annotations

import hashlib
import json
import os
from base64 import urlsafe_b64encode
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from workflow import settings
from workflow.artifacts import manifest as manifests
from workflow.artifacts import stamps
from workflow.artifacts.files import sha256_of
from workflow.artifacts.manifest import MANIFEST, SCENE_SCHEMA
from workflow.registry import STAGES
from workflow.runtime import fingerprint as fp

RECORDS = Path(".snakemake/metadata")
OF_JOBS = ("benchmarks", "logs", "locks")
RESULTS, SCENES = Path("results"), Path("scenes")


def prepare(scenes: Sequence[str], template: str, quality: str = "draft", said: Callable[[str], object] = len) -> None:
    """Make finished scenes in the working folder, whose settings are there already.

    Args:
        scenes: their names; one that is there already is left as it is.
        template: a finished scene of the same folder, of the same kinds of source, prior and segmentation.
        quality: at which all of them are made.
        said: called with the progress, as text.
    """
    new = [scene for scene in scenes if not (SCENES / scene / MANIFEST).is_file()]
    for done, scene in enumerate(new):
        _copy(scene, template, quality)
        if done % 50 == 49:
            said(f"{done + 1} of {len(new)} scenes prepared")
    if not new:
        return
    for scene in [template, *scenes]:  # every link of a file changes the time stamp of its inode, which all of them share
        for stage in _stages(template):
            _noted(RESULTS / scene / stage, manifests.STAGE_SCHEMA, stamps.place(RESULTS, scene, stage))
        _noted(SCENES / scene, SCENE_SCHEMA, stamps.place(RESULTS, scene, stamps.DELIVERABLE))


def _noted(folder: Path, schema: str, place: Path) -> None:
    """Note the hashes of a folder as its job would have done."""
    document, digest = manifests.load(folder / MANIFEST, schema)
    noted = stamps.Stamps()
    for name, found in {MANIFEST: digest, **{name: facts["sha256"] for name, facts in document["files"].items()}}.items():
        noted.note(folder / name, stamps.stamp_of(folder / name), found)
    noted.save(place)


def _stages(scene: str) -> list[str]:
    return [stage for stage in STAGES if (RESULTS / scene / stage / MANIFEST).is_file()]


def _copy(scene: str, template: str, quality: str) -> None:
    document = json.loads(fp.resolved(scene, quality))
    new: dict[str, str] = {}  # SHA-256 or fingerprint in the template -> the same of the scene
    for name in OF_JOBS:
        _link(RESULTS / template / name, RESULTS / scene / name)
    for stage in _stages(template):
        source, folder = RESULTS / template / stage, RESULTS / scene / stage
        if stage == "publish":
            _deliver(scene, template, quality, document, new)
        _link(source, folder, leave=(MANIFEST, "published.json"))
        own = manifests.read(source / MANIFEST)
        mark = fp.fingerprint(stage, scene, quality)
        new[own["fingerprint"]] = mark
        for facts in own["inputs"].values():
            facts |= {
                "scene": scene,
                "fingerprint": new[facts["fingerprint"]],
                "manifest_sha256": new[facts["manifest_sha256"]],
            }
        own |= {"scene": scene, "fingerprint": mark, "settings": settings.select(document, STAGES[stage].settings)}
        own["seed"] = document["seed"]
        if stage == "publish":
            published = json.loads((source / "published.json").read_text())
            published["manifest_sha256"] = sha256_of(SCENES / scene / MANIFEST)
            text = json.dumps(published, indent=1, sort_keys=True) + "\n"
            _write(folder / "published.json", text, source / "published.json")
            own["files"]["published.json"] |= {"sha256": hashlib.sha256(text.encode()).hexdigest(), "bytes": len(text)}
        new[sha256_of(source / MANIFEST)] = _write(folder / MANIFEST, manifests.text_of(own), source / MANIFEST)
    for path in [f"results/{template}/{stage}/{MANIFEST}" for stage in _stages(template)] + [f"scenes/{template}"]:
        _record(path, scene, template, new)


def _deliver(scene: str, template: str, quality: str, document: dict[str, Any], new: dict[str, str]) -> None:
    source, folder = SCENES / template, SCENES / scene
    _link(source, folder, leave=(MANIFEST,))
    own = manifests.read(source / MANIFEST, SCENE_SCHEMA)
    own |= {"scene": scene, "fingerprint": fp.fingerprint("publish", scene, quality), "settings": document}
    for key in ("fingerprints", "manifests"):
        own[key] = {stage: new[value] for stage, value in own[key].items()}
    _write(folder / MANIFEST, manifests.text_of(own), source / MANIFEST)
    for path in [*(path for path in source.rglob("*") if path.is_dir()), source]:
        _dated(folder / path.relative_to(source), path)


def _link(source: Path, folder: Path, leave: tuple[str, ...] = ()) -> None:
    """Link every file below a folder; what an earlier attempt left is replaced."""
    for path in sorted(source.rglob("*")) if source.is_dir() else []:
        target = folder / path.relative_to(source)
        if path.is_dir() or path.name in leave:
            continue
        target.parent.mkdir(parents=True, exist_ok=True)
        target.unlink(missing_ok=True)
        os.link(path, target)


def _write(path: Path, text: str, like: Path) -> str:
    """Write a file with the time stamp of another, and return its SHA-256."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    _dated(path, like)
    return hashlib.sha256(text.encode()).hexdigest()


def _dated(path: Path, like: Path) -> None:
    status = like.stat()
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))


def _record(path: str, scene: str, template: str, new: dict[str, str]) -> None:
    """Write what Snakemake would have noted of the job that made a file or folder; nothing if it noted none of the template."""
    noted = RECORDS / urlsafe_b64encode(path.encode()).decode()
    if not noted.is_file():
        return
    text = noted.read_text()
    for before, after in [
        *new.items(),
        (f"results/{template}/", f"results/{scene}/"),
        (f"scenes/{template}", f"scenes/{scene}"),
        (f" {template} ", f" {scene} "),
    ]:
        text = text.replace(before, after)
    own = path.replace(f"results/{template}/", f"results/{scene}/").replace(f"scenes/{template}", f"scenes/{scene}")
    (RECORDS / urlsafe_b64encode(own.encode()).decode()).write_text(text)
