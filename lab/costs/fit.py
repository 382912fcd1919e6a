"""The cost of jobs, fitted to jobs that are done.

Coefficients are non-negative and minimise the squared error of the logarithm, which counts large errors by their size (Huber) and
many jobs of one room as the square root of their number. The range comes from the errors at rooms that the fit has not seen.
"""

from __future__ import annotations

import json
import math
from collections import Counter, defaultdict
from collections.abc import Iterable
from pathlib import Path
from statistics import median
from typing import Any

from workflow.artifacts.files import write_atomically
from workflow.costs.model import MEASURES, Fit, Fits

OF_MEMORY = ("a_view",)
"""Counts that only memory follows: what is held at once, and not the total that is processed."""
SIZES = ("a_view", "pixels", "faces")
"""Counts that tell one size of a room from another."""
TIMES = ("cpu_seconds", "seconds")
"""Columns that follow the speed of the machine."""
FEWEST_ROOMS = 3
"""Number of rooms from which on errors at unseen rooms are measured; with fewer, the range is `UNMEASURED`."""
LEAST_RATIO = 2.0
"""Ratio of the largest to the smallest count, faces excepted, below which all jobs are of one size."""
LEAST_SHARE = 1e-4
"""Share of the cost below which a count is left out."""
UNMEASURED = (0.5, 2.0)
"""Range of a time of which nothing better is known, as factors on it."""
UNMEASURED_SIZE = (0.75, 1.35)
"""The same of memory and disk, which differ less from room to room."""
HUBER = 0.4
"""Logarithm of actual over predicted cost from which on an error counts by its size instead of its square."""
ROUNDS = 40
"""Least-squares problems that are solved for one fit."""


def fit_rows(rows: Iterable[dict[str, Any]]) -> Fits:
    """Fit the cost of every kind of job.

    Args:
        rows: of `lab.costs.records`: scene, stage, kind, threads, machine, the measures, wall seconds and the counts. Times
            of all machines are brought to those of factor 1.
    """
    of_kind: dict[tuple[str, str], list[dict[str, Any]]] = defaultdict(list)
    for row in rows:
        times = {name: row[name] / row.get("machine", 1.0) for name in TIMES if name in row}
        of_kind[row["stage"], row["kind"]].append({**row, **times})
    fits = {}
    for (stage, kind), jobs in sorted(of_kind.items()):
        for measure in MEASURES:
            used = [row for row in jobs if row.get(measure, 0.0) > 0]
            if used:
                fits[stage, kind, measure] = _fit(used, measure)
    return fits


def _fit(rows: list[dict[str, Any]], measure: str) -> Fit:
    fixed = {"scene", "stage", "kind", "threads", "machine", "fingerprint", *MEASURES, *TIMES}
    names = [name for name in rows[0] if name not in fixed]
    if measure != "memory_mb":
        names = [name for name in names if name not in OF_MEMORY]
    if measure in TIMES and not _sizes_differ(rows, names):
        names.remove("job")
    coefficients = _coefficients(rows, names, measure)
    rooms = sorted({row["scene"] for row in rows})
    low, high = UNMEASURED if measure in TIMES else UNMEASURED_SIZE
    if len(rooms) >= FEWEST_ROOMS:
        errors = {}
        for case in dict.fromkeys(_case(row, measure) for row in rows):
            others = _coefficients([row for row in rows if _case(row, measure) != case], names, measure)
            errors[case] = [_error(row, others, measure) for row in rows if _case(row, measure) == case]
        low, high = _quantiles(errors)
    return Fit(coefficients, low, high, len(rows), len(rooms), _divided(rows) if measure == "cpu_seconds" else 0.0)


def _case(row: dict[str, Any], measure: str) -> tuple[Any, ...]:
    """Return what a fit must not have seen for its error at this job to count: the room, for memory the room at this size. Memory
    follows the size far more than the room, and without all sizes of a room a fit may lack the largest ones."""
    return (row["scene"], *(row.get(name, 0.0) for name in SIZES)) if measure == "memory_mb" else (row["scene"],)


