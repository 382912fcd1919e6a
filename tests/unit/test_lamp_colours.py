"""Colours of lamps, and lamps of one kind."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from iif_core.light.emission.colours import AXES, SPREAD, likely_colours
from iif_core.light.emission.groups import EmitterGroups
from iif_core.light.emission.kinds import IN_PLANE, LARGE, LARGEST, SAME_SIZE, SIDE_BY_SIDE, Piece, of_one_kind, place_names

ONE = np.ones(1)


def test_the_axes_hold_no_brightness():
    np.testing.assert_allclose(AXES @ AXES.T, np.eye(2), atol=1e-15)
    np.testing.assert_allclose(AXES.sum(1), 0.0, atol=1e-15)


def test_colour_temperatures_spread_along_the_first_axis():
    """A radiator of 2700 K (CIE 1931 x = 0.4599, y = 0.4106) in linear sRGB, where D65 is white."""
    x, y = 0.4599, 0.4106
    to_srgb = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])
    warm = AXES @ np.log(to_srgb @ [x / y, 1.0, (1 - x - y) / y])
    assert warm[0] / np.sqrt(12) == pytest.approx(SPREAD[0], rel=0.1)  # spread evenly from white to there
    assert abs(warm[1]) / np.sqrt(12) < SPREAD[1]  # the line of colours is nearly straight


def test_by_hand():
    """Two lamps of the same power: one known, the other green by an error as large as the spread."""
    green = np.exp(0.3 * AXES[1])
    radiance = np.stack([np.ones(3), green])
    error = np.stack([np.full(3, 1e-9), SPREAD[1] * green])
    found = likely_colours(radiance, error, np.array([green.mean(), 1.0]))
    variance = SPREAD[1] ** 2 * np.array([(1e-3 / SPREAD[1]) ** 2, 1.0])
    weight = 1.0 / (SPREAD[1] ** 2 + variance)
    mean = weight @ [0.0, 0.3] / (weight.sum() + SPREAD[1] ** -2)
    expected = mean + SPREAD[1] ** 2 * weight * (np.array([0.0, 0.3]) - mean)
    np.testing.assert_allclose(np.log(found) @ AXES[1], expected, atol=1e-12)
    np.testing.assert_allclose(np.log(found) @ AXES[0], 0.0, atol=1e-12)
    np.testing.assert_allclose(found.mean(1), radiance.mean(1), rtol=1e-12)


def test_what_is_known_stays_and_what_is_not_becomes_like_the_others():
    radiance = np.array([[3.0, 2.0, 1.0], [1.0, 30.0, 0.0], [0.0, 0.0, 0.0]])
    known = likely_colours(radiance[:1], 1e-6 * radiance[:1], ONE)
    np.testing.assert_allclose(known, radiance[:1], rtol=1e-3)
    error = np.array([[1e-6, 1e-6, 1e-6], [1e6, 1e6, 1e6], [1.0, 1.0, 1.0]])
    found = likely_colours(radiance, error, np.array([1.0, 1e-3, 1.0]))
    np.testing.assert_allclose(np.log(found[1]) @ AXES.T, 0.5 * (np.log(radiance[0]) @ AXES.T), rtol=0.2)  # half way to white
    assert found[1].mean() == pytest.approx(31.0 / 3.0) and not found[2].any()
    assert likely_colours(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)).shape == (0, 3)


EXTREME = st.floats(0.0, 1e30)


@given(st.lists(st.tuples(*[EXTREME] * 6, st.floats(0.0, 1e6)), min_size=1, max_size=6))
@example([(0.0, 0.0, 5e-324, 0.0, 0.0, 0.0, 0.0)])
@example([(1e30, 0.0, 0.0, 1e30, 1e30, 1e30, 1e6), (1e-99, 1e-320, 0.0, 0.0, 0.0, 1e30, 0.0)])
def test_at_the_extremes(rows):
    """Always finite, never negative, as bright as before; white lamps stay so."""
    rows = np.array(rows)
    radiance, error, area = rows[:, :3], rows[:, 3:6], rows[:, 6]
    found = likely_colours(radiance, error, area)
    assert np.isfinite(found).all() and (found >= 0).all()
    np.testing.assert_allclose(found.mean(1), radiance.mean(1), rtol=1e-9)
    white = np.repeat(np.abs(radiance).max(1, keepdims=True), 3, 1)
    np.testing.assert_allclose(likely_colours(white, error, area), white, rtol=1e-6, atol=1e-290)


# -------------------------------------------------------------------------------------------------------------- kinds


def squares(*placed):
    """Vertices and faces of squares: (middle, edge, axis of the normal) each."""
    vertices, faces = [], []
    for middle, edge, axis in placed:
        u, v = np.roll(np.eye(3), -axis - 1, 0)[:2]
        first = len(vertices)
        vertices += [np.array(middle) + 0.5 * edge * (a * u + b * v) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        faces += [[first, first + 1, first + 2], [first, first + 2, first + 3]]
    return np.array(vertices), np.array(faces)


def kinds(*placed, family=None, alike=None, pixels=None):
    vertices, faces = squares(*placed)
    count = len(placed)
    of_face = np.repeat(np.arange(count), 2).astype(np.int32)
    rows = (
        np.full(count, 2, np.int32),
        np.ones(count),
        np.ones((count, 3)),
        np.array(np.ones(count) if pixels is None else pixels, int),
    )
    groups = EmitterGroups(of_face, np.ones_like(of_face), *rows, [])
    family = np.arange(count) if family is None else np.array(family)
    return of_one_kind(groups, vertices, faces, family, np.ones(count, bool) if alike is None else np.array(alike)).tolist()


def test_lamps_of_the_same_size_in_one_plane_are_of_one_kind():
    lamps = ([0, 0, 3], 0.2, 2), ([4, 0, 3], 0.21, 2), ([0, 2, 1], 0.2, 0), ([9, 9, 3], 0.4, 2), ([7, 7, 3.06], 0.2, 2)
    assert kinds(*lamps) == [0, 0, 1, 2, 3]
    above = 1.01 * np.sqrt(SAME_SIZE)
    assert kinds(([0, 0, 3], 0.2, 2), ([4, 0, 3], 0.2 * above, 2)) == [0, 1]
    edge = np.sqrt(LARGEST) * 1.01
    assert kinds(([0, 0, 3], edge, 2), ([4, 0, 3], edge, 2)) == [0, 1]  # parts of a ceiling


def test_panes_side_by_side_are_of_one_kind():
    gap = 0.9 * SIDE_BY_SIDE
    big, small = ([0, 0, 1], 1.0, 0), ([0, 0.5 + gap + 0.2, 1], 0.4, 0)
    assert kinds(big, small) == [0, 0]
    assert kinds(big, small, pixels=[9, 0]) == [0, 1] and kinds(small, small, pixels=[9, 0]) == [0, 0]
    assert kinds(big, ([0, 0.5 + 1.2 * SIDE_BY_SIDE + 0.2, 1], 0.4, 0)) == [0, 1]
    assert kinds(big, ([1.1 * IN_PLANE, 0.7 + gap, 1], 0.4, 0)) == [0, 1]  # before it
    assert kinds(big, ([0.0, 0.7 + gap, 1], 0.4, 1)) == [0, 1]  # square to it


def test_a_lamp_shines_to_both_sides_unless_all_of_it_shines_to_one():
    of_face, side = np.array([0, 0, 1, 1, -1, 2, 3, 3]), np.array([1, 1, 0, 0, 0, -1, 1, -1])
    groups = EmitterGroups(of_face, side, np.array([2, 2, 1, 2]), np.ones(4), np.ones((4, 3)), np.ones(4, int), [])
    assert groups.sides.tolist() == [1, 0, -1, 0]
    assert EmitterGroups.none(3).sides.tolist() == []


def called(*placed, overhead=(), unseen=(), power=None):
    pieces = [Piece.of(*squares(one)) for one in placed]
    number = np.arange(len(placed))
    power = np.ones(len(placed)) if power is None else np.array(power)
    return place_names(pieces, np.array([0, 0, 1.0]), np.isin(number, overhead), np.isin(number, unseen), power)


def test_lamps_are_called_by_where_they_are_the_strongest_first():
    spot, other, pane, beside = ([0, 0, 3], 0.2, 2), ([2, 0, 3], 0.2, 2), ([0, 0, 1], 0.4, 0), ([0, 0.5, 1], 0.4, 0)
    assert called(spot, other, pane, beside, overhead=[0, 1], power=[1, 3, 1, 1]) == [
        "ceiling light 2",
        "ceiling light 1",
        "window 1",
        "window 1",
    ]
    edge = np.sqrt(LARGE)
    assert called(([0, 0, 1], 1.01 * edge, 0), ([5, 0, 1], 0.99 * edge, 0)) == ["window 1", "lamp 1"]
    assert called(([0, 0, 1], 2 * edge, 2)) == ["lamp 1"]  # a table
    assert called(pane, beside, unseen=[1]) == ["lamp 1", "unseen lamp 1"]
    assert called(pane, beside, overhead=[0]) == ["ceiling light 1"] * 2  # a panel that hangs
    assert called() == []


def test_a_lamp_all_around_is_no_window():
    """A cube of 1 m, and a pane of which a tenth is bent."""
    cube = [([0.5 * (axis == k) * side + 0.0 for k in range(3)], 1.0, axis) for axis in range(3) for side in (-1, 1)]
    lamp = Piece.of(*squares(*cube))
    assert not lamp.is_flat
    assert place_names([lamp], np.array([0, 0, 1.0]), np.zeros(1, bool), np.zeros(1, bool), np.ones(1)) == ["lamp 1"]
    assert Piece.of(*squares(([0, 0, 1], 0.9, 0), ([0, 0.5, 1], 0.3, 1))).is_flat


def test_only_what_looks_alike_is_joined_and_families_stay_together():
    lamps = [([i, 0, 3], 0.2, 2) for i in range(4)]
    assert kinds(*lamps, alike=[True, False, True, True]) == [0, 1, 0, 0]
    assert kinds(*lamps, alike=[False] * 4, family=[5, 7, 5, 7]) == [0, 1, 0, 1]
    assert kinds(*lamps, alike=[True, False, False, True], family=[5, 7, 7, 9]) == [0, 1, 1, 0]
    assert kinds() == []
