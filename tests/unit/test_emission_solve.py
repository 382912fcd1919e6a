from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from iif_core.errors import InputError
from iif_core.light.emission.direct import solve_emission, solve_families
from iif_core.light.emission.gains import SHARED_ERROR, WHITE_SHARE, object_gains
from iif_core.light.emission.pruning import WhiteSurface, prune_groups
from iif_core.light.emission.rows import EmissionRows, GlossRows, block_rows, scale_rows

TRUE = np.array([5.0, 10.0, 20.0])[:, None] * np.array([1.0, 0.8, 0.5])


def _rows(a1, a2, target, weight=None, bound=None):
    weight = np.ones_like(target) if weight is None else weight
    bound = np.zeros(target.shape, bool) if bound is None else bound
    return EmissionRows(a1.astype(np.float32), a2.astype(np.float32), target, target, weight, bound)


def _random(n=500, groups=3, seed=0):
    a = np.random.default_rng(seed).random((n, groups, 3)).astype(np.float32)
    return a, np.einsum("ngc,gc->nc", a.astype(np.float64), TRUE[:groups])


def test_planted_emission_is_recovered():
    a, y = _random()
    for cross in (True, False):
        out = solve_emission(_rows(a, a, y), np.ones((3, 3)), cross=cross, ridge=1e-12)
        np.testing.assert_allclose(out.radiance, TRUE, rtol=1e-6)
        assert out.residual < 1e-6 and out.converged and (out.determined > 0.999).all()


def test_noise_in_a_attenuates_and_two_estimates_cure_it():
    """METHOD 7a: (7.3, 9.8, 14.8) against (4.98, 9.97, 20.05); the first follows in closed form for uniform A."""
    rng = np.random.default_rng(1)
    a, y = _random(200_000, seed=2)
    a1, a2 = (a * (1 + 0.5 * rng.standard_normal(a.shape)) for _ in range(2))
    single = solve_emission(_rows(a1, a1, y), np.ones((3, 3)), cross=False, ridge=1e-9)
    both = solve_emission(_rows(a1, a2, y), np.ones((3, 3)), cross=True, ridge=1e-9)
    # E[A'A] = J/4 + I/12 for uniform A; the noise adds I/12 on the diagonal: x = (J/4 + I/6)^-1 (J/4 + I/12) (5,
    # 10, 20).
    np.testing.assert_allclose(single.radiance[:, 0], [7.27, 9.77, 14.77], atol=0.15)
    np.testing.assert_allclose(both.radiance[:, 0], [5, 10, 20], atol=0.15)
    assert (np.abs(both.radiance - TRUE) < 5 * both.error + 1e-9).all()


def test_against_bounded_least_squares():
    rng = np.random.default_rng(3)
    a = rng.random((80, 6, 3)).astype(np.float32)
    y, w = rng.normal(1, 2, (80, 3)), rng.uniform(0.2, 3, (80, 3))
    out = solve_emission(_rows(a, a, y, w), np.zeros((6, 3)), cross=False, ridge=1e-13)
    for c in range(3):
        s = np.sqrt(w[:, c])
        oracle = lsq_linear(a[:, :, c] * s[:, None], y[:, c] * s, (0, np.inf), tol=1e-14).x
        np.testing.assert_allclose(out.radiance[:, c], oracle, atol=1e-5)
    assert (out.radiance == 0).any()  # the bound was at work


def test_column_of_zeros_stays_at_the_initial_value():
    a, _ = _random()
    a[:, 1] = 0
    y = np.einsum("ngc,gc->nc", a.astype(float), TRUE)
    out = solve_emission(_rows(a, a, y), np.full((3, 3), 3.3), ridge=1e-10)
    np.testing.assert_allclose(out.radiance[1], 3.3)
    np.testing.assert_allclose(out.radiance[[0, 2]], TRUE[[0, 2]], rtol=1e-5)
    assert out.determined.tolist()[1] == 0 and (out.error[1] == 3.3).all()


def test_duplicate_columns_share_evenly():
    a, _ = _random()
    a[:, 1] = a[:, 0]
    y = np.einsum("ngc,gc->nc", a.astype(float), TRUE)
    out = solve_emission(_rows(a, a, y), np.ones((3, 3)))
    np.testing.assert_allclose(out.radiance[0], out.radiance[1], rtol=1e-6)
    np.testing.assert_allclose(out.radiance[:2].sum(0), TRUE[:2].sum(0), rtol=2e-3)
    assert out.condition > 1e3 and (out.determined[:2] < 0.9).all() and np.isfinite(out.error).all()


