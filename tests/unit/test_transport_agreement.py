"""Light transport: different estimators of one number agree (cached shading, matrix, paths, radiance cache)."""

import numpy as np
import pytest

from iif_core.reflectance import brdf
from iif_core.surface import cells
from tests.unit.transport_rooms import ROOM_RADIANCE, assert_mean, bias_over, box, constant_cache, lambertian, merge, quad


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
                T.Scene(room.geometry, room.material, room.emitters),
                room.points,
                room.normals,
                room.wo,
                levels,
                T.PathOptions(128, 5, seed),
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
            T.Scene(room.geometry, room.material, None),
            T.ShadingPoints(room.points, room.normals, room.wo, room.base_color, room.roughness, room.metallic),
            T.EmitterColumns(room.group, 2, room.side),
            T.PathOptions(128, 5, seed),
        )
        matrix, cached = matrix.sum(1), cached.sum(1)
        assert matrix.shape == (len(room.points), 2, 3) and not cached.any() and (matrix >= 0).all()
        products.append(np.einsum("ngc,gc->nc", matrix, ROOM_RADIANCE))
        rendered.append(room.render(T, 128, seed=50 + seed))  # no visible emission: those pixels were left out
    for number, bias, error in bias_over(products, rendered, room.object, seeds):
        assert abs(bias) < 4 * error + 1e-3 and error < 8e-3, number


def test_constant_cache_in_a_closed_room_is_a_furnace(T, room):
    dark = T.Emitters(room.geometry, np.zeros((len(room.faces), 3)))
    pick = slice(0, None, 3)
    levels = [0.1, 0.9]
    cache = constant_cache(T, (2, 1, 0))
    diffuse, s0, s1 = T.shading_caches(
        T.Scene(room.geometry, room.material, dark, cache),
        room.points[pick],
        room.normals[pick],
        room.wo[pick],
        levels,
        T.PathOptions(64, 1, 0),
    )
    assert_mean(diffuse[:, 0], 2)
    assert_mean(diffuse[:, 1], 1)
    assert not diffuse[:, 2].any()  # in the table with radiance 0: black, not a miss
    matrix, h = T.transport_matrix(
        T.Scene(room.geometry, room.material, None, cache),
        T.ShadingPoints(
            room.points[pick], room.normals[pick], room.wo[pick], room.base_color[pick], room.roughness[pick], room.metallic[pick]
        ),
        T.EmitterColumns(np.full(len(room.faces), -1), 0),
        T.PathOptions(64, 1, 0),
    )
    assert matrix.shape == (len(diffuse), 2, 0, 3)
    walls = room.object[pick] == 0
    kd, ks = brdf.kd_ks(room.base_color[pick], room.metallic[pick, None])
    lobes = brdf.compose(kd, 0, diffuse, 0, 0), brdf.compose(0, ks, 0, s0[:, 1], s1[:, 1])
    for lobe, expected in enumerate(lobes):
        assert_mean((h[:, lobe] - expected)[walls, 0], 0)
    h = h.sum(1)
    seen = T.render(
        T.Scene(room.geometry, room.material, dark, cache), room.origin, room.directions[pick], T.PathOptions(64, 1, 0)
    )
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
    radiance = T.render(T.Scene(geometry, material, emitters), points + 1e-3 * tilted, -tilted, T.PathOptions(128, 9, 2))
    keys = cells.pack_keys(cells.voxel_indices(points, edge, origin))
    unique, row = np.unique(keys, return_inverse=True)
    mean = np.stack([np.bincount(row, radiance[:, c]) for c in range(3)], -1) / np.bincount(row)[:, None]
    cache = T.RadianceCache(edge, origin, cells.unpack_keys(unique)[0], mean)

    rng = np.random.default_rng(0)
    d = rng.normal(size=(4000, 3))
    d[:, 2] = -np.abs(d[:, 2])
    start = np.array([1.03, 0.96, 1.2])
    full = T.render(T.Scene(geometry, material, emitters), start, d, T.PathOptions(64, 9, 3))
    short = T.render(T.Scene(geometry, material, emitters, cache), start, d, T.PathOptions(64, 1, 4))
    without = T.render(T.Scene(geometry, material, emitters), start, d, T.PathOptions(64, 1, 4))
    assert short.mean() == pytest.approx(full.mean(), rel=0.01)
    assert without.mean() < 0.8 * full.mean()
