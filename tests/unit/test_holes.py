"""Small holes of a mesh are closed, and openings that belong to a thing stay open."""

import numpy as np
import pytest

from iif_core.surface.holes import close_holes
from iif_core.surface.triangles import face_geometry


def plate(cells: int = 20, width: float = 2.0):
    """A flat grid of `cells` squares a side, with normal +z; vertices and faces."""
    axis = np.linspace(0, width, cells + 1)
    vertices = np.stack([*np.meshgrid(axis, axis, indexing="ij"), np.zeros((cells + 1, cells + 1))], -1).reshape(-1, 3)
    corner = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    a, b, c, d = corner, corner + cells + 1, corner + cells + 2, corner + 1
    return vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def sphere(rings: int = 24):
    theta, phi = np.linspace(0, np.pi, rings + 1), np.linspace(0, 2 * np.pi, 2 * rings, endpoint=False)
    ring = np.stack(
        [np.outer(np.sin(theta), np.cos(phi)), np.outer(np.sin(theta), np.sin(phi)), np.outer(np.cos(theta), 0 * phi + 1)], -1
    )
    n = 2 * rings

    def at(i, j):
        return i * n + j % n

    faces = [
        f
        for i in range(rings)
        for j in range(n)
        for f in ((at(i, j), at(i + 1, j), at(i + 1, j + 1)), (at(i, j), at(i + 1, j + 1), at(i, j + 1)))
    ]
    return ring.reshape(-1, 3), np.array(faces)


def without(vertices, faces, centre, radius):
    return faces[np.linalg.norm(vertices[faces].mean(1) - centre, axis=1) > radius]


def open_edges(vertices, faces):
    place = np.unique(vertices.astype(np.float32), axis=0, return_inverse=True)[1].ravel()[faces]
    edges = np.sort(np.stack([place, np.roll(place, -1, 1)], -1).reshape(-1, 2), 1)
    edges = edges[edges[:, 0] != edges[:, 1]]
    return int((np.unique(edges, axis=0, return_counts=True)[1] == 1).sum())


def test_a_hole_is_closed_and_the_filling_looks_the_same_way():
    vertices, faces = plate()
    left = without(vertices, faces, (1.0, 1.0, 0.0), 0.2)
    found = close_holes(vertices, left, 0.5)
    assert found.holes == 1
    missing = face_geometry(vertices, faces)[1].sum() - face_geometry(vertices, left)[1].sum()
    np.testing.assert_allclose(found.area, missing, rtol=1e-6)
    np.testing.assert_allclose(face_geometry(vertices, found.faces)[0], [[0.0, 0.0, 1.0]] * len(found.faces), atol=1e-6)
    assert open_edges(vertices, np.concatenate([left, found.faces])) == open_edges(vertices, faces)


@pytest.mark.parametrize("turned", ["all", "some"])
def test_faces_that_are_turned_change_nothing(turned):
    vertices, faces = plate()
    left = without(vertices, faces, (1.0, 1.0, 0.0), 0.2)
    flip = np.ones(len(left), bool) if turned == "all" else np.arange(len(left)) % 5 == 0
    found = close_holes(vertices, np.where(flip[:, None], left[:, ::-1], left), 0.5)
    assert found.holes == 1
    up = face_geometry(vertices, found.faces)[0][:, 2]
    assert np.all(up < 0) if turned == "all" else np.all(up > 0)


def test_vertices_of_faces_need_not_be_shared():
    vertices, faces = plate()
    left = without(vertices, faces, (1.0, 1.0, 0.0), 0.2)
    loose = vertices[left].reshape(-1, 3)
    found = close_holes(loose, np.arange(len(loose)).reshape(-1, 3), 0.5)
    assert found.holes == 1
    assert found.faces.max() < len(loose)


def test_a_closed_and_a_curved_surface():
    vertices, faces = sphere()
    assert close_holes(vertices, faces, 0.5).holes == 0
    left = without(vertices, faces, (1.0, 0.0, 0.0), 0.15)
    found = close_holes(vertices, left, 0.5)
    assert found.holes == 1
    assert open_edges(vertices, np.concatenate([left, found.faces])) == open_edges(vertices, faces)
    outwards = (face_geometry(vertices, left)[0] * vertices[left].mean(1)).sum(1).mean() > 0
    assert ((face_geometry(vertices, found.faces)[0][:, 0] > 0.9) == outwards).all()


@pytest.mark.parametrize("thing", ["leaf", "tube", "box"])
def test_rims_of_things_stay_open(thing):
    if thing == "leaf":  # a sheet by itself: its filling would lie on it
        vertices, faces = plate(4, 0.3)
    else:  # a lamp shade, and a box without a lid
        sides = 24 if thing == "tube" else 4
        angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)
        ring = 0.15 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
        vertices = np.concatenate([ring, ring + (0, 0, 0.3)])
        i, j = np.arange(sides), (np.arange(sides) + 1) % sides
        faces = np.concatenate([np.stack([i, j, j + sides], 1), np.stack([i, j + sides, i + sides], 1)])
        if thing == "box":
            faces = np.concatenate([faces, [[0, 2, 1], [0, 3, 2]]])
    assert close_holes(vertices, faces, 0.5).holes == 0


