from dataclasses import replace

import numpy as np
import pytest

from iif_core.errors import InputError
from iif_core.light.emission.cache import VoxelPixels
from iif_core.light.emission.candidates import (
    FaceStatistics,
    emitter_candidates,
    face_statistics,
    fading_surface,
    glowing_pieces,
    radiance_threshold,
)
from iif_core.light.emission.groups import GroupingOptions, group_emitters
from iif_core.surface.cells import pack_keys
from iif_core.surface.segments import face_adjacency
from iif_core.surface.triangles import face_geometry


def _strip(n, start=(0.0, 0.0, 0.0)):
    """n quads of 1 x 1 m in a row along x, normal +z: vertices, faces (2 n)."""
    x = np.arange(n + 1)
    vertices = np.concatenate([np.stack([x, np.full(n + 1, y), np.zeros(n + 1)], 1) for y in (0, 1)]) + np.array(start)
    quads = [(i, i + 1, i + n + 2, i, i + n + 2, i + n + 1) for i in range(n)]
    return vertices.astype(float), np.array(quads).reshape(-1, 3)


def _sphere(subdivisions=2, radius=0.1):
    trimesh = pytest.importorskip("trimesh")
    ball = trimesh.creation.icosphere(subdivisions, radius)
    return np.asarray(ball.vertices), np.asarray(ball.faces)


def _statistics(count, low, mean=None, front=1.0):
    count = np.asarray(count, np.int32)
    low = np.asarray(low, np.float32)
    mean = np.repeat(low[:, None], 3, 1) if mean is None else np.asarray(mean, np.float32)
    bounded = np.zeros(len(count), bool)
    return FaceStatistics(count, low, bounded, mean, count, np.full(len(count), front, np.float32))


def test_face_statistics_by_hand():
    face = np.array([0] * 40 + [2] * 3 + [-1])
    value = np.zeros((44, 3))
    value[:40, 1] = np.arange(40)[::-1] / 100  # green: 0.39 ... 0
    value[40:43] = [[0.5, 0, 0], [0.2, 0.7, 0], [0, 0, np.nan]]
    out = face_statistics(face, value, np.arange(44) % 2 == 0, 4)
    assert out.count.tolist() == [40, 0, 2, 0]
    np.testing.assert_allclose(out.low, [0.1, 0, 0.5, 0], atol=1e-7)  # rank floor(0.25 * 40) = 10
    np.testing.assert_allclose(out.mean[2], [0.35, 0.35, 0], atol=1e-7)
    np.testing.assert_allclose(out.front, [0.5, 0, 0.5, 0])


def test_quantile_forgives_a_few_dark_pixels_but_not_many():
    for dark, expected in ((9, True), (11, False)):
        value = np.ones((40, 3))
        value[:dark] = 0.3
        stats = face_statistics(np.zeros(40, int), value, np.ones(40, bool), 1)
        got = emitter_candidates(stats, np.zeros((0, 2), int), np.ones(1), 0.99)
        assert got.tolist() == [expected]


def test_saturated_pixels_count_for_what_they_say():
    """Two exposures of a lamp of 5: saturated at 1 in the long one, seen in the short one."""
    value = np.full((40, 3), 5.0)
    value[:20] = 1.0
    bound = np.zeros((40, 3), bool)
    bound[:20] = True
    face = np.zeros(40, int)
    out = face_statistics(face, value, np.ones(40, bool), 1, bound)
    assert out.low[0] == 5 and not out.bounded[0] and out.clear[0] == 20
    np.testing.assert_allclose(out.mean[0], 5)
    plain = face_statistics(face, value, np.ones(40, bool), 1)
    assert plain.low[0] == 1 and plain.clear[0] == 40
    out = face_statistics(face, value, np.ones(40, bool), 1, np.ones((40, 3), bool))
    assert out.bounded[0] and out.low[0] == 5 and out.clear[0] == 0  # never seen: as bright as any bound
    np.testing.assert_allclose(out.mean[0], 3)  # of the bounds


