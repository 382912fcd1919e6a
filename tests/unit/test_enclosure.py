"""Walls that a scan lacks are built around it: where they lie is known in rooms with parts left out."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from iif_core.surface.enclosure import directions, enclosure
from iif_core.surface.triangles import face_geometry
from tests.unit import own_scene as own

SIZE = np.array([5.0, 4.0, 2.5])
MARGIN = 0.02


def room(leave_out=()):
    """A box of `SIZE` around the origin, each side of 20 x 20 quads, without some of its sides (axis, sign)."""
    step = np.linspace(-1, 1, 21)
    vertices, faces = [], []
    for axis in range(3):
        for sign in (-1, 1):
            if (axis, sign) in leave_out:
                continue
            a, b = np.meshgrid(step, step, indexing="ij")
            grid = np.insert(np.stack([a, b], -1), axis, sign, axis=-1).reshape(-1, 3) * SIZE / 2
            corner = (np.arange(20)[:, None] * 21 + np.arange(20)).ravel() + sum(map(len, vertices))
            vertices.append(grid)
            faces += [np.stack([corner, corner + 21, corner + 22], 1), np.stack([corner, corner + 22, corner + 1], 1)]
    return np.concatenate(vertices), np.concatenate(faces)


def roofed():
    """A room with vertical walls and a roof of two slopes, of which one gable and the floor are missing; vertices and faces."""
    half, eaves, ridge = 2.0, 2.0, 3.0
    ends = np.array([[-half, 0.0], [-half, eaves], [0, ridge], [half, eaves], [half, 0.0]])
    near, far = (np.insert(ends, 1, y, axis=1) for y in (-2.5, 2.5))
    strips = [(i, i + 1, i + 6, i + 5) for i in range(4)]
    faces = [f for a, b, c, d in strips for f in ((a, b, c), (a, c, d))]
    faces += [(0, 1, 2), (0, 2, 3), (0, 3, 4)]
    return np.concatenate([near, far]), np.array(faces)


def is_closed(found):
    """Each edge is run through once each way."""
    edges = np.stack([found.faces, np.roll(found.faces, -1, 1)], -1).reshape(-1, 2)
    forth, back = {tuple(e) for e in edges.tolist()}, {tuple(e[::-1]) for e in edges.tolist()}
    return len(forth) == len(edges) and forth == back


def volume(found):
    return -float(np.linalg.det(found.vertices[found.faces]).sum()) / 6


@pytest.mark.parametrize("kind", ["box", "planes"])
@pytest.mark.parametrize("leave_out", [(), ((2, 1),), ((2, 1), (0, -1)), ((2, 1), (2, -1), (1, 1))])
def test_missing_sides_are_where_the_others_end(kind, leave_out):
    vertices, faces = room(leave_out)
    turn = Rotation.from_euler("xyz", [0.3, -0.7, 1.1]).as_matrix()
    found = enclosure(vertices @ turn.T + [40.0, -7.0, 3.0], faces, [[40.0, -7.0, 3.0]], kind)
    assert is_closed(found) and len(found.normal) == 6
    assert volume(found) == pytest.approx(np.prod(SIZE + 2 * MARGIN), rel=1e-6)
    own_sides = (found.vertices - [40.0, -7.0, 3.0]) @ turn
    np.testing.assert_allclose(np.abs(own_sides), np.tile(SIZE / 2 + MARGIN, (8, 1)), atol=1e-6)
    assert found.from_plane.sum() == (6 - len(leave_out) if kind == "planes" else 0)


def test_planes_at_any_angle_are_prolonged_and_a_box_closes_what_is_left():
    vertices, faces = roofed()
    found = enclosure(vertices, faces, [[0.0, 0.0, 1.0]], "planes", margin=0.0)
    assert is_closed(found)
    # Two walls, two slopes and a gable are there; the floor and the other gable are not.
    assert (len(found.normal), found.from_plane.sum()) == (7, 5)
    assert volume(found) == pytest.approx(5 * (4 * 2 + 4 * 1 / 2), rel=1e-6)
    boxed = enclosure(vertices, faces, [[0.0, 0.0, 1.0]], "box", margin=0.0)
    assert len(boxed.normal) == 6 and volume(boxed) == pytest.approx(5 * 4 * 3, rel=1e-6)


def test_a_partition_is_no_wall_and_what_lies_behind_a_window_moves_none():
    vertices, faces = room(((2, 1),))
    area = face_geometry(vertices, faces)[1].sum()
    partition = np.array([[0.5, -1.0, -1.2], [0.5, 1.0, -1.2], [0.5, 1.0, 1.2], [0.5, -1.0, 1.2]])
    edge = np.sqrt(0.008 * area)
    tree = np.array([[9.0, 0, 0], [9.0, edge, 0], [9.0, edge, edge], [9.0, 0, edge]])
    square = np.array([[0, 1, 2], [0, 2, 3]])
    every = np.concatenate([vertices, partition, tree])
    all_faces = np.concatenate([faces, square + len(vertices), square + len(vertices) + 4])
    walled = enclosure(every, all_faces, [[-1.0, 0, 0]], "planes")
    assert np.ptp(walled.vertices[:, 0]) == pytest.approx(SIZE[0] + 2 * MARGIN, abs=1e-6)
    boxed = enclosure(every, all_faces, [[-1.0, 0, 0]], "box")
    assert boxed.vertices[:, 0].max() == pytest.approx(9.0 + MARGIN, abs=1e-6)


def test_points_tell_how_far_the_room_reaches_and_stray_ones_do_not():
    """Of the ceiling only points are known; two in a hundred points lie anywhere within 50 m."""
    vertices, faces = room(((2, 1),))
    low = vertices[faces].mean(1)[:, 2] < 0.2  # walls up to 1.45 m alone
    rng = np.random.default_rng(0)
    ceiling = np.column_stack([rng.uniform(-2, 2, (500, 2)), np.full(500, SIZE[2] / 2)]) + 0.01 * rng.normal(size=(500, 3))
    stray = rng.uniform(-50, 50, (30, 3))
    points = np.concatenate([ceiling, vertices, stray])
    for kind in ("box", "planes"):
        found = enclosure(vertices, faces[low], [[0.0, 0, -0.5]], kind, shown=points)
        assert found.vertices[:, 2].max() == pytest.approx(SIZE[2] / 2, abs=0.08)
        assert np.ptp(found.vertices[:, 0]) == pytest.approx(SIZE[0], abs=0.1)


def test_the_box_lies_along_most_of_the_surface():
    """A slanted plate in the room is the least of its directions."""
    vertices, faces = room(((2, 1),))
    turn = Rotation.from_euler("z", 0.4).as_matrix()
    plate = np.array([[-0.5, -0.5, -0.2], [0.5, -0.5, -0.2], [0.5, 0.5, 0.5], [-0.5, 0.5, 0.5]])
    both = np.concatenate([vertices @ turn.T, plate])
    found = enclosure(both, np.concatenate([faces, [[0, 1, 2], [0, 2, 3]] + np.array(len(vertices))]), [[0.0, 0, 0]], "box")
    assert volume(found) == pytest.approx(np.prod(SIZE + 2 * MARGIN), rel=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_a_direction_is_the_middle_of_normals_that_scatter(seed):
    """Six tenths of the faces scatter by 4 degrees, either way round; the others look anywhere."""
    rng = np.random.default_rng(seed)
    truth = rng.normal(size=3)
    truth /= np.linalg.norm(truth)
    near = truth + np.tan(np.radians(4.0)) * rng.normal(size=(1200, 3)) / np.sqrt(2)
    normal = np.concatenate([near * rng.choice([-1, 1], (1200, 1)), rng.normal(size=(800, 3))])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    found = directions(normal, np.ones(len(normal)))[0]
    assert abs(found @ truth) > np.cos(np.radians(0.7))


@pytest.mark.parametrize("axis", range(3))
def test_a_single_wall_gives_a_box(axis):
    wall = np.roll(np.array([[0.0, -1, -1], [0, 1, -1], [0, 1, 1], [0, -1, 1]]), axis, axis=1)
    camera = np.roll([1.0, 0, 0], axis)
    found = enclosure(wall, [[0, 1, 2], [0, 2, 3]], [camera], "box")
    assert is_closed(found) and volume(found) == pytest.approx((1 + 2 * MARGIN) * (2 + 2 * MARGIN) ** 2, rel=1e-6)


def test_no_wall_is_built_between_scan_and_cameras():
    vertices, faces = room(((0, 1),))
    outside = np.array([[-1.0, 0, 0], [6.0, 0, 0], [0.0, 0, 3.0]])
    for kind in ("box", "planes"):
        found = enclosure(vertices, faces, outside, kind)
        behind = (outside[:, None] - found.vertices[found.faces[:, 0]]) * found.normal[found.side]
        assert (behind.sum(-1) >= MARGIN - 1e-9).all()


def test_faces_that_look_either_way_make_one_wall():
    vertices, faces = room(((2, 1),))
    rng = np.random.default_rng(0)
    turned = np.where(rng.random(len(faces))[:, None] < 0.5, faces[:, ::-1], faces)
    found = enclosure(vertices, turned, [[0.0, 0, 0]], "planes")
    assert volume(found) == pytest.approx(np.prod(SIZE + 2 * MARGIN), rel=1e-6)


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    count=st.integers(1, 60),
    scale=st.sampled_from([1e-2, 1.0, 1e3]),
    thin=st.sampled_from([1.0, 1e-4]),
    kind=st.sampled_from(["box", "planes"]),
)
def test_whatever_the_scan_it_is_closed_and_holds_cameras(seed, count, scale, thin, kind):
    rng = np.random.default_rng(seed)
    vertices = rng.normal(size=(3 * count, 3)) * scale * [1, 1, thin]
    cameras = rng.normal(size=(3, 3)) * scale
    found = enclosure(vertices, np.arange(3 * count).reshape(-1, 3), cameras, kind)
    assert np.isfinite(found.vertices).all()
    assert is_closed(found)
    normal, area = face_geometry(found.vertices, found.faces)
    assert (area > 0).all()
    inside = ((cameras[:, None] - found.vertices[found.faces[:, 0]]) * normal).sum(-1)
    assert (inside > 0).all()
    assert volume(found) == pytest.approx(ConvexHull(found.vertices).volume, rel=1e-6)


def test_a_scene_is_closed_for_light_and_not_for_cameras(tmp_path):
    """Without its ceiling the room of the tests misses rays; they miss still, and what misses is no surface that was seen."""
    captures = {}
    for close in ("none", "box"):
        root = tmp_path / close
        path = own.project(root, source={"registration": "off", "alignment": "off", "close": close})
        own.photographed(path, 4, depth=False)
        vertices, faces, thing = own.room_mesh()
        up = face_geometry(vertices, faces)[0][:, 2]
        kept = ~((up < -0.5) & (thing == 0))
        own.save_mesh(path / "mesh.ply", vertices, faces[kept], thing[kept])
        captures[close] = own.run(root, "capture")
    opened, closed = captures["none"], captures["box"]
    for a, b in zip(opened, closed, strict=True):
        for one, other in zip(opened.gbuffer(a), closed.gbuffer(b), strict=True):
            np.testing.assert_array_equal(one, other)
    vertices, faces = closed.mesh()
    first = len(opened.mesh()[1])
    np.testing.assert_array_equal(faces[:first], opened.mesh()[1])
    area = face_geometry(vertices, faces[first:])[1].sum()
    size = np.ptp(own.ROOM, axis=0) + 2 * MARGIN
    assert area == pytest.approx(2 * (size[0] * size[1] + size[1] * size[2] + size[0] * size[2]), rel=1e-4)
    names = closed.reader.table("instances.parquet")["name"]
    added = [str(name).split()[1] for name in names if str(name).startswith("added")]
    assert sorted(added) == ["ceiling", "floor", "wall", "wall", "wall", "wall"]
    assert sorted(np.unique(closed.faces()["instance_id"][first:])) == [2, 3, 4, 5, 6, 7]
    assert any("source.close" in note for note in closed.facts["notes"])
