"""Objects without a name are called by what they are like, so that a person finds them."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from iif_core.evaluation import flip
from iif_core.numerics.color import lab_from_linear, linear_from_srgb
from iif_core.objects.description import colour_name, described
from tests.unit.own_scene import box

GREY = (0.2, 0.2, 0.2)


def furnished():
    """A room of 4 x 3 x 2.5 m (six sides), a table 0.8 m high (its top, and the rest); vertices, faces, label."""
    room, of_room = box((0, 0, 0), (4, 3, 2.5), inward=True)
    table, of_table = box((1, 1, 0.0), (2, 2, 0.8), inward=False)
    faces = np.concatenate([of_room, of_table + len(room)])
    normal = np.cross(
        *np.moveaxis(np.concatenate([room, table])[faces][:, 1:] - np.concatenate([room, table])[faces][:, :1], 1, 0)
    )
    axis = np.abs(normal).argmax(1)
    sides = np.repeat(np.arange(6), 2)
    is_top = (np.arange(len(faces)) >= 12) & (axis == 2) & (normal[:, 2] > 0)
    label = np.where(np.arange(len(faces)) < 12, np.r_[sides, np.zeros(12, int)], np.where(is_top, 6, 7))
    return np.concatenate([room, table]), faces, label


COLOURS = np.array([[0.7, 0.7, 0.7]] * 4 + [[0.2, 0.1, 0.05], [0.8, 0.8, 0.8], [0.05, 0.1, 0.4], [0.05, 0.1, 0.4]])


@pytest.mark.parametrize("turned", [0.0, 0.4])
@pytest.mark.parametrize("flipped", [False, True])
def test_a_room_is_called_by_its_parts(turned, flipped):
    """Whichever side of the faces is their front; cameras know the vertical only roughly."""
    vertices, faces, label = furnished()
    turn = Rotation.from_euler("x", turned).as_matrix()
    names = described(label, vertices @ turn.T, faces[:, ::-1] if flipped else faces, COLOURS, np.ones(8, bool), (0.0, 0.0, 1.0))
    assert sorted(names[:4]) == ["white wall 1", "white wall 2", "white wall 3", "white wall 4"]
    assert {names[0], names[1]} == {"white wall 3", "white wall 4"}  # of 3 m; the other two are 4 m long
    assert names[4:] == ["brown floor", "white ceiling", "blue top", "blue piece"]


def rectangle(x, y, z):
    """A rectangle in the plane across the axis of which one number is given, of the others the ends; vertices and two faces."""
    a, b = (i for i, v in enumerate((x, y, z)) if not np.isscalar(v))
    ends = [(v, v) if np.isscalar(v) else v for v in (x, y, z)]
    corners = []
    for u, v in ((0, 0), (1, 0), (1, 1), (0, 1)):
        corner = [end[0] for end in ends]
        corner[a], corner[b] = ends[a][u], ends[b][v]
        corners.append(corner)
    return np.array(corners), np.array([[0, 1, 2], [0, 2, 3]])


def built_up(*rectangles):
    parts = [rectangle(*one) for one in rectangles]
    vertices = np.concatenate([v for v, _ in parts])
    return vertices, np.concatenate([f + 4 * i for i, (_, f) in enumerate(parts)]), np.repeat(np.arange(len(parts)), 2)


ROOM = [((0, 4), (0, 4), 0.0), ((0, 4), (0, 4), 2.5)]  # floor and ceiling
STRIPS = [(0.02 * i, (i, i + 1), (0.0, 1.25)) for i in range(3)] + [(0.0, (3, 4), (1.25, 2.5))]  # in a scan with noise


@pytest.mark.parametrize(
    ("more", "colour", "kinds"),
    [
        ([], GREY, ["wall"] * 4),
        # Of another colour: the last one hangs on the wall.
        ([], (0.3, 0.02, 0.02), ["wall"] * 3 + ["front"]),
        # The same in the middle of the room, or before a room behind it, are fronts of cupboards.
        ([(-0.6, (0, 4), (0.0, 2.5)), (4.0, (0, 4), (0.0, 2.5))], GREY, ["front"] * 4),
    ],
)
def test_pieces_of_a_wall_are_a_wall_together_and_other_flat_pieces_are_fronts(more, colour, kinds):
    vertices, faces, label = built_up(*ROOM, *STRIPS, *more)
    count = label.max() + 1
    colours = np.tile(GREY, (count, 1))
    colours[5] = colour
    names = described(label, vertices, faces, colours, np.ones(count, bool), (0, 0, 1))
    assert [" ".join(c for c in name.split() if c in ("wall", "front", "piece")) for name in names[2:6]] == kinds
    if more:
        assert all("wall" in name for name in names[6:])


def test_panels_beside_a_wall_are_none_and_neither_is_what_nobody_saw():
    door, panel = (0.0, (0.0, 1.0), (0.0, 2.1)), (0.02, (1.0, 1.6), (0.3, 2.2))
    vertices, faces, label = built_up(*ROOM, door, panel, *STRIPS)
    names = described(label, vertices, faces, np.tile(GREY, (8, 1)), np.arange(8) < 4, (0, 0, 1))
    assert "wall" in names[2] and "front" in names[3]
    assert all(name.startswith("unseen") and "front" in name for name in names[4:])


def test_low_pieces_and_small_ones_are_no_wall():
    low = [(0.0, (i, i + 1), (0.0, 0.8)) for i in range(4)]
    small = [(4.0, (0.0, 0.1), (0.0, 0.1))]
    vertices, faces, label = built_up(*ROOM, *low, *small)
    names = described(label, vertices, faces, np.tile(GREY, (7, 1)), np.ones(7, bool), (0, 0, 1))
    assert sum("front" in name for name in names) == 4 and "piece" in names[-1]


def test_what_nobody_saw_and_what_was_built_say_so():
    vertices, faces, label = furnished()
    seen = np.arange(8) != 4
    built = np.arange(8) == 5
    names = described(label, vertices, faces, COLOURS, seen, (0, 0, 1), built)
    assert names[4:6] == ["unseen floor", "added ceiling"]


def test_names_are_there_once_and_the_largest_is_the_first():
    rng = np.random.default_rng(3)
    count = 40
    middle = rng.uniform(0, 3, (count, 1, 3))
    size = rng.uniform(0.05, 0.2, (count, 1, 1))
    vertices = (middle + size * rng.normal(size=(count, 3, 3))).reshape(-1, 3)
    faces = np.arange(3 * count).reshape(-1, 3)
    names = described(np.arange(count), vertices, faces, np.tile(GREY, (count, 1)), np.ones(count, bool), (0, 0, 1))
    assert len(set(names)) == count
    area = np.linalg.norm(np.cross(vertices[1::3] - vertices[::3], vertices[2::3] - vertices[::3]), axis=1)
    pieces = sorted((int(n.rsplit(" ", 1)[1]), a) for n, a in zip(names, area, strict=True) if n.startswith("grey piece "))
    assert [a for _, a in pieces] == sorted((a for _, a in pieces), reverse=True) and len(pieces) > 5


def test_degenerate_objects_have_names():
    vertices = np.zeros((3, 3))
    assert described([0, 1], vertices, [[0, 1, 2]] * 2, [GREY] * 2, [True, False], (0, 0, 1)) == ["grey piece", "unseen piece"]


@pytest.mark.parametrize(
    ("srgb", "name"),
    [
        ("ffffff", "white"), ("d0d0d0", "white"), ("b0b0b0", "light grey"), ("808080", "grey"), ("505050", "dark grey"),
        ("101010", "black"), ("c02020", "red"), ("e07020", "orange"), ("e0c020", "yellow"), ("308030", "green"),
        ("3050b0", "blue"), ("7030a0", "purple"), ("7a4a2a", "brown"), ("e0c8a0", "beige"), ("f0a0b0", "pink"),
        ("204070", "blue"),
    ],
)  # fmt: skip
def test_everyday_colours(srgb, name):
    assert colour_name(linear_from_srgb(np.array([int(srgb[i : i + 2], 16) for i in (0, 2, 4)]) / 255)) == name


def test_lab_is_that_of_the_standard():
    """sRGB red, green and blue, D65, 2 degrees (Lindbloom)."""
    expected = [[53.24, 80.09, 67.20], [87.73, -86.18, 83.18], [32.30, 79.19, -107.86]]
    np.testing.assert_allclose(lab_from_linear(np.eye(3)), expected, atol=0.03)
    np.testing.assert_allclose(lab_from_linear([0.18] * 3), [49.50, 0, 0], atol=0.01)
    hunt = flip._hunt_lab(np.array([[0.3], [0.2], [0.1]]))
    np.testing.assert_allclose(hunt[:, 0] / [1, hunt[0, 0] / 100, hunt[0, 0] / 100], lab_from_linear([0.3, 0.2, 0.1]), atol=0.02)
