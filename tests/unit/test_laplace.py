"""Closed-form scales of Laplace distributions, against the divergence and at the limits."""

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from iif_core.numerics import laplace
from lab.published.fusion import divergence


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
