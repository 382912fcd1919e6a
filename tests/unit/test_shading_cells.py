"""Diffuse light per surface cell: which pixels share a cell, number of paths, and agreement with the light of the pixels."""

import warnings

import numpy as np
import pytest

from iif_core.light.shading import roughness_levels
from iif_core.surface import shading_cells
from iif_core.surface.shading_cells import (
    REPRESENTATIVES,
    ShadingCellBuilder,
    combine_estimates,
    diffuse_of_cells,
    normal_bin,
    relative_error,
)
from tests.errors import refused

EDGE = 0.5
UP, SIDE = np.float32([0, 0, 1]), np.float32([1, 0, 0])


def patch(n, seed=0, size=2.0, normal=UP):
    points = np.random.default_rng(seed).uniform(0, size, (n, 3)).astype(np.float32)
    points[:, 2] = 0.25
    return points, np.tile(normal, (n, 1))


def built(parts, edge=EDGE):
    builder = ShadingCellBuilder(edge, (-0.1, -0.1, -0.1))
    for seed, part in enumerate(parts):
        builder.add(*part, seed)
    return builder.finish()


def test_levels_of_roughness_reach_both_ends_and_are_closer_at_the_glossy_one():
    levels = roughness_levels(5)
    np.testing.assert_allclose(levels, 0.02 + 0.98 * np.array([0.0, 0.125, 0.3535534, 0.6495191, 1.0]), rtol=1e-6)


def test_numbers_of_cells_are_spread_over_32_bits():
    """They choose the random numbers of the cells: numbers that were close, or shared a bit, would share some of these."""
    number = built([(*patch(4000, size=20.0), np.zeros(4000, int))]).number
    assert len(np.unique(number)) == len(number) > 1000
    bits = np.unpackbits(number[:, None].view(np.uint8), axis=1)
    assert bits.shape[1] == 32 and (np.abs(bits.mean(0) - 0.5) < 4 * 0.5 / np.sqrt(len(number))).all()


def test_pixels_share_a_cell_by_place_object_and_direction():
    points, normals = patch(400)
    ids = np.where(points[:, 0] < 1, 3, -1)
    tilted = np.tile(np.float32([0.02, -0.02, 0.9996]), (400, 1))  # rounding noise of a normal creates no cell
    cells = built([(points, normals, ids), (points[:50], tilted[:50], ids[:50]), (points, np.tile(SIDE, (400, 1)), ids)])
    voxel = np.floor((points + 0.1) / EDGE).astype(int)
    expected = {(*v, i, b) for v, i in zip(voxel, ids, strict=True) for b in (0, 1)}
    assert len(cells) == len(expected) and cells.pixels.sum() == 850
    row = cells.find(points, normals, ids)
    assert np.array_equal(row, cells.find(points, tilted, ids))
    assert not np.intersect1d(row, cells.find(points, np.tile(SIDE, (400, 1)), ids)).size
    assert np.array_equal(cells.object_id[row], ids)
    home = np.floor((cells.points + np.float32(0.1)) / EDGE).astype(int)[row]
    assert (home == voxel[:, None]).all()  # representatives are pixels of the cell
    together = np.unique(np.c_[row, voxel, ids], axis=0)
    assert len(together) == len(np.unique(row))
    with refused("shading cell"):
        cells.find(points + 50, normals, ids)
    with refused("mesh"):
        ShadingCellBuilder(EDGE, (0, 0, 0)).finish()


def test_when_views_are_joined_changes_nothing(monkeypatch):
    parts = [(*patch(3000, seed), np.arange(3000) % 3) for seed in range(7)] + [(*patch(0), np.zeros(0, int))]
    late = built(parts)
    for rows in (0, 500, 4000):
        monkeypatch.setattr(shading_cells, "MERGE_ROWS", rows)
        early = built(parts)
        for name in ("object_id", "points", "normals", "pixels"):
            np.testing.assert_array_equal(getattr(early, name), getattr(late, name), name)
        np.testing.assert_array_equal(early.find(*parts[3]), late.find(*parts[3]))
    assert late.pixels.sum() == 21000


