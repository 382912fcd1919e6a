"""Light maps: closed forms, the sum over lamps, groups, smoothing, means of denoised maps, half floats."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from iif_core.errors import InputError
from iif_core.light.light_maps import HALF_TOP, group_lamps, smooth, to_half, with_mean_of
from tests.errors import refused
from tests.unit.test_transport import polygon_irradiance
from tests.unit.transport_rooms import assert_mean, box, lambertian, merge, quad, repeated


@pytest.fixture(scope="module")
def light_maps(T):
    from iif_core.light.transport.lightmaps import light_maps

    return light_maps


def test_two_lamps_have_their_form_factors(T, light_maps):
    """Two rectangles over a black floor, and light from everywhere below the horizon's complement that they do not cover."""
    lamps = [quad((-0.2, -0.2, 2), (0, 0.4, 0), (0.4, 0, 0)), quad((0.8, -0.5, 1.2), (0, 1, 0), (1, 0, 0))]
    vertices, faces, ids = merge([quad((-5, -5, 0), (10, 0, 0), (0, 10, 0)), *lamps])
    geometry = T.build_geometry(vertices, faces, ids)
    radiance = np.float32([[0, 0, 0], [3, 1, 0.5], [0.2, 0.4, 5]])[ids]
    emitters = T.Emitters(geometry, radiance, np.where(ids > 0, 1, 0), environment=(0.5, 0.25, 0.125))
    scene = T.Scene(geometry, T.FaceMaterials(np.tile([0, 0, 0, 1, 1.0], (len(faces), 1))), emitters)
    n, point = 3000, (0.3, 0, 0)
    maps = light_maps(scene, repeated(point, n), repeated((0, 0, 3), n), ids - 1, 3, T.PathOptions(32, 1, 5), environment_lamp=2)
    forms = [polygon_irradiance((0.3, 0, 1e-4), (0, 0, 1), lamp[0]) / np.pi for lamp in lamps]
    for lamp, number in ((0, 1), (1, 2)):
        for channel in range(3):
            assert_mean(maps[:, lamp, channel], radiance[ids == number][0, channel] * forms[lamp], slack=2e-4)
    assert_mean(maps[:, 2, 0], 0.5 * (1 - sum(forms)), slack=2e-4)
    # Lamp -1 is left out, and the others do not change by it.
    alone = light_maps(scene, repeated(point, n), repeated((0, 0, 3), n), np.where(ids == 1, 0, -1), 1, T.PathOptions(32, 1, 5))
    np.testing.assert_array_equal(alone[:, 0], maps[:, 0])


def test_every_lamp_has_its_share_of_the_draws_at_every_point(T, light_maps):
    """Of two equal lamps, each is drawn once for a path: independent draws would leave one of them dark at half the points."""
    lamps = [quad((x, -0.1, 2), (0, 0.2, 0), (0.2, 0, 0)) for x in (-0.4, 0.2)]
    vertices, faces, ids = merge([quad((-5, -5, 0), (10, 0, 0), (0, 10, 0)), *lamps])
    geometry = T.build_geometry(vertices, faces, ids)
    emitters = T.Emitters(geometry, np.where(ids[:, None] > 0, 1.0, 0.0) * np.ones(3), np.where(ids > 0, 1, 0))
    scene = T.Scene(geometry, T.FaceMaterials(np.tile([0, 0, 0, 1, 1.0], (len(faces), 1))), emitters)
    maps = light_maps(scene, repeated((0, 0, 0), 200), repeated((0, 0, 1), 200), ids - 1, 2, T.PathOptions(1, 1, 5))
    assert (maps[..., 0] > 0).all()
    assert maps[..., 0].std(0).max() < 0.1 * maps.mean()


