"""Light transport: closed forms and furnaces."""

import numpy as np
import pytest

from iif_core.numerics.xp import NUMPY
from iif_core.reflectance import brdf
from tests.unit.transport_rooms import assert_mean, box, lambertian, merge, quad, repeated


def polygon_irradiance(point, normal, polygon):
    """Lambert: irradiance of a unit-radiance polygon, wholly above the horizon, = 1/2 |sum angle_i (gamma_i .
    n)|."""
    rays = polygon - np.asarray(point, float)
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    following = np.roll(rays, -1, axis=0)
    crossed = np.cross(rays, following)
    angle = np.arctan2(np.linalg.norm(crossed, axis=1), (rays * following).sum(1))
    return 0.5 * abs(np.sum(angle * (crossed @ normal) / np.linalg.norm(crossed, axis=1)))


@pytest.mark.parametrize("half", [0.15, 1.5])
@pytest.mark.parametrize("nee", [True, False])
def test_direct_light_of_a_rectangle_is_the_form_factor(T, half, nee):
    """A large light nearby shows densities in two measures (docs/method/numerics.md#densities-in-two-measures)."""
    light = quad((-half, -half + 0.2, 2), (0, 2 * half, 0), (2 * half, 0, 0))
    vertices, faces, ids = merge([quad((-5, -5, 0), (10, 0, 0), (0, 10, 0)), light])
    geometry = T.build_geometry(vertices, faces, ids)
    radiance = np.where(ids[:, None] == 1, np.float32([3, 1, 0.5]), 0)
    emitters = T.Emitters(geometry, radiance, np.where(ids == 1, 1, 0), sampling_weight=None if nee else np.zeros(4))
    assert emitters.can_be_sampled == nee
    n = 2000
    black = T.FaceMaterials(np.tile([0, 0, 0, 1, 1.0], (4, 1)))
    diffuse, s0, s1 = T.shading_caches(
        T.Scene(geometry, black, emitters),
        repeated((0.3, 0, 0), n),
        repeated((0, 0, 1), n),
        repeated((0.6, 0, 0.8), n),
        [],
        T.PathOptions(64, 1, 3),
    )
    assert s0.shape == s1.shape == (n, 0, 3)
    expected = polygon_irradiance((0.3, 0, 1e-4), (0, 0, 1), light[0]) / np.pi
    for channel, strength in enumerate((3, 1, 0.5)):
        assert_mean(diffuse[:, channel], strength * expected, slack=1e-4)
    if half > 1:
        assert diffuse[:, 0].std() / diffuse[:, 0].mean() < 0.2


def test_emitters_radiate_from_their_side_only(T):
    light = quad((-1, -1, 2), (2, 0, 0), (0, 2, 0))  # normal up, away from the floor
    geometry = T.build_geometry(*light, np.zeros(2, np.int32))
    nothing = T.FaceMaterials(np.tile([0, 0, 0, 1, 1.0], (2, 1)))
    for side, below, above in ((1, 0, 1), (-1, 1, 0), (0, 1, 1)):
        emitters = T.Emitters(geometry, np.ones((2, 3)), np.full(2, side))
        seen = T.render(
            T.Scene(geometry, nothing, emitters), [[0.1, 0, 0], [0.1, 0, 4]], [[0, 0, 1], [0, 0, -1]], T.PathOptions(2, 0, 0)
        )
        assert seen[:, 0].tolist() == [below, above]
        diffuse, _, _ = T.shading_caches(
            T.Scene(geometry, nothing, emitters), [[0, 0, 0]], [[0, 0, 1]], [[0, 0, 1]], [], T.PathOptions(64, 1, 0)
        )
        assert (diffuse[0, 0] > 0.1) == bool(below)


