"""Felzenszwalb segmentation of a mesh: small graphs by hand, boxes, noise, islands, colour."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from iif_core.errors import InputError
from iif_core.objects.felzenszwalb import (
    edge_weights,
    filtered_normals,
    merge_regions,
    segment_mesh,
    smooth_over_faces,
)
from iif_core.surface.segments import face_adjacency
from iif_core.surface.triangles import face_geometry


def sheet(n, place):
    """n x n quads over [0, 1]^2, mapped by place(u, v) -> (..., 3)."""
    u, v = np.meshgrid(np.linspace(0, 1, n + 1), np.linspace(0, 1, n + 1), indexing="ij")
    index = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    return place(u, v).reshape(-1, 3), np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def corner(n, noise=0.0, seed=0):
    """Floor, wall x = 0 and wall y = 0 that meet in edges; side of each face."""
    flat = np.zeros((n + 1, n + 1))
    parts = [
        sheet(n, lambda u, v: np.stack([u, v, flat], -1)),
        sheet(n, lambda u, v: np.stack([flat, u, v], -1)),
        sheet(n, lambda u, v: np.stack([v, flat, u], -1)),
    ]
    vertices = np.concatenate([p[0] for p in parts])
    faces = np.concatenate([p[1] + i * len(parts[0][0]) for i, p in enumerate(parts)])
    if noise:  # the same shift for corners at one place, so that the walls stay joined
        key, inverse = np.unique(vertices.round(9), axis=0, return_inverse=True)
        vertices = vertices + np.random.default_rng(seed).normal(0, noise, key.shape)[inverse.ravel()]
    return vertices, faces, np.repeat([0, 1, 2], len(parts[0][1]))


def oracle(count, pairs, weights, k):
    """The published rule, implemented with sets."""
    region = [{i} for i in range(count)]
    inner = [0.0] * count
    for e in np.argsort(weights, kind="stable"):
        a, b = (next(i for i, r in enumerate(region) if node in r) for node in pairs[e])
        if a == b:
            continue
        if weights[e] <= min(inner[a] + k / len(region[a]), inner[b] + k / len(region[b])):
            region[a] |= region[b]
            inner[a] = weights[e]
            region[b], inner[b] = set(), 0.0
    labels = np.zeros(count, int)
    for i, r in enumerate(sorted((r for r in region if r), key=min)):
        labels[list(r)] = i
    return labels


@settings(max_examples=80, deadline=None)
@given(st.integers(0, 2**31), st.integers(2, 25), st.floats(0.01, 3))
def test_agrees_with_the_rule_written_plainly(seed, count, k):
    rng = np.random.default_rng(seed)
    edges = rng.integers(0, count, (3 * count, 2))
    edges = np.unique(np.sort(edges[edges[:, 0] != edges[:, 1]], 1), axis=0)
    weights = rng.integers(0, 10, len(edges)) / 10.0  # ties happen
    got = merge_regions(count, edges.reshape(-1, 2), weights, k, 1)
    np.testing.assert_array_equal(got, oracle(count, edges, weights, k))


def test_small_regions_join_across_the_lightest_edge():
    pairs = np.array([[0, 1], [1, 2], [2, 3], [3, 4], [4, 5]])
    weights = np.array([0.0, 0.0, 5.0, 4.0, 0.0])  # {0,1,2} {3} {4,5}
    np.testing.assert_array_equal(merge_regions(6, pairs, weights, 0.1, 1), [0, 0, 0, 1, 2, 2])
    np.testing.assert_array_equal(merge_regions(6, pairs, weights, 0.1, 2), [0, 0, 0, 1, 1, 1])
    np.testing.assert_array_equal(merge_regions(6, pairs, weights, 0.1, 4), [0] * 6)
    np.testing.assert_array_equal(merge_regions(3, np.zeros((0, 2), int), np.zeros(0), 0.1, 10), [0, 1, 2])
    for bad in (
        lambda: merge_regions(2, [[0, 1]], [np.nan], 0.1, 1),
        lambda: merge_regions(2, [[0, 1]], [0.1], 0, 1),
    ):
        with pytest.raises(InputError):
            bad()


@pytest.mark.parametrize("degrees", [0, 10, 30, 90, 150])
def test_weights_by_hand(degrees):
    # A ridge: two faces left and right of an edge, both tilted by half the bend. Seen from outside it is convex.
    half = np.radians(degrees / 2)
    normal = np.array([[-np.sin(half), 0, np.cos(half)], [np.sin(half), 0, np.cos(half)]])
    ridge = np.array([[-np.cos(half), 0, -np.sin(half)], [np.cos(half), 0, -np.sin(half)]])
    bend = 1 - np.cos(2 * half)
    convex = edge_weights(normal, ridge, [[0, 1]])
    concave = edge_weights(-normal, ridge, [[0, 1]])
    assert convex == pytest.approx(min(bend, bend**2), abs=1e-12) and concave == pytest.approx(bend, abs=1e-12)
    assert edge_weights(normal, ridge, [[1, 0]]) == pytest.approx(convex, abs=1e-12)
    colour = [[0.1, 0.5, 0.2], [0.1, 0.1, 0.3]]
    assert edge_weights(-normal, ridge, [[0, 1]], colour, 0.5) == pytest.approx(bend + 0.5 * 0.4)
    unknown = [[np.nan] * 3, [0.1, 0.1, 0.3]]
    assert edge_weights(-normal, ridge, [[0, 1]], unknown, 0.5) == pytest.approx(bend, abs=1e-12)
    assert edge_weights(normal * [[0], [1]], ridge, [[0, 1]]) == 0


def test_three_planes_are_three_regions_also_with_noise():
    for noise in (0.0, 0.003):
        vertices, faces, side = corner(24, noise)
        labels = segment_mesh(vertices, faces, 0.05, 100)
        table = np.zeros((labels.max() + 1, 3))
        np.add.at(table, (labels, side), 1)
        assert table.max(1).sum() / len(faces) > 0.99  # pure
        assert 3 <= len(table) <= (3 if noise == 0 else 8)


def test_filter_keeps_creases_and_calms_noise():
    vertices, faces, side = corner(24, 0.003)
    pairs = face_adjacency(faces, vertices)
    noisy = face_geometry(vertices, faces)[0]
    calm = filtered_normals(noisy, np.ones(len(faces)), pairs)
    true = np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]])[side]
    sign = np.sign((noisy * true).sum(1)).mean()
    assert np.abs(1 - sign * (calm * true).sum(1)).mean() < 0.3 * np.abs(1 - sign * (noisy * true).sum(1)).mean()
    clean, faces, side = corner(6)
    exact = face_geometry(clean, faces)[0]
    pairs = face_adjacency(faces, clean)
    assert np.abs((filtered_normals(exact, np.ones(len(faces)), pairs) * exact).sum(1) - 1).max() < 1e-3


def test_colour_splits_a_flat_sheet():
    vertices, faces = sheet(20, lambda u, v: np.stack([u, v, 0 * u], -1))
    left = vertices[faces].mean(1)[:, 0] < 0.5
    colour = np.where(left[:, None], [0.8, 0.2, 0.2], [0.2, 0.2, 0.8])
    assert segment_mesh(vertices, faces, 0.01, 50).max() == 0
    labels = segment_mesh(vertices, faces, 0.01, 50, colour, 0.1)
    assert labels.max() == 1 and len(np.unique(labels[left])) == 1


def test_few_large_faces_stay_a_region():
    """A cupboard of twelve faces before a wall, as somebody models it: it joins the wall unless its area counts."""
    wall, tiles = sheet(12, lambda u, v: np.stack([2 * u, v, 0 * u], -1))
    corners = np.array([[x, y, z] for x in (0.5, 1.0) for y in (0.2, 0.8) for z in (0.01, 0.3)])
    sides = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    box = np.array([triangle for a, b, c, d in sides for triangle in ((a, b, c), (a, c, d))])
    mesh = np.concatenate([wall, corners]), np.concatenate([tiles, box + len(wall)])
    cupboard = np.arange(len(mesh[1])) >= len(tiles)
    labels = segment_mesh(*mesh, 0.05, 100)
    assert not set(labels[cupboard]) & set(labels[~cupboard]) and len(set(labels[~cupboard])) == 1
    assert len(set(labels[cupboard])) == 6  # its sides
    assert segment_mesh(*mesh, 0.05, 100, min_area=np.inf).max() == 0
    assert segment_mesh(*mesh, 0.05, 100, min_area=0.16).max() == 4  # two sides have 0.145 m^2


def test_islands():
    vertices, faces = sheet(12, lambda u, v: np.stack([u, v, 0 * u], -1))
    crumb, piece = sheet(1, lambda u, v: np.stack([0.05 * u + 0.5, 0.05 * v + 0.5, 0 * u + 0.01], -1))
    n = len(vertices)
    near = segment_mesh(np.concatenate([vertices, crumb]), np.concatenate([faces, piece + n]), 0.05, 100)
    assert near.max() == 0
    far = segment_mesh(np.concatenate([vertices, crumb + [0, 0, 5]]), np.concatenate([faces, piece + n]), 0.05, 100)
    assert far.max() == 1 and (far[-2:] == 1).all()


def test_extremes_and_determinism():
    assert len(segment_mesh(np.zeros((0, 3)), np.zeros((0, 3), int))) == 0
    np.testing.assert_array_equal(segment_mesh(np.eye(3), np.array([[0, 1, 2]])), [0])
    flat = segment_mesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 0]]), np.array([[0, 1, 2], [0, 3, 1]]), 0.05, 1)
    assert flat.max() <= 1  # a zero-area face has no normal, and no NaN comes of it
    vertices, faces, _ = corner(12, 0.01)
    first = segment_mesh(vertices, faces)
    np.testing.assert_array_equal(first, segment_mesh(vertices.copy(), faces.copy()))
    assert first.dtype == np.int32 and set(np.unique(first)) == set(range(first.max() + 1))
    assert (np.diff([np.flatnonzero(first == i)[0] for i in range(first.max() + 1)]) > 0).all()


def test_colour_spreads_to_faces_that_nobody_saw():
    pairs = np.array([[0, 1], [1, 2], [2, 3], [3, 4]])
    values = np.array([[1.0], [99], [99], [99], [99]])
    got = smooth_over_faces(values, [2, 0, 0, 0, 0], pairs, 2)
    np.testing.assert_allclose(got[:3], 1.0)
    assert np.isnan(got[3:]).all()
