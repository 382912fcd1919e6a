"""Rivals without a model of light: what the other photographs show of the surface of a held-out one."""

from types import SimpleNamespace

import numpy as np
import pytest

from iif_core.camera.interpolation import Shown, by_others
from iif_core.camera.view import View
from iif_core.surface.triangles import face_geometry, towards_viewer
from tests.unit import own_scene as own
from workflow.artifacts.store import ids_to_disk
from workflow.scoring import rivals

COLOUR = np.array([[0.3, 0.5, 0.2], [0.7, 0.4, 0.6]])  # of the room and of the block in it
COUNT = 9


@pytest.fixture(scope="module")
def seen(llvm):
    """Views of the room: camera, z-depth and faces of each."""
    shape = own.geometry()
    camera = own.CAMERA
    intrinsics = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    return [(View(i, str(i), *intrinsics, pose), *own.shoot(shape, pose)[1:]) for i, pose in enumerate(own.poses(COUNT))]


def shown(seen, radiance, number):
    """What a view shows; `radiance`: (H, W, 3)."""
    view, depth, face = seen[number]
    return Shown(view, radiance, face >= 0, np.zeros(face.shape, bool), depth)


def matte(seen, number):
    """The room under constant light: every point has the colour of its thing, from everywhere."""
    face = seen[number][2]
    return np.where(face[..., None] >= 0, COLOUR[own.room_mesh()[2][face]], 0)


def targets(seen, number):
    """Pixels that hit surface, their points and normals, and the eye."""
    view, depth, face = seen[number]
    at, eye = np.flatnonzero(face >= 0), view.world_from_camera[:3, 3]
    points = view.points(depth, np.float64).reshape(-1, 3)[at]
    normals = face_geometry(*own.room_mesh()[:2])[0][face.ravel()[at]]
    return at, points, towards_viewer(normals, eye - points)[0], eye


def test_the_mean_is_exact_in_a_matte_room_of_constant_light(seen):
    others = [shown(seen, matte(seen, i), i) for i in range(1, COUNT)]
    at, *surface = targets(seen, 0)
    true = matte(seen, 0).reshape(-1, 3)[at]
    mean, blend, found = by_others(*surface, others)
    assert found.mean() > 0.9 and not mean[~found].any()
    for predicted in (mean, blend):
        wrong = np.abs(predicted - true)[found].max(1) > 1e-5
        # Where the block stands on the floor both have one depth, so pixels across that edge are mixed.
        assert wrong.mean() < 0.03


def test_texture_is_as_sharp_as_bilinear_pixels_are(seen):
    """The colour changes with the place alone: both rivals follow it to the error of the interpolation."""
    pictures = [own.pattern(view.points(depth, np.float64)) for view, depth, _ in seen]
    others = [shown(seen, pictures[i], i) for i in range(1, COUNT)]
    at, *surface = targets(seen, 0)
    mean, blend, found = by_others(*surface, others)
    for predicted in (mean, blend):
        assert np.sqrt(np.mean((predicted - pictures[0].reshape(-1, 3)[at])[found] ** 2)) < 0.01


def test_the_photograph_from_the_same_place_has_all_of_the_weight(seen):
    """Every photograph shows another brightness; the mean is the mean of those that show the point."""
    others = [shown(seen, np.full((*seen[i][1].shape, 3), float(i + 1)), i) for i in range(COUNT)]
    _, *surface = targets(seen, 0)
    mean, blend, found = by_others(*surface, others)
    assert found.all()
    np.testing.assert_allclose(blend, 1.0, atol=1e-4)
    assert mean.mean() > 2


