"""Errors of elementwise kernels against the same formula in 50 digits.

Of a kernel f at floating-point arguments x the error is |computed - f(x)|, the condition number kappa the sum over the arguments
of |x_i df/dx_i / f|, and the *ratio* error / (|f| eps max(kappa, 1)): what is left when the part of the error that any
algorithm has to make is divided out. 30 is the threshold of LAPACK's own tests. Results below the smallest normal number count
as zero, because vector units flush them. Components of a unit vector that a GPU computed are measured against the length of the
vector, 1 in the place of |f|, because its sine and cosine have digits of that size alone
(docs/method/numerics.md#arithmetic-of-a-gpu).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import mpmath as mp
import numpy as np

from workflow.runtime import device

DIGITS = 50
"""Of the oracle."""
STEP = mp.mpf(10) ** -20
"""Relative step of the differences that give the condition; its error is far below what a condition number is used for."""
THRESHOLD = 30.0
"""Largest ratio of a kernel that is in order (LAPACK's threshold)."""
FLUSHES = ("drjit",)
"""Libraries that take numbers below the smallest normal one for zero."""
Exact = Callable[..., Any]
Form = Callable[[list[np.ndarray]], Any]


@dataclass(frozen=True)
class Argument:
    """An argument of a kernel: the range for which the kernel is written, and values of interest in it.

    Attributes:
        low, high: ends of the range, between which values are drawn on a logarithmic grid; `low` = 0 starts it at the smallest
            normal number, and 0 and the smallest number of all are tried too.
        special: branch points and others, each tried with the numbers on either side.
        towards_one: whether 1 - x is drawn on a logarithmic grid as well, where the kernel reads it.
        signed: whether -x is tried too.
        zero: whether 0 belongs to the range, also where `low` is positive.
    """

    low: float
    high: float
    special: tuple[float, ...] = ()
    towards_one: bool = False
    signed: bool = False
    zero: bool = False

    def values(self, count: int, dtype: type, rng: np.random.Generator) -> np.ndarray:
        """Draw `count` values of the range, half of them from the values of interest."""
        info = np.finfo(dtype)
        smallest = max(self.low, float(info.tiny))
        largest = min(self.high, float(info.max))
        grid = np.exp(rng.uniform(math.log(smallest), math.log(largest), count))
        if self.towards_one:
            near = 1 - np.exp(rng.uniform(math.log(float(info.eps)), 0.0, count))
            grid = np.where(rng.random(count) < 0.5, grid, near)
        if self.signed:
            grid = grid * rng.choice([-1.0, 1.0], count)
        chosen = np.asarray(list(self._interesting(dtype)), dtype)
        picked = chosen[rng.integers(len(chosen), size=count)]
        out = np.where(rng.random(count) < 0.5, grid.astype(dtype), picked)
        return np.clip(out, dtype(-largest if self.signed else 0.0 if self.zero else self.low), dtype(largest)).astype(dtype)

    def _interesting(self, dtype: type) -> Iterator[float]:
        info = np.finfo(dtype)
        ends = (self.low, min(self.high, float(info.max)), *self.special)
        for value in (*ends, *((-value for value in ends) if self.signed else ())):
            at = dtype(value)
            for one in (np.nextafter(at, dtype(-np.inf)), at, np.nextafter(at, dtype(np.inf))):
                inside = abs(one) <= self.high if self.signed else self.low <= one <= self.high
                if inside and np.isfinite(one):
                    yield float(one)
        if self.zero:
            yield 0.0


@dataclass(frozen=True)
class Kernel:
    """An elementwise function in several forms.

    Attributes:
        name: as in the table.
        exact: the formula of its documentation for mpmath numbers; a number, or a tuple where there are several results.
        outputs: names of the results.
        arguments: name -> its range.
        forms: (library, dtype) -> the function of the project for a list of arrays.
        prepare: makes arguments that belong together, such as unit vectors, of those that were drawn.
        turned: whether the results are components of a unit vector that is turned by sines and cosines of angles.
    """

    name: str
    exact: Exact
    outputs: tuple[str, ...]
    arguments: Mapping[str, Argument]
    forms: Mapping[tuple[str, type], Form]
    prepare: Callable[[list[np.ndarray], np.random.Generator], list[np.ndarray]] | None = None
    turned: bool = False


class Accuracy(NamedTuple):
    """Errors of one result of one form of a kernel, in units in the last place and relative to its condition.

    `at` has the arguments of the worst ratio; `lost` counts results that are not finite where the exact one is."""

    kernel: str
    output: str
    library: str
    dtype: str
    points: int
    median_ulp: float
    worst_ulp: float
    worst_condition: float
    worst_ratio: float
    lost: int
    at: tuple[float, ...]

    @property
    def in_order(self) -> bool:
        return self.worst_ratio <= THRESHOLD and not self.lost


def arguments(kernel: Kernel, dtype: type, count: int, rng: np.random.Generator) -> list[np.ndarray]:
    """Draw points at which a kernel is tried."""
    drawn = [argument.values(count, dtype, rng) for argument in kernel.arguments.values()]
    return kernel.prepare(drawn, rng) if kernel.prepare else drawn


def accuracy(kernel: Kernel, count: int, seed: int = 0) -> list[Accuracy]:
    """Measure all forms of a kernel at `count` points each; a row for each result of each form.

    Forms of one dtype are tried at the same points, but for numbers below the smallest normal one, which are 0 in libraries of
    `FLUSHES`.
    """
    out: list[Accuracy] = []
    known: dict[tuple[type, bool], tuple[list[np.ndarray], list[Any], list[Any]]] = {}
    for library, dtype in kernel.forms:
        flushes = library in FLUSHES
        if (dtype, flushes) not in known:
            points = arguments(kernel, dtype, count, np.random.default_rng([seed, *kernel.name.encode()]))
            if flushes:
                points = [np.where(np.abs(column) < np.finfo(dtype).tiny, dtype(0), column) for column in points]
            known[dtype, flushes] = (points, *_exact_and_change(kernel, points))
        points, exact, change = known[dtype, flushes]
        with np.errstate(all="ignore"):
            computed = kernel.forms[library, dtype](points)
        columns = computed if isinstance(computed, tuple) else (computed,)
        for i, name in enumerate(kernel.outputs):
            column = np.asarray(columns[i], np.float64).reshape(-1)
            wanted, moved = [row[i] for row in exact], [row[i] for row in change]
            least = 1.0 if kernel.turned and library == "drjit" and _on_gpu() else float(np.finfo(dtype).tiny)
            out.append(_accuracy(kernel, name, (library, dtype), points, column, wanted, moved, least))
    return out


def _on_gpu() -> bool:
    """Whether Dr.Jit's arrays are on a CUDA device."""
    return device.mitsuba().variant().startswith("cuda")


def _exact_and_change(kernel: Kernel, points: Sequence[np.ndarray]) -> tuple[list[tuple[Any, ...]], list[tuple[Any, ...]]]:
    """Exact results at all points, and the sum of |x_i df/dx_i| there, for every result."""
    exact, change = [], []
    with mp.workdps(DIGITS):
        for row in zip(*points, strict=True):
            x = [mp.mpf(float(value)) for value in row]
            middle = _tuple(kernel.exact(*x))
            moved = [mp.mpf(0)] * len(middle)
            for i, value in enumerate(x):
                if value == 0:
                    continue
                sides = [_tuple(kernel.exact(*x[:i], value * (1 + step), *x[i + 1 :])) for step in (STEP, -STEP)]
                for o, of in enumerate(middle):
                    moved[o] += max(abs(side[o] - of) for side in sides) / STEP
            exact.append(middle)
            change.append(tuple(moved))
    return exact, change


def _tuple(value: Any) -> tuple[Any, ...]:
    return tuple(mp.mpf(one) for one in value) if isinstance(value, tuple) else (mp.mpf(value),)


def _accuracy(
    kernel: Kernel,
    output: str,
    form: tuple[str, type],
    points: Sequence[np.ndarray],
    computed: np.ndarray,
    exact: Sequence[Any],
    change: Sequence[Any],
    least: float,
) -> Accuracy:
    """Errors of one result; those of results below `least` count relative to `least`."""
    library, dtype = form
    info = np.finfo(dtype)
    ulps, ratios, conditions, lost = [], [], [], 0
    with mp.workdps(DIGITS):
        for got, wanted, moved in zip(computed, exact, change, strict=True):
            size = abs(wanted)
            if size > float(info.max):  # nothing but infinity can be said
                good = math.isinf(got) and (got > 0) == (wanted > 0)
                ulps.append(0.0 if good else math.inf), ratios.append(0.0 if good else math.inf), conditions.append(1.0)
                continue
            if not math.isfinite(got):
                lost += 1
                ulps.append(math.inf), ratios.append(math.inf), conditions.append(math.nan)
                continue
            error = abs(mp.mpf(float(got)) - wanted)
            floor = mp.mpf(float(info.tiny))
            if size < floor and abs(got) <= float(info.tiny):
                ulps.append(0.0), ratios.append(0.0), conditions.append(1.0)
                continue
            ulps.append(float(error / mp.mpf(float(np.spacing(dtype(max(float(size), float(info.tiny))))))))
            scale = max(size, moved, mp.mpf(least)) * float(info.eps)
            ratios.append(float(error / scale))
            conditions.append(float(moved / size) if size else math.inf)
    worst = int(np.argmax(ratios))
    return Accuracy(
        kernel.name,
        output,
        library,
        np.dtype(dtype).name,
        len(ratios),
        float(np.median(ulps)),
        float(np.max(ulps)),
        conditions[worst],
        ratios[worst],
        lost,
        tuple(float(column[worst]) for column in points),
    )


def table(kernels: Sequence[Kernel], count: int, seed: int = 0) -> list[Accuracy]:
    """Measure all forms of all kernels."""
    return list(itertools.chain.from_iterable(accuracy(kernel, count, seed) for kernel in kernels))