def test_representatives_are_a_fair_sample_of_all_views():
    """A thousand cells of 40 pixels from four views: every view and every pixel is drawn equally often."""
    x = np.arange(1000, dtype=np.float32)
    parts = []
    for view in range(4):
        points = np.zeros((10000, 3), np.float32)
        points[:, 0] = np.repeat(x, 10) + 0.25
        points[:, 1] = view * 0.1 + np.tile(np.arange(10), 1000) * 0.01
        parts.append((points, np.tile(UP, (10000, 1)), np.zeros(10000, np.int64)))
    builder = ShadingCellBuilder(1.0, (0, -0.2, 0))
    for seed, part in enumerate(parts):
        builder.add(*part, seed)
    cells = builder.finish()
    assert len(cells) == 1000 and (cells.pixels == 40).all()
    drawn = np.rint(cells.points[..., 1] * 100).astype(int)
    assert (np.diff(np.sort(drawn, 1), axis=1) > 0).all()  # without repetition
    counts = np.bincount(drawn.ravel(), minlength=40)
    expected = 1000 * REPRESENTATIVES / 40
    assert ((counts - expected) ** 2 / expected).sum() < 80  # chi-squared with 39 degrees of freedom: p = 1e-4


def tracer(sigma_of, log=None):
    """Noisy radiance 1 + x with the standard deviation sigma_of(points) of one path."""

    def trace(points, normals, paths, seed, number):
        if log is not None:
            log.append((len(points), paths, seed))
        noise = np.random.default_rng(seed).normal(size=(len(points), 3)) / np.sqrt(paths)
        return (1 + points[:, :1]) + sigma_of(points)[:, None] * noise

    return trace


def test_paths_are_added_where_it_is_noisy_until_it_is_not():
    points, normals = patch(20000, size=10.0)
    ids = (points[:, 0] > 5).astype(np.int64)
    cells = built([(points, normals, ids)])
    log = []

    def sigma(p):
        return np.where(p[:, 0] > 5, 4.0, 0.2) * (1 + p[:, 0])

    found = diffuse_of_cells(cells, tracer(sigma, log), 16, 0.1, 4096, 5)
    noisy = cells.object_id == 1
    assert (found.samples[~noisy] == 16).all()  # 0.2 / sqrt(3 * 16) = 3 % was enough
    assert len(np.unique(found.samples[noisy])) == 1 and 512 <= found.samples[noisy][0] <= 2048  # 4 / sqrt(3 n) = 10 % at 533
    assert found.noise_last < found.noise_first and found.noisy_objects == 0
    value = 1 + cells.points[..., 0].mean(1)
    scatter = (found.diffuse.mean(0)[:, 0] / value - 1)[noisy].std()
    assert scatter == pytest.approx(4 / np.sqrt(found.samples[noisy][0]), rel=0.2)
    error = np.median(relative_error(found.diffuse)[noisy])
    assert error == pytest.approx(4 / np.sqrt(3 * found.samples[noisy][0]), rel=0.15)  # the estimated error is the true one
    residual = (found.diffuse[..., 0] / value - 1)[:, noisy]
    assert abs(np.corrcoef(residual)[0, 1]) < 4 / np.sqrt(noisy.sum())  # the halves are independent
    assert len({seed for _, _, seed in log}) == len(log)


def test_most_paths_stop_it_and_reruns_are_the_same():
    points, normals = patch(2000, size=10.0)
    cells = built([(points, normals, np.zeros(2000, np.int64))])
    runs = [diffuse_of_cells(cells, tracer(lambda p: np.full(len(p), 9.0)), 16, 1e-3, 64, 5) for _ in range(2)]
    assert (runs[0].samples == 64).all() and runs[0].noisy_objects == 1
    assert runs[0].diffuse.tobytes() == runs[1].diffuse.tobytes()
    few = diffuse_of_cells(cells, tracer(lambda p: np.full(len(p), 9.0)), 2, 1e-3, 2, 5)
    assert (few.samples == 2).all()
    dark = diffuse_of_cells(cells, lambda p, n, s, seed, number: np.zeros((len(p), 3)), 16, 0.1, 64, 5)
    assert not dark.diffuse.any() and dark.noise_last == 0 and (dark.samples == 16).all()