def test_closed_grey_box_sums_the_geometric_series(T):
    vertices, faces = box((0, 0, 0), (1, 2, 1.5), inward=True)
    geometry = T.build_geometry(vertices, faces, np.zeros(12, np.int32))
    material, rho = lambertian(0.5)
    for weight in (None, np.zeros(12)):
        emitters = T.Emitters(geometry, np.full((12, 3), 0.7), np.ones(12), sampling_weight=weight)
        n = 4000
        seen = T.render(
            T.Scene(geometry, material, emitters),
            repeated((0.4, 0.9, 0.8), n),
            repeated((0.3, 0.5, -0.6), n),
            T.PathOptions(16, 64, 1),
        )
        # The last term is the grazing remainder, between 0 and 0.0035 of albedo on cosine average.
        low, high = 0.7 / (1 - rho), 0.7 / (1 - rho - 0.004)
        error = 3 * seen[:, 0].std() / np.sqrt(n)
        assert low - error < seen[:, 0].mean() < high + error


def test_closed_sphere_solves_its_integral_equation(T):
    """In a sphere a ray leaves under the angle under which it arrived, so L(theta) obeys a one-dimensional
    equation."""
    import trimesh

    sphere = trimesh.creation.icosphere(subdivisions=5)
    geometry = T.build_geometry(sphere.vertices, sphere.faces, np.zeros(len(sphere.faces), np.int32))
    a, r, m = 0.6, 0.45, 0.4
    emitters = T.Emitters(geometry, np.full((len(sphere.faces), 3), 0.5))
    material = T.FaceMaterials(np.tile([a, a, a, r, m], (len(sphere.faces), 1)))

    nodes, weights = np.polynomial.legendre.leggauss(60)
    mu, weights = (nodes + 1) / 2, weights / 2
    phi = 2 * np.pi * (np.arange(256) + 0.5) / 256
    sine = np.sqrt(1 - mu * mu)
    wo = (sine[:, None, None], 0.0, mu[:, None, None])
    wi = (sine[None, :, None] * np.cos(phi), sine[None, :, None] * np.sin(phi), mu[None, :, None] + 0 * phi)
    kd, ks = brdf.kd_ks(a, m)
    diffuse, spec, fc = brdf.lobes(NUMPY, *brdf.half_angles(NUMPY, (0.0, 0.0, 1.0), wi, wo), r)
    kernel = brdf.compose(kd, ks, diffuse, spec * (1 - fc), spec * fc).mean(-1) * 2 * np.pi * weights
    exact = np.linalg.solve(np.eye(60) - kernel, np.full(60, 0.5))

    for wanted in (0.3, 0.9):
        cosine = mu[np.argmin(np.abs(mu - wanted))]
        start = np.array([0.02, 0.03, 1.0])  # slightly off the pole, so that no ray runs along an edge
        start /= np.linalg.norm(start)
        side = np.cross(start, (0, 1, 0))
        side /= np.linalg.norm(side)
        toward = cosine * start + np.sqrt(1 - cosine**2) * side  # arrives at the far wall under the same angle
        n = 4000
        seen = T.render(
            T.Scene(geometry, material, emitters),
            repeated(start * 0.9 - 0 * side, n),
            repeated(toward, n),
            T.PathOptions(32, 64, 5),
        )
        arrived = np.array([0.9 * start @ toward])
        distance = -arrived + np.sqrt(arrived**2 + 1 - 0.81)
        hit = 0.9 * start + distance * toward
        expected = np.interp(toward @ hit, mu, exact)
        assert_mean(seen[:, 1], expected, slack=3e-3)


