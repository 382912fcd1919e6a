"""publish: the deliverable scenes/<scene>/, copied from the artefacts of the stages."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from iif_core.errors import InputError
from workflow.artifacts import manifest as manifests
from workflow.artifacts import stamps
from workflow.artifacts.files import copy, flush_folder, flush_folders, inside, make_folder, named, sha256_of, write_parquet
from workflow.artifacts.manifest import MANIFEST, SCENE_SCHEMA
from workflow.artifacts.sound import wrong_files
from workflow.artifacts.store import StageReader
from workflow.runtime.job import Job, library_versions
from workflow.runtime.timings import read_timings

TIMING_COLUMNS: dict[str, Any] = {
    "rule": object,
    "wildcards": object,
    "seconds": np.float64,
    "cpu_seconds": np.float64,
    "max_rss_mb": np.float64,
    "threads": np.int32,
}


def run(job: Job) -> None:
    """Build `scenes/.<scene>.tmp` and rename it to `scenes/<scene>`, so the folder is complete, old or new, or absent.

    Every upstream stage is opened first, so an artefact that was built under other settings or code stops the stage.
    """
    readers = {stage: job.read(stage) for stage in job.stage.upstream}
    writer = job.writer  # from here on, the stage is not finished
    target = Path("scenes") / job.scene
    temporary = target.with_name(f".{job.scene}.tmp")
    make_folder(target.parent)
    bring_back(target)
    shutil.rmtree(temporary, ignore_errors=True)
    try:
        files, seen = _build(job, readers, temporary)
        _replace(temporary, target)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    published = {
        "files": {name: facts["sha256"] for name, facts in files.items()},
        "manifest_sha256": sha256_of(target / MANIFEST),
    }
    writer.json("published.json", published)
    noted = stamps.Stamps()
    for name, stamp in seen.items():
        noted.note(target / name, stamp, files[name]["sha256"] if name in files else published["manifest_sha256"])
    noted.save(stamps.place(Path("results"), job.scene, stamps.DELIVERABLE), flushed=True)
    job.log.info("%s: %d files, %.1f MB", target, len(files), sum(f["bytes"] for f in files.values()) / 1e6)


def _build(
    job: Job, readers: dict[str, StageReader], temporary: Path
) -> tuple[dict[str, dict[str, Any]], dict[str, stamps.Stamp | None]]:
    """Fill the folder, its manifest last, and flush it to disk; return the files of the manifest, and the stamps of all."""
    with named(temporary):
        temporary.mkdir()
    made: dict[str, tuple[StageReader, str]] = {}
    for stage, name in deliverables(readers):
        made[name] = readers[stage], readers[stage].manifest["files"][name]["sha256"]
        copy(readers[stage].path(name), inside(temporary, name))  # so that editing the deliverable does not change results/
    timings = read_timings(job.scene)
    columns = {name: np.array([row[name] for row in timings], dtype) for name, dtype in TIMING_COLUMNS.items()}
    write_parquet(temporary / "timings.parquet", columns, {"iif.schema": SCENE_SCHEMA}, settled=False)
    names = sorted(path.relative_to(temporary).as_posix() for path in temporary.rglob("*") if path.is_file())
    seen = {name: stamps.stamp_of(temporary / name) for name in names}
    files = {name: {"sha256": sha256_of(temporary / name), "bytes": (temporary / name).stat().st_size} for name in names}
    for name, (reader, digest) in made.items():  # what is sealed here is what the stages have sealed, and not what became of it
        if files[name]["sha256"] != digest:
            raise InputError(
                f"{temporary / name}: the copy differs from what rule {reader.stage} wrote, {reader.directory / name}; it changed"
                " meanwhile, or the disk lost a part. Run the same command again; if it happens again, check the disk"
            )
    manifests.write(temporary / MANIFEST, _manifest(job, files), settled=False)
    flush_folders(temporary)
    return files, seen | {MANIFEST: stamps.stamp_of(temporary / MANIFEST)}


def deliverables(readers: dict[str, StageReader]) -> list[tuple[str, str]]:
    """Return (stage, file) of everything that is published under its own name, as the manifests list it."""
    export = readers["export"]
    chosen = [("export", name) for name in export.names() if name != "export.json"]
    chosen += [("render", name) for name in readers["render"].names("maps/")]
    chosen += [
        ("report", "report.html"),
        ("room", "room.html"),
        ("room", "scene_unlit.glb"),
        ("report", "verdict.json"),
        ("report", "plan.yaml"),
        ("metrics", "metrics.parquet"),
    ]
    chosen += [("affines", "objects.parquet")]
    if readers["affines"].has("camera_response.parquet"):
        chosen.append(("affines", "camera_response.parquet"))
    return chosen


WRITTEN_HERE = ("manifest.json", "timings.parquet")
"""Files of the deliverable that this stage writes itself."""


def published_names(readers: dict[str, StageReader]) -> list[str]:
    """Return the names of all files of the deliverable, for pages that link to them."""
    return sorted({*(name for _, name in deliverables(readers)), *WRITTEN_HERE})


def _manifest(job: Job, files: dict[str, Any]) -> dict[str, Any]:
    return {
        "schema": SCENE_SCHEMA,
        "scene": job.scene,
        "quality": job.quality,
        "fingerprint": job.fingerprint,
        "fingerprints": {stage: job.read(stage).fingerprint for stage in job.stage.upstream},
        "manifests": {stage: job.read(stage).digest for stage in job.stage.upstream},
        "settings": job.document,
        "versions": library_versions(),
        "files": files,
    }


def set_aside(target: Path) -> Path:
    """Return where the folder that a deliverable replaces is while that is renamed."""
    return target.with_name(f".{target.name}.old")


def bring_back(target: Path) -> None:
    """Rename a deliverable that was set aside to its place, if publishing was killed before the new one was there."""
    old = set_aside(target)
    if not old.is_dir() or target.exists():
        return
    try:
        whole = next(wrong_files(old, manifests.read(old / MANIFEST, SCENE_SCHEMA)), None) is None
    except manifests.Broken:
        return  # what was left when it was being removed
    if whole:
        os.rename(old, target)
        flush_folder(target.parent)


def _replace(temporary: Path, target: Path) -> None:
    """Rename into place. Snakemake has removed the old folder unless the stage is run by hand.

    At every moment, and after a power cut at any, the old folder or the new one is complete, here or set aside.
    """
    old = set_aside(target)
    _discard(old)
    if target.exists():
        os.rename(target, old)
        flush_folder(target.parent)
    os.rename(temporary, target)
    flush_folder(target.parent)
    _discard(old)


def _discard(old: Path) -> None:
    """Remove a folder that was set aside, its manifest first, so that what is left of it is not taken for whole."""
    if old.is_dir():
        (old / MANIFEST).unlink(missing_ok=True)
        flush_folder(old)
    shutil.rmtree(old, ignore_errors=True)
