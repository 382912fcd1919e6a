"""Time and memory of the jobs of a scene, as each job measured them itself (`Job.write_timings`)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from workflow.artifacts.files import facts_in
from workflow.registry import STAGES

MEASURED = ("seconds", "cpu_seconds", "max_rss_mb", "threads")
LARGEST = 1e12
"""No job measures as much; what is not below it is no measurement. It leaves out what is not finite, too."""


def read_timings(scene: str, root: Path = Path(".")) -> list[dict[str, Any]]:
    """Return one row per job, in the order of the workflow: rule, wildcards, seconds, cpu_seconds, max_rss_mb, threads, expected.

    `expected` is what the model of costs says of the job on the machine that it was fitted on (`cpu_seconds`, `memory_mb`, ...).
    Rows are of the last run of each job. A job without a readable record has no row, and a number that is not in it is 0. Stage
    `publish` has no row either, because it writes the table before its own job is over.
    """
    rows = []
    for stage in STAGES:
        record = read_parts(scene, stage, root)
        if stage != "publish" and (job := record.get("job")):
            measured = {key: job.get(key, 0.0) for key in MEASURED} | {"threads": int(job.get("threads", 0))}
            rows.append({"rule": stage, "wildcards": f"scene={scene}", **measured, "expected": record.get("expected", {})})
    return rows


def read_parts(scene: str, stage: str, root: Path = Path(".")) -> dict[str, Any]:
    """Return what a job recorded itself (`Job.timed`): part -> seconds, cpu_seconds; `job`: the whole, with max_rss_mb, threads.

    `expected`: what the model of costs said of it. Only numbers are kept; empty if there is no readable file. Benchmarks of
    Snakemake are not used: it looks at a job every 30 seconds, so they lack most of the CPU time of a short one.
    """
    document = facts_in(root / "results" / scene / "benchmarks" / f"{stage}.parts.json")
    return {part: _numbers(facts) for part, facts in document.items() if isinstance(facts, dict)}


def _numbers(facts: dict[str, Any]) -> dict[str, float]:
    """Return the entries that are numbers."""
    return {key: value for key, value in facts.items() if isinstance(value, int | float) and abs(value) < LARGEST}