@pytest.mark.parametrize(("r", "m"), [(0.02, 1.0), (0.3, 0.0), (1.0, 0.5)])
def test_white_furnace(T, r, m):
    """Environment 1 over a floor: reflected radiance is the albedo of the lobes; an all-white cache closes it
    likewise."""
    floor = quad((-5, -5, 0), (10, 0, 0), (0, 10, 0))
    geometry = T.build_geometry(*floor, np.zeros(2, np.int32))
    NoV, a, n = 0.6, np.array([0.9, 0.5, 0.1]), 3000
    u = (np.arange(600) + 0.5) / 600
    u1, u2 = (g.ravel() for g in np.meshgrid(u, u))
    wo = (0.8, 0.0, NoV)
    wi = brdf.reflect(wo, brdf.sample_ggx_half(NUMPY, u1, u2, r))
    angles = brdf.half_angles(NUMPY, (0.0, 0.0, 1.0), wi, wo)
    _, spec, fc = brdf.lobes(NUMPY, *angles, r)
    weight = spec / np.maximum(brdf.specular_pdf(NUMPY, *angles[2:], r), 1e-30)
    s0, s1 = np.mean(weight * (1 - fc)), np.mean(weight * fc)
    kd, ks = brdf.kd_ks(a, m)
    expected = brdf.compose(kd, ks, 1.0, s0, s1)

    emitters = T.Emitters(geometry, np.zeros((2, 3)), environment=(1, 1, 1))
    assert not emitters.can_be_sampled
    material = T.FaceMaterials(np.tile([*a, r, m], (2, 1)))
    seen = T.render(
        T.Scene(geometry, material, emitters), repeated((0, 0, 1), n), repeated((-0.8, 0, -NoV), n), T.PathOptions(32, 8, 1)
    )
    caches = T.shading_caches(
        T.Scene(geometry, material, emitters),
        repeated((0, 0, 0), n),
        repeated((0, 0, 1), n),
        repeated(wo, n),
        [r],
        T.PathOptions(32, 8, 1),
    )
    matrix, cached = T.transport_matrix(
        T.Scene(geometry, material, None),
        T.ShadingPoints(
            repeated((0, 0, 0), n), repeated((0, 0, 1), n), repeated(wo, n), repeated(a, n), np.full(n, r), np.full(n, m)
        ),
        T.EmitterColumns(np.full(2, -1), 1, of_texel=[[0]]),
        T.PathOptions(32, 8, 1),
    )
    assert not cached.any()
    lobes = brdf.compose(kd, 0, 1.0, 0, 0), brdf.compose(0, ks, 0, s0, s1)
    for channel in range(3):
        assert_mean(seen[:, channel], expected[channel], slack=2e-4)
        for lobe in range(2):
            assert_mean(matrix[:, lobe, 0, channel], np.broadcast_to(lobes[lobe], 3)[channel], slack=2e-4)
    assert_mean(caches[0][:, 0], 1)
    assert_mean(caches[1][:, 0, 0], s0, slack=2e-4)
    assert_mean(caches[2][:, 0, 0], s1, slack=2e-4)


def test_jitter_is_a_box_filter_over_the_pixel(T):
    """One pixel over an edge between a bright and a dark half: the mean is the covered share."""
    geometry = T.build_geometry(*quad((0.2, -9, 2), (9, 0, 0), (0, 18, 0)), np.zeros(2, np.int32))
    emitters = T.Emitters(geometry, np.ones((2, 3)))
    black = T.FaceMaterials(np.tile([0, 0, 0, 1, 1.0], (2, 1)))
    n = 2000
    # At depth 2 the pixel of width 1 spans x in [-1, 1] (centre 0): 40 % lies beyond x = 0.2.
    seen = T.render(
        T.Scene(geometry, black, emitters),
        repeated((0, 0, 0), n),
        repeated((0, 0, 1), n),
        T.PathOptions(16, 0, 0),
        ((1, 0, 0), (0, 1, 0)),
    )
    assert_mean(seen[:, 0], 0.4)
    wide = T.render(
        T.Scene(geometry, black, emitters),
        repeated((0, 0, 0), n),
        repeated((3, 0, 5), n),
        T.PathOptions(16, 0, 0),
        ((3, 0, 0), (0, 1, 0)),
    )  # un-normalised direction: x/z in 2 * [0.3, 0.9] - all but nothing below 0.1
    assert (wide == 1).all()
