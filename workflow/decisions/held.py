"""What rooms with truth say of the intervals of objects: the file that `lab/benchmarks/object_intervals.py` writes."""

from __future__ import annotations

import json
from functools import lru_cache
from pathlib import Path
from typing import Any

FILE = Path(__file__).resolve().with_name("intervals.json")


def raw_inputs(document: dict[str, Any]) -> list[Path]:
    """Return the file, whose content is part of the fingerprints of the stages that claim intervals."""
    return [FILE]


@lru_cache(None)
def measured() -> dict[str, Any]:
    """Return the document: `errors` (`iif_core.fitting.intervals.MeasuredErrors`), `told_by` the scenes from which they
    are, and of each quantity in `held` the share of the objects whose truth an interval held that other rooms had made: the mean
    over the `rooms` that were captured as they are (`pooled`), and the `lowest` and `highest`. Of roughness, objects with an
    interval of 0 to 1 do not count. `metals`: how many objects were metal, and of how many of these the interval of metallic held
    that."""
    return json.loads(FILE.read_text())


def rooms() -> int:
    """Return the number of rooms with truth in which intervals were tested."""
    return int(measured()["rooms"])


def words(quantity: str) -> str:
    """Say what the 95 % intervals of a quantity held in rooms with truth, e.g. `94 % (88 to 100 % in a room)`."""
    held = measured()["held"][quantity]
    pooled, low, high = (f"{100 * held[name]:.0f}" for name in ("pooled", "lowest", "highest"))
    return f"{pooled} % ({low} to {high} % in a room)"
