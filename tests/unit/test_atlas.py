"""Texture atlases: charts that do not overlap, texels on the surface that they show, densities, and simpler meshes."""

import subprocess
import sys

import numpy as np
import pytest

from iif_core.surface import xatlas_process
from iif_core.surface.atlas import (
    SEEN_SHARE,
    STEP,
    UNSEEN,
    nearest_covered,
    texel_density,
    texel_surface,
    texel_values,
    texels_around,
    unwrap,
)
from iif_core.surface.closest import closest_points
from iif_core.surface.simplify import clean, simplify
from iif_core.surface.tangents import in_tangent_frame, vertex_tangents
from iif_core.surface.triangles import face_geometry
from tests.errors import refused


def sphere(rings=24, radius=1.0, centre=(0.0, 0.0, 0.0)):
    """A sphere in triangles."""
    lat, lon = np.meshgrid(np.linspace(0, np.pi, rings + 1), np.linspace(0, 2 * np.pi, 2 * rings, endpoint=False), indexing="ij")
    points = np.stack([np.sin(lat) * np.cos(lon), np.sin(lat) * np.sin(lon), np.cos(lat)], -1).reshape(-1, 3)
    columns = 2 * rings
    i, j = np.indices((rings, columns))
    a, b = i * columns + j, i * columns + (j + 1) % columns
    faces = np.concatenate([np.stack([a, a + columns, b], -1), np.stack([b, a + columns, b + columns], -1)]).reshape(-1, 3)
    vertices = radius * points + centre
    return vertices, faces[clean(faces, vertices)]


@pytest.fixture(scope="module")
def unwrapped():
    meshes = [sphere(), sphere(12, 0.3, (5.0, 0, 0))]
    return meshes, unwrap(meshes, [40.0, 80.0], 2048)


def test_charts_show_every_face_once(unwrapped):
    """The texels of a face cover its area at the density that was asked for, and no texel is claimed by two faces."""
    meshes, made = unwrapped
    assert made.shrunk == 1 and made.size % STEP == 0
    first = np.cumsum([0, *(len(uv) for uv in made.uv)])
    faces = np.concatenate([f + start for f, start in zip(made.faces, first, strict=False)])
    face, barycentric = texel_surface(np.concatenate(made.uv), faces, made.size)
    of = np.repeat([0, 1], [len(f) for f in made.faces])
    for number, ((vertices, old), density) in enumerate(zip(meshes, (40.0, 80.0), strict=True)):
        np.testing.assert_array_equal(made.source[number][made.faces[number]], old)
        area = face_geometry(vertices, old)[1].sum()
        found = (of[face[face >= 0]] == number).sum() / density**2
        assert found == pytest.approx(area, rel=0.15)  # charts of a sphere are stretched
    inside = face >= 0
    np.testing.assert_allclose(barycentric[inside].sum(-1), 1, atol=1e-5)
    # The texel's centre comes back from the texture coordinates of its face.
    row, column = np.nonzero(inside)
    uv = texel_values(np.concatenate(made.uv), faces, face[inside], barycentric[inside])
    np.testing.assert_allclose(uv * made.size, np.stack([column, row], 1) + 0.5, atol=2e-3)


def test_texels_lie_on_the_surface(unwrapped):
    meshes, made = unwrapped
    face, barycentric = texel_surface(made.uv[0], made.faces[0], 512)  # not the size of the atlas
    inside = face >= 0
    points = texel_values(meshes[0][0][made.source[0]], made.faces[0], face[inside], barycentric[inside])
    radius = np.linalg.norm(points, axis=1)
    assert inside.mean() > 0.15 and radius.max() < 1 + 1e-5 and radius.min() > np.cos(np.pi / 24) ** 2


def test_an_atlas_that_is_too_small_lowers_all_densities():
    meshes = [sphere(), sphere(12, 0.3, (5.0, 0, 0))]
    made = unwrap(meshes, [400.0, 800.0], 256)
    assert made.size == 256 and made.shrunk < 0.2
    ratio = [np.ptp(uv, axis=0).max() for uv in made.uv]
    assert max(ratio) <= 1


