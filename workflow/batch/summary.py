"""Summary of a batch: results/batch/summary.parquet, .tsv and report.html, with one row per scene of config/batch.tsv.

It is made from the files that jobs have left, so it can be made at any time (`python -m workflow batch`), also while they run.
"""

from __future__ import annotations

import csv
import io
import json
import logging
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from iif_core.errors import InputError
from workflow.artifacts.files import read_parquet, read_record, remove, sha256_of, write_atomically
from workflow.batch import causes
from workflow.batch import plan as batch_plan
from workflow.batch.columns import SCORES, VERDICTS
from workflow.batch.page import render, write_pictures
from workflow.batch.standing import STATES, standing
from workflow.runtime import fingerprint as fp
from workflow.runtime.job_state import SILENCE, written_out
from workflow.runtime.timings import read_timings
from workflow.settings.batch_table import Line

FOLDER = batch_plan.FOLDER
_TEXT = ("scene", "status", "stage", "reason", "source", "base", "quality", "verdict", "doubt", "log", "report", "slowest")
COLUMNS = {
    "line": "int64",
    **dict.fromkeys(_TEXT[:9], "string"),
    "views": "int64",
    **dict.fromkeys((score.column for score in SCORES), "float64"),
    **dict.fromkeys(("seconds", "cpu_seconds", "max_rss_mb"), "float64"),
    **dict.fromkeys(_TEXT[9:], "string"),
}

Row = dict[str, Any]


def write_summary(quality: str, complete: str | None = None, over: bool = False) -> None:
    """Write table and page, and log which scenes are not done, and why.

    Args:
        quality: preset of the batch.
        complete: fingerprint of the plan, when all its jobs are done; it is kept with the digests of all files. Without it,
            `results/batch/complete` is removed, so that Snakemake does not take what a failed run left for the summary of a
            finished one.
        over: whether the run is over: a job that has not ended by now was killed, also on another machine.

    Raises:
        InputError: `complete` is given, and a scene is not done nevertheless.
    """
    remove(FOLDER / "complete")
    plan = batch_plan.plan(quality)
    rows = [row_of(line, plan, quality, 0.0 if over else SILENCE) for line in plan.lines]
    write_atomically(FOLDER / "summary.parquet", partial(_write_parquet, rows))
    write_atomically(FOLDER / "summary.tsv", lambda path: path.write_text(_tsv(rows), encoding="utf-8"))
    pictures = write_pictures([row["scene"] for row in rows if row["status"] == "done"], FOLDER)
    page = render(rows, quality, SCORES, STATES, VERDICTS, pictures)
    write_atomically(FOLDER / "report.html", lambda path: path.write_text(page, encoding="utf-8"))
    logging.getLogger("batch").info("%s", closing(rows))
    if not complete:
        return
    left = [row["scene"] for row in rows if row["scene"] in plan.ready and row["status"] != "done"]
    if left:
        others = f" and {len(left) - 1} more" if len(left) > 1 else ""
        raise InputError(f"{left[0]}{others}: not done, although all jobs ended well; the table and the page say why")
    files = [FOLDER / name for name in (*batch_plan.WRITTEN, *pictures.values())]
    lines = [complete, *(f"{sha256_of(path)}  {path.relative_to(FOLDER).as_posix()}" for path in files)]
    write_atomically(FOLDER / "complete", lambda path: path.write_text("\n".join(lines) + "\n"))


def refuse(quality: str) -> None:
    """Fail with the reasons of the scenes that cannot be run.

    Raises:
        InputError: always; a line for each scene, or for each cause where there are many.
    """
    refused = batch_plan.plan(quality).refused
    if refused:
        raise InputError(f"{len(refused)} of the batch cannot be run:\n" + "\n".join(causes.refusals(refused)))
    raise InputError("settings or data changed while the workflow was running. Run the same command again.")


def closing(rows: Sequence[Row]) -> str:
    """Return the last message of a run: how many scenes are done, what the others lack, and which other jobs failed."""
    done = [row for row in rows if row["status"] == "done"]
    judged = {word: sum(row["verdict"] == word for row in done) for word in VERDICTS}
    words = ", ".join(f"{count} {word}" for word, count in judged.items() if count)
    verdicts = f" ({words}, by their reports)" if words else ""
    lines = [f"{len(done)} of {len(rows)} scenes done{verdicts}; {FOLDER / 'report.html'}, {FOLDER / 'summary.tsv'}"]
    return written_out("\n".join([*lines, *causes.lines(rows)]))


