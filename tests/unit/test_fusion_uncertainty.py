"""Calibrated uncertainty: planted laws are found, and intervals have their nominal coverage, also on new data."""

from dataclasses import replace

import numpy as np
import pytest

from iif_core.fusion import uncertainty
from iif_core.fusion.direct import solve_direct
from iif_core.fusion.selection import effective_number, margin
from iif_core.fusion.uncertainty import NOMINAL_COVERAGES, Calibration, coverage, gauge_free_error, interval
from tests.errors import refused
from tests.oracles.calibration import fit_calibration
from tests.unit.test_fusion_direct import simulated


@pytest.mark.parametrize("beta", [1.0, 2.0])
def test_planted_law_is_found_and_covers(beta):
    rng = np.random.default_rng(0)
    n = 30_000
    planted = Calibration(0.3, 0.8, 0.5, 0.4, -0.1, beta, 0.0)

    def draw(k):
        b, views = rng.uniform(0.01, 0.1, n), rng.integers(1, 9, n)
        pixels = views * rng.integers(1, 6, n)
        unit = rng.laplace(0, 1 / np.sqrt(2), n) if beta == 1 else rng.standard_normal(n)
        return unit * planted.deviation(b, views, pixels, k), b, views, pixels, k

    found = fit_calibration([draw(k) for k in (1, 4, 16)])
    for name, tolerance in (("g", 0.04), ("h", 0.04), ("q", 0.04), ("p", 0.04), ("beta_1", 0.35)):
        assert getattr(found, name) == pytest.approx(getattr(planted, name), abs=tolerance), name
    error, *facts = draw(8)
    np.testing.assert_allclose(coverage(error, found.deviation(*facts), float(found.beta(8))), NOMINAL_COVERAGES, atol=0.015)


@pytest.mark.parametrize("samples", [1, 3, 6, 16])
@pytest.mark.parametrize("views", [2, 8])
def test_coverage_on_a_room_that_had_no_part_in_the_calibration(samples, views):
    """At least nine of ten albedo errors lie within the 95 % interval, and not all within the 50 % interval."""
    problem, truth = simulated(views=views, samples=samples)
    result = solve_direct(problem)
    seen = result.coverage > 0
    error = gauge_free_error(result.value[seen, :3], truth[seen, :3], problem.object_of_cell[seen])
    beta = float(uncertainty.CALIBRATION["albedo"].beta(samples))
    half, _, most = coverage(error, result.uncertainty[seen, :3], beta)
    assert 0.25 < half < 0.75 and most > 0.8


def test_a_repeated_photograph_does_not_reduce_the_uncertainty():
    problem, _ = simulated()
    doubled = replace(
        problem,
        predictions=[*problem.predictions] * 2,
        cell_of_pixel=[*problem.cell_of_pixel] * 2,
        segment_of_pixel=[*problem.segment_of_pixel, *[s + problem.n_segments for s in problem.segment_of_pixel]],
        object_of_segment=np.tile(problem.object_of_segment, 2),
        weight=[*problem.weight] * 2,
    )
    once, twice = solve_direct(problem), solve_direct(doubled)
    np.testing.assert_allclose(twice.uncertainty, once.uncertainty, rtol=1e-3)


def test_intervals_are_those_of_the_distribution():
    assert interval(0.95, 1.0) == pytest.approx(np.log(20) / np.sqrt(2))
    assert interval(0.95, 2.0) == pytest.approx(1.959964)
    sample = np.random.default_rng(1).laplace(0, 0.2 / np.sqrt(2), 100_000)
    np.testing.assert_allclose(coverage(sample, np.float64(0.2)), NOMINAL_COVERAGES, atol=0.006)


def test_gauge_free_error_ignores_any_affine_of_the_object():
    rng = np.random.default_rng(2)
    truth, objects = rng.random((300, 3)), rng.integers(0, 3, 300)
    a, b = rng.standard_normal((3, 3, 3)), rng.standard_normal((3, 3))
    noise = 0.01 * rng.standard_normal((300, 3))
    value = np.einsum("nij,nj->ni", a[objects], truth) + b[objects] + noise
    error = gauge_free_error(value, truth, objects)
    assert 0.9 * noise.std() < error.std() < 1.01 * noise.std()
    flat = gauge_free_error(0.3 + noise, np.full((300, 3), 0.7), objects)  # one colour: the map is a level
    for o in range(3):
        np.testing.assert_allclose(flat[objects == o], noise[objects == o] - noise[objects == o].mean(0), atol=1e-9)
    assert gauge_free_error(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, int)).shape == (0, 3)


def test_uncertainty_ranks_the_errors():
    """On a room that had no part in the calibration, cells with a larger uncertainty have larger errors."""
    problem, truth = simulated()
    result = solve_direct(problem)
    seen = result.coverage > 0
    error = np.abs(gauge_free_error(result.value[seen, :3], truth[seen, :3], problem.object_of_cell[seen]))
    claimed = result.uncertainty[seen, :3]
    sure, unsure = claimed < np.quantile(claimed, 0.3), claimed > np.quantile(claimed, 0.7)
    assert error[unsure].mean() > 1.3 * error[sure].mean()
    assert np.isfinite(result.uncertainty).all() and (result.uncertainty > 0).all()


def test_uncertainty_shrinks_with_views_and_predictions_and_grows_with_scale():
    scale, views = np.full((4, 5), 0.03), np.array([0, 1, 2, 8])
    one = uncertainty.location_uncertainty(scale, views, views, 4)
    assert (one[0] == one[1]).all() and (np.diff(one[1:], axis=0) < 0).all()
    assert (uncertainty.location_uncertainty(2 * scale, views, views, 4) > one).all()
    assert (uncertainty.location_uncertainty(scale, views, views, 16) < one).all()


def test_uncertainty_is_the_power_law():
    """Eq. F.45: c b^g V^-h K^-q P^-p, with K predictions and P pixels a viewpoint; 0 viewpoints count as 1."""
    law = Calibration(0.3, 0.8, 0.5, 0.4, -0.1, 1.0, 0.25)
    b, views, pixels = np.array([0.02, 0.05, 0.07]), np.array([4, 9, 0]), np.array([64, 27, 16])
    expected = 0.3 * b**0.8 / np.maximum(views, 1) ** 0.5 / 5**0.4 * np.array([16.0, 3.0, 16.0]) ** 0.1
    np.testing.assert_allclose(law.deviation(b, views, pixels, 5), expected, rtol=1e-12)
    assert law.beta(8) == pytest.approx(1.75)


def test_margin_and_effective_number():
    error, usable = np.array([[1.0, 4.0, 2.0], [1, 1, 3], [5, 1, 1], [0, 0, 0]]), np.ones((4, 3), bool)
    np.testing.assert_allclose(margin(error, usable), [0.5, 0, 0, 0])
    usable[0, 2] = False
    np.testing.assert_allclose(margin(error, usable)[0], 0.75)
    assert margin(np.array([[0.2]]), np.array([[True]]))[0] == 1 and margin(np.array([[0.2]]), np.array([[False]]))[0] == 0
    assert margin(np.array([[0.2, 0.1]]), np.array([[True, False]]))[0] == 1
    np.testing.assert_allclose(effective_number([[1, 0, 0], [1 / 3] * 3, [0.5, 0.5, 0], [0, 0, 0]]), [1, 3, 2, 0])


def test_bad_calls_are_refused():
    with refused("level 95", "0.95"):
        interval(95)
    with refused("coverage"):
        coverage(np.zeros(0), np.zeros(0))