def test_more_charts_than_texels_make_the_atlas_larger_until_that_is_an_error():
    quad = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]])
    many = [(quad + [2 * i, 0, 0], np.array([[0, 1, 2]])) for i in range(300)]
    made = unwrap(many, np.full(300, 10.0), 64)
    assert 64 < made.size <= 256 and made.charts == 300
    with refused("64 x 64"):
        unwrap(many, np.full(300, 10.0), 16)


@pytest.mark.parametrize("crashes, works", [(1, True), (100, False)])
def test_a_crash_of_xatlas_is_tried_again(monkeypatch, crashes, works):
    """Its threads race, so that a call now and then dies of a signal; one that always does is an error with a name."""
    run, left = subprocess.run, iter(range(crashes))

    def dies(command, **options):
        crash = next(left, None) is not None
        return run([sys.executable, "-c", "import os; os.kill(os.getpid(), 11)"] if crash else command, **options)

    monkeypatch.setattr(xatlas_process.subprocess, "run", dies)
    if works:
        assert unwrap([sphere(12)], [50.0], 1024).charts > 0
    else:
        with pytest.raises(RuntimeError):
            unwrap([sphere(12)], [50.0], 1024)
        assert 1 < crashes - len(list(left)) < 20


def test_an_error_of_the_child_is_not_tried_again_and_is_told(monkeypatch):
    calls = []
    run = subprocess.run
    monkeypatch.setattr(xatlas_process.subprocess, "run", lambda *args, **options: calls.append(1) or run(*args, **options))
    with pytest.raises(RuntimeError, match="TypeError|ValueError"):
        xatlas_process.pack([(np.zeros((3, 2), np.float32), np.zeros((1, 3), np.uint32))], 4, 1.0)
    assert len(calls) == 1


def test_a_face_without_area_is_in_no_chart_and_harms_none():
    vertices, faces = sphere(12)
    needle = np.concatenate([vertices, [[0, 0, 1.0], [0, 0, 1.0 + 1e-9], [1e-9, 0, 1.0]]])
    made = unwrap([(needle, np.concatenate([faces, [[len(vertices) + i for i in range(3)]]]))], [50.0], 1024)
    assert ((made.uv[0] > 0) & (made.uv[0] < 1)).all()


def test_nothing_to_show():
    face, barycentric = texel_surface(np.zeros((0, 2)), np.zeros((0, 3), int), 16)
    assert (face == -1).all() and not barycentric.any()
    np.testing.assert_array_equal(nearest_covered(np.zeros((3, 3), bool)).ravel(), np.arange(9))


def test_no_texel_near_a_face_is_left_out():
    """Against the distance of every texel; and texels far from all faces are left out."""
    rng = np.random.default_rng(5)
    uv = (rng.random((12, 1, 2)) + rng.uniform(-0.04, 0.04, (12, 3, 2))).reshape(-1, 2)  # some reach over the border
    faces = np.arange(36).reshape(-1, 3)
    size, reach = 96, 1.5
    around = texels_around(uv, faces, size, reach)
    row, column = np.divmod(np.arange(size * size), size)
    centre = np.stack([column + 0.5, row + 0.5, np.zeros(size * size)], 1)
    near = closest_points(np.pad(uv * size, ((0, 0), (0, 1))), faces, centre)
    distance = np.linalg.norm(near.points - centre, axis=1).reshape(size, size)
    assert around[distance <= reach].all() and not around[distance > 12].any() and 0.02 < around.mean() < 0.4
    assert not texels_around(uv, faces[:0], size, reach).any()


def test_background_takes_the_nearest_texel():
    covered = np.zeros((5, 7), bool)
    covered[2, 1] = covered[2, 5] = True
    nearest = nearest_covered(covered)
    assert (nearest[:, :3] == 2 * 7 + 1).all() and (nearest[:, 4:] == 2 * 7 + 5).all()


