"""The paper's loss, minimised directly: compared with general minimisers and judged by the reference loss."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

from iif_core.fusion.direct import solve_direct
from iif_core.fusion.options import FusionOptions
from lab.published.fusion.direct import describe_fit, solve_distribution
from lab.published.fusion.matching import identity_penalty, penalised_affine, penalised_gain
from lab.published.fusion.reference_loss import loss_of_result
from lab.published.fusion.sgd.options import sgd_options
from lab.published.fusion.sgd.solve import converged, solve_sgd
from tests.errors import refused
from tests.unit.test_fusion_direct import simulated


def affine_problem(seed, n=200):
    rng = np.random.default_rng(seed)
    v = np.c_[rng.random((n, 3)), np.ones(n)]
    t = v @ (np.eye(4, 3) * rng.uniform(0.6, 1.5) + 0.1 * rng.standard_normal((4, 3)))
    w = rng.uniform(0.1, 2, (n, 3))
    gram = np.stack([(v * w[:, c : c + 1]).T @ v for c in range(3)])
    cross = np.stack([(v * w[:, c : c + 1] * t[:, c : c + 1]).sum(0) for c in range(3)])
    return gram[None], cross[None]


@pytest.mark.parametrize("strength", [1e-3, 1.0, 300.0])
@pytest.mark.parametrize("seed", range(3))
def test_penalised_affine_is_the_minimum(seed, strength):
    gram, cross = affine_problem(seed)

    def objective(x):
        t = x.reshape(3, 4)
        quadratic = 0.5 * np.einsum("ci,cij,cj->", t, gram[0], t) - (t * cross[0]).sum()
        return quadratic + strength * identity_penalty(t)

    found = penalised_affine(gram, cross, np.eye(3, 4)[None], np.array([strength]), steps=20)[0]
    best = minimize(objective, np.eye(3, 4).ravel(), method="BFGS", options={"gtol": 1e-9})
    assert objective(found.ravel()) <= best.fun + 1e-7 * abs(best.fun)


def test_a_step_never_raises_the_objective():
    gram, cross = affine_problem(0)
    far = np.random.default_rng(1).standard_normal((1, 3, 4)) * 3

    def objective(t):
        return 0.5 * np.einsum("sci,scij,scj->s", t, gram, t) - (t * cross).sum((1, 2)) + 50 * identity_penalty(t)

    values = [objective(penalised_affine(gram, cross, far, np.array([50.0]), steps=n))[0] for n in range(6)]
    assert all(b <= a + 1e-9 * abs(a) for a, b in zip(values, values[1:], strict=False)) and values[-1] < 0.1 * values[0]


def test_penalty_near_identity():
    """R = 5 |sym|^2 + |skew|^2 + |t|^2 to second order (docs/method/fusion.md#identity-regulariser)."""
    rng = np.random.default_rng(2)
    delta, b = 1e-4 * rng.standard_normal((3, 3)), 1e-4 * rng.standard_normal(3)
    sym, skew = (delta + delta.T) / 2, (delta - delta.T) / 2
    expected = 5 * (sym**2).sum() + (skew**2).sum() + (b**2).sum()
    assert identity_penalty(np.c_[np.eye(3) + delta, b]) == pytest.approx(expected, rel=1e-3)


def test_penalised_gain_equals_ridge_regression():
    rng = np.random.default_rng(3)
    v, t, w = rng.random(50), rng.random(50), rng.random(50)
    phi = np.c_[v, np.ones(50)]
    expected = np.linalg.solve(phi.T @ (w[:, None] * phi) + 2 * 7 * np.eye(2), phi.T @ (w * t) + 2 * 7 * np.array([1, 0]))
    found = penalised_gain((phi.T @ (w[:, None] * phi))[None], (phi.T @ (w * t))[None], np.array([7.0]))
    np.testing.assert_allclose(found[0], expected)


def test_polishing_lowers_the_papers_loss():
    """Every sweep on the paper's loss is below the least squares with a hard selection, from which it starts."""
    problem, _ = simulated()
    problem = replace(problem, weight=None)
    start = solve_direct(problem, FusionOptions(final_temperature=0))
    one, many = (solve_distribution(problem, FusionOptions(final_temperature=0), polish=n) for n in (1, 15))

    def judged(result):
        loss = loss_of_result(problem, result)
        return loss.data + 100 * (loss.regulariser_albedo + loss.regulariser_roughness + loss.regulariser_metallic)

    assert judged(many) < judged(one) < judged(start)
    assert (many.weight.max(1) == 1).all()
    totals = [h["data"] + h["regulariser"] for h in many.history if "data" in h]
    assert all(b < a * 1.002 for a, b in zip(totals, totals[1:], strict=False))  # not strictly, because b_ref is computed again
    assert abs(totals[-1] - totals[-2]) < 0.01 * totals[-1]


@pytest.mark.long
def test_direct_is_not_above_the_papers_optimiser_on_the_papers_loss():
    """Both use one selection, and the optimiser runs until its loss is flat."""
    problem, _ = simulated()
    problem = replace(problem, weight=None)
    fit = solve_sgd(problem, sgd_options("safe", iterations=1500))
    assert converged(fit.history)
    direct = solve_distribution(problem, polish=40, chosen=fit.alpha.argmax(1))

    def judged(result):
        loss = loss_of_result(problem, result)
        return loss.data + 100 * (loss.regulariser_albedo + loss.regulariser_roughness + loss.regulariser_metallic)

    assert judged(direct) <= judged(fit)
    own, twin = (loss_of_result(problem, result) for result in (direct, fit))
    assert own.data <= twin.data + 1e-3  # no term is lower at the expense of the other
    assert abs(own.regulariser_albedo - twin.regulariser_albedo) < 1e-5


def test_polish_counts_only_usable_predictions():
    """With some predictions dropped, the loss that is minimised equals the reference loss."""
    problem, _ = simulated()
    maps = [p.copy() for p in problem.predictions]
    for p in maps:
        p[1:4] = np.nan
    problem = replace(problem, predictions=maps, weight=None)
    result = solve_distribution(problem, FusionOptions(final_temperature=0), polish=10)
    loss = loss_of_result(problem, result)
    regulariser = 100 * (loss.regulariser_albedo + loss.regulariser_roughness + loss.regulariser_metallic)
    assert result.history[-1]["regulariser"] == pytest.approx(regulariser, rel=1e-4)
    assert result.history[-1]["data"] == pytest.approx(loss.data, rel=0.05)  # before the last update of texture and scale


def test_a_selection_that_does_not_fit_is_refused():
    problem, _ = simulated()
    with refused("(2, 3)"):
        solve_distribution(problem, chosen=np.zeros((2, 3), int))


def test_described_fit_is_the_fit():
    problem, _ = simulated()
    result = solve_direct(problem)
    affine = np.concatenate(
        [result.affine_albedo.reshape(*result.weight.shape[:2], 12), result.affine_roughness, result.affine_metallic], -1
    )
    again = describe_fit(problem, result.value, result.scale, affine, result.weight)
    for name in ("value", "scale", "uncertainty", "views", "coverage", "object_value", "probability", "weight", "affine_albedo"):
        np.testing.assert_allclose(getattr(again, name), getattr(result, name), atol=2e-3, err_msg=name)
    assert again.history == []
