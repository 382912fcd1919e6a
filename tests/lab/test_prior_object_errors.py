"""Errors of predictions over whole objects: what was planted is found again."""

import numpy as np
import pytest

from iif_core.fitting.object_levels import relative_error_of_base
from lab.prior.object_errors import ObjectSums


def test_planted_errors_are_found_again():
    rng, sums = np.random.default_rng(0), ObjectSums()
    for _ in range(40):
        sums.begin()
        room = 0.15 * rng.normal()
        for group in range(30):
            pixels = 60
            bright = rng.uniform(0.1, 0.7)
            is_metal = rng.uniform() < 0.2
            logit = rng.normal(-1.0 if is_metal else -4.0, np.sqrt(3.0))  # log likelihood ratio: x + 2.5
            shown = bright * np.exp(room + 0.2 * relative_error_of_base(np.array([bright]))[0] * rng.standard_t(4))
            guess = rng.uniform(0.2, 0.8)
            rough = 0.45 + 0.9 * (guess - 0.5) + 0.1 * rng.standard_t(4)
            predicted = [shown, shown, shown, guess, 1 / (1 + np.exp(-logit))]
            true = [bright, bright, bright, rough, float(is_metal)]
            sums.add(np.full(pixels, group), np.tile(predicted, (pixels, 1)), np.tile(true, (pixels, 1)))
    found = sums.errors()
    assert found.level == pytest.approx(0.15, rel=0.3) and found.brightness == pytest.approx(0.2, rel=0.15)
    middle, true, slope, scatter = found.roughness
    assert true + slope * (0.5 - middle) == pytest.approx(0.45, abs=0.02) and slope == pytest.approx(0.9, abs=0.05)
    assert scatter == pytest.approx(0.1 * np.sqrt(2), rel=0.15), "the root mean square of Student's t of scale 0.1"
    assert found.metal[0] == pytest.approx(2.5, abs=0.5) and found.metal[1] == pytest.approx(1.0, abs=0.2)


def test_pixels_of_an_object_add_up_over_views_and_few_are_left_out():
    sums = ObjectSums()
    assert sums.errors() is None
    sums.begin()
    for _ in range(2):
        sums.add(np.zeros(40, int), np.full((40, 5), 0.4), np.full((40, 5), 0.3))
    sums.add(np.ones(9, int), np.full((9, 5), 0.4), np.ones((9, 5)))
    assert sums.rooms[-1][0][0] == 80 and sums.errors() is None, "no metal of fifty pixels"
