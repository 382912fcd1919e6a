"""`bench/<scene>`: three measured qualities in a room of one's own: what they took and what they scored."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from iif_core.errors import InputError
from workflow.artifacts import links
from workflow.artifacts.files import write_atomically, write_json
from workflow.costs.machine import machine_factor
from workflow.registry import STAGES
from workflow.runtime import fingerprint as fp
from workflow.runtime import forecast
from workflow.runtime.timings import read_parts
from workflow.settings.derived import BENCH, scene_of
from workflow.trade.points import SCORES, WORDS, bench_points, measured_scores

HEADS = {"albedo": "albedo / dB", "held_out": "held out / dB"}
FOLDER = Path(BENCH)


def scenes(scene: str) -> dict[str, str]:
    """Return point -> the derived scene that runs it."""
    return {point: scene_of(BENCH, scene, point, 0) for point in bench_points()}


def marks(scene: str) -> dict[str, str]:
    """Return point -> fingerprint of its scores, as it is now."""
    return {point: fp.fingerprint("metrics", derived, point) for point, derived in scenes(scene).items()}


def measured(scene: str, score: str) -> dict[str, float] | None:
    """Return point -> score of a bench that still is what it was; None where there is none.

    Raises:
        InputError: its file is damaged.
    """
    file = FOLDER / scene / "bench.json"
    if not file.is_file():
        return None
    try:
        found: dict[str, Any] = json.loads(file.read_text())["points"]
        now = marks(scene)
        return {
            name: point["scores"][score]
            for name, point in found.items()
            if point["metrics"] == now.get(name) and score in point["scores"]
        }
    except (ValueError, KeyError, TypeError, AttributeError):
        raise InputError(f"{file}: damaged; make it again: snakemake --cores 2 bench/{scene} --force") from None


def write_bench(scene: str, cores: int = 2) -> None:
    """Write bench.json, which `--config quality=<score>:<dB>` reads, and bench.md, which a person reads."""
    folder, points, rows, now = FOLDER / scene, {}, [], marks(scene)
    links.check_folder(str(folder))
    folder.mkdir(parents=True, exist_ok=True)
    for point, derived in scenes(scene).items():
        scores = measured_scores(json.loads(Path(f"results/{derived}/metrics/summary.json").read_text()))
        jobs = {stage: read_parts(derived, stage).get("job") for stage in STAGES}
        taken = {stage: job for stage, job in jobs.items() if job}
        seconds = sum(job["seconds"] for stage, job in taken.items() if stage != "capture")
        try:
            expected = forecast.span(forecast.wall(derived, point, cores).seconds)
        except InputError:  # of a kind of work of which the model has no row
            expected = "not known"
        points[point] = {"metrics": now[point], "scores": scores}
        memory = max((job["max_rss_mb"] for job in taken.values()), default=0.0)
        shown = [f"{scores[name]:.2f}" if name in scores else "" for name in SCORES]
        rows.append([point, f"{seconds:.0f}", expected, f"{memory:.0f}", *shown])
    factor = machine_factor()
    write_json(folder / "bench.json", {"scene": scene, "machine": round(factor, 3), "points": points})
    head = ["quality", "s of its jobs", "expected for the whole run from now on", "peak MB", *HEADS.values()]
    lines = [f"# {scene}: three qualities", ""]
    lines += ["| " + " | ".join(head) + " |", "|---|---:|---:|---:|---:|---:|"]
    lines += ["| " + " | ".join(row) + " |" for row in rows]
    lines += ["", *(f"{HEADS[name]}: {words}." for name, words in WORDS.items())]
    lines += [
        "",
        f"This machine takes {factor:.2f} times as long as the machine of the shipped costs. Seconds are of the stages after",
    ]
    lines += ["`capture` up to `metrics`; the expected ones are of all stages and include the start of the jobs.", ""]
    write_atomically(folder / "bench.md", lambda path: path.write_text("\n".join(lines)))
    print("\n".join(lines))
