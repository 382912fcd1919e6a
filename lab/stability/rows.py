"""The measurements of all parts as rows of one table, `results/studies/stability.parquet`.

A row is one figure: what was measured (`part`, `subject`, `form`, `case`), the `quantity` with its `value`, the `limit` above
which it is a defect (NaN: none), whether it is `in_order`, and what `says` of it, such as the guard of a limit that is known.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING, Any

from lab.stability import caches, chain, digits, extremes, relations, samplers, sensitivity
from lab.stability.caches import Bias
from lab.stability.digits import Digits, Flips
from lab.stability.extremes import Extreme
from lab.stability.monte_carlo import SIGMAS, Agreement
from lab.stability.relations import Related
from lab.stability.samplers import Drawn
from lab.stability.scalar import THRESHOLD, Accuracy
from lab.stability.sensitivity import Effect
from lab.stability.solvers import BACKWARD_LIMIT, Solved
from lab.stability.sums import Order, Summed

if TYPE_CHECKING:
    import pandas as pd

COLUMNS = ("part", "subject", "form", "case", "quantity", "value", "limit", "in_order", "says")
POINTS = 400
"""Points at which each form of a kernel is tried."""
TERMS = 10**8
"""Terms of the sums; the paper's kitchen has 53 million pixels."""

LIMITS = {
    ("step of materials and response", "condition 0.1 / eps"),
    ("step of materials and response", "duplicate columns"),
}
"""Solvers and matrices beyond which the arithmetic ends; `says` names the guard."""


Row = dict[str, Any]


def _row(part: str, subject: str, form: str, case: str, quantity: str, value: float, limit: float, says: str = "") -> Row:
    in_order = bool(value <= limit) if math.isfinite(limit) else True
    row = (part, subject, form, case, quantity, float(value), float(limit), in_order, says)
    return dict(zip(COLUMNS, row, strict=True))


def of_kernels(found: Iterable[Accuracy]) -> Iterator[Row]:
    """Rows of the kernels: errors in units in the last place, and the ratio to condition x eps with LAPACK's limit."""
    for one in found:
        key = ("kernels", one.kernel, f"{one.library} {one.dtype}", one.output)
        worst = "at " + ", ".join(f"{value:.9g}" for value in one.at)
        yield _row(*key, "points", one.points, math.nan)
        yield _row(*key, "median error / ulp", one.median_ulp, math.nan)
        yield _row(*key, "largest error / ulp", one.worst_ulp, math.nan)
        yield _row(*key, "ratio", one.worst_ratio, THRESHOLD, worst)
        yield _row(*key, "lost", one.lost, 0.0)


def of_solvers(found: Iterable[Solved]) -> Iterator[Row]:
    """Rows of the solvers; the limit of the backward error is void where a guard is named (`LIMITS`)."""
    for one in found:
        form = "single" if one.eps > 1e-10 else "double"
        key = ("solvers", one.solver, form, one.kind)
        judged = (one.solver, one.kind) not in LIMITS and not math.isnan(one.backward)  # some have no matrix to judge
        yield _row(*key, "size", one.size, math.nan)
        yield _row(*key, "condition", one.condition, math.nan)
        yield _row(*key, "backward error / eps", one.backward, BACKWARD_LIMIT if judged else math.nan, one.says)
        yield _row(*key, "forward error", one.forward, math.nan)
        yield _row(*key, "growth", one.growth, math.nan)
        yield _row(*key, "lost", one.lost, 0.0)


def of_sums(found: Iterable[Summed]) -> Iterator[Row]:
    """Rows of the sums; the limit is the bound of the way in which is added."""
    for one in found:
        key = ("sums", one.way, one.accumulator, one.terms)
        yield _row(*key, "terms", one.count, math.nan)
        yield _row(*key, "error / eps", one.error, one.bound)


def of_orders(found: Iterable[Order]) -> Iterator[Row]:
    """Rows of what another order changes."""
    for one in found:
        yield _row("orders", one.what, "float32", one.changed, "difference", one.difference, one.allowed)


def of_relations(found: Iterable[Related]) -> Iterator[Row]:
    """Rows of the relations: distance of the result from the result of the unchanged capture; no limit where it is explained."""
    for one in found:
        for name, value, most in zip(one.found._fields, one.found, one.allowed, strict=True):
            yield _row("relations", one.room, one.yardstick, one.relation, name, value, most, one.explained)


def of_samplers(found: Iterable[Drawn]) -> Iterator[Row]:
    """Rows of the samplers: Pearson's statistic, and the smallest probability that so many tests may show over its own."""
    found = list(found)
    least = samplers.threshold(len(found))
    for one in found:
        key = ("samplers", one.sampler, one.form, one.case)
        yield _row(*key, "draws", one.draws, math.nan)
        yield _row(*key, "cells", one.cells, math.nan)
        yield _row(*key, "statistic / freedom", one.statistic, math.nan)
        yield _row(*key, "threshold / p", least / max(one.probability, 1e-300), 1.0)


def of_caches(found: Iterable[Bias]) -> Iterator[Row]:
    """Rows of cached light: its bias, the standard error of that, and the spread of one run."""
    for one in found:
        key = ("caches", one.room, one.cache, one.paths)
        yield _row(*key, "bias / %", 100 * one.bias, math.nan)
        yield _row(*key, "standard error / %", 100 * one.error, math.nan)
        yield _row(*key, "bias / standard error", one.sigmas, caches.LIMIT if one.judged else math.nan)
        yield _row(*key, "spread / %", 100 * one.spread, math.nan)


