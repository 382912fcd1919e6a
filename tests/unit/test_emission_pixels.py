"""Pixels of the linear system, and rows that keep what was observed and what was cached apart."""

from dataclasses import replace

import numpy as np

from iif_core.light.emission.direct import EmissionPrior
from iif_core.light.emission.pixels import EmissionPixels, choose_pixels, tile_of
from iif_core.light.emission.problem import ANCHOR_WEIGHT, assemble
from iif_core.light.emission.rows import TracedTransport


def of_one_object(radiance, group, coverage):
    """Pixels of one view and one object, each in another tile; what shares a pixel with an emitter has radiance 5."""
    n = len(radiance)
    nothing = np.zeros(n, int)
    bound = np.zeros((n, 3), bool)
    seen = {"group": group, "coverage": coverage, "rest": 5.0}
    return EmissionPixels(radiance=radiance, bound=bound, object_id=nothing, view=nothing, tile=np.arange(n), **seen)


def test_pixels_are_drawn_evenly_and_border_pixels_only_where_there_are_no_others():
    group = np.repeat([-1, 0, 1], [100, 20, 20])
    interior = np.arange(140) % 2 == 0
    interior[120:] = False  # group 1 has no interior pixel
    usable = np.arange(140) != 100
    chosen = choose_pixels(group, usable, interior, 30, 5, np.random.default_rng(0))
    assert np.bincount(group[chosen] + 1).tolist() == [30, 5, 5] and (np.diff(chosen) > 0).all()
    assert usable[chosen].all() and interior[chosen[group[chosen] == 0]].all()
    few = choose_pixels(group, usable, interior, 1000, 1000, np.random.default_rng(0))
    assert np.bincount(group[few] + 1).tolist() == [100, 9, 20]


def test_a_pixel_more_or_less_changes_the_draw_by_one_pixel():
    rng = np.random.default_rng(5)
    group, interior, usable = rng.integers(-1, 3, 4000), rng.random(4000) < 0.8, rng.random(4000) < 0.9
    drawn = choose_pixels(group, usable, interior, 500, 50, np.random.default_rng(0))
    for out in rng.choice(drawn, 20):
        fewer = choose_pixels(group, usable & (np.arange(4000) != out), interior, 500, 50, np.random.default_rng(0))
        assert set(drawn) - set(fewer) == {out} and len(fewer) == len(drawn)


def test_tiles_are_squares_of_eight_pixels():
    index = np.arange(20 * 17)
    tile = tile_of(index, 20)
    assert np.bincount(tile).tolist() == [64, 64, 32, 64, 64, 32, 8, 8, 4]


def test_a_pane_behind_blinds_is_as_bright_as_its_light_and_not_as_its_pixels():
    """The pane fills a third of its pixels, slats of radiance 2 the rest; taken as equalities they would show 30 / 3 + 4 / 3."""
    rng = np.random.default_rng(3)
    n, seen, truth = 900, 60, 30.0
    a = np.abs(rng.normal(1.0, 0.5, (n, 1, 3)))
    share = rng.uniform(0.2, 0.5, n).astype(np.float32)
    group = np.where(np.arange(n) < seen, 0, -1)
    y = truth * a[:, 0] * np.exp(0.1 * rng.standard_normal((n, 1)))
    y[:seen] = (share * truth + (1 - share) * 2.0)[:seen, None]
    coverage = np.where(group >= 0, share, 0.0)[:, None].astype(np.float32)
    pixels = of_one_object(y, group, coverage)
    transport = TracedTransport(np.broadcast_to(a.astype(np.float32), (2, 1, n, 1, 3)), np.zeros((2, 1, n, 3)))
    prior = EmissionPrior.independent(np.full((1, 3), 12.0))
    bounded = prior.solve(assemble(pixels, transport, 1).rows).radiance
    whole = prior.solve(assemble(replace(pixels, coverage=None), transport, 1).rows).radiance
    np.testing.assert_allclose(bounded, truth, rtol=0.05)
    assert whole.max() < 0.6 * truth
    rows = assemble(pixels, transport, 1)
    assert rows.rows.lower_bound[rows.anchor].all() and rows.anchor.sum() == 2 * seen


