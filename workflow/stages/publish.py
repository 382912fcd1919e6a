"""publish: the deliverable scenes/<scene>/, copied from the artefacts of the stages."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np

from iif_core.errors import InputError
from workflow.artifacts import manifest as manifests
from workflow.artifacts import stamps
from workflow.artifacts.files import copy, flush_folders, inside, make_folder, named, sha256_of, write_parquet
from workflow.artifacts.manifest import MANIFEST, SCENE_SCHEMA
from workflow.artifacts.store import StageReader
from workflow.artifacts.swap import bring_back, replace
from workflow.report.deliverable import deliverables
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
    """Publish the scene. Every upstream stage is opened first, so that one built under other settings or code stops the job."""
    readers = {stage: job.read(stage) for stage in job.stage.upstream}
    writer = job.writer  # from here on, the stage is not finished
    facts = {"scene": job.scene, "quality": job.quality, "fingerprint": job.fingerprint, "settings": job.document}
    published, size, own = deliver(readers, facts, read_timings(job.scene))
    if own:
        job.log.info("scenes/%s: kept %d files that were put there: %s", job.scene, len(own), ", ".join(own[:5]))
    writer.json("published.json", published)
    job.log.info("scenes/%s: %d files, %.1f MB", job.scene, len(published["files"]), size / 1e6)


def deliver(
    readers: dict[str, StageReader], facts: dict[str, Any], timings: list[dict[str, Any]]
) -> tuple[dict[str, Any], int, list[str]]:
    """Build `scenes/.<scene>.tmp` and rename it to `scenes/<scene>`, so the folder is complete, old or new, or absent.

    Args:
        readers: the stages from which it is copied.
        facts: scene, quality, fingerprint and settings, for the manifest.
        timings: of the jobs (`read_timings`), for timings.parquet.

    Returns:
        The hashes of its files and of its manifest, how many bytes the files have, and the names of what the user has put there.
    """
    target = Path("scenes") / facts["scene"]
    temporary = target.with_name(f".{target.name}.tmp")
    make_folder(target.parent)
    bring_back(target)
    shutil.rmtree(temporary, ignore_errors=True)
    try:
        files, seen = _build(readers, facts, timings, temporary)
        own = replace(temporary, target)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    hashes = {name: file["sha256"] for name, file in files.items()}
    digest = sha256_of(target / MANIFEST)
    noted = stamps.Stamps()
    for name, stamp in seen.items():
        noted.note(target / name, stamp, hashes.get(name, digest))
    noted.save(stamps.place(Path("results"), target.name, stamps.DELIVERABLE), flushed=True)
    return {"files": hashes, "manifest_sha256": digest}, sum(file["bytes"] for file in files.values()), own


def _build(
    readers: dict[str, StageReader], facts: dict[str, Any], timings: list[dict[str, Any]], temporary: Path
) -> tuple[dict[str, dict[str, Any]], dict[str, stamps.Stamp | None]]:
    """Fill the folder, its manifest last, and flush it to disk; return the files of the manifest, and the stamps of all."""
    with named(temporary):
        temporary.mkdir()
    made: dict[str, tuple[StageReader, str]] = {}
    for stage, name in deliverables(readers):
        made[name] = readers[stage], readers[stage].manifest["files"][name]["sha256"]
        copy(readers[stage].path(name), inside(temporary, name))  # so that editing the deliverable does not change results/
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
    manifest = {
        "schema": SCENE_SCHEMA,
        **facts,
        "fingerprints": {stage: reader.fingerprint for stage, reader in readers.items()},
        "manifests": {stage: reader.digest for stage, reader in readers.items()},
        "versions": library_versions(),
        "files": files,
    }
    manifests.write(temporary / MANIFEST, manifest, settled=False)
    flush_folders(temporary)
    return files, seen | {MANIFEST: stamps.stamp_of(temporary / MANIFEST)}