def of_renderings(found: Iterable[Agreement]) -> Iterator[Row]:
    """Rows of the renderings: smallest probability below its threshold as a quotient, bias, its error, and fireflies."""
    for one in found:
        key = ("renderings", one.room, "drjit float32", "against Mitsuba")
        yield _row(*key, "pixels x channels", one.tests, math.nan)
        yield _row(*key, "threshold / smallest p", one.threshold / max(one.smallest, 1e-300), 1.0)
        yield _row(*key, "bias / %", 100 * one.bias, math.nan)
        yield _row(*key, "standard error / %", 100 * one.error, math.nan)
        yield _row(*key, "bias / standard error", one.sigmas, SIGMAS)
        yield _row(*key, "fireflies / million", 1e6 * one.fireflies, math.nan)
        yield _row(*key, "of Mitsuba", 1e6 * one.of_reference, math.nan)


def of_extremes(found: Iterable[Extreme]) -> Iterator[Row]:
    """Rows of the extremes: errors against the truth, or the message with which the capture was refused."""
    for one in found:
        key = ("extremes", one.room, "", one.extreme)
        yield _row(*key, "seconds", one.seconds, math.nan, one.says)
        if one.found is None:
            continue
        for name, value in zip(one.found._fields, one.found, strict=True):
            yield _row(*key, name, value, 0.0 if name == "lost" else math.nan)


def of_sensitivity(found: Iterable[Effect]) -> Iterator[Row]:
    """Rows of the effects of factors, in dB or as logarithms."""
    for one in found:
        key = ("sensitivity", one.room, one.levels, one.factor)
        yield _row(*key, f"{one.score}: effect", one.mean, math.nan)
        yield _row(*key, f"{one.score}: size", one.size, math.nan)
        yield _row(*key, f"{one.score}: error", one.error, math.nan)


def of_digits(found: Iterable[Digits | Flips]) -> Iterator[Row]:
    """Rows of significant digits, amplification, and decisions that came out otherwise."""
    for one in found:
        if isinstance(one, Flips):
            key = ("digits", one.room, one.moved, one.decision)
            yield _row(*key, "flips", one.count, math.nan)
            yield _row(*key, "of", one.of, math.nan)
            continue
        key = ("digits", one.room, one.moved, f"{one.stage}: {one.column}")
        yield _row(*key, "median digits", one.median, math.nan)
        yield _row(*key, "digits of 99 %", one.low, math.nan)
        yield _row(*key, "share with 3 digits", one.enough, math.nan)
        yield _row(*key, "amplification", one.amplification, math.nan)


def _kernels() -> Iterator[Row]:
    from lab.stability import kernels, scalar

    log = logging.getLogger("stability")
    for number, kernel in enumerate(kernels.KERNELS, 1):
        log.info("kernels: %d of %d: %s", number, len(kernels.KERNELS), kernel.name)
        yield from of_kernels(scalar.accuracy(kernel, POINTS))


def _solvers() -> Iterator[Row]:
    from lab.stability import solvers

    return of_solvers(solvers.table())


def _sums() -> Iterator[Row]:
    from lab.stability import sums

    log = logging.getLogger("stability")
    for one in sums.table(TERMS):
        log.info("sums: %s, %s", one.way, one.terms)
        yield from of_sums([one])
    yield from of_orders(sums.orders())


def _relations() -> Iterator[Row]:
    log = logging.getLogger("stability")
    for room in chain.ROOMS:
        for one in relations.measure(room):
            log.info("relations: %s: %s%s", room, one.relation, f": beyond: {', '.join(one.beyond)}" if one.beyond else "")
            yield from of_relations([one])


def _digits() -> Iterator[Row]:
    log = logging.getLogger("stability")
    for room in chain.ROOMS:
        log.info("digits: %s", room)
        yield from of_digits(digits.measure(room))


def _renderings() -> Iterator[Row]:
    from lab.stability import monte_carlo

    log = logging.getLogger("stability")
    for one in monte_carlo.measure():
        log.info("renderings: %s", one.room)
        yield from of_renderings([one])


def _samplers() -> Iterator[Row]:
    return of_samplers(samplers.measure())


def _caches() -> Iterator[Row]:
    log = logging.getLogger("stability")
    for room in chain.ROOMS:
        for one in caches.measure(room):
            log.info("caches: %s: %s, %s", room, one.cache, one.paths)
            yield from of_caches([one])


def _extremes() -> Iterator[Row]:
    log = logging.getLogger("stability")
    for one in extremes.measure():
        log.info("extremes: %s: %s", one.room, one.extreme)
        yield from of_extremes([one])


def _sensitivity() -> Iterator[Row]:
    there = sensitivity.rooms()
    for room in sensitivity.ROOMS:
        if room not in there:
            logging.getLogger("stability").warning("sensitivity: %s is left out: its files are not there", room)
            continue
        yield from of_sensitivity(sensitivity.measure(room))


PARTS: dict[str, Callable[[], Iterator[Row]]] = {
    "kernels": _kernels,
    "solvers": _solvers,
    "sums": _sums,
    "relations": _relations,
    "digits": _digits,
    "samplers": _samplers,
    "renderings": _renderings,
    "caches": _caches,
    "extremes": _extremes,
    "sensitivity": _sensitivity,
}
"""Name of a part -> its rows."""


def measure(part: str) -> pd.DataFrame:
    """Measure one of `PARTS`."""
    import numpy as np
    import pandas as pd

    with np.errstate(all="ignore"):
        return pd.DataFrame(list(PARTS[part]()), columns=list(COLUMNS))
