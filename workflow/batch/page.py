"""results/batch/report.html: the scenes of a batch on one page, without scripts. Its links stay inside the project."""

from __future__ import annotations

import json
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from workflow.batch.columns import Score
from workflow.report import pictures as pic
from workflow.report.page import template

TEMPLATE = Path(__file__).with_name("batch.html.j2")
UP = "../../"  # from results/batch/ to the folder that scenes/ and results/ lie in
WIDTH = 132
"""Pixels across a thumbnail."""


def render(rows: Sequence[dict[str, Any]], quality: str, columns: Sequence[Score], statuses: dict[str, str]) -> str:
    """Return the page as HTML text, with every text escaped.

    Args:
        rows: one per scene, with the columns of `workflow.batch.summary.COLUMNS`.
        quality: preset of the batch.
        columns: scores to show, where some scene has them.
        statuses: status -> its meaning.
    """
    done = [row for row in rows if row["status"] == "done"]
    scores = [score for score in columns if any(row[score.column] is not None for row in done)]
    return template(TEMPLATE).render(
        rows=rows,
        done=done,
        others=[row for row in rows if row["status"] != "done"],
        counts={status: sum(row["status"] == status for row in rows) for status in statuses},
        meanings=statuses,
        scores=scores,
        medians={score.column: _median([row[score.column] for row in done]) for score in scores},
        total_cpu=sum(row["cpu_seconds"] or 0.0 for row in rows),
        peak=max((row["max_rss_mb"] or 0.0 for row in rows), default=0.0),
        thumbnails={row["scene"]: thumbnails(row["scene"]) for row in done},
        quality=quality,
        up=UP,
    )


def _median(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return statistics.median(known) if known else None


def thumbnails(scene: str) -> list[tuple[str, str]]:
    """Return (title, `data:` address) of photograph, re-rendering and albedo of the middle view; nothing if a file is damaged."""
    from workflow.artifacts.files import read_exr, read_parquet
    from workflow.artifacts.store import rgb

    maps = sorted((Path("scenes") / scene / "maps").glob("*.exr"))
    try:
        path = maps[len(maps) // 2]
        capture = Path("results") / scene / "capture"
        channels, photo = read_exr(path), rgb(read_exr(capture / "photos" / path.name))
        hdr = json.loads((capture / "capture.json").read_text())["dynamic_range"] == "hdr"
        show = pic.linear if hdr else pic.encoded  # what `ldr` of an HDR scene holds is linear
        if hdr:
            cameras = read_parquet(capture / "cameras.parquet")
            photo = photo * float(cameras["exposure"][cameras["name"].tolist().index(path.stem)])
        shown = [
            ("photograph", show(_small(photo).clip(0, 1))),
            ("re-rendering", show(_small(rgb(channels, "ldr")))),
            ("albedo", pic.linear(_small(rgb(channels, "albedo")))),
        ]
        return [(f"{title}, view {path.stem}", pic.data_uri(image)) for title, image in shown]
    except Exception:  # the page matters more than a picture; `snakemake verify` names what is damaged
        return []


def _small(image: Any) -> Any:
    """Return (H, W, 3) averaged over blocks to at most `WIDTH` pixels across; incomplete blocks are cut off."""
    step = max(1, -(-image.shape[1] // WIDTH))
    height, width = image.shape[0] // step * step, image.shape[1] // step * step
    blocks = image[:height, :width].reshape(height // step, step, width // step, step, 3)
    return blocks.mean((1, 3))