def test_two_estimates_are_better_than_one():
    rng = np.random.default_rng(0)
    truth = rng.uniform(1, 3, (1, 4000, 1)) * np.ones(3)
    cell = truth * (1 + rng.normal(0, 0.1 * np.sqrt(2), (2, 4000, 1)))
    own = truth * (1 + rng.normal(0, 0.2 * np.sqrt(2), (2, 4000, 1)))
    both = combine_estimates(cell, 0.1, own)
    scatter = (both.mean(0) / truth[0] - 1).std()
    assert scatter == pytest.approx(1 / np.sqrt(1 / 0.1**2 + 1 / 0.2**2), rel=0.05)
    assert abs(np.corrcoef((both / truth - 1)[..., 0])[0, 1]) < 0.07
    assert not combine_estimates(np.zeros((2, 5, 3)), 0.0, np.zeros((2, 5, 3))).any()
    with warnings.catch_warnings(action="error"):  # no pixel: no median of nothing
        assert combine_estimates(np.zeros((2, 0, 3)), 0.1, np.zeros((2, 0, 3))).shape == (2, 0, 3)


def test_normals_of_every_direction_have_a_bin():
    n = np.random.default_rng(0).normal(size=(5000, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    bins = normal_bin(n)
    assert bins.min() >= 0 and bins.max() < 125 and len(np.unique(bins)) > 40
    for b in np.unique(bins):  # no bin is wider than 60 degrees
        own = n[bins == b]
        assert (own @ own.T).min() > 0.5
    assert not np.array_equal(normal_bin(n), normal_bin(-n))


def test_light_of_the_cells_is_the_light_of_the_pixels(llvm):
    """A floor under a lamp: the mean over a cell's pixels, traced from a few of them."""
    from iif_core.light.transport.emitters import Emitters
    from iif_core.light.transport.geometry import build_geometry
    from iif_core.light.transport.scene import PathOptions, Scene
    from iif_core.light.transport.shading import shading_caches
    from tests.oracles.face_materials import FaceMaterials

    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    vertices = np.concatenate([square * 2, square * 0.6 + np.float32([0.5, 0.5, 1.0])])
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 6, 5], [4, 7, 6]])
    geometry = build_geometry(vertices, faces, np.array([0, 0, 1, 1]))
    radiance = np.where(np.arange(4)[:, None] >= 2, np.float32([3, 2, 1]), 0)
    emitters = Emitters(geometry, radiance, np.array([0, 0, 1, 1]))
    material = FaceMaterials(np.tile(np.float32([0.5, 0.5, 0.5, 0.9, 0]), (4, 1)))
    points, normals = patch(6000, size=2.0)
    points[:, 2] = 0
    cells = built([(points, normals, np.zeros(6000, np.int64))], edge=0.1)

    def trace(p, n, paths, seed, number=None):
        return shading_caches(Scene(geometry, material, emitters), p, n, n, [], PathOptions(paths, 2, seed), number)[0]

    found = diffuse_of_cells(cells, trace, 64, 0.02, 1024, 1)
    assert found.noise_last < 0.03
    row = cells.find(points, normals, np.zeros(6000, np.int64))
    each = trace(points, normals, 256, 77)
    for channel in range(3):
        truth = np.bincount(row, each[:, channel]) / np.bincount(row)
        ratio = found.diffuse.mean(0)[:, channel] / truth
        assert abs(ratio.mean() - 1) < 5e-3 and ratio.std() < 0.04


def test_random_numbers_of_a_cell_do_not_depend_on_other_cells():
    points, normals = patch(4000, size=3.0)
    ids = np.zeros(4000, np.int64)
    numbers = []

    def trace(points, normals, paths, seed, number):
        assert len(np.unique(number)) == len(number) == len(points) and number.dtype == np.uint32
        numbers.append(set(number.tolist()))
        return np.ones((len(points), 3))

    whole = built([(points, normals, ids)])
    diffuse_of_cells(whole, trace, 16, 0.1, 64, 5)
    part = points[:, 0] < 1.5
    fewer = built([(points[part], normals[part], ids[part])])
    diffuse_of_cells(fewer, trace, 16, 0.1, 64, 5)
    assert 10 < len(fewer) < len(whole)
    assert numbers[0] == numbers[1] and numbers[2] == numbers[3] and numbers[2] < numbers[0]  # both halves, other seeds