def test_indefinite_cross_moment_is_no_danger():
    """Two rows of pure noise: the cross moment is indefinite; the answer stays near the initial value."""
    rng = np.random.default_rng(5)
    a1, a2 = rng.random((2, 4, 3)), rng.random((2, 4, 3))
    out = solve_emission(_rows(a1, a2, rng.random((2, 3))), np.full((4, 3), 2.0))
    assert np.isfinite(out.radiance).all() and (out.radiance >= 0).all() and out.radiance.max() < 20


def test_saturated_rows_are_one_sided():
    a, y = _random(400)
    level = np.quantile(y, 0.6)
    bound = y > level
    target = np.minimum(y, level)
    out = solve_emission(_rows(a, a, target, bound=bound), np.ones((3, 3)), ridge=1e-12)
    np.testing.assert_allclose(out.radiance, TRUE, rtol=1e-5)
    naive = solve_emission(_rows(a, a, target), np.ones((3, 3)), ridge=1e-12)
    assert np.abs(naive.radiance / TRUE - 1).max() > 0.1  # treating them as equalities is plainly wrong
    assert out.violated == 0


def test_all_saturated_rises_to_the_bound_and_no_further():
    a = np.ones((50, 1, 3), np.float32)
    rows = _rows(a, a, np.full((50, 3), 7.0), bound=np.ones((50, 3), bool))
    low = solve_emission(rows, np.ones((1, 3)), ridge=1e-9)
    np.testing.assert_allclose(low.radiance, 7, rtol=1e-4)
    high = solve_emission(rows, np.full((1, 3), 9.0))
    np.testing.assert_array_equal(high.radiance, 9.0)  # already above: nothing to do
    assert high.converged


def test_no_rows_and_no_groups():
    none = _rows(np.zeros((0, 2, 3)), np.zeros((0, 2, 3)), np.zeros((0, 3)))
    out = solve_emission(none, np.full((2, 3), 4.0))
    assert (out.radiance == 4).all() and (out.determined == 0).all()
    empty = _rows(np.zeros((5, 0, 3)), np.zeros((5, 0, 3)), np.ones((5, 3)))
    assert solve_emission(empty, np.zeros((0, 3))).radiance.shape == (0, 3)


def test_blocks_average_and_keep_bounds_apart():
    a, y = _random(64)
    block = np.repeat(np.arange(16), 4)
    bound = np.zeros((64, 3), bool)
    bound[3] = True
    weight = np.ones((64, 3))
    weight[1] = 3
    out = block_rows(_rows(a, a, y, weight, bound), block)
    assert len(out.target) == 17 and out.lower_bound.any(1).sum() == 1
    np.testing.assert_allclose(out.weight.sum(0), weight.sum(0))
    np.testing.assert_allclose(out.target[0], (y[0] + 3 * y[1] + y[2]) / 5, rtol=1e-6)
    np.testing.assert_allclose(out.first[1], a[3], rtol=1e-6)
    solution = solve_emission(out, np.ones((3, 3)), ridge=1e-12)
    np.testing.assert_allclose(solution.radiance, TRUE, rtol=1e-4)


def test_blocks_with_zero_weight_are_harmless():
    a, y = _random(8)
    out = block_rows(_rows(a, a, y, np.zeros((8, 3))), np.zeros(8, int))
    assert (out.weight == 0).all() and np.isfinite(out.target).all()
    assert (solve_emission(out, np.ones((3, 3))).radiance == 1).all()


def test_blocks_cut_the_attenuation():
    rng = np.random.default_rng(7)
    tiles = rng.random((400, 3, 3))
    a = np.repeat(tiles, 64, 0)
    y = np.einsum("ngc,gc->nc", a, TRUE)
    noisy = a * (1 + rng.standard_normal(a.shape))
    pixel = _rows(noisy, noisy, y)
    blocks = block_rows(pixel, np.repeat(np.arange(400), 64))
    error = [np.abs(solve_emission(r, np.ones((3, 3)), cross=False).radiance - TRUE).max() for r in (pixel, blocks)]
    assert error[1] < 0.1 * error[0]


@pytest.mark.parametrize("initial", [np.ones((2, 3)), -np.ones((3, 3)), np.full((3, 3), np.nan)])
def test_refused(initial):
    a, y = _random(10)
    with pytest.raises(InputError):
        solve_emission(_rows(a, a, y), initial)


def test_non_finite_rows_are_refused():
    a, y = _random(10)
    y[3, 1] = np.nan
    with pytest.raises(InputError, match="target"):
        solve_emission(_rows(a, a, y), np.ones((3, 3)))
    with pytest.raises(InputError, match="weight"):
        EmissionRows(a, a, y, y, np.ones(3), np.zeros((10, 3), bool))


