"""Light gathered from photographed surface: a room with an answer, form factors, the parts on their own."""

import numpy as np
import pytest

from iif_core.light import irradiance
from iif_core.light.irradiance import SurfaceCellsBuilder, estimate_log_light, fit_light, gather, residual_light
from tests.errors import refused

EDGE = 0.125
N = 8
"""Cells along an edge of the unit cube."""


def trace_cube(origins, directions):
    """The inside of the unit cube."""
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.where(directions > 0, (1 - origins) / directions, np.where(directions < 0, -origins / directions, np.inf))
    return np.zeros(len(t), int), t.min(1)


def cube():
    """Centres and inward normals of the patches of the unit cube, and the wall of each (6 * N * N)."""
    u, v = (g.ravel() for g in np.meshgrid(*[(np.arange(N) + 0.5) / N] * 2))
    points, normals = [], []
    for axis in range(3):
        for end in (0.0, 1.0):
            p = np.insert(np.stack([u, v], 1), axis, end, axis=1)
            points.append(p)
            normals.append(np.tile(np.eye(3)[axis] * (1 - 2 * end), (len(p), 1)))
    return np.concatenate(points), np.concatenate(normals), np.repeat(np.arange(6), N * N)


def radiosity(points, normals, albedo, emission):
    """(n, 3) radiance of diffuse patches of area 1 / N^2: L = E + albedo F L, form factors between centres, rows sum to 1."""
    way = points[None] - points[:, None]
    square = np.maximum((way**2).sum(-1), 1e-9)
    cosines = np.maximum(np.einsum("ijk,ik->ij", way, normals), 0) * np.maximum(-np.einsum("ijk,jk->ij", way, normals), 0)
    factor = cosines / square**2
    np.fill_diagonal(factor, 0)
    factor /= factor.sum(1, keepdims=True)
    return np.stack([np.linalg.solve(np.eye(len(points)) - albedo[:, c, None] * factor, emission[:, c]) for c in range(3)], 1)


def cells_of(points, normals, group, radiance, saturated):
    """Four pixels a patch."""
    builder = SurfaceCellsBuilder(np.array([[0, 0, 0], [1, 1, 1.0]]), EDGE)
    inner = np.clip(points + 1e-4 * normals, 1e-6, 1 - 1e-6)
    for dx in (-0.2, 0.2):
        for dy in (-0.2, 0.2):
            tangent = np.roll(np.abs(normals), 1, 1) * dx + np.roll(np.abs(normals), 2, 1) * dy
            builder.add(inner + tangent * EDGE, normals, group, radiance, saturated, 1.0)
    return builder.finish()


def test_furnace():
    """Everything has radiance 0.5: so has the light, and everything is white, but for the weak prior of the albedo."""
    points, normals, wall = cube()
    cells = cells_of(points, normals, wall, np.full((len(points), 3), 0.5), np.zeros(len(points), bool))
    found = gather(cells, trace_cube)
    np.testing.assert_allclose(found.known, 0.5, rtol=0.02)
    light, albedo = fit_light(cells, found, 0.4)
    np.testing.assert_allclose(np.exp(light), 0.5, rtol=0.02)
    np.testing.assert_allclose(np.exp(albedo), 1.0, atol=0.1)


def test_cells_that_see_nothing_are_nearly_dark():
    points, normals, wall = cube()
    cells = cells_of(points, normals, wall, np.full((len(points), 3), 0.5), np.zeros(len(points), bool))
    found = gather(cells, trace_cube)
    dark = np.arange(len(cells)) % 3 == 0
    found.known[dark], found.share[dark] = 0.0, 0.0
    light, albedo = fit_light(cells, found, 0.4)
    assert np.isfinite(light).all() and np.isfinite(albedo).all()
    assert light[dark].max() < light[~dark].min()


def test_lamp_of_unknown_radiance_is_found():
    """A clipped lamp on the ceiling of a room with coloured walls: the albedos come out, and no light is left inside walls."""
    points, normals, wall = cube()
    rng = np.random.default_rng(0)
    albedo = (0.2 + 0.5 * rng.random((6, 3)))[wall] * np.exp(0.1 * rng.standard_normal((len(points), 1)))
    lamp = (wall == 5) & (np.abs(points[:, 0] - 0.3) < 0.15) & (np.abs(points[:, 1] - 0.6) < 0.15)
    emission = np.where(lamp[:, None], 30.0, 0.0) * np.ones(3)
    radiance = radiosity(points, normals, albedo, emission)
    photographed = np.minimum(radiance, 3.0)
    cells = cells_of(points, normals, np.where(lamp, 6, wall), photographed, lamp)
    light, _ = fit_light(cells, gather(cells, trace_cube), 0.4)
    clear = cells.pixels > 0
    key = {tuple(np.round(p, 2)): i for i, p in enumerate(points)}
    centre = np.round(np.round(cells.points * N - 0.5) / N + 0.5 / N, 2)  # of the patch, along its wall
    across = np.abs(cells.normals) > 0.5
    row = np.array([key[tuple(p)] for p in np.where(across, cells.points > 0.5, centre)])
    found, truth = np.exp(cells.log_radiance - light)[clear], albedo[row][clear]
    before = np.log(photographed[row][clear] / truth)
    after = np.log(found / truth)
    group = cells.group[clear]

    def inside(x):
        return np.sqrt(np.mean(np.concatenate([(x[group == g] - x[group == g].mean(0)) ** 2 for g in range(6)])))

    assert inside(after) < 0.35 * inside(before)
    assert np.abs(after.mean()) < 0.25  # the scale comes from light that was photographed on its way