def test_lamps_of_a_furnace_add_up_to_the_geometric_series(T, light_maps):
    """Walls of a closed grey box that all shine with L: the lamps, two walls each, add up to D = L / (1 - rho)."""
    vertices, faces = box((0, 0, 0), (1, 2, 1.5), inward=True)
    geometry = T.build_geometry(vertices, faces, np.zeros(12, np.int32))
    material, rho = lambertian(0.5)
    emitters = T.Emitters(geometry, np.full((12, 3), 0.7), np.ones(12))
    n = 4000
    lamp = np.repeat([0, 1, 2], 4)
    maps = light_maps(
        T.Scene(geometry, material, emitters),
        repeated((0.4, 0.9, 0), n),
        repeated((0, 0, 1), n),
        lamp,
        3,
        T.PathOptions(16, 64, 1),
    )
    whole = maps.sum(1)[:, 0]
    low, high = 0.7 / (1 - rho), 0.7 / (1 - rho - 0.004)  # the grazing rest of the lobe
    error = whole.std(ddof=1) / np.sqrt(n)
    assert low - 3 * error < whole.mean() < high + 3 * error


def test_lamps_add_up_to_the_diffuse_light_of_the_shading_caches(T, room, light_maps):
    """The sum over lamps, and each lamp alone, against the existing integrator with the other lamps dark: Z-tests over blocks."""
    scene = T.Scene(room.geometry, room.material, room.emitters)
    take = slice(None, None, 3)
    points, normals = room.points[take], room.normals[take]
    maps = np.stack([light_maps(scene, points, normals, room.group, 2, T.PathOptions(64, 5, seed)) for seed in range(8)])
    for chosen in ((0, 1), (0,), (1,)):
        on = np.isin(room.group, chosen)
        emitters = T.Emitters(room.geometry, np.where(on[:, None], room.radiance, 0), room.side)
        other = T.Scene(room.geometry, room.material, emitters)
        reference = np.stack(
            [T.shading_caches(other, points, normals, normals, [], T.PathOptions(64, 5, 100 + seed))[0] for seed in range(8)]
        )
        ours = maps[:, :, list(chosen)].sum(2)
        a, b = ours.mean((1, 2), dtype=np.float64), reference.mean((1, 2), dtype=np.float64)
        error = np.hypot(a.std(ddof=1), b.std(ddof=1)) / np.sqrt(8)
        assert abs(a.mean() - b.mean()) < 4 * error
        assert error < 0.01 * b.mean()


def test_lamps_are_independent_of_who_else_is_asked_for(T, room, light_maps):
    scene = T.Scene(room.geometry, room.material, room.emitters)
    paths = T.PathOptions(8, 5, 3)
    both = light_maps(scene, room.points, room.normals, room.group, 2, paths)
    merged = light_maps(scene, room.points, room.normals, np.minimum(room.group, 0), 1, paths)
    np.testing.assert_allclose(both.sum(1), merged[:, 0], rtol=2e-5, atol=1e-7)
    chunked = light_maps(scene, room.points, room.normals, room.group, 2, T.PathOptions(8, 5, 3, chunk=1000))
    np.testing.assert_array_equal(both, chunked)
    some = np.arange(5, 400, 7)
    numbered = light_maps(scene, room.points[some], room.normals[some], room.group, 2, paths, number=some.astype(np.uint32))
    np.testing.assert_array_equal(numbered, both[some])


@pytest.fixture(scope="module")
def lit_by_known(T, room):
    """Points of the furnished room under one lamp, and the light of the surface that they see."""
    from iif_core.light.transport.lightmaps import known_light

    lamps = room.group == 1  # the wall light alone: the opposite wall is bright, and most of the rest is lit by it
    emitters = T.Emitters(room.geometry, np.where(lamps[:, None], room.radiance, 0), room.side)
    scene = T.Scene(room.geometry, room.material, emitters)
    of_face = np.where(lamps, 0, -1)
    points, normals = np.repeat(room.points[::4], 4, 0), np.repeat(room.normals[::4], 4, 0)
    known = known_light(scene, points, normals, of_face, 1, room.ids, T.PathOptions(16, 15, 2))
    return scene, of_face, room.points[::4], room.normals[::4], known


