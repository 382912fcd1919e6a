"""Plan of `snakemake scenes`: every scene of the batch table, checked on its own before any job starts."""

from __future__ import annotations

import hashlib
import json
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from iif_core.errors import InputError
from workflow.artifacts import DamagedArtefact, links, sound
from workflow.artifacts.files import is_inside, read_record, sha256_of
from workflow.batch.page import FILES
from workflow.runtime import fingerprint as fp
from workflow.runtime import input_digests
from workflow.runtime.job_state import written_out
from workflow.scene.named import check_overrides
from workflow.settings.batch_table import Line, read_table

FOLDER = Path("results/batch")
WRITTEN = ("summary.parquet", "summary.tsv", "report.html")


@dataclass(frozen=True)
class Plan:
    """The lines of the table; scene -> fingerprint of its deliverable; scene that cannot be run -> reason."""

    lines: tuple[Line, ...]
    ready: dict[str, str]
    refused: dict[str, str]


@lru_cache(None)
def plan(quality: str) -> Plan:
    """Check every scene of the table on its own: its settings, everything about its source except pixels, and whatever else of it
    would stop a plan (`check`).

    Raises:
        InputError: the table itself cannot be read (`read_table`).
    """
    lines = read_table()
    ready, refused = {}, {}
    said = time.monotonic()
    with input_digests.saved_once():
        for done, line in enumerate(lines):
            if time.monotonic() > said + 5:
                said = time.monotonic()
                print(f"batch: {done} of {len(lines)} scenes checked", file=sys.stderr)
            try:
                mark = fp.fingerprint("publish", line.name, quality)
                check(line.name, quality)
                ready[line.name] = mark
            except InputError as error:
                refused[line.name] = str(error) if line.at() in str(error) or not line.number else f"{line.at()}: {error}"
            except Exception as error:  # whatever is wrong with one scene must not stop hundreds of others
                reason = f"{line.at() + ': ' if line.number else ''}{type(error).__name__}: {error} (a bug: please report it)"
                refused[line.name] = written_out(reason)
    return Plan(lines, ready, refused)


def faults_of_the_summary() -> tuple[str, ...]:
    """Return what is wrong with the table and the page of a batch that was complete, a line for each file."""
    try:
        lines = read_record(FOLDER / "complete").decode().splitlines()[1:]
    except (OSError, ValueError):
        return ()
    out = []
    for digest, _, name in (line.partition("  ") for line in lines):
        path = FOLDER / name
        if not is_inside(FOLDER, name) or not path.is_file():
            out.append(f"{path}: missing")
        elif sha256_of(path) != digest:
            out.append(f"{path}: its content changed since it was written")
    return tuple(out)


def check(scene: str, quality: str) -> tuple[str, ...]:
    """Check what Snakemake's plan of a scene looks at besides its settings and its source. Return the faults of what is
    published; publishing it again mends them.

    Raises:
        InputError: the folder of what is published is a file, or a link is where jobs write; or as `check_stage`.
    """
    links.check_folders(Path("results"), scene)
    for stage in fp.needed(scene, quality):
        check_stage(stage, scene, quality)
    mark = fp.fingerprint("publish", scene, quality)
    return sound.deliverable_faults(Path(f"scenes/{scene}"), Path("results"), scene, mark)


def check_stage(stage: str, scene: str, quality: str) -> tuple[str, ...]:
    """Check what of a stage lies in results/, and return what is wrong with it that making it again mends (`stage_faults`).

    Raises:
        InputError: a file is in the way, the stage is of an earlier version, or `materials` names what is not there.
    """
    mark = fp.fingerprint(stage, scene, quality)
    links.check_folders(Path("results"), scene, stage)
    with suppress(DamagedArtefact):  # of a segmentation that will be made again; then its objects are known
        check_overrides(stage, scene, quality)
    return sound.stage_faults(Path("results"), scene, stage, mark)


def fingerprint(quality: str) -> str:
    """Return a digest that changes with the scenes, their results, the refused scenes and the code of the summary."""
    found = plan(quality)
    code = [fp.modules_digest(fp.modules_of("workflow.batch")), *map(sha256_of, FILES)]
    facts = [[line.number, line.name] for line in found.lines], found.ready, found.refused, quality, code
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:16]