def test_right_hand_side_crosses_the_noise_of_one_trace():
    """A path that reaches an emitter does not end in the cache: noise of A and h of one trace is anticorrelated."""
    rng = np.random.default_rng(8)
    a = rng.random((60_000, 2, 3))
    y = np.einsum("ngc,gc->nc", a, TRUE[:2]) + 1.0
    noise = [0.5 * rng.standard_normal(a.shape) * a for _ in range(2)]
    targets = [y - (1.0 - n.sum(1)) for n in noise]
    rows = EmissionRows(*(np.float32(a + n) for n in noise), *targets, np.ones(y.shape), np.zeros(y.shape, bool))
    out = solve_emission(rows, np.ones((2, 3)), ridge=1e-9)
    np.testing.assert_allclose(out.radiance, TRUE[:2], rtol=0.03)


def _white(seen, matrix=None, cached=0.0):
    seen = np.asarray(seen, float)[:, None] * np.ones(3)
    groups = len(seen)
    matrix = np.zeros((groups, groups)) if matrix is None else np.asarray(matrix, float)
    return WhiteSurface(seen, matrix[:, :, None] * np.ones(3), np.full((groups, 3), cached))


def _pruning(shown, seen, matrix, area, noise=0.05, seed=9):
    """`shown`: radiance that each group sends out, its own or reflected; `seen`: what the photographs say of it."""
    rng = np.random.default_rng(seed)
    groups = len(shown)
    a = rng.random((2000, groups, 3)).astype(np.float32)
    y = np.einsum("ngc,gc->nc", a, np.asarray(shown)[:, None] * np.ones(3)) * (1 + noise * rng.standard_normal((2000, 3)))
    everywhere, last = np.ones(2000, bool), np.arange(groups) == groups - 1
    rows = _rows(a, a, y)
    return prune_groups(rows, np.ones((groups, 3)), np.asarray(area, float), _white(seen, matrix), everywhere, last, cross=False)


def test_pruning_keeps_what_shines():
    """A lamp; a lit wall beside it; a strip brighter than white but without power; nothing; the environment."""
    matrix = np.zeros((5, 5))
    matrix[1, 0] = 0.4  # a white surface there would show 0.4 of the lamp
    out = _pruning([8.0, 2.0, 2.0, 0.0, 1.0], [8.0, 2.0, 2.0, 0.0, 0.0], matrix, [1.0, 1.0, 1e-3, 1.0, 0.0])
    assert out.kept.tolist() == [True, False, False, False, True]
    assert (out.solution.radiance[~out.kept] == 0).all()
    assert "white surface" in out.reason[1] and out.excess[1] == pytest.approx(2 / 3.2, rel=0.1)
    assert "power" in out.reason[2] and out.reason[0] == out.reason[4] == ""


def test_dim_surface_whose_light_is_missed_stays():
    """Saturated, and its bound is no brighter than a white surface; but the rest of the scene needs more of its light."""
    matrix = np.zeros((3, 3))
    matrix[1, 0] = 0.5
    out = _pruning([8.0, 3.0, 0.0], [8.0, 1.0, 0.0], matrix, [1.0, 1.0, 0.0])
    assert out.kept[1] and out.excess[1] < 1


def test_wall_that_is_dropped_keeps_reflecting():
    """The wall's light is a third of what arrives: without it the residual would grow, but it is known how bright the wall is."""
    matrix = np.zeros((3, 3))
    matrix[1, 0] = 0.6
    out = _pruning([8.0, 4.0, 0.0], [8.0, 4.0, 0.0], matrix, [1.0, 1.0, 0.0])
    assert out.kept.tolist() == [True, False, True]
    np.testing.assert_allclose(out.solution.radiance[0], 8.0, rtol=0.02)


def test_false_emitter_goes_before_the_lamp_it_hides():
    """A shade around a bulb: each makes the other look like a reflector; the less credible one goes."""
    matrix = np.array([[0.0, 0.9, 0.0], [0.3, 0.0, 0.0], [0.0, 0.0, 0.0]])
    out = _pruning([8.0, 2.0, 0.0], [8.0, 2.0, 0.0], matrix, [1.0, 1.0, 0.0])
    assert out.kept.tolist() == [True, False, True] and out.excess[0] > 4


def test_pruning_with_nothing():
    rows = _rows(np.zeros((4, 0, 3)), np.zeros((4, 0, 3)), np.ones((4, 3)))
    none = np.zeros((0, 3))
    out = prune_groups(rows, none, np.zeros(0), _white(np.zeros(0)), np.ones(4, bool), np.zeros(0, bool))
    assert out.kept.shape == (0,)


