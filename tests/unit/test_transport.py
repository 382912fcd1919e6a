"""Light transport: closed forms, furnaces, two roads to one number, determinism and extremes."""

from __future__ import annotations

import numpy as np
import pytest

from iif_core import brdf, camera, cells, native
from iif_core.errors import InputError
from iif_core.xp import NUMPY

pytestmark = pytest.mark.usefixtures("device")


@pytest.fixture(scope="session")
def device():
    native.prepare()
    import drjit as dr
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    dr.set_thread_count(2)


@pytest.fixture(scope="module")
def T(device):
    from iif_core import transport

    return transport


def quad(corner, edge1, edge2):
    """Two triangles, right-hand normal edge1 x edge2."""
    c, a, b = (np.asarray(v, float) for v in (corner, edge1, edge2))
    return np.array([c, c + a, c + a + b, c + b]), np.array([[0, 1, 2], [0, 2, 3]])


def box(low, high, inward):
    """Axis-aligned box, 12 triangles."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    parts = []
    for axis in range(3):
        e1, e2 = np.zeros(3), np.zeros(3)
        e1[(axis + 1) % 3] = (high - low)[(axis + 1) % 3]
        e2[(axis + 2) % 3] = (high - low)[(axis + 2) % 3]
        lift = np.zeros(3)
        lift[axis] = (high - low)[axis]
        parts += [quad(low, e1, e2), quad(low + lift, e2, e1)] if inward else [quad(low, e2, e1), quad(low + lift, e1, e2)]
    return merge(parts)[:2]


def merge(parts):
    """(vertices, faces, part number of each face)."""
    start, vertices, faces, ids = 0, [], [], []
    for number, (v, f) in enumerate(parts):
        vertices.append(v)
        faces.append(f + start)
        ids.append(np.full(len(f), number))
        start += len(v)
    return np.concatenate(vertices), np.concatenate(faces), np.concatenate(ids).astype(np.int32)


# base colour, roughness, metallic: walls, glossy block, rough metal block, black emitter
ROOM_MATERIALS = np.array(
    [
        [0.7, 0.6, 0.5, 0.9, 0.0],
        [0.3, 0.5, 0.7, 0.25, 0.0],
        [0.9, 0.7, 0.4, 0.35, 1.0],
        [0.0, 0.0, 0.0, 1.0, 1.0],
        [0.0, 0.0, 0.0, 1.0, 1.0],
    ],
    np.float32,
)
ROOM_RADIANCE = np.array([[8.0, 7.0, 5.0], [2.0, 3.0, 6.0]], np.float32)


class Room:
    """4 x 3 x 2.5 m, a glossy and a metal block, a ceiling light and a wall light."""

    def __init__(self, T):
        parts = [
            box((0, 0, 0), (4, 3, 2.5), inward=True),
            box((0.6, 1.2, 0.0005), (1.4, 2, 0.9), inward=False),
            box((2.4, 1.0, 0.0005), (3.2, 1.8, 0.7), inward=False),
            quad((1.5, 1.0, 2.45), (0, 0.8, 0), (1, 0, 0)),
            quad((3.95, 0.5, 1), (0, 0, 0.5), (0, 0.6, 0)),
        ]
        self.vertices, self.faces, self.ids = merge(parts)
        self.geometry = T.build_geometry(self.vertices, self.faces, self.ids)
        self.material = T.FaceMaterials(ROOM_MATERIALS[self.ids])
        self.group = np.where(self.ids >= 3, self.ids - 3, -1).astype(np.int32)
        self.radiance = np.where(self.group[:, None] >= 0, ROOM_RADIANCE[self.group], 0)
        self.side = np.where(self.group >= 0, 1, 0).astype(np.int8)
        self.emitters = T.Emitters(self.geometry, self.radiance, self.side)
        pose = camera.look_at((2, 0.2, 1.3), (2, 2.2, 0.9), (0, 0, 1))
        self.directions = camera.pixel_directions(26, 26, 24, 24, 48, 48, pose).reshape(-1, 3)
        self.origin = pose[:3, 3].astype(np.float32)
        self.face, depth = T.trace(self.geometry, self.origin, self.directions)
        keep = (self.face >= 0) & (self.group[self.face] < 0)
        self.face, self.directions = self.face[keep], self.directions[keep]
        self.points = self.origin + depth[keep, None] * self.directions
        self.wo = -self.directions / np.linalg.norm(self.directions, axis=1, keepdims=True)
        normals = self.geometry.normals[self.face]
        self.normals = np.where((normals * self.wo).sum(1, keepdims=True) < 0, -normals, normals)
        values = ROOM_MATERIALS[self.ids[self.face]]
        self.base_color, self.roughness, self.metallic = values[:, :3], values[:, 3], values[:, 4]
        self.object = self.ids[self.face]

    def render(self, T, samples, seed, **options):
        options = {"max_bounces": 5} | options
        return T.render(
            self.geometry,
            self.material,
            self.emitters,
            self.origin,
            self.directions,
            samples,
            seed=seed,
            **options,
        )


@pytest.fixture(scope="module")
def room(T):
    return Room(T)


def repeated(vector, count):
    return np.tile(np.asarray(vector, np.float32), (count, 1))


def assert_mean(samples, expected, sigmas=3.0, slack=0.0):
    """The mean of independent rows is the expected number within `sigmas` standard errors (plus a relative
    slack)."""
    samples = np.asarray(samples, np.float64)
    error = samples.std(ddof=1) / np.sqrt(len(samples))
    assert samples.mean() == pytest.approx(expected, abs=sigmas * error + slack * abs(expected) + 1e-7)


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
    """A large near light is where a mixed-up measure in the MIS weights shows (METHOD 2.5: x1.64 for 3 x 3 m
    at 2 m)."""
    light = quad((-half, -half + 0.2, 2), (0, 2 * half, 0), (2 * half, 0, 0))
    vertices, faces, ids = merge([quad((-5, -5, 0), (10, 0, 0), (0, 10, 0)), light])
    geometry = T.build_geometry(vertices, faces, ids)
    radiance = np.where(ids[:, None] == 1, np.float32([3, 1, 0.5]), 0)
    emitters = T.Emitters(geometry, radiance, np.where(ids == 1, 1, 0), sampling_weight=None if nee else np.zeros(4))
    assert emitters.can_be_sampled == nee
    n = 2000
    black = T.FaceMaterials(np.tile([0, 0, 0, 1, 1.0], (4, 1)))
    diffuse, s0, s1 = T.shading_caches(
        geometry,
        black,
        emitters,
        repeated((0.3, 0, 0), n),
        repeated((0, 0, 1), n),
        repeated((0.6, 0, 0.8), n),
        [],
        64,
        1,
        seed=3,
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
        seen = T.render(geometry, nothing, emitters, [[0.1, 0, 0], [0.1, 0, 4]], [[0, 0, 1], [0, 0, -1]], 2, 0, seed=0)
        assert seen[:, 0].tolist() == [below, above]
        diffuse, _, _ = T.shading_caches(geometry, nothing, emitters, [[0, 0, 0]], [[0, 0, 1]], [[0, 0, 1]], [], 64, 1, 0)
        assert (diffuse[0, 0] > 0.1) == bool(below)


def lambertian(rho):
    """Material without the dielectric lobe: metallic chosen so that k_s = 0; only the grazing rest S1 <=
    0.014 is left."""
    import mitsuba as mi

    metallic = -0.04 / (rho - 0.04)
    return lambda point, face, object_id, active: (mi.Color3f(rho), mi.Float(1), mi.Float(metallic)), (1 - metallic) * rho


def test_closed_grey_box_sums_the_geometric_series(T):
    vertices, faces = box((0, 0, 0), (1, 2, 1.5), inward=True)
    geometry = T.build_geometry(vertices, faces, np.zeros(12, np.int32))
    material, rho = lambertian(0.5)
    for weight in (None, np.zeros(12)):
        emitters = T.Emitters(geometry, np.full((12, 3), 0.7), np.ones(12), sampling_weight=weight)
        n = 4000
        seen = T.render(
            geometry,
            material,
            emitters,
            repeated((0.4, 0.9, 0.8), n),
            repeated((0.3, 0.5, -0.6), n),
            16,
            64,
            1,
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
        seen = T.render(geometry, material, emitters, repeated(start * 0.9 - 0 * side, n), repeated(toward, n), 32, 64, 5)
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
    seen = T.render(geometry, material, emitters, repeated((0, 0, 1), n), repeated((-0.8, 0, -NoV), n), 32, 8, 1)
    caches = T.shading_caches(
        geometry,
        material,
        emitters,
        repeated((0, 0, 0), n),
        repeated((0, 0, 1), n),
        repeated(wo, n),
        [r],
        32,
        8,
        1,
    )
    matrix, cached = T.transport_matrix(
        geometry,
        material,
        repeated((0, 0, 0), n),
        repeated((0, 0, 1), n),
        repeated(wo, n),
        repeated(a, n),
        np.full(n, r),
        np.full(n, m),
        np.full(2, -1),
        1,
        None,
        32,
        8,
        1,
        environment_columns=[[0]],
    )
    assert not cached.any()
    for channel in range(3):
        assert_mean(seen[:, channel], expected[channel], slack=2e-4)
        assert_mean(matrix[:, 0, channel], expected[channel], slack=2e-4)
    assert_mean(caches[0][:, 0], 1)
    assert_mean(caches[1][:, 0, 0], s0, slack=2e-4)
    assert_mean(caches[2][:, 0, 0], s1, slack=2e-4)


def bias_over(values, reference, groups, seeds):
    """Relative bias of block means and its standard error, per group, from repeated independent runs."""
    for number in range(groups.max() + 1):
        member = groups == number
        if np.count_nonzero(member) < 30:
            continue
        a = np.array([v[member].mean() for v in values])
        b = np.array([v[member].mean() for v in reference])
        yield (
            number,
            a.mean() / b.mean() - 1,
            np.hypot(a.std(ddof=1), b.std(ddof=1)) / np.sqrt(seeds) / b.mean(),
        )


def test_shading_caches_compose_to_the_rendered_radiance(T, room):
    """Diffuse walls, a glossy and a metal block; exact levels agree within noise, interpolated levels within
    0.5 %."""
    exact = np.array([0.25, 0.35, 0.9])
    grid = np.array([0.02, 0.1, 0.2, 0.3, 0.4, 0.6, 0.8, 1.0])
    kd, ks = brdf.kd_ks(room.base_color, room.metallic[:, None])
    rows, seeds = np.arange(len(room.points)), 6
    composed, interpolated, rendered = [], [], []
    for seed in range(seeds):
        rendered.append(room.render(T, 128, seed=100 + seed))
        for levels, kept in ((exact, composed), (grid, interpolated)):
            diffuse, s0, s1 = T.shading_caches(
                room.geometry,
                room.material,
                room.emitters,
                room.points,
                room.normals,
                room.wo,
                levels,
                128,
                5,
                seed=seed,
            )
            lower = np.clip(np.searchsorted(levels, room.roughness) - 1, 0, len(levels) - 2)
            t = ((room.roughness - levels[lower]) / (levels[lower + 1] - levels[lower]))[:, None]
            at_r = [(1 - t) * s[rows, lower] + t * s[rows, lower + 1] for s in (s0, s1)]
            kept.append(brdf.compose(kd, ks, diffuse, *at_r))
    for number, bias, error in bias_over(composed, rendered, room.object, seeds):
        assert abs(bias) < 4 * error + 1e-3 and error < 8e-3, number
    assert abs(np.mean(composed) / np.mean(rendered) - 1) < 5e-3
    assert abs(np.mean(interpolated) / np.mean(rendered) - 1) < 5e-3


def test_transport_matrix_reproduces_reflected_radiance(T, room):
    seeds, products, rendered = 4, [], []
    for seed in range(seeds):
        matrix, cached = T.transport_matrix(
            room.geometry,
            room.material,
            room.points,
            room.normals,
            room.wo,
            room.base_color,
            room.roughness,
            room.metallic,
            room.group,
            2,
            room.side,
            128,
            5,
            seed=seed,
        )
        assert matrix.shape == (len(room.points), 2, 3) and not cached.any() and (matrix >= 0).all()
        products.append(np.einsum("ngc,gc->nc", matrix, ROOM_RADIANCE))
        rendered.append(room.render(T, 128, seed=50 + seed))  # no visible emission: those pixels were left out
    for number, bias, error in bias_over(products, rendered, room.object, seeds):
        assert abs(bias) < 4 * error + 1e-3 and error < 8e-3, number


def constant_cache(T, value, low=(-6, -6, -1), count=26):
    """A cache that covers everything with one radiance."""
    axis = np.arange(count)
    ijk = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    return T.RadianceCache(0.5, low, ijk, np.tile(np.asarray(value, np.float32), (len(ijk), 1)))


def test_constant_cache_in_a_closed_room_is_a_furnace(T, room):
    dark = T.Emitters(room.geometry, np.zeros((len(room.faces), 3)))
    pick = slice(0, None, 3)
    levels = [0.1, 0.9]
    cache = constant_cache(T, (2, 1, 0))
    diffuse, s0, s1 = T.shading_caches(
        room.geometry,
        room.material,
        dark,
        room.points[pick],
        room.normals[pick],
        room.wo[pick],
        levels,
        64,
        1,
        0,
        cache=cache,
    )
    assert_mean(diffuse[:, 0], 2)
    assert_mean(diffuse[:, 1], 1)
    assert not diffuse[:, 2].any()  # in the table with radiance 0: black, not a miss
    matrix, h = T.transport_matrix(
        room.geometry,
        room.material,
        room.points[pick],
        room.normals[pick],
        room.wo[pick],
        room.base_color[pick],
        room.roughness[pick],
        room.metallic[pick],
        np.full(len(room.faces), -1),
        0,
        None,
        64,
        1,
        0,
        cache=cache,
    )
    assert matrix.shape == (len(diffuse), 0, 3)
    walls = room.object[pick] == 0
    kd, ks = brdf.kd_ks(room.base_color[pick], room.metallic[pick, None])
    expected = brdf.compose(kd, ks, diffuse, s0[:, 1], s1[:, 1])
    assert_mean((h - expected)[walls, 0], 0)
    seen = T.render(room.geometry, room.material, dark, room.origin, room.directions[pick], 64, 1, 0, cache=cache)
    assert_mean(seen[:, 0] - h[:, 0], 0)  # the primary hit is shaded with its material, never cached
    assert_mean(seen[:, 1] - h[:, 1], 0)
    assert seen[:, 0].mean() < 1.7 and not seen[:, 2].any()


def test_empty_cache_and_missing_voxels_trace_on(T, room):
    none = room.render(T, 4, seed=1)
    for cache in (
        T.RadianceCache(0.1, (0, 0, 0), np.zeros((0, 3)), np.zeros((0, 3))),
        T.RadianceCache(0.1, (50, 50, 50), [[0, 0, 0]], [[9, 9, 9]]),
    ):
        assert np.array_equal(none, room.render(T, 4, seed=1, cache=cache))


def test_true_radiance_cache_replaces_the_tail_of_the_paths(T):
    """Nearly Lambertian room: cache = radiance traced along wall normals; one bounce + cache equals eight
    bounces."""
    shell = box((0, 0, 0), (2, 2, 2), inward=True)
    light = quad((0.7, 0.7, 1.98), (0, 0.6, 0), (0.6, 0, 0))
    vertices, faces, ids = merge([shell, light])
    geometry = T.build_geometry(vertices, faces, ids)
    grey, _ = lambertian(0.6)

    def material(point, face, object_id, active):
        import drjit as dr
        import mitsuba as mi

        colour, roughness, metallic = grey(point, face, object_id, active)
        return (
            dr.select(object_id == 1, mi.Color3f(0), colour),
            roughness,
            dr.select(object_id == 1, 1, metallic),
        )

    emitters = T.Emitters(geometry, np.where(ids[:, None] == 1, [5.0, 5, 5], 0.0), np.where(ids == 1, 1, 0))
    edge, origin = 0.1, np.array([-0.05, -0.05, -0.05], np.float32)
    centre = np.array([0.025, *np.arange(1, 20) * edge, 1.975])  # of each voxel's part inside the room
    points, inward = [], []
    for axis in range(3):
        for wall, sign in ((0.0, 1.0), (2.0, -1.0)):
            u, v = (g.ravel() for g in np.meshgrid(centre, centre))
            p = np.zeros((len(u), 3))
            p[:, axis], p[:, (axis + 1) % 3], p[:, (axis + 2) % 3] = wall, u, v
            n = np.zeros((len(u), 3))
            n[:, axis] = sign
            points.append(p)
            inward.append(n)
    points, inward = np.concatenate(points), np.concatenate(inward)
    tilted = inward + np.array([0.31, 0.17, 0.23]) * (inward == 0)
    radiance = T.render(geometry, material, emitters, points + 1e-3 * tilted, -tilted, 128, 9, seed=2)
    keys = cells.pack_keys(cells.voxel_indices(points, edge, origin))
    unique, row = np.unique(keys, return_inverse=True)
    mean = np.stack([np.bincount(row, radiance[:, c]) for c in range(3)], -1) / np.bincount(row)[:, None]
    cache = T.RadianceCache(edge, origin, cells.unpack_keys(unique)[0], mean)

    rng = np.random.default_rng(0)
    d = rng.normal(size=(4000, 3))
    d[:, 2] = -np.abs(d[:, 2])
    start = np.array([1.03, 0.96, 1.2])
    full = T.render(geometry, material, emitters, start, d, 64, 9, seed=3)
    short = T.render(geometry, material, emitters, start, d, 64, 1, seed=4, cache=cache)
    without = T.render(geometry, material, emitters, start, d, 64, 1, seed=4)
    assert short.mean() == pytest.approx(full.mean(), rel=0.01)
    assert without.mean() < 0.8 * full.mean()


def test_reruns_chunks_and_threads_do_not_change_a_bit(T, room):
    import drjit as dr

    pick = np.arange(0, len(room.points), 2)
    levels = [0.02, 0.3, 1.0]

    def everything(chunk):
        parts = (room.points[pick], room.normals[pick], room.wo[pick])
        du = np.float32([1 / 26, 0, 0])
        rendered = T.render(
            room.geometry,
            room.material,
            room.emitters,
            room.origin,
            room.directions[pick],
            8,
            4,
            9,
            jitter=(du, du),
            chunk=chunk,
            cache=constant_cache(T, (1, 2, 3), low=(-6, -6, -3), count=12),
        )
        caches = T.shading_caches(room.geometry, room.material, room.emitters, *parts, levels, 8, 4, 9, chunk=chunk)
        matrix = T.transport_matrix(
            room.geometry,
            room.material,
            *parts,
            room.base_color[pick],
            room.roughness[pick],
            room.metallic[pick],
            room.group,
            2,
            room.side,
            8,
            4,
            9,
            chunk=chunk,
        )
        return b"".join(a.tobytes() for a in (rendered, *caches, *matrix))

    first = everything(1 << 18)
    assert first == everything(1 << 18)
    assert first == everything(333)
    dr.set_thread_count(1)
    try:
        assert first == everything(1 << 18)
    finally:
        dr.set_thread_count(2)


def test_lanes_and_seeds_are_independent(T, room):
    n = 4000
    same = (repeated(room.origin, n), repeated(room.directions[len(room.directions) // 2], n))

    def run(seed):
        return T.render(room.geometry, room.material, room.emitters, *same, 1, 5, seed)[:, 0].astype(np.float64)

    a, b, c = run(0), run(1), run(2**63 + 1)
    assert len(np.unique(a)) > 0.5 * n
    for left, right in ((a, b), (a, c), (b, c), (a[:-1], a[1:]), (a[:-2], a[2:])):
        assert abs(np.corrcoef(left, right)[0, 1]) < 4 / np.sqrt(n)


def test_jitter_is_a_box_filter_over_the_pixel(T):
    """One pixel over an edge between a bright and a dark half: the mean is the covered share."""
    geometry = T.build_geometry(*quad((0.2, -9, 2), (9, 0, 0), (0, 18, 0)), np.zeros(2, np.int32))
    emitters = T.Emitters(geometry, np.ones((2, 3)))
    black = T.FaceMaterials(np.tile([0, 0, 0, 1, 1.0], (2, 1)))
    n = 2000
    # At depth 2 the pixel of width 1 spans x in [-1, 1] (centre 0): 40 % lies beyond x = 0.2.
    seen = T.render(
        geometry,
        black,
        emitters,
        repeated((0, 0, 0), n),
        repeated((0, 0, 1), n),
        16,
        0,
        0,
        jitter=((1, 0, 0), (0, 1, 0)),
    )
    assert_mean(seen[:, 0], 0.4)
    wide = T.render(
        geometry,
        black,
        emitters,
        repeated((0, 0, 0), n),
        repeated((3, 0, 5), n),
        16,
        0,
        0,
        jitter=((3, 0, 0), (0, 1, 0)),
    )  # un-normalised direction: x/z in 2 * [0.3, 0.9] - all but nothing below 0.1
    assert (wide == 1).all()


def test_trace_agrees_with_open3d(T, room):
    open3d = pytest.importorskip("open3d")
    rng = np.random.default_rng(1)
    origins = rng.uniform((0.1, 0.1, 0.1), (3.9, 2.9, 2.4), (20000, 3)).astype(np.float32)
    directions = (rng.normal(size=(20000, 3)) * rng.uniform(0.1, 5, (20000, 1))).astype(np.float32)
    face, t = T.trace(room.geometry, origins, directions, chunk=7001)
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(open3d.core.Tensor(room.vertices.astype(np.float32)), open3d.core.Tensor(room.faces.astype(np.uint32)))
    other = scene.cast_rays(open3d.core.Tensor(np.concatenate([origins, directions], 1)))
    assert np.mean(face == other["primitive_ids"].numpy().astype(np.int64)) > 0.9995
    np.testing.assert_allclose(t, other["t_hit"].numpy(), rtol=1e-4)
    missed, far = T.trace(room.geometry, [[9, 9, 9]], [[1, 0, 0]])
    assert missed.tolist() == [-1] and np.isinf(far).all()
    empty = T.trace(room.geometry, np.zeros((0, 3)), np.zeros((0, 3)))
    assert empty[0].dtype == np.int32 and empty[0].shape == empty[1].shape == (0,)


def test_degenerate_faces_keep_their_ids(T):
    vertices, faces = quad((-1, -1, 0), (2, 0, 0), (0, 2, 0))
    vertices = np.concatenate([vertices, [[0, 0, 0.5], [0.5, 0, 0.5], [1, 0, 0.5]]])  # a sliver without area
    faces = np.array([[4, 5, 6], faces[0], [4, 4, 5], faces[1]])
    geometry = T.build_geometry(vertices, faces, np.arange(4))
    assert geometry.areas.tolist() == [0, 2, 0, 2]
    assert np.allclose(np.linalg.norm(geometry.normals, axis=1), 1)
    face, t = T.trace(geometry, [[0.5, -0.5, 1], [-0.5, 0.5, 1], [0.25, 0, 1]], repeated((0, 0, -1), 3))
    assert face[:2].tolist() == [1, 3] and face[2] in (1, 3) and np.allclose(t, 1)
    emitters = T.Emitters(geometry, np.ones((4, 3)))
    assert set(emitters.slots) == {1, 3} and emitters.pdf_area[[0, 2]].tolist() == [0, 0]
    colours = T.FaceMaterials(np.tile([0.5, 0.5, 0.5, 0.5, 0], (4, 1)))
    assert np.isfinite(T.render(geometry, colours, emitters, [0, 0, 1], repeated((0.1, 0, -1), 5), 8, 3, 0)).all()


def test_light_slots_have_the_density_they_report(T):
    rng = np.random.default_rng(0)
    parts = [quad((x, 0, 0), (w, 0, 0), (0, 1, 0)) for x, w in enumerate(rng.uniform(0.01, 0.9, 40))]
    geometry = T.build_geometry(*merge(parts))
    weight = np.where(np.arange(80) % 3 == 0, 0, rng.uniform(0, 1, 80) ** 8)
    emitters = T.Emitters(geometry, np.zeros((80, 3)), sampling_weight=weight)
    counts = np.bincount(emitters.slots, minlength=80)
    np.testing.assert_allclose(emitters.pdf_area * geometry.areas, counts / len(emitters.slots), rtol=1e-6)
    assert ((counts > 0) == (weight > 0)).all() and counts.sum() == len(emitters.slots)
    assert np.abs(counts / counts.sum() - weight / weight.sum()).max() < 80 / len(emitters.slots)
    assert np.sum(emitters.pdf_area * geometry.areas) == pytest.approx(1)


def test_sampling_weights_do_not_change_the_mean(T, room):
    n, direction = 6000, room.directions[len(room.directions) // 2]
    means = []
    for weight in (None, room.geometry.areas, np.where(room.group == 0, 1.0, 0.0), np.zeros(len(room.faces))):
        emitters = T.Emitters(room.geometry, room.radiance, room.side, sampling_weight=weight)
        seen = T.render(room.geometry, room.material, emitters, repeated(room.origin, n), repeated(direction, n), 32, 3, 4)
        means.append((seen[:, 0].mean(), seen[:, 0].std() / np.sqrt(n)))
    for mean, error in means[1:]:
        assert abs(mean - means[0][0]) < 3.5 * np.hypot(error, means[0][1])


def test_cell_materials_read_what_numpy_reads(T, room):
    import mitsuba as mi

    edge = 0.11
    origin = cells.grid_origin(room.vertices, edge)
    ijk = cells.voxel_indices(room.points, edge, origin)
    keys = np.unique(cells.pack_keys(ijk, room.object))[::2]  # half of the cells were never seen
    rng = np.random.default_rng(3)
    values = rng.uniform(0, 1, (len(keys), 5)).astype(np.float32)
    values[:10, 3] = 0  # below the smallest roughness
    means = rng.uniform(0.1, 1, (3, 5)).astype(np.float32)
    material = T.CellMaterials(edge, origin, *cells.unpack_keys(keys), values, means)
    objects = np.where(np.arange(len(ijk)) % 50 == 0, -1, room.object).astype(np.int32)
    far = np.array([[1e9, 0, 0], [-1e9, 0, 0], [2, 1, 1e4]], np.float32)
    points = np.concatenate([room.points, far]).astype(np.float32)
    objects = np.concatenate([objects, [0, 1, 2]]).astype(np.int32)
    color, roughness, metallic = material(mi.Point3f(points.T), mi.UInt32(0), mi.Int32(objects), mi.Bool(True))
    got = np.column_stack([color.numpy().T, roughness.numpy(), metallic.numpy()])

    table = cells.CellTable.build(keys)
    row = np.append(table.lookup(cells.pack_keys(ijk, objects[: len(ijk)])), [-1, -1, -1])
    fallback = np.where(objects[:, None] >= 0, means[objects], means.mean(0))
    coarse_ijk, coarse_object, coarse = cells.coarse_cells(*cells.unpack_keys(keys), values)
    around = cells.CellTable.build(cells.pack_keys(coarse_ijk, coarse_object))
    near = np.append(around.lookup(cells.pack_keys(ijk >> cells.COARSE_SHIFT, objects[: len(ijk)])), [-1, -1, -1])
    assert 0 < np.mean((row < 0) & (near >= 0)) < np.mean(row < 0)  # all three roads are taken
    fallback = np.where(near[:, None] >= 0, coarse[near], fallback)
    expected = np.where(row[:, None] >= 0, values[row], fallback)
    expected[:, 3] = np.maximum(expected[:, 3], brdf.R_MIN)
    assert 0.2 < np.mean(row >= 0) < 0.8
    np.testing.assert_array_equal(got, expected.astype(np.float32))
    assert np.isfinite(room.render(T, 2, seed=0)).all()
    rendered = T.render(room.geometry, material, room.emitters, room.origin, room.directions, 2, 3, 0)
    assert np.isfinite(rendered).all() and rendered.mean() > 0


def test_extremes_are_finite(T, room):
    mirror = T.FaceMaterials(np.tile([0, 0, 0, 0, 1.0], (len(room.faces), 1)))  # black metal, r clamped to 0.02
    bright = T.Emitters(room.geometry, room.radiance * 1e6, room.side)
    grazing = room.normals * 1e-6 + np.cross(room.normals, (0.3, 0.5, 0.8))
    behind = np.cross(room.normals, (0.3, 0.5, 0.8))
    some = slice(0, 300)
    for material in (mirror, room.material):
        for wo in (grazing, behind, room.wo):
            caches = T.shading_caches(
                room.geometry,
                material,
                bright,
                room.points[some],
                room.normals[some],
                wo[some],
                [0.02, 1],
                8,
                6,
                0,
            )
            matrix = T.transport_matrix(
                room.geometry,
                material,
                room.points[some],
                room.normals[some],
                wo[some],
                np.zeros((300, 3)),
                np.zeros(300),
                np.ones(300),
                room.group,
                2,
                room.side,
                8,
                6,
                0,
            )
            for value in (*caches, *matrix):
                assert np.isfinite(value).all() and (value >= 0).all()
        assert np.isfinite(T.render(room.geometry, material, bright, room.origin, room.directions, 4, 12, 0)).all()
    dark = T.Emitters(room.geometry, np.zeros((len(room.faces), 3)))
    assert not T.render(room.geometry, room.material, dark, room.origin, room.directions, 2, 4, 0).any()


def test_far_from_the_origin_nothing_shadows_itself(T):
    """At 5 km a float32 hit is off by 5e-4 m: the offset along the normal must grow with it (METHOD H24)."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_euler("xyz", (0.4, 0.7, 1.1)).as_matrix()
    corners, faces = box((-1, -1, -1), (1, 1, 1), inward=True)
    directions = np.random.default_rng(0).normal(size=(3000, 3))
    material, rho = lambertian(0.5)
    seen = []
    for shift in (np.zeros(3), np.array([5000.0, -4000, 3000])):
        geometry = T.build_geometry(corners @ turn.T + shift, faces, np.zeros(12, np.int32))
        emitters = T.Emitters(geometry, np.ones((12, 3)), np.ones(12), sampling_weight=np.zeros(12))
        seen.append(T.render(geometry, material, emitters, shift, directions, 32, 1, 0)[:, 0])
    assert 1 + rho < seen[0].mean() < 1 + rho + 0.01
    assert seen[1].mean() == pytest.approx(seen[0].mean(), rel=5e-3)


