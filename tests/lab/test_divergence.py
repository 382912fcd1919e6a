"""Divergence of Laplace distributions and the scale of the reference: check values, quadrature, limits."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad

from iif_core.numerics import laplace
from lab.published.fusion import divergence
from tests.errors import refused

CHECKED = [(0.3, 0.1, 0.2, 1.2180407), (0.05, 0.3, 0.1, 0.9408329), (0.0, 0.1, 0.1, 0.0)]
unit = st.floats(0, 1)


@pytest.mark.parametrize(("d", "b_r", "b_p", "expected"), CHECKED)
def test_kl_check_values(d, b_r, b_p, expected):
    assert divergence.kl(d, b_r, b_p) == pytest.approx(expected, abs=5e-8)


@pytest.mark.parametrize(("d", "b_r", "b_p"), [(0.3, 0.1, 0.2), (0.05, 0.3, 0.1), (0.0, 0.2, 0.7), (1.0, 0.02, 0.5)])
def test_kl_equals_quadrature(d, b_r, b_p):
    def integrand(x):
        p = np.exp(-abs(x) / b_r) / (2 * b_r)
        return p * (np.log(b_p / b_r) - abs(x) / b_r + abs(x - d) / b_p)

    breaks = sorted({0.0, d})
    edges = [-60 * b_r, *breaks, d + 60 * b_r]
    by_quadrature = sum(quad(integrand, a, b, epsabs=1e-12, limit=200)[0] for a, b in zip(edges, edges[1:], strict=False))
    assert divergence.kl(d, b_r, b_p) == pytest.approx(by_quadrature, rel=1e-8, abs=1e-9)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_kl_keeps_its_digits_where_it_vanishes(dtype):
    distance = dtype(10.0) ** -np.arange(1, 12, dtype=dtype)
    close = divergence.kl(distance, dtype(0.1), dtype(0.1))
    series = 0.5 * (distance / dtype(0.1)) ** 2 * (1 - distance / dtype(0.1) / 3)  # of third order in d / b
    assert close.dtype == dtype and (close > 0).all()
    np.testing.assert_allclose(close[2:], series[2:], rtol=1e-4)
    np.testing.assert_allclose(close[7:], series[7:], rtol=20 * np.finfo(dtype).eps)
    scale = dtype(0.1) * (1 + distance[2:4])
    np.testing.assert_allclose(divergence.kl(dtype(0), dtype(0.1), scale), 0.5 * ((scale - dtype(0.1)) / scale) ** 2, rtol=2e-2)


def test_float32_agrees_with_float64():
    rng = np.random.default_rng(3)
    d, b_r, b_p = rng.random((3, 1000))
    single = divergence.kl(*(x.astype(np.float32) for x in (d, b_r, b_p)))
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, divergence.kl(d, b_r, b_p), rtol=2e-5, atol=2e-5)


def test_joint_scaling_leaves_kl():
    assert divergence.kl(0.3, 0.1, 0.2) == pytest.approx(divergence.kl(3.0, 1.0, 2.0), rel=1e-12)


def test_lower_median():
    assert divergence.lower_median(np.arange(16.0)[::-1]) == 7  # the 8th smallest of 16
    assert divergence.lower_median(np.array([3.0, 1.0])) == 1
    assert divergence.lower_median(np.array([[2.0], [9.0], [4.0]])).tolist() == [4.0]
    with refused("median"):
        divergence.lower_median(np.zeros((0, 3)))


def test_reference_scale():
    v = np.array([[0.1], [0.2], [0.5], [0.9]])
    assert divergence.reference_scale(np.array([0.2]), v) == pytest.approx(0.1)  # |.| = .1 0 .3 .7 -> .1
    assert divergence.reference_scale(np.array([0.4]), np.array([[0.4]])) == laplace.SCALE_FLOOR  # K = 1


@settings(max_examples=200, deadline=None)
@given(unit, unit, unit, st.sampled_from([1e-2, 1e-6, 1e-30]))
def test_kl_is_finite_and_not_negative_down_to_zero_scale(d, b_r, b_p, floor):
    with np.errstate(under="ignore"):
        value = divergence.kl(np.float64(d), np.float64(b_r), np.float64(b_p), floor)
        slope = -np.expm1(-d / laplace.floored(b_r, floor)) / laplace.floored(b_p, floor)  # dKL / dd
        weight = divergence.kl_weight(np.float64(d), np.float64(b_r), np.float64(b_p), floor)
    assert np.isfinite(value) and value >= 0
    assert np.isfinite(weight) and weight > 0
    # the weight is the slope over the distance, so it majorises with the right tangent
    assert weight * d == pytest.approx(slope, rel=1e-6, abs=1e-12)


def test_weighted_least_squares_with_kl_weight_minimises_the_sum():
    rng = np.random.default_rng(5)
    x = np.r_[0.5 + 0.02 * rng.standard_normal(20), 0.95, 0.05, 0.99]
    mu = x.mean()
    for _ in range(200):
        w = divergence.kl_weight(x - mu, 0.02, 0.05)
        mu = np.sum(w * x) / w.sum()
    grid = np.linspace(0, 1, 20001)
    best = grid[np.argmin(divergence.kl(x[:, None] - grid, 0.02, 0.05).sum(0))]
    assert mu == pytest.approx(best, abs=1e-4)


def test_floor_must_be_positive():
    with refused("floor", "0.0", "0.01"):
        divergence.kl(0.1, 0.1, 0.1, floor=0.0)