def test_known_light_keeps_the_mean_and_takes_the_noise(T, light_maps, lit_by_known):
    """Against whole paths: the same mean within 2 % over all points, and less variance, though half of it is of direct light."""
    scene, of_face, points, normals, known = lit_by_known
    assert known is not None and len(known.light) > 100

    def runs(light):
        return np.stack(
            [light_maps(scene, points, normals, of_face, 1, T.PathOptions(16, 16, seed), known=light)[:, 0] for seed in range(8)]
        )

    whole, short = runs(None), runs(known)
    assert short.mean() == pytest.approx(whole.mean(), rel=0.02)
    variance = [np.median(one.var(0, ddof=1).sum(1)) for one in (whole, short)]
    assert variance[1] < 0.75 * variance[0]


def test_known_light_of_one_bounce_changes_nothing(T, light_maps, lit_by_known):
    scene, of_face, points, normals, known = lit_by_known
    one = T.PathOptions(8, 1, 3)
    direct = light_maps(scene, points, normals, of_face, 1, one, known=known)
    np.testing.assert_allclose(direct.mean(), light_maps(scene, points, normals, of_face, 1, one).mean(), rtol=0.02)


def test_known_light_is_asked_by_side_object_and_distance(T):
    """Two objects back to back in one voxel, one of them lit on one side; sparse places are put together."""
    import drjit as dr
    import mitsuba as mi

    from iif_core.light.transport.lamp_cache import LEAST, LampCache

    rng = np.random.default_rng(0)
    n = 3 * LEAST
    points = np.concatenate([rng.uniform(0.01, 0.05, (3 * n, 3)), [[0.25, 0.05, 0.05], [0.35, 0.05, 0.05]]])
    normals = np.repeat([[1.0, 0, 0], [-1, 0, 0], [1, 0, 0], [1, 0, 0]], [n, n, n, 2], 0)
    objects = np.repeat([4, 4, -1, 4], [n, n, n, 2])
    value = np.concatenate([rng.uniform(1, 2, n), np.full(n, 5.0), np.full(n, 7.0), [10, 20]])
    light = np.stack([value, 2 * value], 1)[..., None].repeat(3, 2)
    known = LampCache(0.1, points, normals, objects, light)

    def asked(point, normal, number, distance=1.0):
        point, normal = mi.Point3f(*map(float, point)), mi.Vector3f(*map(float, normal))
        found, row = known.find(point, normal, mi.Int32(number), mi.Float(distance), mi.Bool(True))
        dr.eval(found, row)
        return known.light[int(row[0]), :, 0].tolist() if bool(found[0]) else None

    at = points[0]
    assert asked(at, (-1, 0, 0), 4) == pytest.approx([5, 10]) and asked(at, (1, 0, 0), -1) == pytest.approx([7, 14])
    assert 1 < asked(at, (1, 0, 0), 4)[0] < 2
    assert asked(at, (0, 0, 1), 4) is None and asked(at, (1, 0, 0), 5) is None
    assert asked(at, (-1, 0, 0), 4, 0.05) is None  # too near
    assert asked((0.25, 0.05, 0.05), (1, 0, 0), 4) == pytest.approx([15, 30])  # of both, because each is too few


def test_lamps_out_of_range_are_named(T, room, light_maps):
    scene = T.Scene(room.geometry, room.material, room.emitters)
    with refused("lamp_of_face", "(40,)", 1):
        light_maps(scene, room.points, room.normals, room.group, 1, T.PathOptions(1, 1, 0))
    assert light_maps(scene, room.points[:0], room.normals[:0], room.group, 2, T.PathOptions(1, 1, 0)).shape == (0, 2, 3)


def test_the_weakest_lamps_share_a_map():
    of, count = group_lamps([5, 0, 1, 3, 2, 2], most=3)
    assert of.tolist() == [0, -1, 2, 1, 2, 2] and count == 3
    of, count = group_lamps([5, 0, 1, 3], most=3)
    assert of.tolist() == [0, -1, 1, 2] and count == 3
    assert group_lamps([])[1] == 0