def _divided(rows: list[dict[str, Any]]) -> float:
    """Return the share s of CPU seconds that threads divide, from jobs of two: their wall time is c (1 - s/2)."""
    ratios = [row["seconds"] / row["cpu_seconds"] for row in rows if row["threads"] == 2 and row.get("seconds", 0.0) > 0]
    return float(f"{min(max(2 * (1 - median(ratios)), 0.0), 1.0):.3g}") if ratios else 0.0


def _sizes_differ(rows: list[dict[str, Any]], names: list[str]) -> bool:
    """Return whether the jobs tell what starting one costs from what its work costs. Where they do not, all of its time is taken
    to grow with the work: a larger scene that is promised the time of a small one would be ended by a scheduler."""
    sizes = ([row.get(name, 0.0) for row in rows] for name in names if name not in ("job", "faces", *OF_MEMORY))
    return names == ["job"] or any(max(values) > LEAST_RATIO * min(values) > 0 for values in sizes)


def _coefficients(rows: list[dict[str, Any]], names: list[str], measure: str) -> dict[str, float]:
    """Minimise the sum of rho(log p) over non-negative coefficients, p = predicted over actual cost, rho Huber's function: a
    sequence of non-negative least-squares problems in p - 1 with the weights that make their gradients agree."""
    import numpy as np
    from scipy.optimize import nnls

    counts = np.array([[row.get(name, 0.0) for name in names] for row in rows])
    relative = counts / np.array([row[measure] for row in rows])[:, None]
    scale = np.maximum(np.sqrt((relative**2).mean(axis=0)), 1e-300)
    of_room = Counter(row["scene"] for row in rows)
    balance = np.array([of_room[row["scene"]] ** -0.5 for row in rows])
    weights = balance
    for _ in range(ROUNDS):
        root = np.sqrt(weights)
        solution, _ = nnls(relative / scale * root[:, None], root)
        p = np.maximum(relative / scale @ solution, 1e-3)
        log = np.log(p)
        slope = np.where(np.abs(p - 1) > 1e-6, log / np.where(p == 1, 1.0, p - 1), 1.0)
        weights = balance * slope / p / np.maximum(1.0, np.abs(log) / HUBER)
    share = solution * np.average(relative, axis=0, weights=balance) / scale  # of the cost of the jobs, in the mean
    found = zip(names, solution / scale, share, strict=True)
    return {name: float(f"{value:.5g}") for name, value, part in found if part > LEAST_SHARE}


def _error(row: dict[str, Any], coefficients: dict[str, float], measure: str) -> float:
    """Return the logarithm of actual over predicted cost."""
    predicted = sum(value * row.get(name, 0.0) for name, value in coefficients.items())
    return math.log(row[measure] / predicted) if predicted > 0 else 0.0


def _quantiles(errors: dict[Any, list[float]]) -> tuple[float, float]:
    """Return the factors of 10 and 90 per cent; rooms count as in the fit."""
    import numpy as np

    values = np.concatenate(list(errors.values()))
    weights = np.concatenate([np.full(len(own), len(own) ** -0.5) for own in errors.values()])
    low, high = np.quantile(values, [0.1, 0.9], weights=weights, method="inverted_cdf")
    return float(f"{min(math.exp(low), 1.0):.3g}"), float(f"{max(math.exp(high), 1.0):.3g}")


def write_fits(path: Path, fits: Fits) -> None:
    """Write fits as JSON: stage -> kind -> measure."""
    tree: dict[str, Any] = {}
    for (stage, kind, measure), fit in fits.items():
        entry = {"coefficients": fit.coefficients, "range": [fit.low, fit.high], "jobs": fit.jobs, "rooms": fit.rooms}
        entry |= {"divided": fit.divided} if measure == "cpu_seconds" else {}
        tree.setdefault(stage, {}).setdefault(kind, {})[measure] = entry
    lines = json.dumps(tree, indent=1)
    write_atomically(path, lambda temporary: temporary.write_text(lines + "\n"))
