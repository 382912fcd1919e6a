import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from iif_core.camera.response import project, response, response_facts, response_from_facts, sampled_response
from iif_core.errors import InputError

CURVES = {
    "identity": response("identity"),
    "srgb": response("srgb"),
    "gamma": response("gamma"),
    "ggcm": response("ggcm", [-0.7, 0.4, -0.3]),
    "ggcm_per_channel": response("ggcm", [[-0.8, 0, 0], [-0.5, 0.3, 0.2], [-1.0, -0.5, 0.6]]),
    "spline": response("spline", [0.3, -0.4, 0.5, -0.2, 0.1, -0.6]),
    "spline_per_channel": response("spline", np.random.default_rng(0).normal(0, 0.7, (3, 8))),
    "sampled": sampled_response(np.linspace(0, 1, 101), np.linspace(0, 1, 101) ** 0.5),
    "sampled_per_channel": sampled_response(
        np.linspace(0, 1, 65), np.stack([np.linspace(0, 1, 65) ** p for p in (0.4, 0.6, 0.9)])
    ),
}
POINTS = np.r_[0.0, 1e-9, 3e-5, 9.9e-5, 1.01e-4, 1e-3, 0.02, 0.2, 0.55, 0.9, 0.9999, 1.0001, 1.3, 20.0, -0.01]
X = np.stack([POINTS, POINTS[::-1], np.roll(POINTS, 3)], -1)


@pytest.mark.parametrize("name", CURVES)
def test_ends_and_monotone(name):
    f = CURVES[name]
    ends = f(np.array([[0.0] * 3, [1.0] * 3]))
    np.testing.assert_allclose(ends, [[0] * 3, [1] * 3], atol=1e-12)
    grid = np.repeat(np.r_[np.linspace(-0.5, 3, 4001)][:, None], 3, 1)
    assert (np.diff(f(grid), axis=0) > 0).all()
    assert (f.derivative(X) > 0).all() and np.isfinite(f.derivative(X)).all()


@pytest.mark.parametrize("name", CURVES)
def test_there_and_back(name):
    f = CURVES[name]
    np.testing.assert_allclose(f.inverse(f(X)), X, rtol=1e-9, atol=1e-12)
    y = np.linspace(-0.2, 1.4, 999)[:, None].repeat(3, 1)
    np.testing.assert_allclose(f(f.inverse(y)), y, atol=1e-9)


@pytest.mark.parametrize("name", CURVES)
def test_derivative_against_differences(name):
    f = CURVES[name]
    x = X[np.abs(X[:, 0] - 1) > 1e-3][:, :1].repeat(3, 1) if "sampled" not in name else np.full((4, 3), 0.3337)
    x = x[(x[:, 0] != 0)]
    h = 1e-6 * np.maximum(np.abs(x), 1e-4)
    np.testing.assert_allclose(f.derivative(x), (f(x + h) - f(x - h)) / (2 * h), rtol=2e-5)


@pytest.mark.parametrize("name", ["gamma", "ggcm", "ggcm_per_channel", "spline", "spline_per_channel"])
def test_parameter_derivatives_against_differences(name):
    f = CURVES[name]
    exact = f.evaluate(X)[2]
    for k in range(f.params.shape[-1]):
        step = np.zeros_like(f.params)
        step[..., k] = 1e-6
        numeric = (f.with_params(f.params + step)(X) - f.with_params(f.params - step)(X)) / 2e-6
        np.testing.assert_allclose(exact[..., k], numeric, rtol=1e-5, atol=1e-8)


def test_known_values():
    np.testing.assert_allclose(response("gamma")(0.5), 0.5 ** (1 / 2.2))
    np.testing.assert_allclose(response("srgb")(np.array([0.002, 0.5])), [0.02584, 0.735357], atol=1e-6)
    np.testing.assert_allclose(response("ggcm")(0.18), 0.18 ** np.exp(-0.8))
    # beyond 1: end slope, here 1/2.2
    np.testing.assert_allclose(response("gamma")(3.0), 1 + 2 / 2.2)


def test_zero_spline_is_the_power_and_knots_are_where_they_should_be():
    x = np.linspace(1e-4, 1, 300)
    np.testing.assert_allclose(response("spline")(x), x**0.45, rtol=1e-12)
    f = response("spline", [np.log(2.0), 0.0, 0.4, 0.1, 0.2, -0.3])
    knot = (np.arange(4) / 3) ** (1 / 0.45)
    np.testing.assert_allclose(f(knot), [0, 0.5, 0.75, 1], atol=1e-12)
    np.testing.assert_allclose(f.derivative(knot[1:]), np.exp([0.1, 0.2, -0.3]) * 0.45 * knot[1:] ** -0.55, rtol=1e-9)


def test_continuous_with_slope_at_the_toe():
    for name in ("gamma", "ggcm", "spline"):
        f = CURVES[name]
        edge = np.array([1e-4 * (1 - 1e-9), 1e-4 * (1 + 1e-9)])
        np.testing.assert_allclose(np.diff(f(edge)), 0, atol=1e-9)
        np.testing.assert_allclose(np.diff(f.derivative(edge)) / f.derivative(edge)[0], 0, atol=1e-6)


@settings(max_examples=60, deadline=None)
@given(st.sampled_from([("gamma", 1), ("ggcm", 3), ("spline", 6), ("spline", 8)]), st.data())
def test_any_parameters_give_a_monotone_invertible_curve(family, data):
    name, size = family
    f = response(name, data.draw(st.lists(st.floats(-50, 50), min_size=size, max_size=size)))
    y = np.array(data.draw(st.floats(0, 1)))
    grid = np.linspace(0, 1, 2001)
    assert (np.diff(f(grid)) > 0).all() and f(0.0) == 0 and abs(f(1.0) - 1) < 1e-12
    assert abs(f(f.inverse(y)) - y) < 1e-9


def test_project_is_idempotent():
    theta = project("ggcm", np.array([9.0, 9.0, 9.0]))
    np.testing.assert_array_equal(theta, project("ggcm", theta))


def test_sampled_curve_with_flat_and_falling_pieces():
    f = sampled_response(np.linspace(0, 1, 5), [0, 0.5, 0.4, 0.5, 1.0])
    y = f(np.linspace(0, 1, 5))
    assert (np.diff(y) > 0).all() and y[0] == 0 and y[-1] == 1
    assert np.isfinite(f.inverse(np.linspace(0, 1, 50))).all()


@pytest.mark.parametrize(
    "call",
    [
        lambda: response("nope"),
        lambda: response("sampled"),
        lambda: response("gamma", [1.0, 2.0]),
        lambda: response("ggcm", [0, np.nan, 0]),
        lambda: response("spline", np.zeros(7)),
        lambda: response("spline", np.zeros(2)),
        lambda: sampled_response([0, 1], [1, 1]),
        lambda: sampled_response([0, 2], [0, 1]),
        lambda: sampled_response([0, 0.5, 1], [0, 1]),
        lambda: CURVES["ggcm_per_channel"].inverse(np.zeros((4, 2))),
    ],
)
def test_refused(call):
    with pytest.raises(InputError):
        call()


def test_empty():
    assert response("ggcm")(np.zeros((0, 3))).shape == (0, 3)
    assert response("ggcm").inverse(np.zeros((0, 3))).shape == (0, 3)


@pytest.mark.parametrize("name", CURVES)
def test_facts_bring_the_curve_back(name):
    again = response_from_facts(json.loads(json.dumps(response_facts(CURVES[name]))))
    np.testing.assert_allclose(again(X), CURVES[name](X), atol=1e-12)
