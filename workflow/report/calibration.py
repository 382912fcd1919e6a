"""How often a light of the verdict was right in rooms with truth: the file that `lab/benchmarks/verdicts.py` writes."""

from __future__ import annotations

import json
from functools import lru_cache
from pathlib import Path
from typing import Any

FILE = Path(__file__).resolve().with_name("calibration.json")
FEW = 5
"""Results of which no share is told."""


@lru_cache(None)
def measured() -> dict[str, Any]:
    """Return the document: how many `captures` of how many `rooms` had a result, and for each of `lights` and each colour `of`:
    how many results had it, and `right`: of how many of these what green means was true; `left_out`: the same of green, each room
    judged by thresholds that the others have made."""
    return json.loads(FILE.read_text())


def words(light: str, level: str, meaning: str) -> str:
    """Say what a colour of a light means, with the counts.

    Args:
        light: name of the light.
        level: `green`, `amber` or `red`.
        meaning: what green means, as a clause.
    """
    found = measured()
    made = f"{found['captures']} results of rendered captures, good and spoilt"
    counts = found["lights"][light][level]
    if level == "green":
        return f"Green means that {meaning}. That was true of {counts['right']} of the {counts['of']} green ones of {made}."
    if counts["of"] < FEW:
        return f"Green means that {meaning}. Of {made}, only {counts['of']} had {level} here, too few to say what it means."
    of_them = f"Of {made}, {counts['of']} had {level} here, and {counts['right']} of these were as good all the same"
    return f"Green means that {meaning}. {of_them}."