def test_parts_of_one_object_share_what_only_their_sum_tells():
    """Two panes whose light arrives almost alike, under noise: alone one takes all, as a family both are near the truth."""
    rng = np.random.default_rng(3)
    common = rng.random((300, 1, 3))
    a = np.concatenate([common, common + 1e-3 * rng.standard_normal((300, 1, 3)), rng.random((300, 1, 3))], 1)
    true = np.array([4.0, 6.0, 3.0])[:, None] * np.ones(3)
    y = np.einsum("ngc,gc->nc", a, true) + 0.05 * rng.standard_normal((300, 3))
    rows = _rows(a, a, y)
    alone = solve_emission(rows, np.ones((3, 3)), prior_width=np.inf, ridge=1e-9).radiance
    family = solve_families(rows, np.ones((3, 3)), np.array([7, 7, 2])).radiance
    assert np.abs(alone[:2] / true[:2] - 1).max() > 0.5
    assert np.abs(family[:2] / 5.0 - 1).max() < 0.1 and np.abs(family[2] / 3 - 1).max() < 0.02
    single = solve_families(rows, np.ones((3, 3)), np.arange(3)).radiance
    np.testing.assert_array_equal(single, solve_emission(rows, np.ones((3, 3))).radiance)


@pytest.mark.parametrize("soft", [True, False])
def test_pixels_that_noise_has_saturated_do_not_push(soft):
    """Noisy pixels around the saturation level: a hard bound is raised by every one that noise lifts above it."""
    rng = np.random.default_rng(4)
    n, level = 40_000, 2.0
    a = rng.uniform(0.5, 1.5, (n, 1, 3))
    y = 2.0 * a[:, 0] + 0.5 * rng.standard_normal((n, 3))
    bound = y > level
    rows = EmissionRows(*[a.astype(np.float32)] * 2, *[np.minimum(y, level)] * 2, np.ones((n, 3)), bound)
    rows = replace(rows, noise=np.ones(n)) if soft else rows
    out = solve_emission(rows, np.ones((1, 3)))
    assert (np.abs(out.radiance / 2 - 1).max() < 0.02) == soft


def test_standard_errors_are_those_of_repeated_solves():
    """Noise of A and of y redrawn: the claimed error is the scatter, and the scatter has the truth in its middle."""
    rng = np.random.default_rng(11)
    a, y = _random(1500)
    found, claimed = [], []
    for _ in range(60):
        a1, a2 = (a * (1 + 0.4 * rng.standard_normal(a.shape)) for _ in range(2))
        noisy = y * (1 + 0.1 * rng.standard_normal(y.shape))
        out = solve_emission(_rows(a1, a2, noisy), np.ones((3, 3)), ridge=1e-9)
        found.append(out.radiance)
        claimed.append(out.error)
    scatter = np.std(found, 0)
    np.testing.assert_allclose(np.mean(claimed, 0) / scatter, 1, atol=0.3)
    inside = np.abs(np.array(found) - TRUE) < np.array(claimed)
    assert 0.58 < inside.mean() < 0.78


def test_rows_that_err_together_count_as_few():
    rng = np.random.default_rng(12)
    a, y = _random(900)
    off = np.repeat(1 + 0.1 * rng.standard_normal((30, 1)), 30, 0)
    alone = solve_emission(_rows(a, a, y * off), np.ones((3, 3)))
    rows = replace(_rows(a, a, y * off), cluster=np.repeat(np.arange(30), 30))
    together = solve_emission(rows, np.ones((3, 3)))
    np.testing.assert_allclose(alone.radiance, together.radiance, rtol=0.03)  # only the prior counts for more
    assert (together.error > 1.5 * alone.error).any()


def test_prior_is_weighed_against_what_rows_really_know():
    """Errors that many rows share, and a prior: the answer is near the mean of both, weighed by their real errors."""
    rng = np.random.default_rng(13)
    objects, rows_each, true, start = 8, 400, 4.0, 5.0
    found, plain = [], []
    for _ in range(40):
        off = np.repeat(1 + 0.5 * rng.standard_normal((objects, 1)), rows_each, 0)
        a = rng.uniform(0.5, 1.5, (objects * rows_each, 1, 3))
        rows = replace(_rows(a, a, true * a[:, 0] * off), cluster=np.repeat(np.arange(objects), rows_each))
        found.append(solve_emission(rows, np.full((1, 3), start), prior_width=0.2).radiance[0])
        plain.append(solve_emission(replace(rows, cluster=None), np.full((1, 3), start), prior_width=0.2).radiance[0])
    # data: sd 0.5 * 4 / sqrt(8) = 0.7 around 4; prior: 1 around 5. Independent rows would leave the prior no say.
    share = 1.0 / (1.0 + 0.71**2)
    assert np.mean(found) == pytest.approx(share * 4 + (1 - share) * 5, abs=0.15)
    assert np.mean(plain) == pytest.approx(4.0, abs=0.25)
    assert np.std(found) < 0.85 * np.std(plain)