def test_censored_quantile_is_kaplan_and_meier():
    """Against the estimator written out."""
    rng = np.random.default_rng(0)
    face = rng.integers(0, 6, 600)
    truth, limit = rng.lognormal(0, 1, 600), rng.lognormal(0.5, 1, 600)
    bound = truth > limit
    seen = np.minimum(truth, limit).astype(np.float32)
    out = face_statistics(face, seen[:, None] * np.ones(3), np.ones(600, bool), 7, bound[:, None] & np.ones(3, bool), 0.4)
    for f in range(6):
        own = face == f
        survival = 1.0
        order = np.argsort(seen[own], kind="stable")
        for rank, i in enumerate(np.flatnonzero(own)[order]):
            survival *= 1.0 if bound[i] else 1 - 1 / (own.sum() - rank)
            if survival < 0.6 - 1e-9:
                assert out.low[f] == seen[i]
                break
        else:
            assert out.bounded[f]
    assert out.count[6] == 0 and out.low[6] == 0 and not out.bounded[6]


def test_always_saturated_faces_are_candidates():
    _, faces = _strip(2)
    stats = replace(_statistics([9] * 4, [0.3] * 4), bounded=np.array([True, True, False, False]))
    assert emitter_candidates(stats, face_adjacency(faces), np.ones(4), 0.99).tolist() == [True, True, False, False]


def test_selected_groups_are_renumbered():
    vertices, faces = _strip(6)
    normals, areas = face_geometry(vertices, faces)
    stats = _statistics([30] * 12, np.repeat(2.0 ** np.arange(6), 2))
    groups = group_emitters(np.ones(12, bool), stats, face_adjacency(faces), normals, areas)
    some = groups.select(np.array([True, False, True, False, False, False]))
    assert some.size == 2 and set(some.of_face) == {-1, 0, 1} and (some.side[some.of_face < 0] == 0).all()
    np.testing.assert_array_equal(some.observed, groups.observed[[0, 2]])
    assert (groups.of_face[some.of_face == 1] == 2).all()
    assert groups.select(np.zeros(6, bool)).size == 0


def test_sphere_adjacency_and_geometry():
    vertices, faces = _sphere()
    normals, areas = face_geometry(vertices, faces)
    assert len(face_adjacency(faces)) == 1.5 * len(faces)
    np.testing.assert_allclose(areas.sum(), 4 * np.pi * 0.01, rtol=0.05)
    assert (np.sum(normals * vertices[faces].mean(1), -1) > 0).all()
    zero = face_geometry(np.zeros((3, 3)), np.array([[0, 1, 2]]))
    assert np.isfinite(zero[0]).all() and zero[1][0] == 0


def test_finely_tessellated_lamp_is_found_by_pooling():
    vertices, faces = _sphere()
    adjacency, (_, areas) = face_adjacency(faces), face_geometry(vertices, faces)
    count = np.where(vertices[faces].mean(1)[:, 2] > 0, 1, 0)  # the upper half was seen, one pixel a face
    stats = _statistics(count, count * 1.0)
    assert (emitter_candidates(stats, adjacency, areas, 0.99)).all()  # far side included
    sparse = np.where(np.random.default_rng(0).random(len(faces)) < 0.25, 1, 0) * (vertices[faces].mean(1)[:, 2] > -0.05)
    found = emitter_candidates(_statistics(sparse, sparse * 1.0), adjacency, areas, 0.99)
    assert areas[found].sum() > 0.9 * areas.sum()  # gaps between the seen faces are filled
    few = np.zeros(len(faces))
    few[:5] = 1
    assert not emitter_candidates(_statistics(few, few), adjacency, areas, 0.99).any()


