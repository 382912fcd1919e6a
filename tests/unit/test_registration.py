"""Registration on the painted room."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.ndimage import uniform_filter1d

from iif_core.camera import registration
from iif_core.camera.alignment import (
    SIGMA_ROTATION,
    SIGMA_TRANSLATION,
    Cameras,
    Maps,
    Photo,
    Unknowns,
    apart,
    camera_points,
    edge_points,
    feature_image,
    free,
    mesh_edges,
    normal_equations,
    overlap,
    project,
    together,
)
from iif_core.camera.registration import MIN_VIEWS, SURE, Gain, _Comparison, combined, register
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
    assert abs(found.focal - 1) < 0.01 and not found.each
    np.testing.assert_allclose(found.moved, 2.5, atol=0.3)  # every pixel moves by the hypotenuse


@pytest.fixture(scope="module")
def turned(photos: list[Photo]) -> list[Photo]:
    """All cameras turned by two pixels against their poses, as a colour camera beside the depth camera that made the mesh."""
    return posed(photos, [twisted(p.pose, np.array([0.0, 0.02, 0.004]), np.array([0.01, 0.0, 0.0])) for p in photos])


def motions(photos: list[Photo], poses: np.ndarray) -> np.ndarray:
    """How each pose moved in the frame of its own camera."""
    return np.array([np.linalg.inv(p.pose) @ pose for p, pose in zip(photos, poses, strict=True)])


def test_an_error_that_all_cameras_share_is_corrected_alike(photos: list[Photo], turned: list[Photo]) -> None:
    """A held-out photograph moves with the others, whatever it shows, and moves none of them."""
    noise = np.random.default_rng(0).random(turned[3].image.shape)
    found, other = (
        register(
            [replace(p, held=True, image=image) if k == 3 else p for k, p in enumerate(turned)], points=4000, intrinsics=False
        )
        for image in (noise, turned[3].image)
    )
    assert found.accepted and not found.each and found.evidence > SURE
    assert off(np.array([p.pose for p in turned]), photos).min() > 1.5 and off(found.pose, photos).max() < 0.5
    moved = motions(turned, found.pose)
    np.testing.assert_allclose(moved, np.broadcast_to(moved[0], moved.shape), atol=1e-12)
    np.testing.assert_array_equal(found.pose, other.pose)


def test_five_photographs_are_too_few_to_judge(turned: list[Photo]) -> None:
    found = register(turned[::2], points=4000)
    assert len(turned[::2]) == MIN_VIEWS - 1
    assert not found.accepted and not found.each and found.evidence == 0.0 and found.moved.max() > 0.5


@pytest.mark.parametrize("unknowns", [together(10, True, True), apart(np.ones(10, bool), 0.1), apart(np.arange(10) != 4, 1.0)])
def test_equations_along_directions_are_those_of_the_views(turned: list[Photo], unknowns: Unknowns) -> None:
    """Along directions D of no held-out view, the equations are D^T N D and D^T r with the prior of the directions."""
    views, features = len(turned), [feature_image(p.image, p.usable) for p in turned]
    state = Cameras.of(turned).moved(np.r_[np.tile([0.004, -0.002, 0.001, 0.003, 0.001, -0.002], views), 0.001, 0.002, 0.003])
    maps, rows = [Maps.of(f, 1.2) for f in features], overlap(turned, features, 2000)
    edges, each = [edge_points(p) for p in turned], free(views, True)
    own, right = normal_equations(turned, maps, state, rows, edges, each)
    found, sums = normal_equations(turned, maps, state, rows, edges, unknowns)
    weight = max(len(rows.view) / views / 200.0, 1.0)
    of_views, prior = weight / each.sigma**2, weight / unknowns.sigma**2
    steps, directions = np.r_[state.twist.ravel(), state.principal, np.log(state.focal)], unknowns.directions
    along = np.linalg.lstsq(directions, steps, rcond=None)[0]  # the coordinates of all steps so far
    np.testing.assert_allclose(
        found, directions.T @ (own - np.diag(of_views)) @ directions + np.diag(prior), rtol=1e-9, atol=1e-6
    )
    np.testing.assert_allclose(sums, directions.T @ (right + of_views * steps) - prior * along, rtol=1e-9, atol=1e-6)


def test_a_step_is_that_of_least_squares_over_cameras_and_levels(turned: list[Photo]) -> None:
    """With the level of every point as an unknown beside the cameras, a dense solver finds the same equations."""
    views, features = len(turned), [feature_image(p.image, p.usable) for p in turned]
    kept = [replace(p, held=k == 3) for k, p in enumerate(turned)]
    maps, rows = [Maps.of(f, 1.2) for f in features], overlap(kept, features, 300)
    state, unknowns, none = Cameras.of(kept), free(views, True), [np.zeros((0, 3))] * views
    found, right = normal_equations(kept, maps, state, rows, none, unknowns)

    def at(name: str, step: np.ndarray) -> np.ndarray:
        """Image coordinates, or a map there, of each (point, view)."""
        moved = state.moved(step)
        places = [
            project(kept[v], moved, camera_points(moved, v, world[None])) for v, world in zip(rows.view, rows.world, strict=True)
        ]
        if name == "uv":
            return np.concatenate(places)
        return np.array([maps[v].at((name,), place)[0][0] for v, place in zip(rows.view, places, strict=True)])

    size = 6 * views + 3
    still = np.zeros(size)
    value, slope = at("value", still), np.stack([at("du", still), at("dv", still)], -1)
    moving = rows.view != 3
    total = np.bincount(rows.point, moving)
    residual = value - (np.bincount(rows.point, value * moving) / total)[rows.point]
    scale = 1.4826 * np.median(np.abs(residual[moving]))
    weight = 1 / (1 + (residual / (2.385 * scale)) ** 2) / scale**2
    # Finite differences of the image coordinates; a held-out photograph leaves the intrinsics as they are.
    slopes = np.stack([((at("uv", 1e-6 * one) - at("uv", still)) * slope).sum(1) / 1e-6 for one in np.eye(size)], -1)
    slopes[:, 6 * views :] *= moving[:, None]
    # A held-out photograph sees the levels as they are: its rows have no derivative by them.
    levels = np.zeros((len(value), len(total)))
    levels[np.arange(len(value)), rows.point] = -1.0 * moving
    whole = np.concatenate([slopes, levels], 1)
    big = whole.T @ (weight[:, None] * whole)
    eliminated = big[:size, :size] - big[:size, size:] @ np.linalg.solve(big[size:, size:], big[size:, :size])
    prior = max(moving.sum() / (views - 1) / 200.0, 1.0) / unknowns.sigma**2
    np.testing.assert_allclose(found - np.diag(prior), eliminated, rtol=1e-3, atol=1e-4 * np.abs(eliminated).max())
    level = (np.bincount(rows.point, weight * moving * value) / np.bincount(rows.point, weight * moving))[rows.point]
    np.testing.assert_allclose(right, -slopes.T @ (weight * (value - level)), atol=1e-4 * np.abs(right).max())


def test_cameras_that_move_beside_each_other_have_no_mean_motion() -> None:
    moving = np.arange(7) != 2
    unknowns = apart(moving, 0.1)
    directions = unknowns.directions
    assert directions.shape == (45, 36)
    np.testing.assert_allclose(directions.T @ directions, np.eye(36), atol=1e-12)
    of_views = directions[:42].reshape(7, 6, 36)
    np.testing.assert_allclose(of_views[moving].sum(0), 0, atol=1e-12)
    assert np.linalg.matrix_rank(of_views[2]) == 6 and not directions[42:].any()  # the held-out one moves for itself
    assert not of_views[moving][:, :, of_views[2].any(0)].any()
    assert (
        unknowns.sigma.reshape(-1, 6).tolist() == [pytest.approx([0.1 * SIGMA_ROTATION] * 3 + [0.1 * SIGMA_TRANSLATION] * 3)] * 6
    )
    assert apart(np.array([True]), 1.0).directions.shape == (9, 0)
    assert apart(np.array([False, False]), 1.0).directions.shape == (15, 12)


def test_small_errors_of_single_views_are_corrected_beside_each_other(photos: list[Photo]) -> None:
    """Less than a pixel each, which is what free views are known to: the narrow priors are needed."""
    rng = np.random.default_rng(4)
    wrong = posed(photos, [twisted(p.pose, rng.normal(0, 0.005, 3), rng.normal(0, 0.003, 3)) for p in photos])
    found = register(wrong, points=4000)
    assert found.accepted and found.each
    before, after = off(np.array([p.pose for p in wrong]), photos), off(found.pose, photos)
    assert np.median(before) > 0.7 and np.median(after) < 0.3 and after.max() < 0.6
    # The first correction that pays leaves the mean of the twists, which the errors of the mesh hide, where it was.
    np.testing.assert_allclose(np.mean([motion[:3, 3] for motion in motions(wrong, found.pose)], 0), 0, atol=1e-4)


def test_poses_that_are_far_off_need_the_large_blur(photos: list[Photo]) -> None:
    """From 3.5 pixels away the small blur alone finds nothing that pays."""
    rng = np.random.default_rng(3)
    wrong = posed(photos, [twisted(p.pose, rng.normal(0, 0.025, 3), rng.normal(0, 0.0175, 3)) for p in photos])
    found = register(wrong, points=4000, intrinsics=False)
    assert found.accepted and found.each
    before, after = off(np.array([p.pose for p in wrong]), photos), off(found.pose, photos)
    assert np.median(before) > 3.0 and np.median(after) < 0.7 * np.median(before)


def test_the_gain_of_views_has_the_error_of_its_clusters() -> None:
    rng = np.random.default_rng(0)
    view, deviations = np.repeat(np.arange(40), 25), []
    for _ in range(2000):
        of_view = rng.normal(0.3, 1.0, 40)
        found = Gain.of(np.repeat(of_view, 25), view, 40)
        deviations.append((found.mean - 0.3) / found.error)
    assert np.std(deviations) == pytest.approx(np.sqrt(39 / 37), abs=0.06)  # Student's t of 39 degrees of freedom
    assert found.views == 40 and found.error == pytest.approx(np.std(of_view, ddof=1) / np.sqrt(40))
    few = Gain.of(np.ones(125), view[:125], 40)
    assert few.views == MIN_VIEWS - 1 and few.error == np.inf and few.mean == 1.0


def test_gains_are_combined_with_what_they_share() -> None:
    rng = np.random.default_rng(0)
    texture, edge = rng.normal(size=(2, 4000, 60))
    alone, both, twice = [], [], []
    for t, e in zip(texture, edge, strict=True):
        of = [Gain.of(values, np.arange(60), 60) for values in (t, 2.0 * e, 3.0 * t)]
        alone.append(combined(of[:1])), both.append(combined(of[:2])), twice.append(combined(of[::2]))
    assert twice == pytest.approx(alone)  # the same again is no more evidence
    assert np.std(both) == pytest.approx(1.0, abs=0.04) == np.std(alone)
    known, six = Gain.of(0.5 + texture[0], np.arange(60), 60), Gain.of(1.0 + texture[0][:6], np.arange(6), 6)
    assert combined([six]) == pytest.approx(six.mean / six.error * SURE / stats.t.ppf(stats.norm.cdf(3.0), 5))
    assert combined([known, Gain.of(np.zeros(0), np.zeros(0, int), 60)]) == combined([known]) and combined([]) == 0.0


@pytest.mark.parametrize(
    "texture, edges, pays",
    [(8.0, 0.0, True), (6.0, 0.0, False), (-2.0, 14.0, True), (-4.0, 14.0, False), (14.0, -4.0, False), (3.0, 3.0, False)],
)
def test_a_correction_pays_that_is_surely_better_and_much_worse_in_nothing(texture: float, edges: float, pays: bool) -> None:
    rng = np.random.default_rng(0)
    away = np.linalg.qr(rng.normal(size=(1000, 2)))[0].T  # what views add to one does not go with what they add to the other
    first, second = (Gain(0.1 * z, 0.1, 0.1 * one, 1000) for z, one in zip((texture, edges), away, strict=True))
    assert _Comparison((1.0, 1.0), first, (0.5, 0.5), second).pays(5.0) == pays


@pytest.mark.parametrize(
    "evidence, accepted, each, shown",
    [
        ({}, 0, False, 1),
        ({(0, 1): 4.5}, 0, False, 1),  # what all cameras share needs 5
        ({(0, 1): 5.5}, 1, False, 1),
        ({(0, 1): 5.5, (1, 2): 3.5, (0, 2): 9.0}, 1, False, 1),  # single views must surely be better than what all share
        ({(0, 1): 4.5, (0, 2): 4.2}, 2, True, 2),
        ({(0, 1): 4.5, (0, 4): 3.9}, 0, False, 4),  # the numbers are of the one that comes closest to its limit
        ({(0, 2): 4.5, (2, 3): 2.5, (0, 3): 4.5}, 3, True, 3),  # between widths less decides
        ({(0, 2): 4.5, (2, 3): 1.5, (0, 3): 4.5}, 2, True, 2),
        ({(0, 2): 4.5, (2, 3): 2.5, (0, 3): 3.5}, 2, True, 2),
        ({(0, 1): 9.0, (1, 2): 4.5, (0, 2): 9.0, (2, 3): 2.5, (0, 3): 9.0, (1, 3): 3.5}, 2, True, 2),
        ({(0, 2): 4.5, (2, 5): 3.5, (0, 5): 9.0}, 2, True, 2),  # free views are no mere width
        ({(0, 2): 4.5, (2, 5): 4.5, (0, 5): 4.5}, 5, True, 5),
        ({(0, 5): 4.5}, 5, True, 5),
    ],
)
def test_which_correction_is_accepted(
    photos: list[Photo],
    monkeypatch: pytest.MonkeyPatch,
    evidence: dict[tuple[int, int], float],
    accepted: int,
    each: bool,
    shown: int,
) -> None:
    """Corrections are numbered in the order in which they are tried; `evidence` is of the second of a pair against the first."""
    tried: list[tuple[float, float]] = []

    def descend(
        photos: list[Photo],
        features: object,
        blurs: tuple[float, ...],
        start: Cameras,
        rows: object,
        edges: object,
        way: Unknowns,
    ) -> Cameras:
        tried.append((blurs[0], way.sigma[0] / SIGMA_ROTATION))
        return replace(start, focal=1.0 + 1e-6 * len(tried))

    def compare(photos: list[Photo], maps: object, states: tuple[Cameras, Cameras], *rest: object) -> _Comparison:
        z = evidence.get(tuple(round((state.focal - 1.0) * 1e6) for state in states), 0.0)
        return _Comparison(
            (1.0, 1.0), Gain(0.1 * z, 0.1, np.full(100, 0.01), 1000), (0.0, 0.0), Gain(0.0, np.inf, np.zeros(100), 0)
        )

    monkeypatch.setattr(registration, "descend", descend)
    monkeypatch.setattr(registration, "_compare", compare)
    found = register(photos, points=400)
    assert found.accepted == (accepted > 0) and found.each == each
    assert round((found.focal - 1.0) * 1e6) == shown
    assert found.needed == (4.0 if shown > 1 else 5.0)
    of = max((first for first, second in evidence if second == shown and first < 2), default=0) if accepted else 0
    assert found.evidence == pytest.approx(evidence.get((of, shown), 0.0))
    assert tried == [(2.5, 1.0), *((1.2, pytest.approx(width)) for width in (0.03, 0.1, 0.3)), (2.5, 1.0)]


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
