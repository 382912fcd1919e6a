"""Studies that fit odds to rooms with truth: planted numbers, rooms that did not fit, areas by hand."""

import numpy as np

from iif_core.fitting.selection import METAL_ODDS, metal_witnesses
from lab.benchmarks import logistic, metal_odds
from lab.benchmarks.metal_odds import Objects

NUMBERS = np.array([-1.0, 0.5, 0.9, 1.5])


def planted(numbers, rooms=20, rows=400, seed=0):
    rng = np.random.default_rng(seed)
    columns = rng.normal(0, 2, (rooms * rows, 3))
    chance = 1.0 / (1.0 + np.exp(-logistic.log_odds(columns, numbers)))
    return columns, rng.random(rooms * rows) < chance, np.repeat(np.arange(rooms), rows)


def test_planted_numbers_are_found_within_their_errors():
    columns, truth, room = planted(NUMBERS)
    error = logistic.errors(columns, truth, room, np.random.default_rng(1))
    assert (error > 0).all() and (error < 0.15).all()
    assert (np.abs(logistic.fitted(columns, truth) - NUMBERS) < 3.5 * error).all()


def test_answers_that_are_apart_give_finite_numbers():
    columns = np.array([[-1.0], [-2.0], [1.0], [2.0]])
    assert np.isfinite(logistic.fitted(columns, columns[:, 0] > 0)).all()


def test_a_room_has_no_say_about_itself():
    """Where the columns of one room mean the opposite, numbers from the others are wrong there."""
    columns, truth, room = planted(NUMBERS)
    turned = room == 3
    truth[turned] = ~truth[turned]
    right = (logistic.by_others(columns, truth, room, np.random.default_rng(2)) > 0) == truth
    assert right[turned].mean() < 0.25 and right[~turned].mean() > 0.75


def test_claims_that_hold_are_told_as_such():
    columns, truth, room = planted(NUMBERS)
    others = logistic.by_others(columns, truth, room, np.random.default_rng(3))
    lines = logistic.told(("constant", "a", "b", "c"), columns, truth, room, NUMBERS, others)
    claims = [line for line in lines if line.startswith("claimed")]
    assert len(claims) == 7 and sum(int(line.split(": ")[1].split(",")[0]) for line in claims) == len(truth)
    for line in claims:
        said, are = (float(part.split()[-1]) for part in line.split(",")[1:])
        assert abs(said - are) < 0.06


def test_shares_of_metal_by_hand():
    room, area = np.array([0, 0, 0, 1, 1]), np.array([0.2, 0.3, 0.5, 0.9, 0.1])
    objects = Objects(room, np.zeros((5, 3)), np.array([True, False, True, False, False]), area)
    found, false = objects.found(np.array([1.0, 1.0, -1.0, -1.0, 1.0]))
    np.testing.assert_allclose([found, false], [0.2 / 0.7, (0.3 + 0.1) / 2])


def test_the_study_of_metals_fits_the_numbers_of_the_product():
    rng = np.random.default_rng(4)
    witnesses = np.column_stack([rng.normal(0, 3, 4000), rng.standard_t(2, 4000) * 20, rng.uniform(-2, 2, 4000)])
    chance = 1.0 / (1.0 + np.exp(-logistic.log_odds(metal_witnesses(witnesses), np.array(METAL_ODDS))))
    objects = Objects(np.repeat(np.arange(20), 200), witnesses, rng.random(4000) < chance, np.full(4000, 1 / 200))
    lines = metal_odds.report(objects)
    assert "20 rooms, 4000 objects" in lines[0]
    for line in lines[3:7]:
        name, new, _, error, _, present = line.rsplit(maxsplit=5)
        assert name.strip() and abs(float(new) - float(present)) < 4 * float(error) + 0.01