def test_unseen_surface_beside_dark_surface_does_not_shine():
    _, faces = _strip(6)
    low = np.array([1, 1, 1, 1, 0, 0, 0, 0, 0.2, 0.2, 0.2, 0.2])
    count = np.where(np.arange(12) // 2 % 4 < 2, 9, 0)
    count[8:] = 9
    got = emitter_candidates(_statistics(count, low), face_adjacency(faces), np.full(12, 0.5), 0.99)
    assert got.tolist() == [True] * 4 + [False] * 8


def test_dark_neighbour_is_not_pooled_and_degenerate_faces_never_shine():
    _, faces = _strip(4)
    adjacency = face_adjacency(faces)
    stats = _statistics([3] * 8, [1, 1, 1, 1, 0.5, 1, 1, 1])
    areas = np.full(8, 0.5)
    got = emitter_candidates(stats, adjacency, areas, 0.99)
    assert got.tolist() == [True] * 4 + [False, True, False, False]  # beyond the dark face only 6 pixels are left
    areas[0] = 0
    assert not emitter_candidates(stats, adjacency, areas, 0.99)[0]


def test_groups_by_plane_colour_and_side():
    flat, faces = _strip(6)
    vertices = flat.copy()
    vertices[vertices[:, 0] > 3, 2] = vertices[vertices[:, 0] > 3, 0] - 3  # bent by 45 degrees at x = 3
    normals, areas = face_geometry(vertices, faces)
    adjacency = face_adjacency(faces)
    everything = np.ones(12, bool)
    stats = _statistics([50] * 12, [1.0] * 12)
    out = group_emitters(everything, stats, adjacency, normals, areas)
    assert out.size == 2 and set(out.of_face[:6]) != set(out.of_face[6:])
    assert group_emitters(everything, stats, adjacency, normals, areas, GroupingOptions(small_area=100)).size == 1

    colour = np.repeat([1.0, 1.0, 2.0], 4)
    stats = _statistics([50] * 12, colour)
    flat_normals, flat_areas = face_geometry(flat, faces)
    assert group_emitters(everything, stats, adjacency, flat_normals, flat_areas).size == 2

    front = np.repeat([1.0, 0.0, 0.5], 4).astype("f4")
    back = replace(stats, mean=np.ones((12, 3), np.float32), front=front)
    out = group_emitters(everything, back, adjacency, flat_normals, flat_areas)
    assert out.size == 3 and out.side[[0, 4, 8]].tolist() == [1, -1, 0]


@pytest.mark.parametrize("subdivisions", [0, 1, 2])
def test_the_rim_of_a_saturated_panel_is_part_of_it(subdivisions):
    """A panel of 2 x 1 x 0.05 m: where it is seen unsaturated its sides are lamps of their own, where nothing but bounds is known
    each joins top or bottom, and where only top and bottom were seen unsaturated they are a ring. Surface that is no smaller than
    a lamp stays apart, however fine the mesh is and however its edges are ordered."""
    trimesh = pytest.importorskip("trimesh")
    for size, lamps, half_seen in (((2.0, 1.0, 0.05), 2, 3), ((1.0, 1.0, 1.0), 6, 6), ((3.0, 3.0, 3.0), 6, 6)):
        box = trimesh.creation.box(size)
        for _ in range(subdivisions):
            box = box.subdivide()
        faces = np.asarray(box.faces)
        everything = np.ones(len(faces), bool)
        normals, areas = face_geometry(np.asarray(box.vertices), faces)
        adjacency = face_adjacency(faces)
        adjacency = adjacency[np.random.default_rng(1).permutation(len(adjacency))]
        clear = _statistics([50] * len(faces), [1.0] * len(faces))
        assert group_emitters(everything, clear, adjacency, normals, areas).size == 6
        bounds = replace(clear, bounded=everything, clear=np.zeros(len(faces), np.int32))
        found = group_emitters(everything, bounds, adjacency, normals, areas)
        assert found.size == lamps and found.area.sum() == pytest.approx(areas.sum())
        half = replace(bounds, clear=np.where(np.abs(normals[:, 2]) > 0.5, 50, 0).astype(np.int32))
        assert group_emitters(everything, half, adjacency, normals, areas).size == half_seen


def test_gradient_is_cut_into_steps():
    vertices, faces = _strip(20)
    normals, areas = face_geometry(vertices, faces)
    brightness = np.repeat(1.15 ** np.arange(20), 2)  # neighbours differ by 15 %, the ends by a factor 14
    out = group_emitters(np.ones(40, bool), _statistics([30] * 40, brightness), face_adjacency(faces), normals, areas)
    assert 4 <= out.size <= 14
    for g in range(out.size):
        inside = brightness[out.of_face == g]
        assert inside.max() / inside.min() < 2.3
    assert out.area.sum() == pytest.approx(20) and (np.diff(out.area * out.observed.sum(1)) <= 1e-9).all()


def test_a_curtain_is_one_lamp_however_its_folds_fall():
    """Folds of alternating brightness and normals: dark folds are not bright by themselves, but the curtain is. The wall next to
    it, with one bright face, is not."""
    vertices, faces = _strip(20)
    vertices[:, 2] = 0.8 * (np.arange(len(vertices)) % 21 % 2)  # folds of nearly 40 degrees
    normals, areas = face_geometry(vertices, faces)
    object_id = np.repeat([0] * 12 + [1] * 8, 2)
    brightness = np.repeat([2.0, 0.5, 4.0] * 4 + [0.2] * 7 + [3.0], 2)
    count = np.repeat([30] * 12 + [100] * 7 + [30], 2)  # the wall fills most of the photographs
    stats, adjacency = _statistics(count, 0.5 * brightness, np.repeat(brightness[:, None], 3, 1)), face_adjacency(faces)
    views = np.tile(np.arange(6), 40)
    face = np.repeat(np.arange(40), 6)
    steady = face, views, np.repeat(brightness, 6)
    glowing = glowing_pieces(stats, adjacency, object_id, steady)
    assert (glowing[object_id == 0] == glowing[0]).all() and glowing[0] >= 0 and (glowing[object_id == 1] == -1).all()
    alone = emitter_candidates(stats, adjacency, areas, 1.0)
    candidate = emitter_candidates(stats, adjacency, areas, 1.0, glowing=glowing)
    assert candidate[object_id == 0].all() and not alone[object_id == 0].all()
    assert (candidate[object_id == 1] == alone[object_id == 1]).all()
    assert group_emitters(alone, stats, adjacency, normals, areas).size > 4
    out = group_emitters(candidate, stats, adjacency, normals, areas, glowing=glowing)
    assert np.ptp(out.of_face[object_id == 0]) == 0 and out.size == 2
    assert (glowing_pieces(_statistics([3] + [0] * 39, 9 * np.ones(40)), adjacency, object_id, steady) == -1).all()
    unseen = _statistics([0] * 40, 9 * np.ones(40))
    assert (glowing_pieces(unseen, adjacency, object_id, steady) == -1).all()
    mirror = face, views, np.repeat(brightness, 6) * np.where(views % 2 == 0, 0.1, 1.9)  # a window in every other view
    assert (glowing_pieces(stats, adjacency, object_id, mirror) == -1).all()


def test_a_piece_glows_if_its_brightest_channel_does():
    """A blue shade, of whose light red and green are below what the wall shows, and a wall that is grey."""
    _, faces = _strip(20)
    object_id = np.repeat([0] * 6 + [1] * 14, 2)
    mean = np.where(object_id[:, None] == 0, [0.1, 0.1, 2.0], 0.3)
    pixels = np.arange(40), np.zeros(40, int), mean.max(1)
    glowing = glowing_pieces(_statistics([30] * 40, mean.min(1), mean), face_adjacency(faces), object_id, pixels)
    np.testing.assert_array_equal(glowing >= 0, object_id == 0)


def test_a_lamp_that_is_cut_into_many_objects_stays_one():
    """Six quads of one lamp, each an object that glows by itself, next to a dark wall."""
    vertices, faces = _strip(20)
    normals, areas = face_geometry(vertices, faces)
    object_id = np.repeat([*range(1, 7), *[0] * 14], 2)
    brightness = np.repeat([8.0, 8.2, 8.1, 7.9, 8.0, 8.3] + [0.2] * 14, 2)
    stats, adjacency = _statistics([30] * 40, brightness), face_adjacency(faces)
    face, views = np.repeat(np.arange(40), 3), np.tile(np.arange(3), 40)
    glowing = glowing_pieces(stats, adjacency, object_id, (face, views, np.repeat(brightness, 3)))
    assert len(np.unique(glowing[:12])) == 6 and (glowing[12:] == -1).all()
    out = group_emitters(brightness > 1, stats, adjacency, normals, areas, glowing=glowing)
    assert out.size == 1 and (out.of_face[:12] == 0).all()


def _ceiling(size=24):
    """A ceiling of size x size m in quads of 1 m: centres (n, 2) from its middle, areas, normals and neighbours of the faces."""
    i, j = np.meshgrid(np.arange(size + 1), np.arange(size + 1), indexing="ij")
    vertices = np.stack([i.ravel(), j.ravel(), np.zeros(i.size)], 1).astype(float)
    at = (np.arange(size)[:, None] * (size + 1) + np.arange(size)).ravel()
    faces = np.stack([at, at + size + 1, at + size + 2, at, at + size + 2, at + 1], 1).reshape(-1, 3)
    normals, areas = face_geometry(vertices, faces)
    return vertices[faces].mean(1)[:, :2] - size / 2, areas, normals, face_adjacency(faces)


def _fading(brightness, candidate, parts, **options):
    _, areas, normals, adjacency = parts
    statistics = _statistics(np.full(len(areas), 20), brightness)
    return fading_surface(candidate, replace(statistics, **options.pop("seen", {})), adjacency, normals, areas, **options)


def test_light_on_a_ceiling_fades_and_a_lamp_in_it_does_not():
    parts = _ceiling()
    radius = np.linalg.norm(parts[0], axis=1)
    spot = 8 * np.exp(-0.5 * (radius / 6) ** 2)
    assert (_fading(spot, spot >= 3, parts) == (spot >= 3)).all() and (spot >= 3).sum() > 200
    lamp = np.where(radius < 4, 8.0, 0.5)
    assert not _fading(lamp, lamp >= 3, parts).any()
    # A lamp is no less of one where it is brighter in its middle.
    uneven = np.where(radius < 4, 8 * np.exp(-0.5 * (radius / 4) ** 2), 0.5)
    assert not _fading(uneven, uneven >= 3, parts).any()


@pytest.mark.parametrize("ratio, fades", [(1.4, True), (1.6, False)])
def test_a_step_of_half_as_much_again_is_an_edge(ratio, fades):
    parts = _ceiling()
    lamp = np.linalg.norm(parts[0], axis=1) < 4
    assert _fading(np.where(lamp, ratio, 1.0), lamp, parts)[lamp].all() == fades


@pytest.mark.parametrize("share, fades", [(0.3, False), (0.6, True)])
def test_half_of_the_border_decides_however_large_the_faces_around_are(share, fades):
    at, areas, normals, adjacency = _ceiling()
    lamp, angle = np.linalg.norm(at, axis=1) < 4, np.abs(np.arctan2(at[:, 1], at[:, 0])) / np.pi
    brightness = np.where(lamp, 8.0, np.where(angle < share, 7.0, 1.0))
    around = np.where(lamp, areas, 16 * areas)
    assert _fading(brightness, lamp, (at, around, normals, adjacency))[lamp].all() == fades


def test_light_around_a_saturated_lamp_fades_and_takes_the_lamp_not_along():
    parts = _ceiling()
    radius = np.linalg.norm(parts[0], axis=1)
    lamp = radius < 3
    seen = np.minimum(8 * np.exp(-0.5 * (radius / 7) ** 2), 7)  # the lamp is as bright as the bound, and so is what is next to it
    hidden, mostly, half = {"bounded": lamp}, *({"clear": np.where(lamp, n, 20).astype(np.int32)} for n in (9, 10))
    for says in (hidden, mostly, hidden | mostly):
        assert (_fading(seen, seen >= 3, parts, seen=says) == (seen >= 3) & ~lamp).all()
    assert _fading(seen, seen >= 3, parts, seen=half)[lamp].all()
    # Without the bounds, nothing tells the lamp from the light around it.
    assert _fading(seen, seen >= 3, parts)[lamp].all()


def test_what_ends_at_a_crease_does_not_fade():
    """The front of a shining box, whose sides are hardly darker."""
    parts = _ceiling()
    front = np.abs(parts[0]).max(1) < 4
    brightness = np.where(front, 8.0, 6.0)
    tilted = np.where(front[:, None], [0.0, 0.0, 1.0], [0.0, np.sin(1.0), np.cos(1.0)])
    assert _fading(brightness, front, parts)[front].all()
    assert not _fading(brightness, front, (*parts[:2], tilted, parts[3])).any()


def test_a_piece_that_glows_fades_as_a_whole_or_not_at_all():
    parts = _ceiling()
    across = np.abs(parts[0][:, 0])
    curtain = across < 6
    folds = np.where(parts[0][:, 1] % 2 < 1, 9.0, 3.0)
    glowing = np.where(curtain, 5, -1).astype(np.int32)
    assert not _fading(np.where(curtain, folds, 1.0), curtain, parts, glowing=glowing).any()
    assert _fading(np.where(curtain, folds, folds / 1.2), curtain, parts, glowing=glowing)[curtain].all()
    # Two of them do not decide for each other.
    two = np.where(curtain & (parts[0][:, 1] > 0), 6, glowing)
    half = np.where(curtain & (parts[0][:, 1] > 0), folds, np.where(curtain, folds, folds / 1.2))
    half[~curtain & (parts[0][:, 1] > 0)] = 1.0
    found = _fading(half, curtain, parts, glowing=two)
    assert found[two == 5].all() and not found[two == 6].any()


def test_nothing_fades_where_nothing_was_seen_or_nothing_is_bright():
    parts = _ceiling(2)
    n = len(parts[1])
    assert not _fading(np.zeros(n), np.ones(n, bool), parts).any()
    assert not _fading(np.ones(n), np.zeros(n, bool), parts).any()
    assert not _fading(np.ones(n), np.arange(n) < 2, parts, seen={"count": np.zeros(n, np.int32)}).any()


def test_small_and_surplus_groups_are_dropped_with_a_reason():
    vertices, faces = _strip(6)
    normals, areas = face_geometry(vertices * 1e-3, faces)
    colour = np.repeat(2.0 ** np.arange(6), 2)  # six groups of two faces, 1 mm^2
    stats = _statistics([30] * 12, colour)
    out = group_emitters(np.ones(12, bool), stats, face_adjacency(faces), normals, areas)
    assert out.size == 0 and len(out.dropped) == 6 and out.dropped[0][2] == "too small or hardly seen"
    assert (out.of_face == -1).all() and (out.side == 0).all()
    normals, areas = face_geometry(vertices, faces)
    out = group_emitters(np.ones(12, bool), stats, face_adjacency(faces), normals, areas, GroupingOptions(max_groups=2))
    assert out.size == 2 and len(out.dropped) == 4 and out.observed[0, 0] == 32


def test_no_candidates():
    _, faces = _strip(2)
    stats = _statistics([0] * 4, [0] * 4)
    candidate = emitter_candidates(stats, face_adjacency(faces), np.ones(4), 0.99)
    assert not candidate.any()
    assert group_emitters(candidate, stats, face_adjacency(faces), np.ones((4, 3)), np.ones(4)).size == 0
    assert radiance_threshold(stats) == float("inf")


def test_radiance_threshold_ignores_emitters_and_finds_them():
    rng = np.random.default_rng(0)
    wall = np.exp(rng.normal(np.log(0.3), 0.5, 400))
    lamp = np.full(30, 12.0)
    stats = _statistics(np.r_[np.full(400, 20), np.full(30, 100)], np.r_[wall, lamp])
    threshold = radiance_threshold(stats)
    assert 1.0 < threshold < 6.0
    np.testing.assert_allclose(radiance_threshold(_statistics([5, 5], [7, 7])) / 7, 5)


def cache_of(points, radiance, censored, edge=1.0, origin=(0, 0, 0)):
    """The cache of all pixels."""
    return VoxelPixels.of(edge, np.array(origin, np.float32), points, radiance, censored).cache(np.ones(len(points), bool))


def test_radiance_voxels_against_a_dictionary():
    rng = np.random.default_rng(1)
    points, value = rng.uniform(-1, 1, (3000, 3)).astype(np.float32), rng.random((3000, 3))
    censored = rng.random(3000) < 0.3
    origin = np.array([-1.3, -1.1, -1.2], np.float32)
    at_once = VoxelPixels.of(0.25, origin, points, value, censored)
    for use in (np.ones(3000, bool), rng.random(3000) < 0.5, rng.random(3000) < 0.01):
        out = at_once.cache(use)
        expected: dict = {}
        for p, v, c in zip(points[use], value[use], censored[use], strict=True):
            expected.setdefault(tuple(np.floor((p - origin) / np.float32(0.25)).astype(int)), []).append((v, c))
        assert out.edge == 0.25 and (out.origin == origin).all()
        assert len(out.ijk) == len(expected) == len(np.unique(out.ijk, axis=0))
        assert (np.diff(pack_keys(out.ijk).astype(np.int64)) > 0).all()
        for key, radiance, samples, bound in zip(out.ijk, out.radiance, out.samples, out.censored, strict=True):
            rows = expected[tuple(key)]
            clear = [v for v, c in rows if not c]
            want = np.mean(clear, 0) if clear else np.max([v for v, _ in rows], 0)
            np.testing.assert_allclose(radiance, want, rtol=1e-5)
            assert bound == (not clear) and samples == len(clear or rows)


def test_radiance_voxels_extremes():
    empty = cache_of(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, bool))
    assert empty.ijk.shape == (0, 3) and empty.radiance.shape == (0, 3)
    black = cache_of(np.full((1, 3), 0.05), np.zeros((1, 3)), np.zeros(1, bool))
    assert len(black.ijk) == 1 and black.samples[0] == 1 and (black.radiance == 0).all()  # black, but known
    for point, edge in ((1e6, 0.1), (-5.0, 0.1), (0.0, 0.0)):
        with pytest.raises(InputError):
            cache_of(np.full((1, 3), point), np.ones((1, 3)), np.zeros(1, bool), edge)


def test_bounds_of_the_cache_are_raised_and_nothing_else():
    points = np.array([[0.5, 0.5, 0.5], [1.5, 0.5, 0.5], [2.5, 0.5, 0.5]])
    cache = cache_of(points, np.full((3, 3), 2.0), np.array([True, True, False]))
    at = np.concatenate([points[[0, 0, 2]], [[9.5, 0.5, 0.5]]])
    out = cache.raised(at, np.array([[3.0, 1.0, 8.0], [5.0, 2.0, 8.0], [7.0] * 3, [7.0] * 3]))
    order = np.argsort(out.ijk[:, 0])
    assert out.radiance[order].tolist() == [[4.0, 2.0, 8.0], [2.0] * 3, [2.0] * 3]
    assert out.censored.tolist() == cache.censored.tolist() and (cache.radiance == 2).all()
    assert cache.raised(np.zeros((0, 3)), np.zeros((0, 3))).radiance.tolist() == cache.radiance.tolist()
    known = cache_of(points, np.ones((3, 3)), np.zeros(3, bool))
    assert known.raised(points, np.full((3, 3), 9.0)).radiance.max() == 1