@pytest.mark.parametrize("level", [0.6, 1.0, 1.5])
def test_indirect_light_tells_light_from_albedo(level):
    """All albedos off by one factor and no emitter seen: the share of photographed indirect light tells light from albedo."""
    rng = np.random.default_rng(14)
    n, owner = 4000, np.repeat(np.arange(8), 500)
    a = (rng.random((n, 3)) ** 2)[:, :, None] * np.ones(3)  # many pixels see little of the emitters
    h = rng.uniform(2, 20, (n, 3))
    y = level * (np.einsum("ngc,gc->nc", a, TRUE) + h) * (1 + 0.1 * rng.standard_normal((n, 3)))
    rows = EmissionRows(*[a.astype(np.float32)] * 2, *[y - h] * 2, 1 / y**2, np.zeros(y.shape, bool))
    gain = object_gains(rows, y, owner, np.ones((3, 3)), True).gain
    light = solve_emission(scale_rows(rows, y, gain[owner]), np.ones((3, 3))).radiance
    assert np.median(gain) == pytest.approx(level, rel=0.06)
    np.testing.assert_allclose(light.sum(0), TRUE.sum(0), rtol=0.12)


def test_level_and_its_error_from_unlike_shares_of_photographed_light():
    """Albedos off by object, errors that an object's rows share: the level lies within the claimed error two times of three."""
    z = []
    for seed in range(24):
        rng = np.random.default_rng(seed)
        n, owner = 800, np.repeat(np.arange(20), 40)
        a = rng.uniform(0.05, 1, (n, 3))[:, :, None] * np.ones(3)
        h = rng.uniform(2, 20, (n, 3)) * np.exp(0.2 * rng.standard_normal((20, 1)))[owner]
        gain = np.exp(0.25 * rng.standard_normal((20, 3)))[owner]
        seen = gain * (np.einsum("ngc,gc->nc", a, TRUE) + h * np.exp(0.15 * rng.standard_normal((20, 1)))[owner])
        y = seen * (1 + 0.1 * rng.standard_normal((n, 3)))
        rows = EmissionRows(*[a.astype(np.float32)] * 2, *[y - h] * 2, 1 / y**2, np.zeros(y.shape, bool))
        found = object_gains(rows, y, owner, np.ones((3, 3)), True)
        light = solve_emission(scale_rows(rows, y, found.gain[owner]), np.ones((3, 3))).radiance
        own = np.sqrt(found.level_error**2 - SHARED_ERROR**2)
        z.append(np.log(light.sum() / TRUE.sum()) / own)
    assert 0.5 < np.std(z) < 1.6 and abs(np.mean(z)) < 1.0


def test_light_is_raised_until_albedos_are_possible():
    """A base twice too bright asks for light that is too dim; nothing reflects more than it receives."""
    rng = np.random.default_rng(12)
    n, owner = 2000, np.repeat(np.arange(20), 100)
    base = rng.uniform(0.3, 0.9, (20, 3))
    a = rng.uniform(0.05, 1, (n, 3))[:, :, None] * np.ones(3)
    h = rng.uniform(2, 20, (n, 3))  # photographed light, which holds the level at gains of 1.6
    y = 1.6 * (np.einsum("ngc,gc->nc", a, TRUE) + h)
    rows = EmissionRows(*[a.astype(np.float32)] * 2, *[y - h] * 2, 1 / y**2, np.zeros(y.shape, bool))
    plain = object_gains(rows, y, owner, np.ones((3, 3)), True, shrink=1e-6).gain
    assert ((plain * base).max(1)[owner] > 1).mean() > 0.2
    raised = object_gains(rows, y, owner, np.ones((3, 3)), True, shrink=1e-6, albedo=base)
    found = raised.gain
    assert raised.raised > 0.1
    whitest = (found * base).max(1)
    assert (whitest[owner] > 1).mean() <= WHITE_SHARE
    assert np.quantile(whitest, 0.97) > 0.9  # and no more than is needed
    light = [solve_emission(scale_rows(rows, y, g[owner]), np.ones((3, 3))).radiance.sum() for g in (plain, found)]
    assert light[0] == pytest.approx(TRUE.sum(), rel=0.05) and light[1] > 1.2 * light[0]
    # Where albedos are possible as they are nothing changes, to the last bit.
    dark = object_gains(rows, y, owner, np.ones((3, 3)), True, shrink=1e-6, albedo=0.3 * base)
    np.testing.assert_array_equal(dark.gain, plain)
    assert dark.raised == 0
    # Nor where no level makes them so: photographed light alone asks for gains of 1.6, emitters are next to nothing.
    faint = EmissionRows(*[1e-3 * rows.first] * 2, *[1.6 * h - h] * 2, 1 / y**2, rows.lower_bound)
    assert object_gains(faint, 1.6 * h, owner, np.ones((3, 3)), True, shrink=1e-6, albedo=np.full((20, 3), 0.9)).raised == 0


