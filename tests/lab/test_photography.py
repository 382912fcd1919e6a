"""Simulated photographs: response curves, exposures, eight bits."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from iif_core.camera import response as families
from iif_core.errors import InputError
from lab.simulated.photographs import STOPS, ResponseCurve, expose, exposures, response_curve
from tests.errors import refused

CURVES = ("filmic", "soft", "srgb", "linear")
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


@pytest.mark.parametrize("name", CURVES)
def test_curve_rises_from_zero_to_one(name):
    y = response_curve(name).samples(4097)
    np.testing.assert_allclose(y[:, [0, -1]], [[0, 1]] * 3, atol=1e-15)
    assert (np.diff(y, axis=1) > 0).all()


def test_srgb_is_the_standard_and_linear_is_linear():
    x = np.linspace(0, 1, 1001)[:, None] * np.ones(3)
    np.testing.assert_allclose(response_curve("srgb")(x), families.response("srgb")(x), atol=1e-12)
    np.testing.assert_allclose(response_curve("linear")(x), x, atol=0)
    np.testing.assert_allclose(response_curve("srgb")([0.5, 0.5, 0.5]), 0.7354, atol=5e-5)


def test_channels_differ_and_the_family_is_not_the_solvers():
    y = response_curve("filmic").samples(256)
    assert min(np.abs(y[0] - y[1]).max(), np.abs(y[1] - y[2]).max()) > 0.004
    # Best ggcm (x^exp(a0 + a1 x + a2 x^2)) by least squares on log log: near, but not the same.
    x = np.linspace(0, 1, 256)[2:-2]
    exponent = np.log(np.log(y[1, 2:-2]) / np.log(x))
    a = np.polynomial.polynomial.polyfit(x, exponent, 2)
    gap = np.abs(families.response("ggcm", a)(x) - y[1, 2:-2]).max()
    assert 0.002 < gap < 0.08


@given(st.floats(0.2, 3), st.floats(0, 3), st.floats(0, 2))
def test_every_curve_that_is_accepted_rises(gamma, strength, pivot):
    try:
        curve = ResponseCurve("x", (gamma,) * 3, (strength,) * 3, (pivot,) * 3)
    except InputError:
        assert strength * max(pivot, 2 - pivot) >= 1
        return
    # In y = sRGB(x^gamma), where steps are even; the slope at the worst end is 1 - strength max(p, 2 - p).
    y = np.linspace(0, 1, 2001)
    x = np.where(y <= 0.04045, y / 12.92, ((y + 0.055) / 1.055) ** 2.4) ** (1 / gamma)
    assert (np.diff(curve(x[:, None] * np.ones(3)), axis=0) > -1e-9).all()


def test_unknown_curve_is_refused():
    with refused("'kodak'", "filmic, soft, srgb, linear"):
        response_curve("kodak")


def test_expose_rounds_to_nearest_and_clips():
    levels = np.arange(256) / 255
    radiance = np.stack([levels] * 3, -1)
    np.testing.assert_array_equal(expose(radiance, 1.0, response_curve("linear")), radiance.astype(np.float32))
    nudged = expose(radiance + 0.49 / 255, 1.0, response_curve("linear"))  # truncation and rounding differ here
    np.testing.assert_array_equal(nudged, radiance.astype(np.float32))
    assert expose(np.full((1, 3), 1e30), 4.0).max() == 1.0
    assert expose(np.full((1, 3), -1.0), 4.0).max() == 0.0


def test_expose_scales_radiance_before_the_response():
    rng = np.random.default_rng(0)
    radiance = rng.uniform(0, 0.4, (7, 5, 3))
    np.testing.assert_array_equal(expose(radiance, 2.0), expose(2 * radiance, 1.0))
    out = expose(radiance, 2.0)
    assert out.dtype == np.float32 and out.shape == radiance.shape
    assert np.abs(out - response_curve()(2 * radiance)).max() <= 0.5 / 255 + 1e-7
    np.testing.assert_array_equal(out * 255, np.rint(out * 255))


@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan, np.inf])
def test_expose_refuses_bad_exposure(bad):
    with refused("exposure", bad):
        expose(np.ones((2, 3)), bad)


def test_expose_refuses_nan():
    with refused(1, "radiance"):
        expose(np.array([[np.nan, 0, 0]]), 1.0)


def _views(n=10, size=400, seed=0):
    rng = np.random.default_rng(seed)
    return [rng.lognormal(np.log(0.2 * 1.3**k), 0.3, (size, 3)) for k in rng.permutation(n)]


def test_brightest_group_gets_the_shortest_exposure():
    views = _views()
    e = exposures(views, saturated=0.9)
    mean = np.array([(v @ LUMINANCE).mean() for v in views])
    by_brightness = e[np.argsort(-mean)].reshape(5, 2)
    assert (by_brightness[:, 0] == by_brightness[:, 1]).all()
    np.testing.assert_allclose(by_brightness[:, 0] / by_brightness[2, 0], STOPS)
    typical = np.exp(np.mean([np.log(g * np.median(v @ LUMINANCE)) for g, v in zip(e, views, strict=True)]))
    np.testing.assert_allclose(typical, 0.18, rtol=1e-12)


def test_few_pixels_saturate_and_lamps_do_not_count():
    rng = np.random.default_rng(1)
    views = [rng.lognormal(-2, 1.0, (2000, 3)) for _ in range(6)]
    masks = [np.ones(2000, bool) for _ in views]
    for view, mask in zip(views, masks, strict=True):
        view[:300] = 50.0
        mask[:300] = False
    e = exposures(views, masks)
    shares = [(g * v[m] > 1).any(-1).mean() for g, v, m in zip(e, views, masks, strict=True)]
    assert max(shares) <= 0.03 and max(shares) > 0.005
    assert all((g * v[~m] > 1).all() for g, v, m in zip(e, views, masks, strict=True))
    without = exposures(views)
    assert (without < 0.1 * e).all()  # a lamp that must not clip closes the lens
    stops = np.log2(e / exposures(views, masks, saturated=0.99))
    np.testing.assert_allclose(3 * stops, np.rint(3 * stops), atol=1e-9)


@given(st.floats(1e-6, 1e6))
def test_unit_of_radiance_does_not_matter(scale):
    views = _views(7, 50)
    a, b = exposures(views), exposures([scale * v for v in views])
    np.testing.assert_allclose(a, b * scale, rtol=2e-9)


def test_shapes_stack_list_and_means():
    stack = np.random.default_rng(2).uniform(0.05, 0.5, (4, 6, 5, 3))
    np.testing.assert_array_equal(exposures(stack), exposures(list(stack)))
    assert exposures(stack.mean((1, 2))).shape == (4,)
    assert exposures(stack[:1]).shape == (1,)
    different = [stack[0], stack[1, :2], stack[2].reshape(-1, 3)]
    assert (exposures(different) > 0).all()


def test_extremes_black_views_masked_views_all_black():
    views = [np.zeros((9, 3)), np.full((9, 3), 0.3), np.full((9, 3), 0.6)]
    e = exposures(views)
    assert np.isfinite(e).all() and (e > 0).all() and e[0] >= e.max()
    assert (exposures([np.zeros((4, 3))] * 2) > 0).all()
    assert np.isfinite(exposures(views, [np.zeros(9, bool)] * 3)).all()


@pytest.mark.parametrize(
    "arguments, names",
    [
        (([],), ["view"]),
        (([np.ones((4, 2))],), ["view 0", "(4, 2)"]),
        (([np.full((4, 3), np.nan)],), ["view 0"]),
        (([np.full((4, 3), -1.0)],), ["view 0"]),
        (([np.ones((4, 3))], [np.ones(3, bool)]), ["view 0", "(3,)", "(4, 3)"]),
        (([np.ones((4, 3))], None, (2.0, 1.0)), ["stops", "[2.0, 1.0]"]),
        (([np.ones((4, 3))], None, STOPS, 0.18, 1.0), ["grey=0.18", "saturated=1.0"]),
    ],
)
def test_bad_input_is_named(arguments, names):
    with refused("exposures", *names):
        exposures(*arguments)


def test_held_out_views_change_no_exposure_but_their_own():
    rng = np.random.default_rng(4)
    views = rng.uniform(0.01, 1, (10, 1, 1, 1)) * rng.random((10, 6, 5, 3))
    used = np.arange(10) % 5 != 4
    spoilt = np.where(used[:, None, None, None], views, 50 * rng.random(views.shape))
    a, b = exposures(views, used=used), exposures(spoilt, used=used)
    np.testing.assert_array_equal(a[used], b[used])
    np.testing.assert_array_equal(a[used], exposures(views[used]))
    twin = np.concatenate([views[:1], views[used]])
    np.testing.assert_allclose(exposures(twin, used=np.arange(len(twin)) > 0)[0], exposures(views[used])[0])
    with refused("held out"):
        exposures(views, used=np.zeros(10, bool))
