"""Segments, borders, face votes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from iif_core.surface import segments
from tests.errors import refused


def test_segments_are_numbered_by_view_then_object():
    maps = np.array([[[5, 5], [2, -1]], [[2, 2], [2, 2]], [[-1, -1], [-1, -1]], [[7, 2], [5, 5]]], np.int32)
    segment_maps, table = segments.segment_table(maps)
    assert table.view.tolist() == [0, 0, 1, 3, 3, 3]
    assert table.object.tolist() == [2, 5, 2, 2, 5, 7]
    assert table.pixels.tolist() == [1, 2, 4, 1, 2, 1]
    assert segment_maps[0].tolist() == [[1, 1], [0, -1]]
    assert segment_maps[2].tolist() == [[-1, -1], [-1, -1]]
    assert segment_maps[3].dtype == np.int32


@settings(max_examples=50, deadline=None)
@given(arrays(np.int32, st.tuples(st.integers(0, 4), st.integers(1, 5), st.integers(1, 5)), elements=st.integers(-1, 6)))
def test_segment_maps_give_the_object_back(maps):
    segment_maps, table = segments.segment_table(maps)
    assert table.segment_id.tolist() == list(range(len(table)))
    for view, (object_map, segment_map) in enumerate(zip(maps, segment_maps, strict=True)):
        seen = object_map >= 0
        np.testing.assert_array_equal(seen, segment_map >= 0)
        np.testing.assert_array_equal(table.object[segment_map[seen]], object_map[seen])
        assert (table.view[segment_map[seen]] == view).all()
    assert table.pixels.sum() == (maps >= 0).sum()


def test_views_may_differ_in_size():
    maps, table = segments.segment_table([np.zeros((2, 3), np.int32), np.zeros((4, 1), np.int32)])
    assert [m.shape for m in maps] == [(2, 3), (4, 1)] and table.pixels.tolist() == [6, 4]


def test_float_ids_are_refused():
    with refused("(2, 2)", "float32"):
        segments.segment_table([np.zeros((2, 2), np.float32)])


@pytest.mark.parametrize("border", [0, 1, 2])
def test_interior_equals_the_slow_definition(border):
    rng = np.random.default_rng(border)
    ids = np.kron(rng.integers(-1, 3, (4, 5)), np.ones((4, 5), int)).astype(np.int32)
    found = segments.interior(ids, border)
    for (y, x), value in np.ndenumerate(ids):
        window = ids[max(0, y - border) : y + border + 1, max(0, x - border) : x + border + 1]
        assert found[y, x] == (value >= 0 and (window == value).all())


def test_interior_of_one_pixel():
    assert segments.interior(np.zeros((1, 1), np.int32), 3).tolist() == [[True]]


def grid_mesh(n):
    """n x n quads, two triangles each."""
    index = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    a, b, c, d = index[:-1, :-1].ravel(), index[:-1, 1:].ravel(), index[1:, :-1].ravel(), index[1:, 1:].ravel()
    y, x = np.divmod(np.arange((n + 1) ** 2), n + 1)
    return np.stack([np.c_[a, b, c], np.c_[b, d, c]], 1).reshape(-1, 3), np.c_[x, y, 0 * x].astype(np.float32)


def test_adjacency_of_a_grid():
    faces, vertices = grid_mesh(3)
    pairs = segments.face_adjacency(faces)
    slow = {(i, j) for i in range(len(faces)) for j in range(i + 1, len(faces)) if len(set(faces[i]) & set(faces[j])) == 2}
    assert {tuple(p) for p in pairs.tolist()} == slow
    # the same with every corner its own vertex, joined by position
    split = vertices[faces].reshape(-1, 3)
    own = np.arange(len(split)).reshape(-1, 3)
    assert len(segments.face_adjacency(own)) == 0
    np.testing.assert_array_equal(segments.face_adjacency(own, split), pairs)


def test_vertices_at_one_position_to_rounding_are_one():
    """Every face has its own corners, each off by rounding: the neighbours are those of the joined mesh."""
    n = 12
    i, j = (axis.ravel() for axis in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
    a = i * (n + 1) + j
    faces = np.concatenate([np.stack([a, a + n + 1, a + n + 2], 1), np.stack([a, a + n + 2, a + 1], 1)])
    grid = np.stack(np.meshgrid(np.arange(n + 1), np.arange(n + 1), [0.0], indexing="ij"), -1).reshape(-1, 3)
    grid = (0.05 * grid + [3.0, -1.0, 2.0]).astype(np.float32)
    split, own = grid[faces].reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3)
    rng = np.random.default_rng(0)
    moved = np.nextafter(split, np.where(rng.random(split.shape) < 0.5, np.inf, -np.inf).astype(np.float32))
    np.testing.assert_array_equal(segments.face_adjacency(own, moved), segments.face_adjacency(faces))
    # A gap that is wider than rounding stays one: every other face 0.1 mm aside.
    apart = split + np.float32(1e-4) * (np.arange(len(split)) // 3 % 2).astype(np.float32)[:, None]
    assert len(segments.face_adjacency(own, apart)) < len(segments.face_adjacency(faces))


def test_adjacency_of_odd_meshes():
    assert segments.face_adjacency(np.zeros((0, 3), int)).shape == (0, 2)
    assert segments.face_adjacency(np.array([[0, 1, 1]])).shape == (0, 2)
    fan = np.array([[0, 1, 2], [0, 1, 3], [0, 1, 4]])  # three faces on one edge
    assert segments.face_adjacency(fan).tolist() == [[0, 1], [1, 2]]
    with refused("faces", "(4, 4)"):
        segments.face_adjacency(np.zeros((4, 4), int))


def test_majority_ties_and_agreement():
    face = np.array([0, 0, 0, 1, 1, 2, -1, 2, 2, 2])
    inst = np.array([4, 4, 9, 9, 4, -1, 4, 9, 9, 4])
    votes = segments.vote_faces(face, inst, 3)
    assert votes.object_of_face.tolist() == [4, 4, 9]  # face 1 ties: lowest id
    assert votes.votes.tolist() == [3, 2, 3]
    assert votes.object_id.tolist() == [4, 9] and votes.pixels.tolist() == [5, 3]
    np.testing.assert_allclose(votes.agreement, [3 / 5, 2 / 3])
    assert votes.background is None


def test_unseen_faces_take_the_nearest_label_then_the_background():
    strip = np.array([[i, i + 1, i + 2] for i in range(7)])
    lonely = np.array([[100, 101, 102]])
    faces = np.concatenate([strip, lonely])
    votes = segments.vote_faces([0, 6], [8, 3], len(faces), segments.face_adjacency(faces))
    assert votes.object_of_face.tolist() == [8, 8, 8, 3, 3, 3, 3, 9]  # the middle is equally near: lowest id
    assert votes.background == 9
    assert votes.agreement.tolist() == [1, 1, 0] and np.isfinite(votes.agreement).all()


def test_spread_equals_breadth_first_search():
    faces, _ = grid_mesh(12)
    pairs = segments.face_adjacency(faces)
    rng = np.random.default_rng(1)
    seen = rng.choice(len(faces), 9, replace=False)
    votes = segments.vote_faces(seen, rng.integers(0, 5, 9), len(faces), pairs)
    label = dict(zip(seen.tolist(), votes.object_of_face[seen].tolist(), strict=True))
    near = {i: [] for i in range(len(faces))}
    for i, j in pairs.tolist():
        near[i].append(j)
        near[j].append(i)
    while len(label) < len(faces):
        label |= {
            i: min(label[j] for j in near[i] if j in label) for i in near if i not in label and any(j in label for j in near[i])
        }
    assert votes.object_of_face.tolist() == [label[i] for i in range(len(faces))]


def test_no_votes_at_all():
    votes = segments.vote_faces(np.zeros(0, int), np.zeros(0, int), 4, np.array([[0, 1]]))
    assert votes.object_of_face.tolist() == [0, 0, 0, 0] and votes.background == 0
    assert votes.agreement.tolist() == [0]


def test_maps_of_another_mesh_are_refused():
    with refused("face id 3", "3 faces"):
        segments.vote_faces([3], [0], 3)
    with refused("2 face", "1 instance"):
        segments.vote_faces([1, 2], [0], 3)


def test_votes_do_not_depend_on_pixel_order():
    rng = np.random.default_rng(2)
    face, inst = rng.integers(-1, 20, 500), rng.integers(-1, 6, 500)
    order = rng.permutation(500)
    first, second = segments.vote_faces(face, inst, 25), segments.vote_faces(face[order], inst[order], 25)
    np.testing.assert_array_equal(first.object_of_face, second.object_of_face)
    np.testing.assert_array_equal(first.agreement, second.agreement)
