"""A model of what jobs cost.

cost = factor of the machine x sum over counts of (coefficient x count), for CPU seconds, memory and disk, for every stage and
kind. Wall seconds follow from CPU seconds and from the share of them that threads divide. The laboratory fits the coefficients to
jobs that are done (docs/development/costs.md).
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from workflow.costs.work import Work

SHIPPED = Path(__file__).with_name("coefficients.json")
MEASURES = ("cpu_seconds", "memory_mb", "disk_mb")


class Range(NamedTuple):
    """A predicted cost: the middle, and the bounds of 10 and 90 per cent."""

    middle: float
    low: float
    high: float

    def __mul__(self, factor: float) -> Range:  # type: ignore[override]
        return Range(self.middle * factor, self.low * factor, self.high * factor)


@dataclass(frozen=True)
class Fit:
    """Coefficients of one measure of one kind of job, and factors for the bounds of 10 and 90 per cent.

    `divided`: share of the CPU seconds that threads divide among them, 0 ... 1; 0 where no job of two threads tells.
    """

    coefficients: dict[str, float]
    low: float
    high: float
    jobs: int
    rooms: int
    divided: float = 0.0

    def predict(self, counts: dict[str, float]) -> Range:
        middle = sum(value * counts.get(name, 0.0) for name, value in self.coefficients.items())
        return Range(middle, middle * self.low, middle * self.high)


Fits = dict[tuple[str, str, str], Fit]
"""(stage, kind, measure) -> fit."""


class Cost(NamedTuple):
    """What a job will cost; a measure that was never fitted for this kind of job is None."""

    cpu_seconds: Range | None
    seconds: Range | None
    memory_mb: Range | None
    disk_mb: Range | None


@lru_cache(None)
def shipped() -> Fits:
    """Return the fits that come with the project."""
    return read_fits(SHIPPED)


def predict(stage: str, work: Work, threads: int = 2, machine: float = 1.0, fits: Fits | None = None) -> Cost:
    """Return what a job will cost.

    Of c CPU seconds, of which threads divide the share s, n threads take c (1 - s + s/n) of wall time (Amdahl).

    Args:
        stage, work: the job (`workflow.costs.work.work_of`).
        threads: that it may use.
        machine: times as slow as the machine of the fits.
        fits: default: those that come with the project.
    """
    fits = shipped() if fits is None else fits
    of_kind = {name: fits.get((stage, work.kind, name)) for name in MEASURES}
    cpu, memory, disk = (fit.predict(work.counts) if fit else None for fit in of_kind.values())
    if cpu is None:
        return Cost(None, None, memory, disk)
    divided = of_kind["cpu_seconds"].divided
    return Cost(cpu * machine, cpu * (machine * (1 - divided + divided / max(threads, 1))), memory, disk)


def read_fits(path: Path) -> Fits:
    """Read what `write_fits` wrote."""
    tree = json.loads(path.read_text())
    return {
        (stage, kind, measure): Fit(
            entry["coefficients"], *entry["range"], entry["jobs"], entry["rooms"], entry.get("divided", 0.0)
        )
        for stage, kinds in tree.items()
        for kind, measures in kinds.items()
        for measure, entry in measures.items()
    }
