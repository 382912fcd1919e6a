"""The spread of the error of the light over objects."""

import numpy as np
import pytest

from iif_core.evaluation.light import LightSpread


def spread_of(gains, pixels=400, level=1.0, views=2):
    rng = np.random.default_rng(0)
    found = LightSpread()
    for _ in range(views):
        for o, gain in enumerate(gains):
            light = rng.uniform(0.1, 2.0, (pixels, 3))
            found.add(level * gain * light, light, np.full(pixels, o))
    return found.finish()


def test_closed_form():
    gains = [0.5, 1.0, 2.0]
    assert spread_of(gains) == pytest.approx(np.log(2) * np.sqrt(2 / 3))
    assert spread_of(gains, level=1e6) == pytest.approx(spread_of(gains))
    assert spread_of([1.0, 1.0]) == pytest.approx(0, abs=1e-12)


def test_small_objects_and_bad_pixels_do_not_count():
    found = LightSpread()
    found.add(np.ones((500, 3)), np.ones((500, 3)), np.zeros(500, int))
    found.add(np.full((500, 3), 3.0), np.ones((500, 3)), np.ones(500, int))
    before = found.finish()
    found.add(np.full((5, 3), 100.0), np.ones((5, 3)), np.full(5, 2))
    found.add(np.full((50, 3), np.nan), np.ones((50, 3)), np.full(50, 1))
    found.add(np.ones((50, 3)), np.full((50, 3), np.inf), np.full(50, 1))
    assert found.finish() == pytest.approx(before) == pytest.approx(np.log(3) / 2)


def test_too_little_to_compare():
    assert LightSpread().finish() is None
    assert spread_of([1.0]) is None
    found = LightSpread()
    found.add(np.zeros((10, 3)), np.ones((10, 3)), np.repeat([0, 1], 5))  # black objects have no logarithm
    assert found.finish() is None