def test_both_ends_of_a_pane_outweigh_the_rows_of_its_own_group():
    """Groups 0 and 1 shine on the room far more than the pane, group 2, and neither may lend it its factor (Eq. L.17)."""
    rng = np.random.default_rng(4)
    n, seen, n_groups = 300, 30, 3
    group = np.where(np.arange(n) < seen, 2, -1)
    light = np.array([8.0, 2.0, 0.5])[:, None] * rng.uniform(0.8, 1.2, (n, n_groups, 3))
    y = (light * 10).sum(1)
    y[:seen] = 6.0
    coverage = np.zeros((n, n_groups), np.float32)
    coverage[:seen, 2] = 0.4
    pixels = of_one_object(y, group, coverage)
    transport = TracedTransport(np.broadcast_to(light.astype(np.float32), (2, 1, n, n_groups, 3)), np.zeros((2, 1, n, 3)))
    found = assemble(pixels, transport, n_groups)
    # Groups that no anchor looks at divide nothing, however much they light.
    with np.errstate(over="raise", divide="raise"):
        bright = TracedTransport(1e5 * transport.matrix, transport.cached)
        assert np.isfinite(assemble(pixels, bright, n_groups).rows.weight).all()
    weight, matrix = found.rows.weight[found.anchor], found.rows.matrix[0, 0][found.anchor]
    upper = (matrix < 0).any((1, 2))
    assert upper.sum() == seen and (~upper).sum() == seen
    # An upper end looks at the same pane, through the same pixels, as its lower end.
    np.testing.assert_allclose(weight[upper].mean(0), weight[~upper].mean(0), rtol=0.5)
    elsewhere = (found.rows.weight[~found.anchor][:, None] * found.rows.matrix[0, 0][~found.anchor].astype(float) ** 2).sum(0)
    assert (weight.sum(0) >= 0.99 * elsewhere[2]).all() and (weight.sum(0) < 0.1 * ANCHOR_WEIGHT * elsewhere[0]).all()


def test_averaged_rows_hold_the_means_of_what_was_observed_and_cached():
    """Two lobes, bright pixels with hardly any cached light: nothing is lost to differences of large numbers."""
    rng = np.random.default_rng(1)
    n, tile = 600, np.arange(600) // 6
    matrix, cached = rng.random((2, 2, n, 3, 3)).astype(np.float32), 1e-6 * rng.random((2, 2, n, 3)).astype(np.float32)
    radiance = 1e3 * rng.random((n, 3)).astype(np.float32)
    none = np.zeros(n, int)
    pixels = EmissionPixels(radiance=radiance, bound=np.zeros((n, 3), bool), object_id=none, view=none, tile=tile, group=none - 1)
    rows = assemble(pixels, TracedTransport(matrix, cached), 3).rows
    np.testing.assert_allclose(rows.observed, radiance.reshape(-1, 6, 3).mean(1), rtol=1e-6)
    np.testing.assert_allclose(rows.cached, cached.reshape(2, 2, -1, 6, 3).mean(3), rtol=1e-6)
    np.testing.assert_allclose(rows.matrix, matrix.reshape(2, 2, -1, 6, 3, 3).mean(3), rtol=1e-5)
    gain, gloss = rng.random((100, 3)) + 0.5, rng.random(100)
    scaled = rows.scaled(gain, gloss)
    assert not scaled.has_lobes
    np.testing.assert_allclose(scaled.cached[:, 0], gain * rows.cached[:, 0] + gloss[:, None] * rows.cached[:, 1], rtol=1e-12)
    np.testing.assert_array_equal(scaled.observed, rows.observed)
