"""The environment map: directions, solid angles, densities, and that every road through the tracer agrees on its light."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from iif_core.light import environment
from iif_core.numerics.xp import NUMPY
from tests.errors import refused

H, W = 16, 32


def sky(seed=0):
    """(H, W, 3) dim, one bright texel above and one below the horizon."""
    radiance = np.random.default_rng(seed).uniform(0.1, 0.5, (H, W, 3)).astype(np.float32)
    radiance[3, 5], radiance[5, 21] = (90, 80, 60), (20, 30, 40)
    return radiance


@pytest.mark.parametrize("shape", [(1, 1), (16, 32), (5, 3), (512, 1024)])
def test_solid_angles_are_the_sphere(shape):
    omega = environment.solid_angles(*shape)
    assert omega.sum() == pytest.approx(4 * np.pi, rel=1e-12) and (omega > 0).all()
    theta = np.pi * np.arange(shape[0] + 1) / shape[0]
    np.testing.assert_allclose(omega[:, 0], 2 * np.pi / shape[1] * -np.diff(np.cos(theta)), rtol=1e-6)


def test_axes_poles_and_seam_have_their_texels():
    at = np.array([[0, 0, 1], [0, 0, -1], [1, 1e-9, 0], [1, -1e-9, 0], [-1, 1e-9, -1e-9], [0, -1, 1e-9], [-0.0, -0.0, 1]])
    row, column = environment.texel_of(NUMPY, tuple(at.T), H, W)
    assert row.tolist() == [0, 15, 8, 8, 8, 7, 0]
    assert column.tolist()[2:6] == [0, 31, 15, 24] and ((column >= 0) & (column < W)).all()


def test_directions_return_to_their_texel_and_are_uniform_in_it():
    rng = np.random.default_rng(0)
    row, column = rng.integers(0, H, 20000), rng.integers(0, W, 20000)
    u = rng.uniform(1e-9, 1 - 1e-9, (2, 20000))
    d = environment.direction_in(NUMPY, row, column, *u, H, W)
    np.testing.assert_allclose(np.linalg.norm(d, axis=0), 1, rtol=1e-12)
    again = environment.texel_of(NUMPY, d, H, W)
    assert np.array_equal(again[0], row) and np.array_equal(again[1], column)
    # A quarter of every texel by solid angle holds a quarter of the draws: here the halves of u1 as finer rows.
    fine, _ = environment.texel_of(NUMPY, d, 64 * H, W)
    edges = np.cos(np.pi * np.arange(64 * H + 1) / (64 * H))
    expected = -np.diff(edges) / 2 * 20000 * np.repeat(np.bincount(row, minlength=H) / 20000, 64)
    expected *= np.repeat(2 / -np.diff(np.cos(np.pi * np.arange(H + 1) / H)), 64)
    got = np.bincount(fine.astype(int), minlength=64 * H)
    keep = expected > 5
    statistic = ((got - expected)[keep] ** 2 / expected[keep]).sum()
    assert stats.chi2.sf(statistic, keep.sum()) > 1e-3


def test_resample_turns_a_map():
    radiance = sky()
    np.testing.assert_allclose(environment.resample(radiance, np.eye(3), H, W), radiance, rtol=1e-6)
    quarter = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])  # the map's x axis is the world's y
    np.testing.assert_allclose(environment.resample(radiance, quarter, H, W), np.roll(radiance, W // 4, 1), rtol=1e-6)
    y_up = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    turned = environment.resample(radiance, y_up, 2 * H, 2 * W, points=8)
    before, after = environment.texel_weights(radiance).sum(), environment.texel_weights(turned).sum()
    assert after == pytest.approx(before, rel=0.05)
    brightest = np.unravel_index(turned.mean(-1).argmax(), (2 * H, 2 * W))
    toward = np.array(environment.direction_in(NUMPY, *brightest, 0.5, 0.5, 2 * H, 2 * W))
    row, column = environment.texel_of(NUMPY, tuple(y_up @ toward), H, W)
    assert (row, column) == (3, 5)


def test_maps_are_checked():
    assert environment.as_map([1, 2, 3]).shape == (1, 1, 3)
    for bad, name in ((np.ones((4, 8)), "(4, 8)"), (np.full((2, 2, 3), np.nan), "NaN"), (-np.ones((2, 2, 3)), -1)):
        with refused("environment radiance", name):
            environment.as_map(bad)


def square(half, z, up):
    corner = np.array([[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return corner, faces if up else faces[:, ::-1]


class Terrace:
    """A floor under half a roof that shines; everything else is sky."""

    def __init__(self, T, roughness=0.5, metallic=0.3):
        floor, roof = square(2, 0, True), square(0.5, 1, False)
        self.faces = np.concatenate([floor[1], roof[1] + 4])
        self.group = np.array([-1, -1, 0, 0], np.int32)
        self.geometry = T.build_geometry(np.concatenate([floor[0], roof[0]]), self.faces, np.zeros(4, np.int32))
        self.values = np.tile(np.float32([0.8, 0.5, 0.3, roughness, metallic]), (4, 1))
        self.material = T.FaceMaterials(self.values)
        self.radiance = np.where(self.group[:, None] >= 0, np.float32([3, 2, 1]), 0)

    def emitters(self, T, environment, **options):
        return T.Emitters(self.geometry, self.radiance, np.where(self.group >= 0, 1, 0), environment, **options)

    def points(self, n):
        tile = np.tile
        return (
            tile(np.float32([0.6, 0.4, 0]), (n, 1)),
            tile(np.float32([0, 0, 1]), (n, 1)),
            tile(np.float32([0.6, 0, 0.8]), (n, 1)),
        )

    def seen(self, T, emitters, samples=64, seed=0, n=3000, bounces=3):
        point, _, wo = self.points(n)
        return T.render(
            T.Scene(self.geometry, self.material, emitters), point + 0.5 * wo, -wo, T.PathOptions(samples, bounces, seed)
        )


def agree(a, b, sigmas=4.0, slack=1e-3):
    """Two sets of independent rows have one mean."""
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    error = np.hypot(a.std(0, ddof=1) / np.sqrt(len(a)), b.std(0, ddof=1) / np.sqrt(len(b)))
    np.testing.assert_array_less(np.abs(a.mean(0) - b.mean(0)), sigmas * error + slack * np.abs(b.mean(0)) + 1e-7)


def test_draws_have_the_density_that_is_reported(T):
    import drjit as dr
    import mitsuba as mi

    scene = Terrace(T)
    emitters = scene.emitters(T, sky())
    p = emitters.pdf_sky * environment.solid_angles(H, W)
    shares = np.concatenate([emitters.pdf_area * scene.geometry.areas, p.ravel()])
    assert shares.sum() == pytest.approx(1, abs=1e-6) and 0.1 <= p.sum() <= 0.6
    n = 1 << 18
    rng = mi.PCG32(n, 5)
    _, on_sky, texel = emitters.sample(rng.next_float32(), mi.Bool(True))
    direction = emitters.direction_to(texel, rng.next_float32(), rng.next_float32())
    _, density = emitters.texel(texel, on_sky)
    dr.eval(direction, density, texel, on_sky)
    drawn = on_sky.numpy()
    d = direction.numpy().T[drawn]
    np.testing.assert_allclose(np.linalg.norm(d, axis=1), 1, rtol=1e-5)
    # Bins that halve every texel in both directions; float32 may put a draw across an edge.
    row, column = environment.texel_of(NUMPY, tuple(d.T.astype(np.float64)), 2 * H, 2 * W)
    fine = environment.solid_angles(2 * H, 2 * W)
    expected = n * np.repeat(np.repeat(emitters.pdf_sky, 2, 0), 2, 1) * fine
    got = np.bincount((row * 2 * W + column).astype(int), minlength=4 * H * W).reshape(2 * H, 2 * W)
    assert expected.min() > 5
    assert stats.chi2.sf(((got - expected) ** 2 / expected).sum(), got.size) > 1e-3
    reported = emitters.pdf_sky.ravel()[texel.numpy()[drawn]]
    np.testing.assert_allclose(density.numpy()[drawn], reported, rtol=1e-6)


def test_a_map_of_one_colour_is_the_constant_environment(T):
    scene, colour = Terrace(T), np.float32([1, 0.5, 0.25])
    constant, drawn = scene.emitters(T, colour), scene.emitters(T, np.tile(colour, (H, W, 1)))
    assert not constant.sky_is_sampled and drawn.sky_is_sampled
    agree(scene.seen(T, drawn, seed=1), scene.seen(T, constant, seed=2))
    empty = T.Emitters(scene.geometry, np.zeros((4, 3)), environment=np.zeros((H, W, 3)))
    assert not empty.can_be_sampled and not scene.seen(T, empty, n=10).any()


@pytest.mark.parametrize("roughness", [0.02, 0.5])
def test_drawing_the_sky_changes_the_noise_alone(T, roughness):
    scene, light = Terrace(T, roughness), sky()
    brute = scene.emitters(T, light, sampling_weight=np.zeros(4), environment_weight=np.zeros((H, W)))
    assert not brute.can_be_sampled
    slow = scene.seen(T, brute, 1024, seed=1, n=2000)
    for options in ({}, {"environment_share": 0.3}, {"environment_weight": np.ones((H, W))}, {"sampling_weight": np.zeros(4)}):
        emitters = scene.emitters(T, light, **options)
        assert emitters.sky_is_sampled
        agree(scene.seen(T, emitters, 128, seed=3, n=2000), slow)
    if roughness == 0.5:
        drawn, found = (scene.seen(T, e, 128, seed=3).std(0) for e in (scene.emitters(T, light), brute))
        assert (drawn < 0.5 * found).all()


def test_caches_and_matrix_see_the_same_sky(T):
    from iif_core.reflectance import brdf

    scene, light, n, bounces = Terrace(T), sky(), 2000, 3
    emitters, points = scene.emitters(T, light), scene.points(n)
    seen = scene.seen(T, emitters, seed=1, n=n, bounces=bounces)
    a, r, m = scene.values[0, :3], float(scene.values[0, 3]), float(scene.values[0, 4])
    world = T.Scene(scene.geometry, scene.material, emitters)
    diffuse, s0, s1 = T.shading_caches(world, *points, [0.1, r], T.PathOptions(64, bounces, 2))
    agree(brdf.compose(*brdf.kd_ks(a, m), diffuse, s0[:, 1], s1[:, 1]), seen)
    # Columns: the roof, the two bright texels, everything else of the sky; one texel stays dark.
    columns = np.full((H, W), 3, np.int32)
    columns[3, 5], columns[5, 21], columns[0, 0] = 1, 2, -1
    uniform = light.copy()
    uniform[columns == 3], uniform[0, 0] = 0.3, 0
    seen = scene.seen(T, scene.emitters(T, uniform), seed=4, n=n, bounces=bounces)
    materials = np.tile(a, (n, 1)), np.full(n, r), np.full(n, m)
    points = T.ShadingPoints(*points, *materials)
    found = T.EmitterColumns(scene.group, 4, of_texel=columns)
    matrix, cached = T.transport_matrix(world, points, found, T.PathOptions(64, bounces, 5))
    matrix, cached = matrix.sum(1), cached.sum(1)
    assert not cached.any()
    radiance = np.array([[3, 2, 1], uniform[3, 5], uniform[5, 21], [0.3, 0.3, 0.3]])
    agree(np.einsum("ngc,gc->nc", matrix, radiance), seen)
    with refused("environment_columns", "(16, 32)", 3):
        T.transport_matrix(world, points, found._replace(count=3), T.PathOptions(1, 1, 5))


def test_only_the_environment_and_any_chunk(T):
    scene = Terrace(T)
    emitters = T.Emitters(scene.geometry, np.zeros((4, 3)), environment=sky() * 1e6)
    assert emitters.sky_is_sampled and np.sum(emitters.pdf_sky * environment.solid_angles(H, W)) == pytest.approx(1, abs=1e-6)
    point, _, wo = scene.points(300)
    first, second = (
        T.render(T.Scene(scene.geometry, scene.material, emitters), point + 0.5 * wo, -wo, T.PathOptions(16, 4, 0, chunk))
        for chunk in (1 << 18, 77)
    )
    assert np.isfinite(first).all() and first.mean() > 1e3 and first.tobytes() == second.tobytes()


def test_texel_table_becomes_a_map():
    from workflow.scene.base_scene import _environment

    row, column = (index.ravel() for index in np.indices((4, 8)))
    owner = np.full(32, -1)
    owner[5], owner[20:22], owner[31] = 7, 8, 9

    class Reader:
        def __init__(self, names):
            self.names = names

        def has(self, name):
            return name in self.names

        def table(self, name):
            return {"row": row, "column": column, "emitter_id": owner}

    emitters = {"emitter_id": np.array([3, 7, 8, 9])}
    radiance = np.float32([[1, 1, 1], [2, 3, 4], [5, 6, 7], [8, 8, 8]])
    shines = np.array([False, True, True, False])  # 3 is an area emitter, 9 was dropped
    out = _environment(Reader(["environment_texels.parquet"]), emitters, radiance, shines)
    assert out.shape == (4, 8, 3) and np.count_nonzero(out.any(-1)) == 3
    assert out[0, 5].tolist() == [2, 3, 4] and out[2, 4].tolist() == out[2, 5].tolist() == [5, 6, 7]
    assert _environment(Reader([]), emitters, radiance, shines).tolist() == [7, 9, 11]
