"""Time and memory of the jobs of a scene, from the benchmark files that Snakemake leaves."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from workflow.artifacts.files import read_record
from workflow.registry import STAGES


def read_timings(scene: str, root: Path = Path(".")) -> list[dict[str, Any]]:
    """Return one row per job, in the order of the workflow: rule, wildcards, seconds, cpu_seconds, max_rss_mb, threads, expected.

    `expected` is what the model of costs says of the job on the machine that it was fitted on (`cpu_seconds`, `memory_mb`, ...),
    and empty where the job left nothing about it.

    Of a job that ran several times, the last line of `results/<scene>/benchmarks/<rule>.jsonl` is used. A rule without a
    readable file (run without Snakemake, or not yet finished) has no row. Numbers that were not recorded are 0: threads of
    some jobs, and CPU time and memory ("NA") of jobs of less than half a second.
    """
    rows = []
    for stage in STAGES:
        path = root / "results" / scene / "benchmarks" / f"{stage}.jsonl"
        try:
            lines = [line for line in read_record(path).decode().splitlines() if line.strip()]
            facts = dict(json.loads(lines[-1]))
            seconds = float(facts["s"])
        except (OSError, ValueError, KeyError, IndexError, TypeError, OverflowError, RecursionError):
            continue
        rows.append(
            {
                "rule": stage,
                "wildcards": f"scene={scene}",
                "seconds": _number(seconds),
                "cpu_seconds": _number(facts.get("cpu_time")),
                "max_rss_mb": _number(facts.get("max_rss")),
                "threads": int(_number(facts.get("threads", _threads(path)))),
                "expected": read_parts(scene, stage, root).get("expected", {}),
            }
        )
    return rows


def read_parts(scene: str, stage: str, root: Path = Path(".")) -> dict[str, Any]:
    """Return what a job recorded itself (`Job.timed`): part -> seconds, cpu_seconds; `job`: the whole, with max_rss_mb, threads.

    Only numbers are kept; empty if there is no readable file. Snakemake samples too rarely to measure the CPU time of a short
    job.
    """
    try:
        document = json.loads(read_record(root / "results" / scene / "benchmarks" / f"{stage}.parts.json"))
    except (OSError, ValueError, RecursionError):
        return {}
    parts = document.items() if isinstance(document, dict) else ()
    return {part: _numbers(facts) for part, facts in parts if isinstance(facts, dict)}


def _numbers(facts: dict[str, Any]) -> dict[str, float]:
    """Return the entries that are finite numbers."""
    return {key: value for key, value in facts.items() if isinstance(value, int | float) and _number(value) == value}


def _threads(benchmark: Path) -> str:
    """Return the threads that `python -m workflow` wrote next to the benchmark; Snakemake's short format does not have them."""
    try:
        return read_record(benchmark.with_suffix(".threads")).decode()
    except (OSError, ValueError):
        return ""


def _number(value: Any) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        return 0.0
    return number if math.isfinite(number) else 0.0
