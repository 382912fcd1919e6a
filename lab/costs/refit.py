"""`python -m lab costs`: add finished jobs to the table of costs, and fit the model to it again."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path
from statistics import median
from typing import Any

from lab.costs.fit import fit_rows, write_fits
from lab.costs.records import gather, read_rows, write_rows
from workflow.costs.machine import SHORTEST
from workflow.costs.model import MEASURES, SHIPPED, Fits

TABLE = Path("lab/notebook/data/costs.csv")
"""The rows that the shipped coefficients were fitted to."""


def refit(folders: Iterable[Path], table: Path = TABLE, fits: Path = SHIPPED, sizes: bool = False) -> list[str]:
    """Add the finished jobs under `folders` to the table, fit all costs again, and return lines that say how well they fit.

    Args:
        folders: like `results/`; with none, the table stays as it is. A job that the table has already is not added twice. All
            jobs of a folder are of one machine, whose factor is found by what the table says of such jobs.
        table: CSV file of rows (`lab.costs.records.write_rows`).
        fits: JSON file that is written.
        sizes: the jobs of the folders shared the machine with other jobs. Take their memory and disk, but take their times only
            for kinds of which the table has no times.
    """
    rows = list(read_rows(table)) if table.is_file() else []
    before, lines = len(rows), []
    for folder in folders:
        known = {_identity(row) for row in rows}
        new = [row for row in gather([folder]) if _identity(row) not in known]
        factor = _factor(new, fit_rows(rows)) if rows and not sizes else 1.0
        timed = {(row["stage"], row["kind"]) for row in rows if row.get("cpu_seconds")}
        for row in new:
            untimed = sizes and (row["stage"], row["kind"]) in timed
            rows.append({**row, "machine": factor, **({"cpu_seconds": 0.0} if untimed else {})})
        lines.append(f"{folder}: {len(new)} new jobs of a machine that takes {factor:.3g} times as long")
    if len(rows) > before:
        write_rows(table, rows)
        rows = list(read_rows(table))
    found = fit_rows(rows)
    write_fits(fits, found)
    return [*lines, f"{table}: {len(rows)} jobs, {len(rows) - before} of them new", *_lines(found)]


def _factor(rows: list[dict[str, Any]], fits: Fits) -> float:
    """Return how many times as long some jobs took as those that were fitted, in the median over stages and kinds; 1 where
    nothing tells."""
    ratios: dict[tuple[str, str], list[float]] = defaultdict(list)
    for row in rows:
        fit = fits.get((row["stage"], row["kind"], "cpu_seconds"))
        expected = fit.predict(row).middle if fit else 0.0
        if expected > 0 and row["cpu_seconds"] >= SHORTEST:
            ratios[row["stage"], row["kind"]].append(row["cpu_seconds"] / expected)
    return float(f"{median(median(of_kind) for of_kind in ratios.values()):.3g}") if ratios else 1.0


def _identity(row: dict[str, Any]) -> tuple[str, str, float]:
    return row["stage"], row["fingerprint"], float(row["seconds"])


def _lines(fits: Fits) -> list[str]:
    lines = [
        "Range of actual over predicted cost, from the 10 to the 90 % quantile, in rooms that a fit did not see:",
        "| stage, kind | jobs | rooms | CPU seconds | memory | disk | divided by threads |",
        "|---|---:|---:|---|---|---|---:|",
    ]
    for stage, kind in sorted({key[:2] for key in fits}):
        cells = [fits.get((stage, kind, measure)) for measure in MEASURES]
        counted = max((fit for fit in cells if fit), key=lambda fit: fit.jobs)
        ranges = [f"{fit.low:.2f} to {fit.high:.2f}" if fit else "" for fit in cells]
        divided = f"{100 * cells[0].divided:.0f} %" if cells[0] else ""
        lines.append(f"| {stage}, {kind} | {counted.jobs} | {counted.rooms} | {' | '.join([*ranges, divided])} |")
    return lines
