"""Turns by quarter circles and their names."""

import numpy as np
import pytest

from iif_core.surface.axes import AS_IS, TURNS, name_of, turn_of
from tests.errors import refused


def test_the_turns_are_the_24_rotations_of_a_cube():
    found = {tuple(turn_of(name).ravel()) for name in TURNS}
    assert len(found) == len(TURNS) == 24
    for name in TURNS:
        turn = turn_of(name)
        np.testing.assert_array_equal(turn @ turn.T, np.eye(3))
        assert np.linalg.det(turn) == 1
        assert name_of(turn) == name
    for first in TURNS:  # a group: two turns one after the other are one of them
        for second in TURNS:
            assert name_of(turn_of(second) @ turn_of(first)) in TURNS


def test_a_name_says_where_each_new_axis_comes_from():
    point = np.array([1.0, 2.0, 3.0])
    np.testing.assert_array_equal(turn_of(AS_IS) @ point, point)
    np.testing.assert_array_equal(turn_of("x -z y") @ point, [1, -3, 2])
    np.testing.assert_array_equal(turn_of("x,z,-y") @ point, [1, 3, -2])


@pytest.mark.parametrize("text", ["", "x y", "x y z x", "x x z", "x y w", "--x y z", "y x z", "-x y z"])
def test_other_texts_are_refused(text):
    with refused(repr(text)):
        turn_of(text)