def test_form_factor_of_a_far_patch():
    """Patch of area A at height h above a cell, facing it: A / (pi h^2)."""
    builder = SurfaceCellsBuilder(np.array([[0, 0, 0], [4, 4, 4.0]]), 0.1)
    points, normals = np.array([[2, 2, 0], [2, 2, 2.0]]), np.array([[0, 0, 1], [0, 0, -1.0]])
    builder.add(points, normals, np.array([0, 1]), np.ones((2, 3)), np.array([False, True]), 1.0)
    cells = builder.finish()
    lamp, floor = int(np.argmax(cells.points[:, 2])), int(np.argmin(cells.points[:, 2]))

    def trace(origins, directions):
        return np.zeros(len(origins), int), np.full(len(origins), 1.0)

    found = irradiance._form_factor(cells, np.array([lamp]), cells.points, trace, np.random.default_rng(0))
    assert found[floor] == pytest.approx(0.01 / (np.pi * 4), rel=1e-3)
    assert found[lamp] == 0

    def blocked(origins, directions):
        return np.zeros(len(origins), int), np.full(len(origins), 0.5)

    assert not irradiance._form_factor(cells, np.array([lamp]), cells.points, blocked, np.random.default_rng(0)).any()


def test_rays_that_leave_and_unseen_surface_are_unknown_light():
    builder = SurfaceCellsBuilder(np.array([[0, 0, 0], [1, 1, 1.0]]), 0.1)
    n = 40
    rng = np.random.default_rng(0)
    points = np.c_[rng.random((n, 2)), np.zeros(n)]
    builder.add(points, np.tile([0, 0, 1.0], (n, 1)), np.zeros(n, int), np.full((n, 3), 0.3), np.zeros(n, bool), 1.0)
    cells = builder.finish()
    out = gather(cells, lambda o, d: (np.full(len(o), -1), np.full(len(o), np.inf)))
    assert not out.known.any() and not out.share[:, -1].any()
    np.testing.assert_allclose(out.share.sum(1), 1)
    unseen = gather(cells, lambda o, d: (np.zeros(len(o), int), np.full(len(o), 1e6)))
    np.testing.assert_allclose(unseen.share[:, -1], 1)
    light, albedo = fit_light(cells, out, 0.4)
    assert np.isfinite(light).all() and np.isfinite(albedo).all()


def test_residual_light_takes_slow_changes_and_leaves_texture():
    points, normals, wall = cube()
    cells = cells_of(points, normals, wall, np.ones((len(points), 3)), np.zeros(len(points), bool))
    slow = 0.5 * np.cos(np.pi * cells.points[:, :1]) * np.ones(3)
    texture = 0.3 * np.random.default_rng(0).choice([-1, 1], len(cells))[:, None] * np.ones(3)
    found = residual_light(cells, slow + texture, 0.25)
    varies = np.abs(cells.normals[:, 0]) < 0.5  # elsewhere `slow` is one number a wall
    assert np.corrcoef(found[varies, 0], slow[varies, 0])[0, 1] > 0.9
    assert np.std((slow + texture - found)[varies]) > 0.7 * 0.3


def test_cells_do_not_depend_on_how_pixels_come_and_grow_when_there_are_many(monkeypatch):
    points, normals, wall = cube()
    radiance = np.random.default_rng(0).random((len(points), 3)) + 0.1
    dark = np.zeros(len(points), bool)
    whole, parts = (SurfaceCellsBuilder(np.array([[0, 0, 0], [1, 1, 1.0]]), EDGE) for _ in range(2))
    whole.add(points, normals, wall, radiance, dark, 1.0)
    for part in np.array_split(np.arange(len(points)), 3):
        parts.add(points[part], normals[part], wall[part], radiance[part], dark[part], 1.0)
    first, second = whole.finish(), parts.finish()
    np.testing.assert_allclose(first.log_radiance, second.log_radiance, atol=1e-12)
    np.testing.assert_array_equal(first.voxel_key, second.voxel_key)
    monkeypatch.setattr(irradiance, "MAX_CELLS", 120)
    small = SurfaceCellsBuilder(np.array([[0, 0, 0], [1, 1, 1.0]]), EDGE)
    small.add(points, normals, wall, radiance, dark, 1.0)
    cells = small.finish()
    assert len(cells) <= 120 and cells.edge > EDGE and cells.pixels.sum() == len(points)


def test_same_bytes_twice_and_nothing_from_nothing():
    points, normals, wall = cube()
    cells = cells_of(points, normals, wall, np.random.default_rng(1).random((len(points), 3)), np.zeros(len(points), bool))
    first, second = (estimate_log_light(cells, gather(cells, trace_cube, 3), 0.4, (3.0,)) for _ in range(2))
    np.testing.assert_array_equal(first, second)
    with refused("edge", "0.0"):
        SurfaceCellsBuilder(points, 0.0)
