"""Errors of the sums of the project against exact ones, and what the order of threads and views changes.

Terms are numbers of single precision, whose exact sum is `math.fsum` of them. The error is relative to the sum of the moduli and
in units of the spacing of the type that accumulates; `bound` is what it can be at worst (Higham 2002, section 4.2).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from workflow.runtime import device

PIECE_TERMS = 256
"""Terms that the kernels of the fusion add in single precision."""
PATHS = 4096
"""Terms that one entry of a transport matrix gets at most: paths of a row."""


class Summed(NamedTuple):
    """Error of one way to add on one kind of terms; `error` and `bound` in units of the spacing of `accumulator`."""

    way: str
    accumulator: str
    terms: str
    count: int
    error: float
    bound: float

    @property
    def in_order(self) -> bool:
        return self.error <= self.bound


KINDS = ("positive", "mixed signs", "mixed sizes", "cancelling", "one large")


def make_terms(kind: str, count: int, seed: int = 0) -> NDArray:
    """Make float32 terms of one of `KINDS`."""
    rng = np.random.default_rng([seed, count])
    if kind == "positive":
        return rng.random(count, np.float32)
    out = rng.standard_normal(count, np.float32)
    if kind == "mixed sizes":
        out *= np.exp(5 * rng.standard_normal(count, np.float32))
    elif kind == "cancelling":
        half = count // 2
        out[half : 2 * half] = -out[:half] * (1 + 1e-6 * rng.standard_normal(half, np.float32))
    elif kind == "one large":
        out[0] = 1e8
    return out


VIEW = 1_000_000
"""Terms that are added together, as those of one photograph are."""


def _gram(terms: NDArray, reassociated: bool) -> float:
    import numba

    from iif_core.fusion import kernels

    function = kernels.gram if reassociated else numba.njit(nogil=True)(kernels.gram.py_func)
    total = np.zeros((1, 1, kernels.GRAM))
    for first in range(0, len(terms), VIEW):
        part = terms[first : first + VIEW]
        values, start = np.tile(part, (1, 5, 1)), np.array([0, len(part)])
        total += function(values, np.ones(len(part), np.float32), start, np.zeros((0, 0), bool))
    return float(total[0, 0, 6])


def _to_cell(terms: NDArray) -> float:
    from iif_core.fusion import kernels

    total, summed = np.zeros((2, 1, 5))
    for first in range(0, len(terms), VIEW):
        part = terms[first : first + VIEW]
        kernels.add_to_cells(
            total, summed, np.zeros(len(part), np.int32), np.tile(part, (5, 1)), np.ones((1, len(part)), np.float32)
        )
    return float(summed[0, 0])


def _sparse(terms: NDArray) -> float:
    from scipy.sparse import csr_matrix

    row = csr_matrix((np.ones(len(terms)), (np.zeros(len(terms), np.int32), np.arange(len(terms)))), (1, len(terms)))
    return float((row @ terms.astype(np.float64))[0])


def _grouped(terms: NDArray) -> float:
    import pandas as pd

    return float(pd.DataFrame({"key": np.zeros(len(terms), np.int8), "x": terms.astype(np.float64)}).groupby("key")["x"].sum()[0])


def _parquet(terms: NDArray) -> float:
    import pyarrow as pa
    import pyarrow.compute as pc

    return float(pc.sum(pa.array(terms.astype(np.float64))).as_py())


def _rows_of_matrix(terms: NDArray) -> float:
    """The sum of one lane of a loop that adds to its own row, as the transport matrix is made; single precision."""
    import drjit as dr

    mi = device.mitsuba()
    values, rows, end = mi.Float(terms), dr.zeros(mi.Float, 1), dr.opaque(mi.UInt32, len(terms))

    def body(i: Any) -> tuple[Any]:
        dr.scatter_reduce(dr.ReduceOp.Add, rows, dr.gather(mi.Float, values, i), mi.UInt32(0), mode=dr.ReduceMode.NoConflicts)
        return (i + 1,)

    dr.while_loop((mi.UInt32(0),), lambda i: i < end, body)
    return float(np.asarray(rows)[0])


def _in_a_row(count: int) -> float:
    return count / 2


def _pairwise(count: int) -> float:
    return 128 / 2 + math.log2(max(count / 128, 2)) / 2  # numpy adds blocks of 128 in eight lanes


def _in_pieces(count: int) -> float:
    return PIECE_TERMS / 2 + 1 + count / PIECE_TERMS * 2.0**-30  # single precision within a piece, double beyond


Bound = Callable[[int], float]
WAYS: dict[str, tuple[type, Callable[[NDArray], float], Bound, int]] = {
    "cells of the fusion (compiled, in order)": (np.float64, _to_cell, _in_a_row, 10**9),
    "moments of the fusion (compiled, pieces, reassociated)": (np.float32, lambda x: _gram(x, True), _in_pieces, 10**9),
    "moments of the fusion (compiled, pieces, in order)": (np.float32, lambda x: _gram(x, False), _in_pieces, 10**9),
    "numpy bincount": (np.float64, lambda x: float(np.bincount(np.zeros(len(x), np.int8), x)[0]), _in_a_row, 10**9),
    "numpy sum of doubles": (np.float64, lambda x: float(x.sum(dtype=np.float64)), _in_a_row, 10**9),
    "numpy reduceat to doubles": (np.float64, lambda x: float(np.add.reduceat(x, [0], dtype=np.float64)[0]), _in_a_row, 10**9),
    "numpy sum of singles": (np.float32, lambda x: float(x.sum()), _pairwise, 10**9),
    "sparse matrix of scipy": (np.float64, _sparse, _in_a_row, 10**7),
    "groups of pandas": (np.float64, _grouped, lambda count: 2.0, 10**9),
    "column of pyarrow": (np.float64, _parquet, _in_a_row, 10**9),
    "row of the transport matrix (Dr.Jit, in order)": (np.float32, _rows_of_matrix, _in_a_row, PATHS),
}
"""Name -> (type that accumulates, function, bound in its spacings, largest count that occurs)."""


def table(count: int) -> Iterator[Summed]:
    """Add `count` terms of every kind in every way (fewer where so many do not occur)."""
    for kind in KINDS:
        known: dict[int, tuple[NDArray, float, float]] = {}
        for way, (dtype, function, bound, most) in WAYS.items():
            n = min(count, most)
            if n not in known:
                terms = make_terms(kind, n)
                doubles = terms.astype(np.float64)
                known[n] = (terms, math.fsum(doubles), math.fsum(np.abs(doubles)))
            terms, exact, size = known[n]
            spacing = float(np.finfo(dtype).eps) * size
            yield Summed(way, np.dtype(dtype).name, kind, n, abs(function(terms) - exact) / spacing, bound(n))


class Order(NamedTuple):
    """Largest difference of a result when something is done in another order; 0 = the same bytes."""

    what: str
    changed: str
    difference: float
    allowed: float

    @property
    def in_order(self) -> bool:
        return self.difference <= self.allowed


def orders() -> Iterator[Order]:
    """Change threads, views, predictions and memory of the fusion, which must not change the texture, or by rounding alone."""
    from iif_core.fusion.direct import solve_direct
    from iif_core.fusion.options import FusionOptions

    problem = _fusion_problem()
    reference = solve_direct(problem)

    def apart(other: Any) -> float:
        return float(np.abs(other.value.astype(np.float64) - reference.value).max())

    for threads in (2, 3):
        yield Order("texture of the fusion", f"{threads} threads", apart(solve_direct(problem, threads=threads)), 0.0)
    kept_nowhere = solve_direct(problem, FusionOptions(memory=0))
    yield Order("texture of the fusion", "predictions not kept in memory", apart(kept_nowhere), 0.0)
    rounding = 100 * float(np.finfo(np.float32).eps)
    maps = [problem.view(view) for view in range(len(problem.cell_of_pixel))]
    turned = replace(
        problem,
        predictions=maps[::-1],
        cell_of_pixel=problem.cell_of_pixel[::-1],
        segment_of_pixel=problem.segment_of_pixel[::-1],
    )
    yield Order("texture of the fusion", "views in reverse", apart(solve_direct(turned)), rounding)
    mirrored = replace(problem, predictions=[of_view[::-1] for of_view in maps])
    yield Order("texture of the fusion", "predictions in reverse", apart(solve_direct(mirrored)), rounding)


def _fusion_problem(views: int = 6, pixels: int = 2000, cells: int = 900, objects: int = 5) -> Any:
    from iif_core.fusion.problem import FusionProblem

    rng = np.random.default_rng(7)
    object_of_cell = np.sort(rng.integers(objects, size=cells)).astype(np.int32)
    truth = rng.uniform(0.1, 0.9, (cells, 5))
    maps, cell_of_pixel, segment_of_pixel = [], [], []
    for view in range(views):
        cell = rng.integers(cells, size=pixels).astype(np.int32)
        gain = rng.uniform(0.7, 1.2, (4, objects, 5))[:, object_of_cell[cell]]
        noisy = truth[cell] * gain + 0.03 * rng.standard_normal((4, pixels, 5))
        maps.append(np.clip(noisy, 0.01, 0.99).astype(np.float32))
        cell_of_pixel.append(cell)
        segment_of_pixel.append((view * objects + object_of_cell[cell]).astype(np.int32))
    owners = np.tile(np.arange(objects, dtype=np.int32), views)
    return FusionProblem(
        predictions=maps,
        cell_of_pixel=cell_of_pixel,
        segment_of_pixel=segment_of_pixel,
        n_cells=cells,
        object_of_cell=object_of_cell,
        object_of_segment=owners,
    )
