"""Small holes of a scanned mesh are closed, and nothing else is."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from iif_core.surface.holes import close_holes
from iif_core.surface.triangles import face_geometry
from workflow.sources.folder_scene import mesh

EDGE = 0.1


def sheet(n=11, height=None):
    """A square of n - 1 cells of EDGE a side, two triangles a cell, normals up, and the number of cells a side."""
    x, y = np.meshgrid(np.arange(n) * EDGE, np.arange(n) * EDGE)
    z = np.zeros(n * n) if height is None else height(x.ravel(), y.ravel())
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    lower = np.stack([corner, corner + 1, corner + n + 1], 1)
    upper = np.stack([corner, corner + n + 1, corner + n], 1)
    return np.c_[x.ravel(), y.ravel(), z], np.stack([lower, upper], 1).reshape(-1, 3)


def cells(*which, n=11):
    """The triangles of some cells (row, column) of a sheet."""
    return np.array([2 * (row * (n - 1) + column) + half for row, column in which for half in (0, 1)])


def without(faces, rows):
    return np.delete(faces, rows, 0)


def turned(seed):
    return np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]


@pytest.mark.parametrize("seed", [None, 0, 1])
def test_a_hole_is_closed_with_its_area_and_orientation(seed):
    vertices, faces = sheet()
    turn = np.eye(3) if seed is None else turned(seed)
    hole = cells((4, 4), (4, 5), (5, 4), (6, 4))  # an L, which is not convex
    found = close_holes(vertices @ turn.T, without(faces, hole), 0.5)
    assert found.width == pytest.approx([EDGE * np.hypot(3, 2)]) and found.area == pytest.approx(4 * EDGE**2)
    normal, area = face_geometry(vertices @ turn.T, found.faces)
    up = face_geometry(vertices @ turn.T, faces)[0][0]
    assert (normal @ up > 0.999).all() and area.sum() == pytest.approx(found.area)
    kept = np.concatenate([without(faces, hole), found.faces])
    edges = np.sort(np.concatenate([kept[:, [0, 1]], kept[:, [1, 2]], kept[:, [2, 0]]]), 1)
    _, uses = np.unique(edges, axis=0, return_counts=True)
    assert (uses == 1).sum() == 40 and uses.max() == 2  # the outline of the sheet alone is left open


def test_the_outline_of_a_sheet_and_a_hole_that_is_too_wide_stay_open():
    vertices, faces = sheet()
    assert not len(close_holes(vertices, faces, 10.0).width)
    hole = without(faces, cells((4, 4), (4, 5), (4, 6)))
    across = EDGE * np.hypot(3, 1)
    assert len(close_holes(vertices, hole, across + 1e-9).width) == 1 and not len(
        close_holes(vertices, hole, across - 1e-6).width
    )
    assert not len(close_holes(vertices, hole, 0).width)


def test_the_opening_of_a_box_stays_open():
    made = trimesh.creation.box((0.1, 0.1, 0.1))
    vertices, faces = np.asarray(made.vertices), np.asarray(made.faces)
    top = face_geometry(vertices, faces)[0][:, 2] > 0.9
    assert not len(close_holes(vertices, faces[~top], 1.0).width)


def test_vertices_that_are_written_twice_are_one():
    vertices, faces = sheet()
    hole = without(faces, cells((4, 4), (7, 2)))
    soup, own_corners = vertices[hole].reshape(-1, 3), np.arange(3 * len(hole)).reshape(-1, 3)
    found, same = close_holes(soup, own_corners, 0.5), close_holes(vertices, hole, 0.5)
    assert len(found.width) == len(same.width) == 2 and found.area == pytest.approx(same.area)


def test_surface_inside_a_hole_is_not_covered():
    vertices, faces = sheet()
    ring = cells(*((row, column) for row in (3, 4, 5) for column in (3, 4, 5) if (row, column) != (4, 4)))
    assert not len(close_holes(vertices, without(faces, ring), 1.0).width)


def test_two_holes_that_touch_in_a_corner_are_two():
    vertices, faces = sheet()
    found = close_holes(vertices, without(faces, cells((4, 4), (5, 5))), 0.5)
    assert len(found.width) == 2 and found.area == pytest.approx(2 * EDGE**2)


@given(st.sets(st.tuples(st.integers(1, 8), st.integers(1, 8)), max_size=30), st.integers(0, 99))
@settings(max_examples=60, deadline=None)
def test_whatever_is_missing_no_area_appears_that_was_not_there(missing, seed):
    vertices, faces = sheet()
    hole = cells(*missing) if missing else np.zeros(0, int)
    found = close_holes(vertices @ turned(seed).T, without(faces, hole), 10.0)
    assert found.area <= len(missing) * EDGE**2 * (1 + 1e-9)
    assert len(found.beside) == len(found.faces) and np.isfinite(found.width).all()


def test_a_mesh_file_is_closed_with_the_object_around():
    vertices, faces = sheet()
    hole = cells((2, 2), (7, 7))
    right = np.delete(vertices[faces].mean(1)[:, 0] > 0.5, hole)
    given_mesh = mesh.Mesh(vertices, without(faces, hole).astype(np.int32), right.astype(np.int32), ["left", "right"])
    got = mesh.closed(given_mesh, 0.4)
    assert len(got.faces) == len(given_mesh.faces) + 4 and len(got.notes) == 1
    new = got.faces[len(given_mesh.faces) :]
    assert (got.instance[len(given_mesh.faces) :] == (vertices[new].mean(1)[:, 0] > 0.5)).all()
    assert mesh.closed(given_mesh, 0) is given_mesh
