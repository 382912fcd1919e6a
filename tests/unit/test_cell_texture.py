import numpy as np
import pytest

from iif_core.fitting.cell_texture import slow_part, smooth_light, textured_albedo
from iif_core.surface.cells import neighbour_pairs, pack_keys


def _plane(side=60, edge=0.01):
    """Cells of a square of `side` x `side` cells in two objects, left and right, sorted as the workflow has them."""
    i, j = np.divmod(np.arange(side * side), side)
    ijk = np.stack([i + 5, j + 5, np.full_like(i, 5)], 1)
    owner = (i >= side // 2).astype(np.int32)
    keys = pack_keys(ijk, owner)
    order = np.argsort(keys)
    ijk, owner = ijk[order], owner[order]
    return ijk, owner, ijk * edge, neighbour_pairs(keys[order])


def test_slow_part_keeps_what_is_slow_and_objects_apart():
    ijk, owner, points, _ = _plane()
    rng = np.random.default_rng(0)
    level = np.where(owner == 0, 1.0, 5.0)[:, None]
    np.testing.assert_allclose(slow_part(level, np.ones(len(ijk)), points, owner, 0.05), level, atol=1e-12)
    noise = rng.standard_normal((len(ijk), 1))
    assert np.abs(slow_part(level + noise, np.ones(len(ijk)), points, owner, 0.1) - level).mean() < 0.15
    # What weighs nothing says nothing, and nothing around says 0.
    wrong = np.where((ijk[:, :1] + ijk[:, 1:2]) % 2, 100.0, level)
    weight = ((ijk[:, 0] + ijk[:, 1]) % 2 == 0).astype(float)
    np.testing.assert_allclose(slow_part(wrong, weight, points, owner, 0.05), level, atol=1e-12)
    assert (slow_part(level, np.zeros(len(ijk)), points, owner, 0.05) == 0).all()
    assert slow_part(np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)), np.zeros(0, int), 0.1).shape == (0, 3)


def _sums(truth, light_found, light, rng, pixels=2.0, noise=0.0):
    """What pixels that show truth x light add up to, with the light as it was found."""
    y = truth * light * (1 + noise * rng.standard_normal(truth.shape))
    return pixels * light_found**2, pixels * light_found * y, np.full(len(truth), pixels)


def test_texture_comes_from_the_photographs_and_errors_of_the_light_do_not():
    ijk, owner, points, pairs = _plane(side=100, edge=0.02)  # objects of 1 x 2 m
    rng = np.random.default_rng(1)
    stripes = 0.1 * np.sign(np.sin(2 * np.pi * ijk[:, 1:2] / 8.0)) * np.ones(3)  # 16 cm
    truth, base = 0.5 + stripes, np.full((len(ijk), 3), 0.5)
    wrong = np.exp(0.3 * (points[:, :1] - points[:, :1].mean()) / np.ptp(points[:, 0]))  # light off by 30 %
    square, cross, pixels = _sums(truth, wrong * np.ones(3), np.ones((len(ijk), 3)), rng, noise=0.05)
    out = textured_albedo(base, square, cross, pixels, ijk, pairs, points, owner)
    plain = np.clip(cross / square, 0, 1)
    inner = (ijk[:, :2].min(1) > 20) & (ijk[:, :2].max(1) < 90)
    assert np.abs(out - truth)[inner].mean() < 0.5 * np.abs(base - truth)[inner].mean()
    x = points[:, 0] - points[:, 0].mean()
    for o in (0, 1):  # the slope of the wrong light over an object is in the free fit and not in this one
        own = owner == o
        tilt = [abs(np.polyfit(x[own], (a[own] - truth[own]).mean(1), 1)[0]) for a in (plain, out)]
        assert tilt[1] < 0.4 * tilt[0]


def test_cells_without_pixels_keep_their_base():
    ijk, owner, points, pairs = _plane(side=20)
    base = np.random.default_rng(2).uniform(0.2, 0.8, (len(ijk), 3))
    zeros = np.zeros_like(base)
    np.testing.assert_array_equal(textured_albedo(base, zeros, zeros, zeros[:, 0], ijk, pairs, points, owner), base)
    square, cross, pixels = _sums(base, np.ones_like(base), np.ones_like(base), np.random.default_rng(3))
    alone = np.arange(len(base)) == 0
    square, cross, pixels = square * alone[:, None], cross * alone[:, None], pixels * alone
    np.testing.assert_allclose(textured_albedo(base, square, cross, pixels, ijk, pairs, points, owner), base, atol=1e-12)


def test_what_is_off_everywhere_alike_moves_no_cell():
    """An error of the level is left to the light, even where hardly any photograph shows a cell, next to cells that many show."""
    ijk, owner, points, pairs = _plane(side=20)
    base = np.full((len(ijk), 3), 0.5)
    for little in (0.0, 0.1):
        pixels = np.where((ijk[:, 0] > 5) & (ijk[:, 0] < 12), little, 6.0)
        square = pixels[:, None] * np.ones(3)
        out = textured_albedo(base, square, 0.6 * square, pixels, ijk, pairs, points, owner)
        np.testing.assert_allclose(out, base, atol=1e-9)


def test_result_stays_an_albedo():
    ijk, owner, points, pairs = _plane(side=20)
    base = np.full((len(ijk), 3), 0.9)
    for truth in (0.0, 50.0):
        sums = _sums(
            np.where(ijk[:, :1] % 2, truth, 0.9) * np.ones(3), np.ones_like(base), np.ones_like(base), np.random.default_rng(4)
        )
        out = textured_albedo(base, *sums, ijk, pairs, points, owner)
        assert np.isfinite(out).all() and out.min() >= 0 and out.max() <= 1


def test_light_loses_its_noise_and_not_its_steps_between_objects():
    ijk, owner, points, _ = _plane()
    rng = np.random.default_rng(5)
    light = np.where(owner == 0, 1.0, 4.0)[:, None] * np.ones(3)
    noisy = light * np.exp(0.1 * rng.standard_normal(light.shape))
    noisy[7] = 0.0
    out = smooth_light(noisy, points, owner)
    assert out[7].max() == 0.0
    rest = np.arange(len(light)) != 7
    assert np.std(np.log(out[rest] / light[rest])) < 0.03
    assert np.abs(np.log(out[rest] / light[rest])).max() == pytest.approx(0.0, abs=0.15)
