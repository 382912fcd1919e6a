import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from iif_core.numerics.color import id_colours, linear_from_srgb, luminance, srgb_from_linear, to_uint8, tone_map
from tests.errors import refused
from workflow.report.pictures import false_colour


def test_srgb_known_values():
    np.testing.assert_allclose(srgb_from_linear([0, 0.0031308, 0.5, 1]), [0, 0.0404499, 0.7353570, 1], atol=1e-6)
    np.testing.assert_allclose(linear_from_srgb([0, 0.04045, 0.5, 1]), [0, 0.0031308, 0.2140411, 1], atol=1e-6)


@given(st.floats(-50, 50))
def test_srgb_there_and_back(x):
    # The two published thresholds, 0.0031308 and 0.04045, differ by 4e-8.
    assert linear_from_srgb(srgb_from_linear(x)) == pytest.approx(x, rel=1e-6, abs=1e-7)


def test_srgb_keeps_float32():
    assert srgb_from_linear(np.ones(3, np.float32)).dtype == np.float32
    assert srgb_from_linear(np.ones(3, np.int32)).dtype == np.float64


def test_luminance():
    np.testing.assert_allclose(luminance([[1.0, 1.0, 1.0], [1.0, 0.0, 0.0]]), [1.0, 0.2126])
    with refused("luminance", "(4, 2)"):
        luminance(np.ones((4, 2)))


def test_tone_map_is_bounded():
    picture = tone_map(np.array([[np.nan, np.inf, -np.inf], [-1.0, 0.5, 9.0]]))
    np.testing.assert_allclose(picture, [[0, 1, 0], [0, 0.7353570, 1]], atol=1e-6)


def test_to_uint8_rounds():
    assert to_uint8([0.0, 0.5, 1.0, 2.0, -1.0, np.nan, 254.4 / 255]).tolist() == [0, 128, 255, 255, 0, 0, 254]


def test_id_colours_are_stable_and_distinct():
    ids = np.arange(60)
    colours = id_colours(ids)
    assert colours.min() >= 0 and colours.max() <= 1
    distance = np.linalg.norm(colours[:, None] - colours[None], axis=-1) + np.eye(60)
    assert distance.min() > 0.02
    neighbours = np.linalg.norm(np.diff(colours, axis=0), axis=-1)
    assert neighbours.min() > 0.2
    np.testing.assert_array_equal(id_colours([[7, -1]])[0, 0], colours[7])
    np.testing.assert_allclose(id_colours([-1]), [[0.08] * 3])


@pytest.mark.parametrize("scheme", ["error", "value"])
def test_false_colour_gets_lighter(scheme):
    colours = false_colour(np.linspace(-1, 3, 200), 0, 2, scheme)
    lightness = luminance(linear_from_srgb(colours))
    assert (np.diff(lightness) >= -1e-9).all()
    assert lightness[-1] > 0.6 > 0.1 > lightness[0]
    np.testing.assert_allclose(false_colour(np.nan), 0.5)
    with refused("1 ... 1"):
        false_colour(np.zeros(3), 1, 1)
    with refused("'rainbow'", "error, value"):
        false_colour(np.zeros(3), scheme="rainbow")