@settings(max_examples=50, deadline=None)
@given(st.integers(-30, 30), st.integers(0, 2**32 - 1))
def test_half_floats_neither_overflow_nor_lose_digits(exponent, seed):
    rng = np.random.default_rng(seed)
    maps = np.exp(rng.normal(0, 3, (50, 3, 3))) * 10.0**exponent
    maps[:, 2] = 0
    halves = to_half(maps)
    assert halves.value.dtype == np.float16 and np.isfinite(halves.value).all() and halves.value.max() <= HALF_TOP
    factor = np.array([[0.5, 2, 1], [1, 0, 3], [1, 1, 1]])
    expected = np.einsum("nlc,lc->nc", maps, factor)
    again = np.einsum("nlc,lc->nc", halves.value.astype(np.float64), halves.scale[:, None] * factor)
    np.testing.assert_allclose(again, expected, rtol=2.0**-11, atol=1e-11 * maps.max())
    with pytest.raises(InputError):
        to_half(-maps)


def test_denoised_maps_keep_the_light_of_every_part():
    rng = np.random.default_rng(3)
    part = np.repeat([0, 1, 2], [5000, 4000, 20])
    area = np.repeat([1e-4, 4e-4, 1e-4], [5000, 4000, 20])
    truth = np.ones((len(part), 2, 3)) * np.float32([1, 0.5, 0.25])
    traced = truth * rng.gamma(2, 0.5, (len(part), 2, 1))
    lost = np.array([0.9, 0.8, 0.1])[part][:, None, None]  # of a small part the mean over all is believed more
    out = with_mean_of(traced, truth * lost, part, area)
    for p, tolerance in ((0, 0.02), (1, 0.02)):
        own = part == p
        np.testing.assert_allclose(out[own].mean(0), traced[own].mean(0), rtol=tolerance)
    whole = (area[:, None] * traced[:, 0]).sum() / (area[:, None] * (truth * lost)[:, 0]).sum()
    few = (20 * traced[-20:, 0].sum() / (truth * lost)[-20:, 0].sum() + 256 * whole) / 276
    np.testing.assert_allclose(out[-20:, 0], (truth * lost)[-20:, 0] * min(few, 2.0), rtol=1e-5)
    assert with_mean_of(traced[:0], truth[:0], part[:0], area[:0]).shape == (0, 2, 3)
    assert not with_mean_of(0 * traced, 0 * truth, part, area).any()


def test_smoothing_lowers_noise_and_keeps_shadows():
    """A plane with the edge of a shadow and noise of 10 %, and a plane behind it that has other light."""
    rng = np.random.default_rng(1)
    x, y = np.meshgrid(np.arange(60) * 0.02, np.arange(40) * 0.02, indexing="ij")
    plane = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1)
    points, normals = np.concatenate([plane, plane - [0, 0, 0.01]]), np.repeat([[0.0, 0, 1], [0, 0, -1]], len(plane), 0)
    lit, front = points[:, 0] > 0.59, np.arange(len(points)) < len(plane)
    true = np.stack([np.where(lit, 1.0, 0.05) * np.where(front, 1, 3), np.full(len(points), 0.05)], 1)
    true = (true[..., None] * np.float32([1, 0.8, 0.5])).astype(np.float32)
    noisy = (true * rng.gamma(100, 0.01, (len(points), 1, 1))).astype(np.float32)
    out = smooth(points, normals, noisy, reach=0.03)
    assert (out / true - 1).std() < 0.35 * (noisy / true - 1).std()
    edge = np.abs(points[:, 0] - 0.59) < 0.02
    for side in (lit, ~lit):
        np.testing.assert_allclose(out[edge & side & front, 0].mean(0), true[edge & side & front, 0].mean(0), rtol=0.05)
    parted = smooth(points, normals, np.concatenate([0.25 * noisy[:, :1], 0.75 * noisy[:, :1], noisy[:, 1:]], 1), reach=0.03)
    np.testing.assert_allclose(parted[:, :2].sum(1), out[:, 0], rtol=1e-5)
    assert smooth(points[:0], normals[:0], noisy[:0], 0.1).shape == (0, 2, 3)