def test_level_without_a_witness_is_unknown():
    a, y = _random(400)
    rows, owner = _rows(a, a, y), np.repeat(np.arange(4), 100)
    assert object_gains(rows, y, owner, np.ones((3, 3)), False).level_error == np.inf
    # Without photographed light any level does as well as any other.
    assert object_gains(rows, y, owner, np.ones((3, 3)), True).level_error > 1
    anchored = np.r_[owner[:-3], [-1] * 3]
    a[-3:], y[-3:] = np.eye(3)[:, :, None], TRUE
    assert object_gains(_rows(a, a, y), y, anchored, np.ones((3, 3)), True).level_error < 0.05


def _room_with_lamps_in_sight(shown, groups, seed=15):
    """Rows of 20 objects under `TRUE` and photographed light; one row for each of `groups`, `shown` times as bright as it is."""
    rng = np.random.default_rng(seed)
    n, owner = 800, np.repeat(np.arange(20), 40)
    a = rng.uniform(0, 1, (n, 3))[:, :, None] ** 2 * np.ones(3)
    h = rng.uniform(2, 40, (n, 3))
    y = np.exp(0.25 * rng.standard_normal((20, 3)))[owner] * (np.einsum("ngc,gc->nc", a, TRUE) + h)
    a, h = np.concatenate([a, np.eye(3)[groups][:, :, None] * np.ones(3)]), np.r_[h, np.zeros((len(groups), 3))]
    y, owner = np.r_[y, shown * TRUE[groups]], np.r_[owner, np.full(len(groups), -1)]
    weight = 1 / y**2
    weight[n:] *= 1e6
    emitted = [np.einsum("ngc,gc->nc", a[:n, which], TRUE[which]) for which in (groups, list(set(range(3)) - set(groups)))]
    rows = EmissionRows(*[a.astype(np.float32)] * 2, *[y - h] * 2, weight, np.zeros(y.shape, bool))
    share = (emitted[0] * weight[:n] * y[:n]).sum() / (sum(emitted) * weight[:n] * y[:n]).sum()
    return object_gains(rows, y, owner, TRUE, True), share


def test_lamp_in_sight_is_sure_of_its_own_light_alone():
    """What is not seen has the error that all objects share, in proportion to its share of the light."""
    found, share = _room_with_lamps_in_sight(1.0, [2])
    assert 0.3 < share < 0.9
    assert (found.error_of_group[2] == 0).all() and found.error_of_group[:2] == pytest.approx(SHARED_ERROR, rel=0.2)
    assert found.level_error == pytest.approx((1 - share) * found.error_of_group[0, 0], rel=0.1)
    assert _room_with_lamps_in_sight(1.0, [0, 1, 2])[0].level_error < 0.02


def test_lamps_that_show_another_light_than_the_room_are_not_trusted():
    """All 'lamps' show twice the light that the room is lit by: a mirror image or a bright wall, say."""
    found = _room_with_lamps_in_sight(2.0, [0, 1, 2])[0]
    assert found.level_error == pytest.approx(np.log(2), rel=0.15)


