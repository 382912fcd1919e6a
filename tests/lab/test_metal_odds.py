"""The study that fits by what an object is taken for a metal: planted odds, rooms that did not fit, areas by hand."""

import numpy as np

from iif_core.fitting.selection import METAL_ODDS, metal_log_odds
from lab.benchmarks import metal_odds
from lab.benchmarks.metal_odds import Objects


def planted(numbers, rooms=20, objects=400, seed=0):
    rng = np.random.default_rng(seed)
    count = rooms * objects
    witnesses = np.column_stack([rng.normal(0, 3, count), rng.standard_t(2, count) * 20, rng.uniform(-2, 2, count)])
    chance = 1.0 / (1.0 + np.exp(-metal_log_odds(witnesses, numbers)))
    return Objects(np.repeat(np.arange(rooms), objects), witnesses, rng.random(count) < chance, np.full(count, 1.0 / objects))


def test_planted_numbers_are_found_within_their_errors():
    numbers = (-1.0, 0.5, 0.9, 1.5)
    objects = planted(numbers)
    error = metal_odds.errors(objects, np.random.default_rng(1))
    assert (error > 0).all() and (error < 0.15).all()
    assert (np.abs(np.array(metal_odds.fitted(objects)) - numbers) < 3.5 * error).all()


def test_a_room_has_no_say_about_itself():
    """Where the witnesses of one room mean the opposite, numbers from the others are wrong there."""
    objects = planted((-1.0, 0.5, 0.9, 1.5))
    turned = objects.room == 3
    objects.is_metal[turned] = ~objects.is_metal[turned]
    odds = metal_odds.by_others(objects, np.random.default_rng(2))
    right = (odds > 0) == objects.is_metal
    assert right[turned].mean() < 0.25 and right[~turned].mean() > 0.75


def test_shares_of_metal_by_hand():
    room, area = np.array([0, 0, 0, 1, 1]), np.array([0.2, 0.3, 0.5, 0.9, 0.1])
    objects = Objects(room, np.zeros((5, 3)), np.array([True, False, True, False, False]), area)
    found, false = objects.found(np.array([1.0, 1.0, -1.0, -1.0, 1.0]))
    np.testing.assert_allclose([found, false], [0.2 / 0.7, (0.3 + 0.1) / 2])


def test_report_names_numbers_and_present_ones():
    lines = metal_odds.report(planted(METAL_ODDS, rooms=8, objects=200))
    assert "8 rooms, 1600 objects" in lines[0] and f"{METAL_ODDS[2]:.2f}" in lines[3]
    assert len([line for line in lines if line.startswith("claimed")]) == 7