def test_densities():
    """One texel for a pixel or a cell; surface that few photographs show, or none, gets few."""
    edge = 0.01
    area, seen = np.array([1.0, 1.0, 1.0, 100.0, 1e5]), np.array([1.0, 1.0, 0.0, 1.0, 0.0])
    found = texel_density(area, seen, np.array([0.002, 0.05, np.inf, 0.002, np.inf]), edge)
    np.testing.assert_allclose(found[:2], [1 / edge, 1 / 0.05])
    assert found[2] == pytest.approx(1 / (8 * edge))
    assert found[3] ** 2 * 100 == pytest.approx(UNSEEN**2 + SEEN_SHARE / edge**2)
    assert found[4] ** 2 * 1e5 == pytest.approx(UNSEEN**2)
    assert np.isfinite(texel_density([0.0], [0.0], [np.inf], edge)).all()


def test_simpler_meshes_keep_their_parts_and_their_shape():
    a, b = sphere(60), sphere(60, 0.3, (5.0, 0, 0))
    vertices, faces = np.concatenate([a[0], b[0]]), np.concatenate([a[1], b[1] + len(a[0])])
    part = np.repeat([5000, 7], [len(a[1]), len(b[1])])  # numbers of more than one digit
    new, simple, of = simplify(vertices, faces, part, 2000)
    assert len(simple) <= 2000 and set(of) == {7, 5000}
    radius = np.linalg.norm(new[simple[of == 5000]], axis=-1)
    assert radius.min() > 0.97 and radius.max() < 1.03
    np.testing.assert_allclose(np.linalg.norm(new[simple[of == 7]] - [5, 0, 0], axis=-1), 0.3, atol=0.01)
    same = simplify(vertices, faces, part, len(faces))
    np.testing.assert_array_equal(same[1], faces)
    with refused("simplify", "vertex"):
        simplify(a[0], a[1], np.arange(len(a[1])) % 2, 100)
    with refused("simplification", 0, 1):
        simplify(a[0], a[1], np.zeros(len(a[1]), int), 0)


def test_closest_points():
    vertices, faces = np.array([[0, 0, 0], [2, 0, 0], [0, 2, 0.0]]), np.array([[0, 1, 2]])
    found = closest_points(vertices, faces, [[0.5, 0.5, 3.0], [-1, -1, 1], [3, 3, 0]])
    np.testing.assert_allclose(found.points, [[0.5, 0.5, 0], [0, 0, 0], [1, 1, 0]], atol=1e-6)
    np.testing.assert_allclose(texel_values(vertices, faces, found.face, found.barycentric), found.points, atol=1e-6)


def test_tangents_point_to_u_and_components_come_back():
    """A slanted quad with a turned and mirrored texture: t points towards +u and b towards -v, for both handednesses."""
    vertices = np.array([[0, 0, 0], [2, 0, 1], [2, 3, 1], [0, 3, 0.0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    normal = np.cross([2, 0, 1], [0, 3, 0]) / np.linalg.norm(np.cross([2, 0, 1], [0, 3, 0]))
    x, y = np.array([2, 0, 1]) / np.sqrt(5), np.array([0, 1, 0.0])
    plain = np.array([[0, 1], [1, 1], [1, 0], [0, 0.0]])  # +u along x, v falls along y
    for uv, t, b in ((plain, x, y), (plain * [-1, 1], -x, y), (plain[:, ::-1], -y, -x)):
        found = vertex_tangents(vertices, faces, uv, np.tile(normal, (4, 1)))
        np.testing.assert_allclose(found[:, :3], np.tile(t, (4, 1)), atol=1e-12)
        np.testing.assert_allclose(found[:, 3:] * np.cross(normal, found[:, :3]), np.tile(b, (4, 1)), atol=1e-12)
        direction = np.array([[0.3, -0.2, 0.1] @ np.stack([t, b, normal])])
        np.testing.assert_allclose(in_tangent_frame(direction, normal[None], found[:1]), [[0.3, -0.2, 0.1]], atol=1e-12)
    nowhere = vertex_tangents(vertices, faces, np.zeros((4, 2)), np.tile(normal, (4, 1)))
    np.testing.assert_allclose(np.linalg.norm(nowhere[:, :3], axis=1), 1)
    np.testing.assert_allclose(nowhere[:, :3] @ normal, 0, atol=1e-12)
