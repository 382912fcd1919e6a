"""Plan of `snakemake scenes`: every scene of the batch table, checked on its own before any job starts."""

from __future__ import annotations

import hashlib
import json
import sys
import time
from dataclasses import dataclass
from functools import lru_cache

from iif_core.errors import InputError
from workflow.artifacts.files import sha256_of
from workflow.batch.page import FILES
from workflow.runtime import fingerprint as fp
from workflow.runtime import input_digests
from workflow.settings.batch_table import Line, read_table


@dataclass(frozen=True)
class Plan:
    """The lines of the table; scene -> fingerprint of its deliverable; scene that cannot be run -> reason."""

    lines: tuple[Line, ...]
    ready: dict[str, str]
    refused: dict[str, str]


@lru_cache(None)
def plan(quality: str) -> Plan:
    """Check every scene of the table on its own: its settings, and everything about its source except pixels.

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
                ready[line.name] = fp.fingerprint("publish", line.name, quality)
            except InputError as error:
                refused[line.name] = str(error) if line.at() in str(error) or not line.number else f"{line.at()}: {error}"
            except Exception as error:  # whatever is wrong with one scene must not stop hundreds of others
                refused[line.name] = f"{line.at()}: {type(error).__name__}: {error} (a bug: please report it)"
    return Plan(lines, ready, refused)


def fingerprint(quality: str) -> str:
    """Return a digest that changes with the scenes, their results, the refused scenes and the code of the summary."""
    found = plan(quality)
    code = [fp.modules_digest(fp.modules_of("workflow.batch")), *map(sha256_of, FILES)]
    facts = [[line.number, line.name] for line in found.lines], found.ready, found.refused, quality, code
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:16]
