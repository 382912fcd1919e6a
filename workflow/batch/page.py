"""results/batch/report.html: the scenes of a batch on one page. Its links and pictures stay inside the project.

Without JavaScript it shows everything; with it, columns sort and rows are found, and what is shown stands in the address.
"""

from __future__ import annotations

import io
import json
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from workflow.artifacts.files import sha256_of, write_atomically
from workflow.artifacts.manifest import MANIFEST
from workflow.batch.causes import groups
from workflow.batch.columns import Score
from workflow.report import pictures as pic
from workflow.report.page import content_hash, template
from workflow.report.sources import STYLE, TABLES

HERE = Path(__file__).parent
TEMPLATE, OWN_STYLE, SCRIPT = (HERE / name for name in ("batch.html.j2", "batch.css", "batch.js"))
FILES = (TEMPLATE, OWN_STYLE, SCRIPT, STYLE, TABLES)
"""What the page is made of."""
UP = "../../"  # from results/batch/ to the folder that scenes/ and results/ lie in
WIDTH, GAP = 132, 3
"""Pixels across each of the three pictures of a scene, and between them."""
QUALITY = 85
"""Of the JPEG files."""


def render(
    rows: Sequence[dict[str, Any]],
    quality: str,
    columns: Sequence[Score],
    statuses: dict[str, str],
    verdicts: dict[str, str],
    pictures: dict[str, str],
) -> str:
    """Return the page as HTML text, with every text escaped.

    Args:
        rows: one per scene, with the columns of `workflow.batch.summary.COLUMNS`.
        quality: preset of the batch.
        columns: scores to show, where some scene has them.
        statuses: status -> its meaning.
        verdicts: verdict on a finished scene -> its meaning, the best first.
        pictures: scene -> file of its pictures, from the folder of the page.
    """
    done = [row for row in rows if row["status"] == "done"]
    scores = [score for score in columns if any(row[score.column] is not None for row in done)]
    style, script = STYLE.read_text() + OWN_STYLE.read_text(), TABLES.read_text() + SCRIPT.read_text()
    counts = {status: sum(row["status"] == status for row in rows) for status in statuses}
    judged = {word: sum(row["verdict"] == word for row in done) for word in verdicts}
    return template(TEMPLATE).render(
        rows=rows,
        done=done,
        causes=groups(rows),
        explained=any(row["reason"] or row["verdict"] == "poor" for row in rows),
        counts=counts,
        choices={
            "status": [status for status, count in counts.items() if count],
            "verdict": [word for word, count in judged.items() if count],
            "stage": sorted({row["stage"] for row in rows if row["stage"]}),
            "source": sorted({row["source"] for row in rows if row["source"]}),
        },
        judged=judged,
        ranks={word: rank for rank, word in enumerate(verdicts)},
        meanings=statuses | verdicts,
        scores=scores,
        medians={score.column: _median([row[score.column] for row in done]) for score in scores},
        total_cpu=sum(row["cpu_seconds"] or 0.0 for row in rows),
        peak=max((row["max_rss_mb"] or 0.0 for row in rows), default=0.0),
        pictures=pictures,
        quality=quality,
        up=UP,
        style=style,
        script=script,
        style_hash=content_hash(style),
        script_hash=content_hash(script),
    )


def _median(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return statistics.median(known) if known else None


def write_pictures(scenes: Sequence[str], folder: Path) -> dict[str, str]:
    """Write the pictures of each finished scene to `folder`/pictures, as far as they are not there, and remove those of others.

    The name of a file has a digest of the manifest of the deliverable, so pictures of another result are made anew.

    Returns:
        Scene -> name of the file from `folder`; a scene whose files are damaged has none.
    """
    own = folder / "pictures"
    found = {}
    for scene in scenes:
        try:
            name = f"{scene}.{sha256_of(Path('scenes') / scene / MANIFEST)[:12]}.jpg"
            if not (own / name).is_file():
                _write_picture(own / name, scene)
            found[scene] = f"pictures/{name}"
        except Exception:  # the page matters more than a picture; `snakemake verify` names what is damaged
            continue
    for path in own.glob("*.jpg"):
        if f"pictures/{path.name}" not in found.values():
            path.unlink(missing_ok=True)
    return found


def _write_picture(path: Path, scene: str) -> None:
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(strip(scene)).save(buffer, "JPEG", quality=QUALITY)
    write_atomically(path, lambda temporary: temporary.write_bytes(buffer.getvalue()), settled=False)


def strip(scene: str) -> Any:
    """Return photograph, re-rendering and albedo of the middle view side by side, (H, W, 3) uint8.

    Raises:
        Exception: of any kind, where a file is missing or damaged.
    """
    import numpy as np

    from workflow.artifacts.files import read_exr, read_parquet
    from workflow.artifacts.store import rgb

    maps = sorted((Path("scenes") / scene / "maps").glob("*.exr"))
    path = maps[len(maps) // 2]
    capture = Path("results") / scene / "capture"
    channels, photo = read_exr(path), rgb(read_exr(capture / "photos" / path.name))
    hdr = json.loads((capture / "capture.json").read_text())["dynamic_range"] == "hdr"
    show = pic.linear if hdr else pic.encoded  # what `ldr` of an HDR scene holds is linear
    if hdr:
        cameras = read_parquet(capture / "cameras.parquet")
        photo = photo * float(cameras["exposure"][cameras["name"].tolist().index(path.stem)])
    shown = [
        show(_small(photo).clip(0, 1)),
        show(_small(rgb(channels, "ldr"))),
        pic.linear(_small(rgb(channels, "albedo"))),
    ]
    gap = np.full((shown[0].shape[0], GAP, 3), 128, np.uint8)
    return np.concatenate([shown[0], gap, shown[1], gap, shown[2]], 1)


def _small(image: Any) -> Any:
    """Return (H, W, 3) averaged over blocks to at most `WIDTH` pixels across; incomplete blocks are cut off."""
    step = max(1, -(-image.shape[1] // WIDTH))
    height, width = image.shape[0] // step * step, image.shape[1] // step * step
    blocks = image[:height, :width].reshape(height // step, step, width // step, step, 3)
    return blocks.mean((1, 3))
