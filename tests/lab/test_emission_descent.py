"""The paper's kind of descent to emitters, a twin of the direct solver, and the loss that judges both."""

import numpy as np
import pytest

from iif_core.light.emission.direct import EmissionPrior, solve_families
from lab.published.light.loss import reference_loss
from lab.published.light.sgd import SgdOptions, solve_emission_sgd
from tests.unit.emission_systems import rows_of
from tests.unit.planted_room import PlantedScene, build_room
from tests.unit.test_emission_extremes import CASES, _matrix, _rows


@pytest.fixture(scope="module")
def planted(llvm):
    scene = PlantedScene(build_room(), views=10, size=48)
    return scene, scene.photographs(0, 128), scene.transport(0, 8)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("preset", ["safe", "paper"])
def test_a_descent_stays_finite(case, preset):
    a, target, bound = CASES[case]
    rows = _rows(a, target, bound)
    found = solve_emission_sgd(rows, np.ones((3, 3)), SgdOptions(preset, 50, 64))
    assert np.isfinite(found.radiance).all() and (found.radiance >= 0).all() and np.isfinite(found.error).all()
    assert np.isfinite(reference_loss(rows, found.radiance)) and np.isfinite(found.residual)


def test_descent_that_diverges_says_so():
    a = 1e20 * _matrix()
    found = solve_emission_sgd(_rows(a, a.sum(1)), np.ones((3, 3)), SgdOptions("paper", 200, 64))
    assert not found.converged and np.isfinite(found.radiance).all()


def test_descent_reaches_the_answer_on_exact_rows_and_prunes_what_is_dark():
    a = _matrix(2000)
    truth = np.array([5.0, 0.0, 2.0])[:, None] * np.ones(3)
    rows = _rows(a, np.einsum("ngc,gc->nc", a, truth))
    found = solve_emission_sgd(rows, np.ones((3, 3)), SgdOptions(steps=3000, batch=256, prune=((2000, 0.05),)))
    np.testing.assert_allclose(found.radiance, truth, atol=0.05)
    assert (found.radiance[1] == 0).all()
    again = solve_emission_sgd(rows, np.ones((3, 3)), SgdOptions(steps=3000, batch=256, prune=((2000, 0.05),)))
    np.testing.assert_array_equal(found.radiance, again.radiance)


def test_reference_loss_does_not_reward_shrinking():
    """With noise in A the plain loss is smallest below the truth; the crossed one at the truth."""
    rng = np.random.default_rng(5)
    a = _matrix(100_000, 1, 5)
    halves = [(a * (1 + rng.standard_normal(a.shape))).astype(np.float32) for _ in range(2)]
    y = 4.0 * a[:, 0]
    rows = rows_of(tuple(halves), observed=y)
    at = {e: [reference_loss(rows, np.full((1, 3), e), cross) for cross in (True, False)] for e in (3.0, 4.0)}
    assert at[4.0][0] < at[3.0][0] and at[4.0][1] > at[3.0][1]
    assert abs(at[4.0][0]) < 0.02


@pytest.mark.long
def test_twins_are_judged_by_one_loss(planted):
    scene, photographs, transport = planted
    problem, initial = scene.problem(photographs, transport, "hdr_hidden")
    direct = solve_families(problem.rows, EmissionPrior.independent(initial), scene.families())
    descent = solve_emission_sgd(problem.rows, initial, SgdOptions(steps=600, prune=()))
    losses = [reference_loss(problem.rows, s.radiance) for s in (direct, descent)]
    assert losses[0] <= losses[1]
    assert losses[0] == pytest.approx(reference_loss(problem.rows, scene.room.truth), abs=2e-3)
    assert descent.radiance.shape == direct.radiance.shape and descent.converged
