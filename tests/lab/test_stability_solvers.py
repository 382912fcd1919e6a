"""Solvers on matrices of LAPACK's kinds, sums against exact ones, and the measures themselves."""

import math

import numpy as np
import pytest

from lab.stability import rows, solvers, sums
from lab.stability.sums import Summed


@pytest.mark.long
@pytest.mark.parametrize("solver", solvers.SOLVERS, ids=lambda solver: solver.__name__)
def test_solvers_are_backward_stable_or_name_their_guard(solver):
    found = list(solver())
    assert len(found) >= 5
    for one in found:
        assert one.lost == 0, one
        assert one.in_order or ((one.solver, one.kind) in rows.LIMITS and one.says), one
        if not one.says and math.isfinite(one.growth):
            assert one.growth < 100, one  # the error is what the condition explains


def test_the_camera_response_is_found_from_exact_values():
    error = {one.kind: one.forward for one in solvers.calibration()}
    assert max(value for kind, value in error.items() if "levels" not in kind) < 1e-3
    assert error["gamma 1.9, 3 levels"] < 0.05


@pytest.mark.long
def test_every_known_limit_occurs():
    kinds = {(one.solver, one.kind) for one in solvers.table() if one.backward > solvers.BACKWARD_LIMIT}
    assert rows.LIMITS == kinds


@pytest.mark.parametrize("kind", solvers.KINDS)
def test_matrices_are_what_they_are_called(kind):
    matrix = solvers.gram(kind, 8, np.random.default_rng(0))
    assert np.array_equal(matrix, matrix.T)
    condition = solvers.condition_of(matrix)
    if kind in ("zero columns", "duplicate columns"):
        assert math.isinf(condition)
    else:
        wanted = {"condition 2": 2.0, "condition 0.1 / eps": 0.1 / solvers.EPS}.get(kind, 1e4)
        assert condition == pytest.approx(wanted, rel=0.5)


def test_backward_and_forward_error_measure_what_they_say():
    rng = np.random.default_rng(1)
    matrix, x = solvers.gram("condition 1e4", 6, rng), rng.normal(size=6)
    right = matrix @ x
    assert solvers.backward_error(matrix, x, right) < 5
    assert solvers.backward_error(matrix, x * (1 + 1e-9), right) > 1e4
    assert solvers.relative_error(solvers.exact_solution(matrix, right), x) < 1e4 * 10 * solvers.EPS


@pytest.mark.long
def test_sums_are_within_their_bounds(llvm):
    found = list(sums.table(30_000))
    assert {one.way for one in found} == set(sums.WAYS) and {one.terms for one in found} == set(sums.KINDS)
    assert not [one for one in found if not one.in_order]


def test_a_wrong_sum_is_seen(monkeypatch):
    off = (np.float64, lambda terms: float(terms.sum(dtype=np.float64)) * (1 + 1e-9), lambda count: 10.0, 10**9)
    monkeypatch.setattr(sums, "WAYS", {"off": off})
    found = next(sums.table(1000))
    assert isinstance(found, Summed) and not found.in_order


def test_threads_memory_views_and_predictions_change_the_texture_as_little_as_stated():
    assert not [one for one in sums.orders() if not one.in_order]