@pytest.mark.parametrize("pinned", [False, True])
def test_light_and_object_gains_together(pinned):
    """Objects that face the lights differently, with albedos off by up to 2: solved plainly the light is wrong."""
    rng = np.random.default_rng(10)
    n, owner = 2000, np.repeat(np.arange(5), 400)
    lean = rng.uniform(0.05, 1, (5, 3))[owner]
    a = (rng.random((n, 3)) * lean)[:, :, None] * np.ones(3)
    h = rng.uniform(0, 2, (n, 3))
    gain = np.exp(rng.uniform(-0.7, 0.7, (5, 3)))
    y = gain[owner] * (np.einsum("ngc,gc->nc", a, TRUE) + h)
    if pinned:  # one row sees each emitter
        a = np.concatenate([a, np.eye(3)[:, :, None] * np.ones(3)])
        h, y, owner = np.r_[h, np.zeros((3, 3))], np.r_[y, TRUE], np.r_[owner, [-1] * 3]
    weight = 1 / (y + 0.1) ** 2
    weight[n:] *= 1e6
    rows = _rows(a, a, y - h, weight)
    found = object_gains(rows, y, owner, np.ones((3, 3)), pinned, rounds=200, shrink=1e-6).gain
    of_row = np.where((owner >= 0)[:, None], found[owner], 1.0)
    radiance = solve_emission(scale_rows(rows, y, of_row), np.ones((3, 3)), ridge=1e-9).radiance
    plain = solve_emission(rows, np.ones((3, 3)), ridge=1e-9).radiance

    def colour_free(e):
        return e if pinned else e / e.mean(0)

    truth = TRUE if pinned else TRUE / TRUE.mean(0)
    assert np.abs(colour_free(radiance) / truth - 1).max() < 0.03
    if not pinned:
        assert np.abs(colour_free(plain) / truth - 1).max() > 0.2
        np.testing.assert_allclose((found / gain).std(0) / (found / gain).mean(0), 0, atol=0.02)
    else:
        np.testing.assert_allclose(found, gain, rtol=0.02)


def test_gains_without_reflecting_rows():
    a, y = _random(10)
    assert object_gains(_rows(a, a, y), y, np.full(10, -1), np.ones((3, 3)), False).gain.shape == (0, 3)


