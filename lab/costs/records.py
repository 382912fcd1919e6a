"""Costs of finished jobs, gathered from the artefacts and benchmark files under one or more folders `results/`."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from workflow.artifacts.files import read_record, write_atomically
from workflow.costs.size import size_of_capture
from workflow.costs.work import SceneSize, work_of
from workflow.registry import SHARED, STAGES

MEASURES = ("cpu_seconds", "seconds", "memory_mb", "disk_mb")
FIXED = ("scene", "stage", "kind", "threads", "machine", "fingerprint")
"""Columns of the table in addition to measures and counts. `scene` is the room, without the study that took it; `machine` is how
many times as long the machine takes as the machine of the first rows."""


def disk_mb(manifest: dict[str, Any]) -> float:
    """Return the size of the files of a stage in MB."""
    return sum(entry["bytes"] for entry in manifest["files"].values()) / 1e6


def gather(roots: Iterable[Path]) -> list[dict[str, Any]]:
    """Return a row for every finished job of the scenes under `roots`, folders like `results/`; studies are left out.

    A job is left out if the manifests that it was made from are gone, or if it left no measurement.
    """
    rows: dict[tuple[Any, ...], dict[str, Any]] = {}
    for root in roots:
        manifests = {path: json.loads(read_record(path)) for path in sorted(root.glob("*/*/manifest.json"))}
        known = {(one["stage"], one["fingerprint"]): one for one in manifests.values()}
        for path, manifest in manifests.items():
            row = _row(path, manifest, known)
            if row:
                rows[row["stage"], row["fingerprint"], row["threads"], row["seconds"]] = row
    return list(rows.values())


def _row(path: Path, manifest: dict[str, Any], known: dict[tuple[str, str], dict[str, Any]]) -> dict[str, Any] | None:
    stage = manifest["stage"]
    timings = path.parents[1] / "benchmarks" / f"{stage}.parts.json"
    if stage not in STAGES or not timings.is_file():
        return None
    upstream = _upstream(manifest, known)
    if upstream is None or ("capture" not in upstream and stage != "reconstruction"):
        return None
    settings: dict[str, Any] = {}
    for one in upstream.values():
        for dotted, value in one["settings"].items():
            node = settings
            *parents, leaf = dotted.split(".")
            for parent in parents:
                node = node.setdefault(parent, {})
            node[leaf] = {**node[leaf], **value} if isinstance(node.get(leaf), dict) else value
    job = json.loads(timings.read_text())["job"]
    count = len(manifest.get("raw", {}))
    size = size_of_capture(upstream["capture"]) if "capture" in upstream else SceneSize(count, 0.0, 0.0, photographs=count)
    try:
        work = work_of(stage, settings, size)
    except KeyError:  # of an older version, which had other settings
        return None
    return {
        "scene": manifest["scene"].split("--")[0],
        "stage": stage,
        "kind": work.kind,
        "threads": job["threads"],
        "machine": 1.0,
        "fingerprint": manifest["fingerprint"],
        "cpu_seconds": job["cpu_seconds"],
        "seconds": job["seconds"],
        "memory_mb": job["max_rss_mb"],
        "disk_mb": round(disk_mb(manifest), 6),
        **{name: float(f"{value:.6g}") for name, value in work.counts.items()},
    }


def _upstream(manifest: dict[str, Any], known: dict[tuple[str, str], dict[str, Any]]) -> dict[str, dict[str, Any]] | None:
    """Return the manifests that a stage was made from, and its own; None if one is missing."""
    found = {manifest["stage"]: manifest}
    for name, entry in manifest["inputs"].items():
        if name.startswith(SHARED):  # what scores are compared with is no part of the work
            continue
        if (name, entry["fingerprint"]) not in known:
            return None
        further = _upstream(known[name, entry["fingerprint"]], known)
        if further is None:
            return None
        found.update(further)
    return found


def write_rows(path: Path, rows: list[dict[str, Any]]) -> None:
    """Write rows as CSV, sorted; counts that a stage does not have are empty."""
    counts = sorted({name for row in rows for name in row} - {*FIXED, *MEASURES})

    def write(temporary: Path) -> None:
        with temporary.open("w", newline="") as file:
            writer = csv.DictWriter(file, [*FIXED, *MEASURES, *counts], lineterminator="\n")
            writer.writeheader()
            writer.writerows(sorted(rows, key=lambda row: [str(row[name]) for name in (*FIXED, "seconds")]))

    write_atomically(path, write)


def read_rows(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the rows of `write_rows`, with numbers for numbers."""
    with path.open(newline="") as file:
        for row in csv.DictReader(file):
            named = {name: text if name in FIXED else float(text) for name, text in row.items() if text != ""}
            yield {**named, "threads": int(named["threads"]), "machine": float(named["machine"])}
