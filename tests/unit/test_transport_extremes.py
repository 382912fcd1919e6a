"""Light transport at its limits: finite, bounded, and equal to a closed form where there is one (docs/method/numerics.md)."""

import numpy as np
import pytest

from iif_core.reflectance import brdf


def quad(corner, edge1, edge2):
    c, a, b = (np.asarray(v, np.float32) for v in (corner, edge1, edge2))
    return np.array([c, c + a, c + a + b, c + b])


def box(size):
    """Room from the origin, 12 faces, normals inwards."""
    x, y, z = size
    walls = [
        quad((0, 0, 0), (x, 0, 0), (0, y, 0)),
        quad((0, 0, z), (0, y, 0), (x, 0, 0)),
        quad((0, 0, 0), (0, 0, z), (x, 0, 0)),
        quad((0, y, 0), (x, 0, 0), (0, 0, z)),
        quad((0, 0, 0), (0, y, 0), (0, 0, z)),
        quad((x, 0, 0), (0, 0, z), (0, y, 0)),
    ]
    return np.concatenate(walls), faces_of(6)


def faces_of(quads):
    return (4 * np.arange(quads)[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)


def materials(T, count, color, roughness, metallic):
    return T.FaceMaterials(np.tile(np.float32([*np.broadcast_to(color, 3), roughness, metallic]), (count, 1)))


def floor_points(n, seed=0):
    rng = np.random.default_rng(seed)
    points = np.c_[rng.uniform(0.3, 1.7, (n, 2)), np.zeros(n)].astype(np.float32)
    normals = np.tile(np.float32([0, 0, 1]), (n, 1))
    return points, normals


def check(values, most=np.inf):
    for value in values:
        assert np.isfinite(value).all() and (value >= 0).all() and value.max(initial=0) <= most


def reflected(T, geometry, material, emitters, rough, metal, color, wo=(0.6, 0, 0.8), bounces=6, samples=32, n=400):
    """Radiance of floor points by caches and by the matrix; both finite and not negative."""
    points, normals = floor_points(n)
    wo = np.tile(np.float32(wo), (n, 1))
    scene = T.Scene(geometry, material, emitters)
    diffuse, s0, s1 = T.shading_caches(scene, points, normals, wo, [rough], T.PathOptions(samples, bounces, 1))
    check((diffuse, s0, s1))
    kd, ks = brdf.kd_ks(np.broadcast_to(color, 3), metal)
    composed = brdf.compose(kd, ks, diffuse, s0[:, 0], s1[:, 0])
    group = np.where(emitters.radiance.any(1), 0, -1)
    columns = np.zeros((1, 1), int) if emitters.environment.any() else None
    own = np.tile(np.float32(color), (n, 3 // np.size(color))).reshape(n, 3), np.full(n, rough), np.full(n, metal)
    found = T.EmitterColumns(group, 1, emitters.side, columns)
    matrix, h = T.transport_matrix(scene, T.ShadingPoints(points, normals, wo, *own), found, T.PathOptions(samples, bounces, 2))
    check((matrix, h))
    matrix, h = matrix.sum(1), h.sum(1)
    return composed, matrix


@pytest.mark.parametrize("rough", [0.02, 1.0])
@pytest.mark.parametrize(("metal", "color"), [(0.0, 0.8), (1.0, 0.0), (1.0, 1.0)])
@pytest.mark.parametrize("wo", [(0, 0, 1), (1, 0, 1e-6), (1, 0, 0)])
def test_sharpest_roughest_black_and_grazing(T, rough, metal, color, wo):
    vertices, faces = box((2, 2, 2))
    geometry = T.build_geometry(vertices, faces, np.zeros(12))
    lamp = np.where(np.arange(12)[:, None] // 2 == 1, np.float32([5, 5, 5]), 0)
    emitters = T.Emitters(geometry, lamp, np.ones(12))
    composed, matrix = reflected(
        T,
        geometry,
        materials(T, 12, color, rough, metal),
        emitters,
        rough,
        metal,
        color,
        np.add(wo, (0, 0, 0)),
        n=100,
        samples=16,
    )
    # A lobe returns at most 1.04 of what arrives (docs/method/reflectance.md#energy), and nothing inside is brighter than the
    # closed room of the lamp.
    assert composed.mean() <= 5 * 1.1 / (1 - 0.9) and matrix.mean() <= 1.1 / (1 - 0.9)
    if wo == (1, 0, 0):
        assert not matrix.any()  # NoV = 0 counts as a miss: docs/method/numerics.md#grazing-directions


def test_white_closed_room_converges_to_its_series(T):
    """Walls that reflect rho = 0.98 of what arrives and shine: L = E / (1 - rho) after infinitely many bounces."""
    import mitsuba as mi

    vertices, faces = box((2, 1, 1.5))
    geometry = T.build_geometry(vertices, faces, np.zeros(12))
    rho = 0.98
    base = (rho + np.sqrt(rho * rho - 0.16 * rho)) / 2  # with the metallic that takes k_s to 0 and k_d to rho
    metal = -0.04 / (base - 0.04)
    assert (1 - metal) * base == pytest.approx(rho) and 0.04 * (1 - metal) + metal * base == pytest.approx(0, abs=1e-9)

    def grey(point, face, object_id, active):
        return mi.Color3f(base), mi.Float(1), mi.Float(metal)

    emitters = T.Emitters(geometry, np.full((12, 3), 0.1), np.ones(12), sampling_weight=np.zeros(12))
    n = 600
    origin, way = np.tile(np.float32([0.9, 0.4, 0.7]), (n, 1)), np.random.default_rng(0).normal(size=(n, 3))
    means = []
    for bounces in (1, 20, 60, 400):
        seen = T.render(T.Scene(geometry, grey, emitters), origin, way, T.PathOptions(16, bounces, 3))
        check((seen,), 0.1 * 1.06 * (bounces + 1) * 20)
        partial = 0.1 * (1 - rho ** (bounces + 1)) / (1 - rho)
        # The grazing remainder of the lobe adds 0 ... 0.4 % of albedo.
        most = 0.1 * (1 - (rho + 0.004) ** (bounces + 1)) / (1 - rho - 0.004)
        error = 3 * seen[:, 0].std() / np.sqrt(n)
        assert partial - error < seen[:, 0].mean() < most + error, bounces
        means.append(seen[:, 0].mean())
    assert means[0] < 0.2 and (np.diff(means) > 0).all() and means[-1] > 4.5


def test_one_tiny_lamp_of_a_million(T):
    vertices, faces = box((2, 2, 2))
    tiny = quad((1, 1, 1.99), (0, 1e-3, 0), (1e-3, 0, 0))
    geometry = T.build_geometry(np.concatenate([vertices, tiny]), faces_of(7), np.zeros(14))
    lamp = np.where(np.arange(14)[:, None] >= 12, np.float32([1e6, 1e6, 1e6]), 0)
    emitters = T.Emitters(geometry, lamp, np.where(np.arange(14) >= 12, 1, 0))
    dark = materials(T, 14, 0.0, 1.0, 1.0)
    points, normals = np.float32([[1, 1, 0]] * 200), np.float32([[0, 0, 1]] * 200)
    diffuse, _, _ = T.shading_caches(T.Scene(geometry, dark, emitters), points, normals, normals, [], T.PathOptions(16, 1, 0))
    # E = L A cos cos / d^2, D = E / pi: a point light straight above.
    np.testing.assert_allclose(diffuse.mean(), 1e6 * 1e-6 / 1.99**2 / np.pi, rtol=1e-2)
    assert diffuse.std() < 0.02 * diffuse.mean()  # drawn, not found by chance
    grey = materials(T, 14, 0.6, 0.5, 0.0)
    composed, matrix = reflected(T, geometry, grey, emitters, 0.5, 0.0, 0.6, n=200)
    np.testing.assert_allclose(composed.mean(), 1e6 * matrix.mean(), rtol=0.1)


def test_only_the_environment_through_a_hole(T):
    """A room whose ceiling is missing, black walls, sky of radiance 1: D is the sky's share of the cosine."""
    vertices, faces = box((2, 2, 2))
    faces = np.delete(faces, [2, 3], 0)
    geometry = T.build_geometry(vertices, faces, np.zeros(10))
    dark, n = materials(T, 10, 0.0, 1.0, 1.0), 300
    points, normals = np.float32([[1, 1, 0]] * n), np.float32([[0, 0, 1]] * n)
    # View factor from the middle of the floor to a square lid of the same size at distance 2 (four corner factors).
    x = 1 / 2
    corner = (1 / (2 * np.pi)) * 2 * x / np.sqrt(1 + x * x) * np.arctan(x / np.sqrt(1 + x * x))
    for sky in (np.ones(3), np.ones((8, 16, 3))):
        emitters = T.Emitters(geometry, np.zeros((10, 3)), environment=sky)
        diffuse, _, _ = T.shading_caches(
            T.Scene(geometry, dark, emitters), points, normals, normals, [], T.PathOptions(256, 2, 0)
        )
        check((diffuse,), 2)
        error = 3 * diffuse[:, 0].std() / np.sqrt(n)
        assert diffuse[:, 0].mean() == pytest.approx(4 * corner, abs=error + 1e-3)


@pytest.mark.parametrize("side", [0, 1])
def test_coincident_and_flipped_faces(T, side):
    """Every wall twice, once turned over: neither light nor darkness doubles, whichever copy a ray meets."""
    vertices, faces = box((2, 2, 2))
    twice = np.concatenate([faces, faces[:, ::-1]])
    lamp = np.arange(24)[:, None] % 12 // 2 == 1
    n, way = 500, np.random.default_rng(0).normal(size=(500, 3))
    seen = []
    for used in (faces, twice):
        count = len(used)
        geometry = T.build_geometry(vertices, used, np.zeros(count))
        radiance = np.where(lamp[:count], np.float32([1, 1, 1]), 0)
        emitters = T.Emitters(geometry, radiance, np.where(np.arange(count) < 12, side, -side))
        assert np.sum(emitters.pdf_area * geometry.areas) == pytest.approx(count / 12)  # both copies know the density
        grey = materials(T, count, 0.5, 0.9, 0.0)
        seen.append(
            T.render(T.Scene(geometry, grey, emitters), np.tile(np.float32([1, 1, 1]), (n, 1)), way, T.PathOptions(32, 8, 1))
        )
        check((seen[-1],), 20)
    assert seen[1].mean() == pytest.approx(seen[0].mean(), rel=0.04)


def test_lamp_that_is_never_seen_directly(T):
    """A lamp behind a screen: points get its light by reflection alone."""
    vertices, _ = box((2, 2, 2))
    screen = quad((0, 0, 1.5), (2, 0, 0), (0, 1.6, 0))  # light comes round its far edge
    lamp = quad((0.2, 0.2, 1.95), (0, 0.5, 0), (0.5, 0, 0))
    geometry = T.build_geometry(np.concatenate([vertices, screen, lamp]), faces_of(8), np.zeros(16))
    radiance = np.where(np.arange(16)[:, None] >= 14, np.float32([100, 100, 100]), 0)
    emitters = T.Emitters(geometry, radiance, np.where(np.arange(16) >= 14, 1, 0))
    points, normals = np.float32([[0.3, 0.3, 0]] * 400), np.float32([[0, 0, 1]] * 400)
    white = materials(T, 16, 0.7, 1.0, 0.0)
    direct, _, _ = T.shading_caches(T.Scene(geometry, white, emitters), points, normals, normals, [], T.PathOptions(16, 1, 0))
    assert not direct.any()
    full, _, _ = T.shading_caches(T.Scene(geometry, white, emitters), points, normals, normals, [], T.PathOptions(64, 12, 0))
    blind = T.Emitters(geometry, radiance, np.where(np.arange(16) >= 14, 1, 0), sampling_weight=np.zeros(16))
    brute, _, _ = T.shading_caches(T.Scene(geometry, white, blind), points, normals, normals, [], T.PathOptions(256, 12, 1))
    check((full, brute))
    error = np.hypot(full[:, 0].std(), brute[:, 0].std()) / np.sqrt(400)
    assert full.mean() > 0.05 and abs(full[:, 0].mean() - brute[:, 0].mean()) < 4 * error