def test_only_holes_up_to_the_width():
    vertices, faces = plate(40, 4.0)
    left = without(vertices, without(vertices, faces, (1.0, 1.0, 0.0), 0.2), (3.0, 3.0, 0.0), 0.4)
    assert close_holes(vertices, left, 0.3).holes == 0
    assert close_holes(vertices, left, 0.5).holes == 1
    assert close_holes(vertices, left, 1.0).holes == 2
    assert close_holes(vertices, left, 0.0).holes == 0


def test_what_closes_a_hole_belongs_to_the_part_around_it():
    vertices, faces = plate()
    left = without(vertices, faces, (0.9, 1.0, 0.0), 0.25)
    part = (vertices[left].mean(1)[:, 0] > 1.0).astype(int)  # the border between both runs through the hole, right of its middle
    found = close_holes(vertices, left, 0.7, part)
    assert found.holes == 1
    assert (part[found.beside] == 0).all()


def cone(degrees):
    """A ring of 24 faces pairs around a round hole of radius 0.2, which turn down by an angle; vertices and faces."""
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    down = np.radians(degrees)
    vertices = np.concatenate([0.2 * ring, (0.2 + 0.3 * np.cos(down)) * ring - [0, 0, 0.3 * np.sin(down)]])
    i, j = np.arange(24), (np.arange(24) + 1) % 24
    return vertices, np.concatenate([np.stack([i, i + 24, j + 24], 1), np.stack([i, j + 24, j], 1)])


@pytest.mark.parametrize(("degrees", "closed"), [(20, True), (50, True), (70, False), (110, False)])
def test_a_filling_continues_what_turns_by_less_than_sixty_degrees(degrees, closed):
    assert close_holes(*cone(degrees), 0.5).holes == closed


@pytest.mark.parametrize(("steep", "closed"), [(1, True), (3, True), (8, False)])
def test_most_of_the_rim_has_to_be_continued(steep, closed):
    """Of the 24 faces around a hole some are square to it."""
    (flat, faces), square = cone(10), cone(90)[0]
    outer = np.where((np.arange(24) < steep)[:, None], square[24:], flat[24:])
    assert close_holes(np.concatenate([flat[:24], outer]), faces, 0.5).holes == closed


@pytest.mark.parametrize("behind", [0.0, 0.01, 0.3])
def test_an_insert_is_not_covered(behind):
    vertices, faces = plate()
    left = without(vertices, faces, (1.0, 1.0, 0.0), 0.2)
    lid, more = plate(4, 0.3)
    both = np.concatenate([vertices, lid + (0.85, 0.85, -behind)])
    assert close_holes(both, np.concatenate([left, more + len(vertices)]), 0.5).holes == (behind > 0.1)


def test_holes_that_touch_at_a_corner_are_all_closed():
    vertices, faces = plate(20, 4.0)
    middle = np.array([[1.0, 1.0], [1.4, 1.4], [1.8, 1.8]])
    centre = vertices[faces].mean(1)[:, :2]
    left = faces[~(np.abs(centre[:, None] - middle) < 0.2).all(2).any(1)]
    found = close_holes(vertices, left, 0.7)
    assert found.holes == 3
    assert open_edges(vertices, np.concatenate([left, found.faces])) == open_edges(vertices, faces)


@pytest.mark.parametrize("mesh", ["empty", "one face", "all alike"])
def test_degenerate_meshes_have_no_holes(mesh):
    vertices = np.eye(3) if mesh != "all alike" else np.zeros((3, 3))
    faces = np.zeros((0, 3), int) if mesh == "empty" else np.array([[0, 1, 2]])
    found = close_holes(vertices, faces, 5.0)
    assert found.holes == 0
    assert found.faces.shape == (0, 3)


@pytest.mark.parametrize("widest", [0.5, 0.0])
def test_a_mesh_that_is_read_is_closed_and_says_so(widest):
    from workflow.sources.folder_scene.mesh import Mesh

    vertices, faces = plate()
    left = without(vertices, faces, (0.5, 0.5, 0.0), 0.2)
    instance = (vertices[left].mean(1)[:, 1] > 1.0).astype(np.int32)
    closed = Mesh(vertices, left.astype(np.int32), instance, ["floor", "mat"]).closed(widest)
    added = len(closed.faces) - len(left)
    assert (added > 0) == (widest > 0)
    assert len(closed.instance) == len(closed.faces) and closed.faces.dtype == np.int32
    assert not closed.instance[len(left) :].any()
    assert len(closed.notes) == (widest > 0)
