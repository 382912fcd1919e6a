"""What having a component of the plan is expected to bring and to cost, from what it did in other rooms."""

from __future__ import annotations

import json
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

from workflow.decisions.record import Decision

SHIPPED = Path(__file__).with_name("claims.json")
"""Made from the rows of the study `regret` (docs/method/plan.md#what-is-expected-of-a-component)."""
STAGES = ("plan", "base", "emission", "shading", "affines", "render")
"""Stages whose cost the shares of `SHIPPED` are of."""

COLUMNS = ("cpu_seconds", "max_rss_mb", "disk_mb")
"""Names of the shares, in the order of `Whole`."""


class Whole(NamedTuple):
    """What the stages of `STAGES` are expected to cost together (`workflow.runtime.forecast.together`): CPU seconds, peak memory
    and disk in MB."""

    cpu_seconds: float
    memory_mb: float
    disk_mb: float


@lru_cache(None)
def claims(path: Path = SHIPPED) -> dict[str, Any]:
    """Return component -> `included` or `left_out` -> gain and shares (`lab/docs/studies.md`)."""
    return json.loads(path.read_text())


def with_expectation(item: Decision, whole: tuple[float, float, float] | None, path: Path = SHIPPED) -> Decision:
    """Return a decision with what is expected of having its component, `expected`, where it was measured in other rooms:
    `held_out_db` and `held_out_db_range` (gain on held-out photographs: median, smallest and largest), `rooms`, and
    `cpu_seconds`, `memory_mb`, `disk_mb` (what it adds to the scene)."""
    claim = claims(path).get(item["component"], {}).get("included" if item["included"] else "left_out")
    if claim is None:
        return item
    middle, low, high = claim["held_out_db"]
    expected: dict[str, Any] = {"held_out_db": middle, "held_out_db_range": [low, high], "rooms": claim["rooms"]}
    if whole is not None:
        sizes = zip(Whole._fields, COLUMNS, whole, strict=True)
        expected |= {name: round(claim[column] * size, 1) for name, column, size in sizes if column in claim}
    return {**item, "expected": expected}