# ------------------------------------------------------------------------------------------------------------ one scene


def row_of(line: Line, plan: batch_plan.Plan, quality: str, silence: float = SILENCE) -> Row:
    """Return the row of one scene; what is unknown is None. Never raises, whatever the files of the scene hold.

    Args:
        line: of the table.
        plan: of the batch.
        quality: preset of the batch.
        silence: as of `workflow.runtime.job_state.noted`.
    """
    scene = line.name
    row: Row = dict.fromkeys(COLUMNS)
    row |= {"line": line.number, "scene": scene, "base": line.base or None, "quality": quality}
    if scene in plan.refused:
        return row | {"status": "refused", "reason": plan.refused[scene], "source": line.source or None}
    row["source"] = json.loads(fp.resolved(scene, quality))["source"]["kind"]
    found = standing(scene, lambda _: quality, silence)
    reason = found.reason or (f"stage {found.stage} has not run" if found.state == "waiting" else None)
    row |= {"status": found.state, "stage": found.stage or None, "reason": reason}
    if found.reason and found.log:
        row["log"] = found.log
    try:
        row |= _costs(scene)
        if found.state == "done":
            row |= {"report": f"scenes/{scene}/report.html", **_verdict(scene), **_scores(scene)}
    except Exception as error:  # damaged files are for `snakemake verify` to name; the other rows are still wanted
        row |= {"status": "unknown", "stage": "publish", "reason": f"its files cannot be read ({type(error).__name__}: {error})"}
    return row


def _costs(scene: str) -> Row:
    """Return sums over the last recorded run of each job, the largest memory, and the job that took longest."""
    jobs = read_timings(scene)
    if not jobs:
        return {}
    slowest = max(jobs, key=lambda job: job["seconds"])
    return {
        "seconds": sum(job["seconds"] for job in jobs),
        "cpu_seconds": sum(job["cpu_seconds"] for job in jobs),
        "max_rss_mb": max(job["max_rss_mb"] for job in jobs),
        "slowest": f"{slowest['rule']} {slowest['seconds']:.0f} s",
    }


def _verdict(scene: str) -> Row:
    """Return what the report of a scene says of it: a key of `VERDICTS`, and the sentence unless no fault was found.

    Raises:
        Exception: of any kind, if the file is missing or damaged.
    """
    found = json.loads(read_record(Path("scenes") / scene / "verdict.json"))
    word = next(word for word in VERDICTS if word == found["verdict"])
    return {"verdict": word, "doubt": None if word == next(iter(VERDICTS)) else str(found["sentence"])}


def _scores(scene: str) -> Row:
    table = read_parquet(Path("scenes") / scene / "metrics.parquet")
    rows = list(zip(*(table[name].tolist() for name in ("view", "quantity", "metric", "protocol", "value")), strict=True))
    held_out = {view for view, quantity, *_ in rows if quantity == "rgb_held_out"}
    split = {path.stem: "test" if path.stem in held_out else "train" for path in (Path("scenes") / scene / "maps").glob("*.exr")}
    out: Row = {"views": len(split)}
    values: dict[str, list[float]] = {score.column: [] for score in SCORES}
    for view, *key, value in rows:
        for score in SCORES:
            if key == [score.quantity, score.metric, score.protocol] and score.split in ("", split.get(view)):
                values[score.column].append(value)
    return out | {name: sum(found) / len(found) for name, found in values.items() if found}


# ---------------------------------------------------------------------------------------------------------------- files


def _write_parquet(rows: Sequence[Row], path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns = {name: pa.array([row[name] for row in rows], getattr(pa, kind)()) for name, kind in COLUMNS.items()}
    pq.write_table(pa.table(columns), path, compression="zstd")


def _tsv(rows: Sequence[Row]) -> str:
    out = io.StringIO()
    writer = csv.writer(out, delimiter="\t", lineterminator="\n")
    writer.writerow(COLUMNS)
    for row in rows:
        writer.writerow(["" if row[name] is None else _cell(row[name]) for name in COLUMNS])
    return out.getvalue()


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    return " | ".join(written_out(line.replace("\t", " ")) for line in str(value).splitlines())
