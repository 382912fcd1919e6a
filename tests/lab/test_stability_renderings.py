"""Renderings against Mitsuba's path tracer, and the test itself."""

from dataclasses import replace

import numpy as np
import pytest

from lab.stability import mitsuba_twin, monte_carlo
from lab.stability.monte_carlo import SIGMAS, compare


def _noisy(mean, spread=0.3, n=400):
    return lambda seed: mean + spread * np.random.default_rng(seed).standard_normal((n, 3))


def test_equal_means_pass_and_a_wrong_pixel_or_a_bias_does_not():
    equal = compare("equal", _noisy(2.0), _noisy(2.0), 16)
    assert equal.smallest >= equal.threshold and equal.sigmas < SIGMAS and equal.tests == 1200
    wrong = np.full((400, 3), 2.0)
    wrong[7, 1] = 4.0
    one = compare("one pixel", _noisy(wrong), _noisy(2.0), 16)
    assert one.smallest < one.threshold
    biased = compare("bias", _noisy(2.02, 0.1), _noisy(2.0, 0.1), 16)
    assert biased.sigmas > SIGMAS and biased.bias == pytest.approx(0.01, abs=3e-3)


def test_fireflies_are_counted():
    def rare(seed):
        out = _noisy(1.0, 0.01, 1000)(seed)
        out[seed // 2] = 50.0  # another pixel in every replicate
        return out

    found = compare("rare", rare, _noisy(1.0, 0.01, 1000), 10)
    assert found.fireflies == pytest.approx(1e-3) and found.of_reference == 0


@pytest.mark.parametrize("name", ["furnished room", "under the sky"])
def test_our_paths_and_those_of_mitsuba_agree(llvm, name):
    room = monte_carlo.small_rooms(16)[name]
    scene = mitsuba_twin.scene_of(room)
    found = compare(
        name,
        lambda seed: mitsuba_twin.ours(room, 32, 5, seed),
        lambda seed: mitsuba_twin.reference(scene, room, 32, 5, seed),
        12,
    )
    assert found.smallest >= found.threshold and found.sigmas < SIGMAS
    assert found.error < 0.01


def test_another_material_is_seen(llvm):
    room = monte_carlo.small_rooms(16)["under the sky"]
    scene = mitsuba_twin.scene_of(room)
    first, *others = room.parts
    material = (*(1.05 * value for value in first.material[:3]), *first.material[3:])
    floor = replace(first, material=material)
    brighter = replace(room, parts=[floor, *others])
    found = compare(
        "brighter floor",
        lambda seed: mitsuba_twin.ours(brighter, 32, 5, seed),
        lambda seed: mitsuba_twin.reference(scene, room, 32, 5, seed),
        12,
    )
    assert found.sigmas > SIGMAS