def test_weights_fall_with_the_angle_to_zero_at_the_first_that_is_left_out():
    """A point seen by cameras at 10, 20, 30 and 40 degrees; the two nearest are blended: (1 - a / 30) / a."""
    pose = np.diag([1.0, 1.0, 1.0, 1.0])
    others, depth = [], np.full((3, 3), 2.0)
    for i, degrees in enumerate((10, 20, 30, 40)):
        a = np.radians(degrees)
        pose = np.eye(4)
        pose[:3, 2] = [-np.sin(a), 0, np.cos(a)]
        pose[:3, 0] = [np.cos(a), 0, np.sin(a)]
        pose[:3, 3] = [2 * np.sin(a), 0, 2 - 2 * np.cos(a)]
        view = View(i, str(i), 3, 3, 30.0, 30.0, 1.5, 1.5, pose)
        others.append(Shown(view, np.full((3, 3, 3), 10.0**i), np.ones((3, 3), bool), np.zeros((3, 3), bool), depth))
    surface = np.array([[0.0, 0.0, 2.0]]), np.array([[0.0, 0.0, -1.0]]), np.zeros(3)
    mean, blend, _ = by_others(*surface, others, nearest=2)
    np.testing.assert_allclose(mean[0], 1111 / 4)
    weight = (1 - np.array([10, 20]) / 30) / np.array([10, 20])
    np.testing.assert_allclose(blend[0], (weight * [1, 10]).sum() / weight.sum(), rtol=1e-4)
    # A saturated photograph is only a bound, and counts where there is no other.
    bound = [Shown(o.camera, o.radiance, o.usable, o.bound | (i < 3), o.depth) for i, o in enumerate(others)]
    np.testing.assert_allclose(by_others(*surface, bound)[0], 1000)
    every = [Shown(o.camera, o.radiance, o.usable, ~o.bound, o.depth) for o in others]
    np.testing.assert_allclose(by_others(*surface, every)[0], 1111 / 4)


def test_what_stands_behind_or_faces_away_is_not_seen():
    view, depth = View(0, "a", 3, 3, 30.0, 30.0, 1.5, 1.5, np.eye(4)), np.full((3, 3), 2.0)
    one = Shown(view, np.ones((3, 3, 3)), np.ones((3, 3), bool), np.zeros((3, 3), bool), depth)
    points = np.array([[0, 0, 2.0], [0, 0, 2.2], [0, 0, -2.0], [0, 0, 2.0], [9, 0, 2.0]])
    normals = np.array([[0, 0, -1.0], [0, 0, -1.0], [0, 0, 1.0], [0, 0, 1.0], [0, 0, -1.0]])
    assert by_others(points, normals, np.zeros(3), [one])[2].tolist() == [True, False, False, False, False]


def test_the_rivals_are_seen_from_the_eye_of_the_held_out_view(seen, monkeypatch):
    """As `by_others` from there, whatever number of pixels is predicted at once; its own photograph is left out."""
    others = [shown(seen, np.full((*seen[i][1].shape, 3), float(i + 1)), i) for i in range(1, COUNT)]
    at, *surface = targets(seen, 0)
    monkeypatch.setattr(rivals, "BLOCK", 700)
    rival = object.__new__(rivals.OtherPhotographs)
    rival._normals = face_geometry(*own.room_mesh()[:2])[0]
    rival._capture = SimpleNamespace(gbuffer=lambda view: seen[view.view_id][1:], used=[view for view, *_ in seen])
    rival.shown, rival._developed = (
        lambda view: [None, *others][view.view_id],
        lambda view, radiance, photo, counted, fitted: radiance,
    )
    photo = np.zeros((*seen[0][1].shape, 3))
    found = dict(rival.predictions(seen[0][0], photo, photo[..., 0] == 0))
    mean, blend, known = by_others(*surface, others)
    assert known.sum() > 1400
    for name, expected in (("photo_mean", mean), ("photo_nearest", blend)):
        np.testing.assert_allclose(found[name].reshape(-1, 3)[at[known]], expected[known], rtol=1e-5)


def test_mean_photographs_as_albedo_have_the_level_of_the_base(monkeypatch):
    """Cells of radiance 1, 2 and 40 in their views; the base has their geometric mean level, and no albedo is above 1."""
    cell, shown = np.array([[0, 0, 1], [1, 2, -1]]), np.array([[0.5, 1.5, 2.0], [2.0, 40.0, 9.0]])
    level = np.array([0.4, 0.2, 0.1])
    table = {**{f"albedo_{c}": 0.1 * level[i] * np.array([1, 2, 40.0, 7.0]) for i, c in enumerate("rgb")}}
    base = SimpleNamespace(
        table=lambda name: table, has=lambda name: "b" not in name, exr=lambda name: {"cell.id": ids_to_disk(cell)}
    )
    monkeypatch.setattr(rivals, "read_base", lambda job: base)
    rival, view = object.__new__(rivals.OtherPhotographs), SimpleNamespace(name="a")
    rival._job, rival._capture = None, SimpleNamespace(used=[view, SimpleNamespace(name="b")])
    rival.shown = lambda view: SimpleNamespace(usable=np.ones(cell.shape, bool), radiance=shown[..., None] * np.ones(3))
    expected = np.minimum(0.1 * level * np.array([1, 2, 40.0])[:, None], 1.0)
    np.testing.assert_allclose(rival._as_albedo(), [*expected, [0, 0, 0], [0, 0, 0]], rtol=1e-5)
    assert (expected == 1.0).sum() == 1