def _glossy_room(strength, seed=16, n=3000, objects=6, noise=0.0):
    """Rows whose gloss is `strength` (objects,) times as strong as predicted; (rows, y, owner, gloss)."""
    rng = np.random.default_rng(seed)
    owner = np.repeat(np.arange(objects), n // objects)
    diffuse, glossy = rng.random((n, 3)) ** 2, rng.random((n, 3)) ** 6  # highlights are small
    h, k = rng.uniform(2, 20, (n, 3)), rng.uniform(0, 4, (n, 1)) * np.ones(3)
    diffuse, glossy = (x[:, :, None] * np.ones(3) for x in (diffuse, glossy))
    gain = np.exp(0.3 * rng.standard_normal((objects, 3)))
    light = [np.einsum("ngc,gc->nc", x, TRUE) for x in (diffuse, glossy)]
    y = gain[owner] * (light[0] + h) + strength[owner, None] * (light[1] + k)
    weight = 1 / y**2
    y = y * (1 + noise * rng.standard_normal(y.shape))
    whole, cached = (diffuse + glossy).astype(np.float32), h + k
    rows = EmissionRows(whole, whole, y - cached, y - cached, weight, np.zeros(y.shape, bool))
    return rows, y, owner, GlossRows(*[glossy.astype(np.float32)] * 2, k, k), gain


def test_gloss_of_another_strength_than_predicted_does_not_dim_the_light():
    """Plaster predicted as glossy shows no lamps: with one gain for both lobes the light has to give way."""
    strength = np.array([0.0, 0.0, 0.1, 0.0, 1.0, 2.0])
    rows, y, owner, gloss, gain = _glossy_room(strength, noise=0.05)
    light = {}
    for part in (None, gloss):
        found = object_gains(rows, y, owner, np.ones((3, 3)), True, rounds=100, shrink=1e-6, gloss=part)
        scaled = scale_rows(rows, y, found.gain[owner], part, found.gloss_gain[owner])
        light[part is gloss] = solve_emission(scaled, np.ones((3, 3))).radiance.sum() / TRUE.sum()
        if part is None:
            assert (found.gloss_gain == 1).all()
    assert light[False] < 0.9 and light[True] == pytest.approx(1, abs=0.03)
    np.testing.assert_allclose(found.gloss_gain, strength, atol=0.1)
    np.testing.assert_allclose(found.gain, gain, rtol=0.05)


def test_gloss_that_few_rows_tell_stays_as_predicted():
    """Ten rows an object are not worth doubting the prediction; as is an object whose rows have no gloss."""
    strength = np.zeros(6)
    rows, y, owner, gloss, _ = _glossy_room(strength, n=60, noise=0.3)
    few = object_gains(rows, y, owner, np.ones((3, 3)), True, gloss=gloss).gloss_gain
    rows, y, owner, gloss, _ = _glossy_room(strength, n=6000, noise=0.3)
    many = object_gains(rows, y, owner, np.ones((3, 3)), True, gloss=gloss).gloss_gain
    assert few.min() > 0.4 and many.max() < 0.2
    none = GlossRows(*(np.zeros_like(x) for x in (gloss.first, gloss.second, gloss.cached, gloss.cached_second)))
    matte, plain = (object_gains(rows, y, owner, np.ones((3, 3)), True, gloss=part) for part in (none, None))
    np.testing.assert_allclose(matte.gain, plain.gain, rtol=1e-9)
    assert (matte.gloss_gain == 1).all() and matte.level_error == pytest.approx(plain.level_error, rel=1e-9)


def test_objects_without_rows_have_the_common_gain_that_goes_with_the_gloss_found():
    """Gloss is a twentieth of the predicted one and strong: subtracted as predicted it would leave objects in the dark."""
    rows, y, owner, gloss, _ = _glossy_room(np.full(6, 0.05), n=6000)
    gloss = replace(gloss, cached=2.5 * gloss.cached, cached_second=2.5 * gloss.cached_second)
    more = 1.5 / 2.5 * gloss.cached  # of it in h, a twentieth of it in y
    rows = replace(rows, target=rows.target - 0.95 * more, target_second=rows.target_second - 0.95 * more)
    y = y + 0.05 * more
    found = object_gains(rows, y, owner, np.ones((3, 3)), True, n_objects=8, gloss=gloss)
    assert found.gain[7].min() > 0.9 * found.gain[:6].min(0).min() and (found.gain[6] == found.gain[7]).all()


def test_saturated_rows_do_not_loosen_the_gloss():
    """Rows that say nothing are no witnesses for it."""
    rows, y, owner, gloss, _ = _glossy_room(np.zeros(6), n=120, noise=0.3)
    one = object_gains(rows, y, owner, np.ones((3, 3)), True, gloss=gloss)

    def often(x):
        return np.concatenate([x] * 10)

    bound = np.concatenate([rows.lower_bound, np.ones((9 * len(y), 3), bool)])
    parts = {k: often(getattr(rows, k)) for k in ("first", "second", "target", "target_second", "weight")}
    parts["target"][len(y) :] -= 100.0  # bounds that are met
    parts["target_second"][len(y) :] -= 100.0
    many = EmissionRows(**parts, lower_bound=bound)
    glosses = GlossRows(*(often(x) for x in (gloss.first, gloss.second, gloss.cached, gloss.cached_second)))
    seen = often(y)
    seen[len(y) :] -= 100.0
    ten = object_gains(many, seen, often(owner), np.ones((3, 3)), True, gloss=glosses)
    np.testing.assert_allclose(ten.gloss_gain, one.gloss_gain, atol=0.1)


def test_gains_of_both_lobes_against_a_dense_solution():
    """At the level that was found, g and t of an object are the least-squares solution of its rows (4 unknowns)."""
    strength = np.array([0.5, 1.5, 0.8, 0.2, 1.0, 2.0])
    rows, y, owner, gloss, _ = _glossy_room(strength, noise=0.1)
    found = object_gains(rows, y, owner, np.ones((3, 3)), True, rounds=300, shrink=1e-9, gloss=gloss)
    scaled = scale_rows(replace(rows, weight=found.weight), y, found.gain[owner], gloss, found.gloss_gain[owner])
    light = solve_emission(scaled, np.ones((3, 3)), max_rounds=5).radiance
    e, k = np.einsum("ngc,gc->nc", gloss.first, light), gloss.cached
    z = e + k
    x = np.einsum("ngc,gc->nc", rows.first, light) - e + (y - rows.target) - k
    for o in range(6):
        own = owner == o
        design = np.zeros((own.sum(), 3, 4))
        design[:, range(3), range(3)], design[:, :, 3] = x[own], z[own]
        root = np.sqrt(found.weight[own])[:, :, None]
        answer = np.linalg.lstsq((design * root).reshape(-1, 4), (y[own, :, None] * root).ravel(), rcond=None)[0]
        np.testing.assert_allclose(np.r_[found.gain[o], found.gloss_gain[o]], answer, rtol=0.05)


def test_objects_without_rows_have_the_common_gain():
    a, y = _random(300)
    y = 1.4 * y
    h = np.full(y.shape, 0.5)
    rows = EmissionRows(*[a.astype(np.float32)] * 2, *[y] * 2, np.ones(y.shape), np.zeros(y.shape, bool))
    rows = replace(rows, target=y - h, target_second=y - h)
    found = object_gains(rows, y, np.repeat([0, 1, 4], 100), np.ones((3, 3)), True, n_objects=7)
    assert found.gain.shape == (7, 3) and found.gloss_gain.shape == (7,)
    np.testing.assert_allclose(found.gain[[2, 3, 5, 6]], np.tile(found.gain[[2]], (4, 1)))
    assert found.gain[2].min() >= found.gain[[0, 1, 4]].min() and found.gain[2].max() <= found.gain[[0, 1, 4]].max()