def test_bad_input_is_named(T, room):
    square = quad((0, 0, 0), (1, 0, 0), (0, 1, 0))
    with pytest.raises(InputError, match="no face of area"):
        T.build_geometry(np.zeros((3, 3)), [[0, 1, 2]], [0])
    with pytest.raises(InputError, match="vertices 0 ... 9"):
        T.build_geometry(square[0], [[0, 1, 9]], [0])
    with pytest.raises(InputError, match="NaN"):
        T.build_geometry(np.full((4, 3), np.nan), square[1], [0, 0])
    with pytest.raises(InputError, match="one id for each face"):
        T.build_geometry(*square, [0])
    geometry = T.build_geometry(*square, [0, 0])
    with pytest.raises(InputError, match="never negative"):
        T.Emitters(geometry, -np.ones((2, 3)))
    with pytest.raises(InputError, match="side"):
        T.Emitters(geometry, np.ones((2, 3)), [2, 0])
    with pytest.raises(InputError, match="NaN"):
        T.FaceMaterials(np.full((2, 5), np.nan))
    with pytest.raises(InputError, match="roughness levels"):
        T.shading_caches(
            room.geometry,
            room.material,
            room.emitters,
            room.points,
            room.normals,
            room.wo,
            [0.5, 0.1],
            1,
            1,
            0,
        )
    with pytest.raises(InputError, match="samples=0"):
        room.render(T, 0, seed=0)
    with pytest.raises(InputError, match="zero vector"):
        T.render(room.geometry, room.material, room.emitters, [0, 0, 0], np.zeros((1, 3)), 1, 1, 0)
    with pytest.raises(InputError, match="emitter_of_face"):
        T.transport_matrix(
            room.geometry,
            room.material,
            room.points,
            room.normals,
            room.wo,
            room.base_color,
            room.roughness,
            room.metallic,
            room.group,
            1,
            room.side,
            1,
            1,
            0,
        )
    none = np.zeros((0, 3), np.float32)
    assert T.render(room.geometry, room.material, room.emitters, none, none, 1, 1, 0).shape == (0, 3)
    assert T.shading_caches(room.geometry, room.material, room.emitters, none, none, none, [0.5], 1, 1, 0)[1].shape == (0, 1, 3)
