"""`python -m workflow status`: one line for each scene, and a last one that counts them."""

from __future__ import annotations

import json
import os
import shutil
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path

from iif_core.errors import InputError
from workflow.batch import standing
from workflow.batch.standing import STATES, Standing, printable
from workflow.runtime.forecast import duration, size
from workflow.settings import batch_table
from workflow.settings.names import RESERVED, scene_names

UNBOUNDED = 400
"""Columns of a line where no terminal bounds it."""
GAP = "  "


def scenes_to_show(named: Sequence[str] = ()) -> list[str]:
    """Return which scenes are shown: those that are named; or those of the batch table, others of which jobs run, and those that
    have settings and a folder in results/; or, without a table, everything that has a file or a folder in results/. A table of
    which no scene has begun is not in use where others have: its scenes are not shown then.

    Raises:
        InputError: the table cannot be read.
    """
    if named:
        return list(dict.fromkeys(named))
    lines = batch_table.read_table()
    of_table = [line.name for line in lines]
    folders = sorted(path.parent.name for path in Path("results").glob("*/logs") if path.is_dir())
    if any(line.number for line in lines):
        known = set(scene_names())
        running = standing.with_running_jobs({*of_table, *known})
        begun = dict.fromkeys([*running, *(name for name in folders if name in known)])
        in_use = not begun or any(name in begun or name in folders or Path("scenes", name).exists() for name in of_table)
        return list(dict.fromkeys([*(of_table if in_use else ()), *begun]))
    return list(dict.fromkeys([*of_table, *(name for name in folders if name not in RESERVED)]))


def tell(named: Sequence[str], quality_of: Callable[[str], str], as_json: bool = False) -> int:
    """Print where scenes stand; return the exit code, which is 1 if the batch table cannot be read.

    Args:
        named: scenes that are asked for; all without any.
        quality_of: returns the quality of a scene, or raises `InputError`.
        as_json: one JSON object on each line instead of a table.
    """
    now, code = time.time(), 0
    try:
        scenes = scenes_to_show(named)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        code = 1  # what follows may be other scenes than those of the table
        scenes = sorted({*scene_names(), *standing.with_running_jobs(scene_names())})
    found = list(standing.survey(scenes, quality_of))
    width = shutil.get_terminal_size((UNBOUNDED, 24)).columns  # or those that `COLUMNS` says, as `watch` does
    lines = [json_line(one, now) for one in found] if as_json else text(found, now, width)
    others = []
    if not (named or as_json or code):
        others = sorted({*scene_names(), *(line.name for line in batch_table.read_table())} - set(scenes))
    if others:
        lines.append(f"never begun: {', '.join(others)}")
    try:
        print("\n".join(lines), flush=True)
    except BrokenPipeError:  # `| head` has seen enough
        with suppress(OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return code


def json_line(one: Standing, now: float) -> str:
    """Return a scene as one line of JSON. `since` is a time in UTC, `seconds` the time since then."""
    document = asdict(one)
    if one.since is not None:
        then = datetime.fromtimestamp(min(max(one.since, 0.0), 1e11), UTC)  # a time stamp of a file can be any
        document["since"] = then.isoformat(timespec="seconds").replace("+00:00", "Z")
    document["seconds"] = None if one.since is None else round(max(0.0, now - one.since), 1)
    for key in ("expected_seconds", "cpu_seconds", "max_rss_mb", "remaining_cpu_seconds"):
        document[key] = None if document[key] is None else round(document[key], 1)
    return json.dumps(document)


def text(found: Sequence[Standing], now: float, width: int) -> list[str]:
    """Return the lines of the table, cut to the `width` of the terminal in columns; `now` as `time.time`."""
    if not found:
        return ["no scenes: neither config/scenes nor results holds any"]
    rows = [("scene", "state", "stage", "time", "CPU", "memory", "")]
    for one in found:
        stage = f"{one.stage} +{len(one.running) - 1}" if len(one.running) > 1 else one.stage
        cpu = duration(one.cpu_seconds) if one.cpu_seconds else ""
        memory = size(one.max_rss_mb) if one.max_rss_mb else ""
        rows.append((one.scene, one.state, stage, _age(one, now), cpu, memory, printable(one.reason or one.verdict or one.line)))
    widths = [max(len(row[i]) for row in rows) for i in range(6)]
    out = []
    for row in rows:
        cells = [row[i].rjust(widths[i]) if i in (4, 5) else row[i].ljust(widths[i]) for i in range(6)]
        line = GAP.join([*cells, row[6]]).rstrip()
        out.append(line if len(line) <= width else f"{line[: max(width - 3, 0)]}...")
    return [*out, total(found)]


def _age(one: Standing, now: float) -> str:
    if one.since is None:
        return ""
    seconds = max(0.0, now - one.since)
    spent = duration(seconds) if seconds < 48 * 3600 else f"{seconds / 86400:.0f} days"
    if one.expected_seconds is not None:
        return f"{spent} of about {duration(one.expected_seconds)}"
    return spent if one.state == "running" else f"{spent} ago"


def total(found: Sequence[Standing]) -> str:
    """Return the last line: how many scenes there are in each state, CPU time so far, what is expected to be left, and the
    quality under which they were looked at."""
    counts = {state: sum(one.state == state for one in found) for state in STATES}
    parts = [f"{count} {state}" for state, count in counts.items() if count]
    spent = sum(one.cpu_seconds for one in found)
    left = sum(one.remaining_cpu_seconds or 0.0 for one in found if one.state != "failed")  # those wait for a person
    so_far = f"{duration(spent)} of CPU time so far" if spent else "nothing done so far"
    to_go = f", about {duration(left)} to go{'' if any(one.running for one in found) else ', once started'}" if left else ""
    name = "scene" if len(found) == 1 else "scenes"
    qualities = list(dict.fromkeys(one.quality for one in found if one.quality))
    looked_at = f"; at quality {', '.join(qualities)}" if qualities else ""
    return f"{len(found)} {name}: {', '.join(parts)}; {so_far}{to_go}{looked_at}"
