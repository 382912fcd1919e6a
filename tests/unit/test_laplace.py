"""Laplace distributions: weights and scales against the divergence, limits."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar

from iif_core.numerics import laplace
from lab.published.fusion import divergence
from tests.errors import refused

unit = st.floats(0, 1)


@settings(max_examples=200, deadline=None)
@given(unit, unit, unit, st.sampled_from([1e-2, 1e-6, 1e-30]))
def test_kl_is_finite_and_not_negative_down_to_zero_scale(d, b_r, b_p, floor):
    with np.errstate(under="ignore"):
        value = divergence.kl(np.float64(d), np.float64(b_r), np.float64(b_p), floor)
        slope = -np.expm1(-d / laplace.floored(b_r, floor)) / laplace.floored(b_p, floor)  # dKL / dd
        weight = laplace.kl_weight(np.float64(d), np.float64(b_r), np.float64(b_p), floor)
    assert np.isfinite(value) and value >= 0
    assert np.isfinite(weight) and weight > 0
    # the weight is the slope over the distance, so it majorises with the right tangent
    assert weight * d == pytest.approx(slope, rel=1e-6, abs=1e-12)


def test_closed_form_scale_minimises_the_sum():
    rng = np.random.default_rng(4)
    d, b_r, w = rng.random(40), 0.02 + 0.3 * rng.random(40), rng.random(40)
    found = minimize_scalar(
        lambda b: np.sum(w * divergence.kl(d, b_r, b)), bounds=(0.01, 3), method="bounded", options={"xatol": 1e-10}
    ).x
    assert np.average(laplace.scale_contribution(d, b_r), weights=w) == pytest.approx(found, rel=1e-5)


def test_closed_form_scale_at_the_limits():
    assert (laplace.scale_contribution(np.zeros(5), np.zeros(5)) == laplace.SCALE_FLOOR).all()
    # A sharp reference leaves the distance.
    np.testing.assert_allclose(laplace.scale_contribution(np.array([0.2, 0.4]), np.zeros(2)), [0.2, 0.4], atol=1e-9)


def test_weighted_least_squares_with_kl_weight_minimises_the_sum():
    rng = np.random.default_rng(5)
    x = np.r_[0.5 + 0.02 * rng.standard_normal(20), 0.95, 0.05, 0.99]
    mu = x.mean()
    for _ in range(200):
        w = laplace.kl_weight(x - mu, 0.02, 0.05)
        mu = np.sum(w * x) / w.sum()
    grid = np.linspace(0, 1, 20001)
    best = grid[np.argmin(divergence.kl(x[:, None] - grid, 0.02, 0.05).sum(0))]
    assert mu == pytest.approx(best, abs=1e-4)


def test_floor_must_be_positive():
    with refused("floor", "0.0", "0.01"):
        divergence.kl(0.1, 0.1, 0.1, floor=0.0)
