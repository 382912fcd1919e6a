"""`snakemake status` and `python -m workflow status`: one line for each scene, and a last one that counts them."""

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
from workflow.runtime.attempts import TIMES
from workflow.runtime.forecast import duration, size
from workflow.settings import batch_table
from workflow.settings.names import RESERVED, scene_names
from workflow.status import standing
from workflow.status.standing import STATES, Standing, printable

UNBOUNDED = 400
"""Columns of a line where no terminal bounds it."""
LEAST = 12
"""Columns below which the last of them is left out, on a narrow terminal."""
COLOURS = {"done": 32, "running": 36, "failed": 31, "killed": 31, "refused": 31, "unknown": 31, "stale": 33}
GAP = "  "


def scenes_to_show(named: Sequence[str] = ()) -> list[str]:
    """Return which scenes are shown: those that are named; or those of the batch table, and others of which jobs run, or
    did not end well while they still have settings; or, without a table, everything that has a file or a folder in results/.

    Raises:
        InputError: the table cannot be read.
    """
    if named:
        return list(dict.fromkeys(named))
    lines = batch_table.read_table()
    if any(line.number for line in lines):
        of_table = [line.name for line in lines]
        return list(dict.fromkeys([*of_table, *standing.with_running_jobs(time.time(), {*of_table, *scene_names()})]))
    folders = sorted(path.parent.name for path in Path("results").glob("*/logs") if path.is_dir())
    others = [name for name in folders if name not in RESERVED]
    return list(dict.fromkeys([*(line.name for line in lines), *others]))


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
        scenes = sorted({*scene_names(), *standing.with_running_jobs(now, scene_names())})
    found = list(standing.survey(scenes, quality_of, now))
    lines = [json_line(one, now) for one in found] if as_json else text(found, now, _width(), _coloured())
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
        then = min(max(one.since, TIMES[0]), TIMES[1])  # a time stamp of a file can be any
        document["since"] = datetime.fromtimestamp(then, UTC).isoformat(timespec="seconds").replace("+00:00", "Z")
    document["seconds"] = None if one.since is None else round(max(0.0, now - one.since), 1)
    for key in ("expected_seconds", "cpu_seconds", "max_rss_mb", "remaining_cpu_seconds"):
        document[key] = None if document[key] is None else round(document[key], 1)
    return json.dumps(document)


def text(found: Sequence[Standing], now: float, width: int, coloured: bool) -> list[str]:
    """Return the lines of the table.

    Args:
        found: the scenes.
        now: the present time, as `time.time`.
        width: columns of the terminal.
        coloured: whether the state is written in colour.
    """
    if not found:
        return ["no scenes: neither config/scenes nor results holds any"]
    rows = [("scene", "state", "stage", "for", "CPU", "memory", "")]
    rows += [(one.scene, one.state, _stage(one), _age(one, now), *_cost(one), _words(one)) for one in found]
    widths = [max(len(row[i]) for row in rows) for i in range(6)]
    out = []
    for row in rows:
        cells = [row[i].rjust(widths[i]) if i in (4, 5) else row[i].ljust(widths[i]) for i in range(6)]
        room = width - sum(widths) - 6 * len(GAP)
        last = row[6] if len(row[6]) <= room else f"{row[6][: room - 3]}..." if room >= LEAST else ""
        if coloured and row[1] in COLOURS:
            cells[1] = f"\x1b[{COLOURS[row[1]]}m{cells[1]}\x1b[0m"
        out.append(GAP.join([*cells, last]).rstrip())
    return [*out, total(found)]


def _stage(one: Standing) -> str:
    return f"{one.stage} +{len(one.running) - 1}" if len(one.running) > 1 else one.stage


def _age(one: Standing, now: float) -> str:
    if one.since is None:
        return ""
    for_ = _spent(max(0.0, now - one.since))
    return f"{for_} of about {duration(one.expected_seconds)}" if one.expected_seconds is not None else for_


def _spent(seconds: float) -> str:
    return duration(seconds) if seconds < 48 * 3600 else f"{seconds / 86400:.0f} days"


def _cost(one: Standing) -> tuple[str, str]:
    return (duration(one.cpu_seconds) if one.cpu_seconds else "", size(one.max_rss_mb) if one.max_rss_mb else "")


def _words(one: Standing) -> str:
    return printable(one.reason or one.line)


def total(found: Sequence[Standing]) -> str:
    """Return the last line: how many scenes there are in each state, CPU time so far, what is expected to be left, and the
    quality under which they were looked at."""
    counts = {state: sum(one.state == state for one in found) for state in STATES}
    parts = [f"{count} {state}" for state, count in counts.items() if count]
    spent = sum(one.cpu_seconds for one in found)
    unfinished = [one for one in found if one.state not in ("done", "refused", "unknown")]
    known = [one.remaining_cpu_seconds for one in unfinished if one.remaining_cpu_seconds is not None]
    so_far = f"{duration(spent)} of CPU time so far" if spent else "nothing done so far"
    left = f", about {duration(sum(known) / len(known) * len(unfinished))} to go" if known else ""
    name = "scene" if len(found) == 1 else "scenes"
    qualities = list(dict.fromkeys(one.quality for one in found if one.quality))
    looked_at = f"; at quality {', '.join(qualities)}" if qualities else ""
    return f"{len(found)} {name}: {', '.join(parts)}; {so_far}{left}{looked_at}"


def _width() -> int:
    """Return the columns of the terminal, or those that `COLUMNS` says, as `watch` does; where there is neither, plenty."""
    return shutil.get_terminal_size((UNBOUNDED, 24)).columns


def _coloured() -> bool:
    return sys.stdout.isatty() and not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb"
