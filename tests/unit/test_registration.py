"""Registration on the painted room."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import uniform_filter1d

from iif_core.camera.registration import SURE, Photo, _Comparison, combined, feature_image, mesh_edges, register
from tests.errors import refused
from tests.unit.painted_room import FOCAL, look, off, posed, room, twisted


@pytest.fixture(scope="module")
def photos() -> list[Photo]:
    return room()


def test_poses_are_found_again(photos: list[Photo]) -> None:
    rng = np.random.default_rng(0)
    wrong = [twisted(p.pose, rng.normal(0, 0.012, 3), rng.normal(0, 0.01, 3)) for p in photos]
    found = register(posed(photos, wrong), points=4000, intrinsics=False)
    assert found.accepted
    before, after = off(np.array(wrong), photos), off(found.pose, photos)
    assert np.median(before) > 1.0
    # A common drift of half a pixel remains, because texture slides along the surface and only edges prevent it.
    assert np.median(after) < 0.6
    assert found.held_out[1] < 0.5 * found.held_out[0]


def test_features_do_not_depend_on_the_unit_of_radiance(photos: list[Photo]) -> None:
    image, usable = photos[0].image, photos[0].usable
    usual = feature_image(image, usable)
    assert usual.std() > 0.1
    for factor in (1e-30, 1e-6, 1e6, 1e30):
        np.testing.assert_allclose(feature_image(factor * image, usable), usual, atol=1e-9)
    dark = np.where(np.arange(image.shape[1])[None, :, None] < 0.3 * image.shape[1], image, 0)
    assert feature_image(dark, usable)[:, 5:30].std() > 0.1  # most of the picture is black, the rest is seen
    assert not feature_image(0 * image, usable).any() and not feature_image(image, usable & False).any()


def test_edges_of_the_mesh_are_silhouettes_on_the_nearer_side_and_creases() -> None:
    """Columns 0 to 3 are a near wall, 4 to 7 a far one, from 8 on it turns by 90 degrees at one depth."""
    depth = np.where(np.arange(12) < 4, 1.0, 2.0) * np.ones((6, 1))
    normal = np.where(np.arange(12)[:, None] < 8, [0.0, 0, -1], [1.0, 0, 0]) * np.ones((6, 1, 1))
    at, near = mesh_edges(depth, normal, np.ones((6, 12), bool))
    # Half way between two pixels; the crease is found from both sides, and rows at the border are left out.
    expected = [(u, row + 0.5, z) for row in range(1, 5) for u, z in ((4.0, 1.0), (8.0, 2.0), (8.0, 2.0))]
    assert sorted(map(tuple, np.c_[at, near])) == sorted(expected)


def test_a_common_shift_of_the_principal_point_is_found(photos: list[Photo]) -> None:
    """The true principal point is (2, -1.5) pixels from the given one."""
    taken = [replace(p, image=np.repeat(look(p.pose, (66.0, 46.5))[0][..., None], 3, -1)) for p in photos]
    found = register(taken, points=4000, poses=False)
    assert found.accepted
    np.testing.assert_allclose(found.principal * FOCAL, [2.0, -1.5], atol=0.3)
    assert abs(found.focal - 1) < 0.01
    np.testing.assert_allclose(found.moved, 2.5, atol=0.3)  # every pixel moves by the hypotenuse


def test_an_error_that_all_cameras_share_is_corrected_alike(photos: list[Photo]) -> None:
    """A turn of two pixels between camera and pose, as of a colour camera beside the depth camera that made the mesh."""
    wrong = posed(photos, [twisted(p.pose, np.array([0.0, 0.02, 0.004]), np.array([0.01, 0.0, 0.0])) for p in photos])
    wrong[3] = replace(wrong[3], held=True, image=np.zeros_like(wrong[3].image))
    found = register(wrong, points=4000, intrinsics=False)
    assert found.accepted and not found.each and found.evidence > SURE
    before, after = off(np.array([p.pose for p in wrong]), photos), off(found.pose, photos)
    assert before.min() > 1.5
    # A held-out photograph of nothing moves with the others.
    assert after.max() < 0.5
    motion = np.array([np.linalg.inv(p.pose) @ pose for p, pose in zip(wrong, found.pose, strict=True)])
    np.testing.assert_allclose(motion, np.broadcast_to(motion[0], motion.shape), atol=1e-12)


def test_evidence_is_that_of_both_measures_together() -> None:
    assert combined([(0.3, 0.1), (0.4, 0.1)]) == pytest.approx(7 / np.sqrt(2))
    assert combined([(0.3, 0.1), (9.0, np.inf)]) == pytest.approx(3.0) and combined([(1.0, np.inf)]) == 0.0
    rng = np.random.default_rng(0)
    draws = [combined([(z, 1.0), (2.0 * w, 2.0)]) for z, w in rng.normal(size=(4000, 2))]
    assert np.std(draws) == pytest.approx(1.0, abs=0.05)  # of nothing, it is a standard normal variable


@pytest.mark.parametrize(
    "texture, edges, pays",
    [(5.0, 0.0, True), (4.0, 0.0, False), (-2.0, 14.0, True), (-4.0, 14.0, False), (14.0, -4.0, False), (2.0, 2.0, False)],
)
def test_a_correction_pays_that_is_surely_better_and_much_worse_in_nothing(texture: float, edges: float, pays: bool) -> None:
    assert _Comparison((1.0, 1.0), 0.1 * texture, 0.1, (0.5, 0.5), 0.01 * edges, 0.01).pays == pays


def test_what_is_right_is_left_alone(photos: list[Photo]) -> None:
    found = register(photos, points=4000)
    assert not found.accepted
    assert found.shift.max() < 0.3
    assert found.agreement.min() > 0.9


def test_a_view_that_is_kept_for_testing_changes_nothing_but_its_own_pose(photos: list[Photo]) -> None:
    """A held-out photograph is aligned with the texture of the others; noise in its place leaves every other number as it was."""
    rng = np.random.default_rng(0)
    wrong = posed(photos, [twisted(p.pose, rng.normal(0, 0.012, 3), rng.normal(0, 0.01, 3)) for p in photos])
    kept = [replace(p, held=k == 3) for k, p in enumerate(wrong)]
    noise = [replace(p, image=rng.random(p.image.shape)) if k == 3 else p for k, p in enumerate(kept)]
    a, b = (register(x, points=4000) for x in (kept, noise))
    assert a.accepted
    rest = [k for k in range(len(photos)) if k != 3]
    for name in vars(a):
        of_views = name in ("pose", "moved")
        np.testing.assert_array_equal(*(np.asarray(getattr(x, name))[rest] if of_views else getattr(x, name) for x in (a, b)))
    assert a.agreement[3] == a.sharpness[3] == a.shift[3] == 0
    assert off(a.pose, photos)[3] < 0.6 * off(np.array([p.pose for p in wrong]), photos)[3]
    assert not np.array_equal(a.pose[3], b.pose[3])


def test_a_blurred_view_and_a_badly_posed_one_stand_out(photos: list[Photo]) -> None:
    blurred = uniform_filter1d(uniform_filter1d(photos[2].image, 11, axis=1), 9, axis=0)
    bad = twisted(photos[6].pose, np.array([0.25, 0.3, 0.1]), np.array([0.3, 0.2, 0.1]))
    views = [replace(p, image=blurred) if k == 2 else p for k, p in enumerate(photos)]
    views = posed(views, [bad if k == 6 else p.pose for k, p in enumerate(photos)])
    found = register(views, points=4000)
    others = [k for k in range(len(photos)) if k not in (2, 6)]
    assert found.sharpness[2] < 0.5 < 0.7 < found.sharpness[others].min()
    assert found.agreement[6] < 0.4 < 0.6 < found.agreement[others].min()


def test_no_photograph_is_refused() -> None:
    with refused("registration", "photograph"):
        register([])
