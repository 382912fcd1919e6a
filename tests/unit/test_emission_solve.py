from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from iif_core.errors import InputError
from iif_core.light.emission.direct import EmissionPrior, solve_emission, solve_families
from iif_core.light.emission.gains import (
    MAX_SHARE_ABOVE_WHITE,
    SHARED_LEVEL_ERROR,
    BaseAlbedo,
    GainOptions,
    _weighed,
    estimate_object_gains,
)
from iif_core.light.emission.pruning import WhiteSurface, insignificant, prune_groups
from iif_core.light.emission.rows import EmissionRows, block_rows
from tests.errors import refused
from tests.unit.emission_systems import rows_of

TRUE = np.array([5.0, 10.0, 20.0])[:, None] * np.array([1.0, 0.8, 0.5])


def _rows(a1, a2, y, weight=None, bound=None):
    return rows_of((a1, a2), observed=y, weight=weight, bound=bound)


def _gains(rows, owner, identifiable=True, rounds=15, shrinkage=0.05, initial=None, **options):
    """Gains of rows of three groups."""
    initial = np.ones((3, 3)) if initial is None else initial
    return estimate_object_gains(
        rows, owner, EmissionPrior.independent(initial), identifiable, options=GainOptions(rounds, shrinkage), **options
    )


def _light(rows, owner, found, **options):
    """Radiance of rows scaled by the gains found."""
    return solve_emission(rows.scaled(found.gain[owner], found.gloss_gain[owner]), np.ones((3, 3)), **options).radiance


def _random(n=500, groups=3, seed=0):
    a = np.random.default_rng(seed).random((n, groups, 3)).astype(np.float32)
    return a, np.einsum("ngc,gc->nc", a.astype(np.float64), TRUE[:groups])


def test_planted_emission_is_recovered():
    a, y = _random()
    out = solve_emission(_rows(a, a, y), np.ones((3, 3)), ridge=1e-12)
    np.testing.assert_allclose(out.radiance, TRUE, rtol=1e-6)
    assert out.residual < 1e-6 and out.converged and (out.determined > 0.999).all()


def test_noise_in_a_attenuates_and_two_estimates_cure_it():
    """Eq. L.21 and L.22: the attenuated answer (7.27, 9.77, 14.77) follows in closed form for uniform A."""
    rng = np.random.default_rng(1)
    a, y = _random(200_000, seed=2)
    a1, a2 = (a * (1 + 0.5 * rng.standard_normal(a.shape)) for _ in range(2))
    single = solve_emission(_rows(a1, a1, y), np.ones((3, 3)), ridge=1e-9)
    both = solve_emission(_rows(a1, a2, y), np.ones((3, 3)), ridge=1e-9)
    # E[A'A] = J/4 + I/12 for uniform A; the noise adds I/12 on the diagonal: x = (J/4 + I/6)^-1 (J/4 + I/12) (5,
    # 10, 20).
    np.testing.assert_allclose(single.radiance[:, 0], [7.27, 9.77, 14.77], atol=0.15)
    np.testing.assert_allclose(both.radiance[:, 0], [5, 10, 20], atol=0.15)
    assert (np.abs(both.radiance - TRUE) < 5 * both.error + 1e-9).all()


def test_against_bounded_least_squares():
    rng = np.random.default_rng(3)
    a = rng.random((80, 6, 3)).astype(np.float32)
    y, w = rng.normal(1, 2, (80, 3)), rng.uniform(0.2, 3, (80, 3))
    out = solve_emission(_rows(a, a, y, w), np.zeros((6, 3)), ridge=1e-13)
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


def test_the_prior_of_a_dark_group_is_as_wide_as_that_of_a_tenth_of_the_brightest():
    """An unseen group follows a seen one by correlation times the ratio of their widths, here 0.1."""
    a = np.zeros((50, 2, 3), np.float32)
    a[:, 0] = 1
    prior = EmissionPrior(np.repeat([[10.0], [0.0]], 3, 1), np.full(2, 1.5), np.array([[1.0, 0.5], [0.5, 1.0]]))
    out = prior.solve(_rows(a, a, np.full((50, 3), 14.0)))
    np.testing.assert_allclose(out.radiance, np.repeat([[14.0], [0.5 * 0.1 * (14 - 10)]], 3, 1), rtol=1e-3)


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
    assert np.abs(naive.radiance / TRUE - 1).max() > 0.1  # as equalities they give a wrong answer
    assert out.violated == 0


def test_all_saturated_rises_to_the_bound_and_no_further():
    a = np.ones((50, 1, 3), np.float32)
    rows = _rows(a, a, np.full((50, 3), 7.0), bound=np.ones((50, 3), bool))
    low = solve_emission(rows, np.ones((1, 3)), ridge=1e-9)
    np.testing.assert_allclose(low.radiance, 7, rtol=1e-4)
    high = solve_emission(rows, np.full((1, 3), 9.0))
    np.testing.assert_array_equal(high.radiance, 9.0)  # already above: nothing to do
    assert high.converged


@pytest.mark.parametrize("bounded", [False, True])
def test_radiance_alone_is_that_of_the_solution(bounded):
    rng = np.random.default_rng(5)
    a = rng.random((200, 3, 3))
    y = np.einsum("ngc,gc->nc", a, TRUE) * rng.uniform(0.8, 1.2, (200, 1))
    bound = (y > np.quantile(y, 0.7)) if bounded else None
    prior = EmissionPrior(np.ones((3, 3)), np.array([5.0, 0.3, 2.0]), 0.5 * np.eye(3) + 0.5)
    rows = _rows(a, a + 0.05 * rng.standard_normal(a.shape), y, bound=bound)
    for some in (rows, rows.take(np.zeros(0, int))):
        np.testing.assert_array_equal(prior.radiance(some), prior.solve(some).radiance)


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
    out, pixel = block_rows(_rows(a, a, y, weight, bound), block)
    assert len(out.observed) == 17 and out.lower_bound.any(1).sum() == 1
    np.testing.assert_array_equal(block[pixel], np.r_[0, 0, 1:16])
    np.testing.assert_allclose(out.weight.sum(0), weight.sum(0))
    np.testing.assert_allclose(out.observed[0], (y[0] + 3 * y[1] + y[2]) / 5, rtol=1e-6)
    np.testing.assert_allclose(out.matrices[0, 1], a[3], rtol=1e-6)
    solution = solve_emission(out, np.ones((3, 3)), ridge=1e-12)
    np.testing.assert_allclose(solution.radiance, TRUE, rtol=1e-4)


def test_blocks_with_zero_weight_are_harmless():
    a, y = _random(8)
    out, _ = block_rows(_rows(a, a, y, np.zeros((8, 3))), np.zeros(8, int))
    assert (out.weight == 0).all() and np.isfinite(out.observed).all()
    assert (solve_emission(out, np.ones((3, 3))).radiance == 1).all()


def test_blocks_cut_the_attenuation():
    rng = np.random.default_rng(7)
    tiles = rng.random((400, 3, 3))
    a = np.repeat(tiles, 64, 0)
    y = np.einsum("ngc,gc->nc", a, TRUE)
    noisy = a * (1 + rng.standard_normal(a.shape))
    pixel = _rows(noisy, noisy, y)
    blocks, _ = block_rows(pixel, np.repeat(np.arange(400), 64))
    error = [np.abs(solve_emission(r, np.ones((3, 3))).radiance - TRUE).max() for r in (pixel, blocks)]
    assert error[1] < 0.1 * error[0]


@pytest.mark.parametrize("initial", [np.ones((2, 3)), -np.ones((3, 3)), np.full((3, 3), np.nan)])
def test_refused(initial):
    a, y = _random(10)
    with pytest.raises(InputError):
        solve_emission(_rows(a, a, y), initial)


def test_non_finite_rows_are_refused():
    a, y = _random(10)
    y[3, 1] = np.nan
    with refused("emission rows", "observed"):
        solve_emission(_rows(a, a, y), np.ones((3, 3)))
    with refused("emission rows", "weight", "(3,)", "(10, 3)"):
        EmissionRows(np.stack([a, a])[:, None], y, np.zeros((2, 1, 10, 3)), np.ones(3), np.zeros((10, 3), bool))


def test_right_hand_side_crosses_the_noise_of_one_trace():
    """A path that reaches an emitter does not end in the cache: noise of A and h of one trace is anticorrelated."""
    rng = np.random.default_rng(8)
    a = rng.random((60_000, 2, 3))
    y = np.einsum("ngc,gc->nc", a, TRUE[:2]) + 1.0
    noise = [0.5 * rng.standard_normal(a.shape) * a for _ in range(2)]
    rows = rows_of(tuple(a + n for n in noise), observed=y, cached=[tuple(1.0 - n.sum(1) for n in noise)])
    out = solve_emission(rows, np.ones((2, 3)), ridge=1e-9)
    np.testing.assert_allclose(out.radiance, TRUE[:2], rtol=0.03)


def _white(seen, matrix=None, cached=0.0):
    seen = np.asarray(seen, float)[:, None] * np.ones(3)
    groups = len(seen)
    matrix = np.zeros((groups, groups)) if matrix is None else np.asarray(matrix, float)
    return WhiteSurface(seen, matrix[:, :, None] * np.ones(3), np.full((groups, 3), cached))


def _pruning(shown, seen, matrix, noise=0.05, seed=9, family=None, reach=None):
    """`shown`: radiance that each group sends out, its own or reflected; `seen`: what the photographs say of it; `reach`: how
    much of its light reaches the other rows."""
    rng = np.random.default_rng(seed)
    groups = len(shown)
    a = (rng.random((2000, groups, 3)) * (np.ones(groups) if reach is None else np.asarray(reach))[:, None]).astype(np.float32)
    family = np.arange(groups) if family is None else np.asarray(family)
    y = np.einsum("ngc,gc->nc", a, np.asarray(shown)[:, None] * np.ones(3)) * (1 + noise * rng.standard_normal((2000, 3)))
    everywhere, last = np.ones(2000, bool), np.arange(groups) == groups - 1
    rows = _rows(a, a, y)
    return prune_groups(rows, EmissionPrior.independent(np.ones((groups, 3))), family, _white(seen, matrix), everywhere, last)


def test_pruning_keeps_what_shines():
    """A lamp; a lit wall next to it; a strip brighter than white but without power; a dark group; the environment."""
    matrix = np.zeros((5, 5))
    matrix[1, 0] = 0.4  # a white surface there would show 0.4 of the lamp
    out = _pruning([8.0, 2.0, 2.0, 0.0, 1.0], [8.0, 2.0, 2.0, 0.0, 0.0], matrix, reach=[1.0, 1.0, 1e-3, 1.0, 1.0])
    assert out.kept.tolist() == [True, False, False, False, True]
    assert (out.radiance[~out.kept] == 0).all()
    assert "white surface" in out.reason[1] and out.excess[1] == pytest.approx(2 / 3.2, rel=0.1)
    assert "of the light" in out.reason[2] and out.reason[0] == out.reason[4] == ""


def test_a_curtain_of_many_weak_folds_stays_whole():
    """Each of fifty folds gives a fiftieth of what the curtain gives; they are judged together, and alone each would go."""
    groups = 51
    shown, reach = np.r_[np.full(50, 3.0), 8.0], np.r_[np.full(50, 0.01), 1.0]
    matrix = np.zeros((groups, groups))
    together = _pruning(shown, shown, matrix, reach=reach, family=np.r_[np.zeros(50), 1])
    alone = _pruning(shown, shown, matrix, reach=reach)
    assert together.kept.all() and alone.kept.sum() < 10


def test_dim_surface_whose_light_is_missed_stays():
    """Saturated, and its bound is no brighter than a white surface; but the rest of the scene needs more of its light."""
    matrix = np.zeros((3, 3))
    matrix[1, 0] = 0.5
    out = _pruning([8.0, 3.0, 0.0], [8.0, 1.0, 0.0], matrix)
    assert out.kept[1] and out.excess[1] < 1


def test_wall_that_is_dropped_keeps_reflecting():
    """The wall's light is a third of what arrives: without it the residual would grow, but it is known how bright the wall is."""
    matrix = np.zeros((3, 3))
    matrix[1, 0] = 0.6
    out = _pruning([8.0, 4.0, 0.0], [8.0, 4.0, 0.0], matrix)
    assert out.kept.tolist() == [True, False, True]
    np.testing.assert_allclose(out.radiance[0], 8.0, rtol=0.02)


@pytest.mark.parametrize(
    ("white", "reach", "offered"),
    [(0.3, 1.0, True), (0.3, 1e-3, False), (0.6, 1.0, False)],
    ids=["brighter than white", "without light", "no brighter than white"],
)
def test_what_was_dropped_may_shine_if_it_is_brighter_than_white_and_gives_light(white, reach, offered):
    """A window of radiance 4 next to a lamp of 8. In this light a white surface in the window's place would show 2.4 or 4.8."""
    matrix = np.zeros((3, 3))
    matrix[1, 0] = white
    out = _pruning([8.0, 4.0, 0.0], [8.0, 4.0, 0.0], matrix, reach=[1.0, reach, 1.0])
    assert not out.kept[1] and out.excess[1] == pytest.approx(4 / (8 * white), rel=0.1)
    assert out.power[1] == pytest.approx(reach * 4 / 12, rel=0.2 if reach == 1.0 else 0.8)
    assert out.may_shine(2.0, 0.01).tolist() == [True, offered, True]
    assert out.may_shine(1.5, 1.0)[1] == (out.excess[1] >= 1.5)  # for certain, however little its light


def test_false_emitter_goes_before_the_lamp_it_hides():
    """A shade around a bulb: each makes the other look like a reflector; the less credible one goes."""
    matrix = np.array([[0.0, 0.9, 0.0], [0.3, 0.0, 0.0], [0.0, 0.0, 0.0]])
    out = _pruning([8.0, 2.0, 0.0], [8.0, 2.0, 0.0], matrix)
    assert out.kept.tolist() == [True, False, True] and out.excess[0] > 4


def test_pruning_with_nothing():
    rows = _rows(np.zeros((4, 0, 3)), np.zeros((4, 0, 3)), np.ones((4, 3)))
    none = np.zeros((0, 3))
    out = prune_groups(
        rows, EmissionPrior.independent(none), np.zeros(0, int), _white(np.zeros(0)), np.ones(4, bool), np.zeros(0, bool)
    )
    assert out.kept.shape == (0,)


def test_parts_of_one_object_share_what_only_their_sum_determines():
    """Two panes whose light arrives almost alike, with noise: alone one gets all, as a family both are near the truth."""
    rng = np.random.default_rng(3)
    common = rng.random((300, 1, 3))
    a = np.concatenate([common, common + 1e-3 * rng.standard_normal((300, 1, 3)), rng.random((300, 1, 3))], 1)
    true = np.array([4.0, 6.0, 3.0])[:, None] * np.ones(3)
    y = np.einsum("ngc,gc->nc", a, true) + 0.05 * rng.standard_normal((300, 3))
    rows = _rows(a, a, y)
    alone = solve_emission(rows, np.ones((3, 3)), prior_width=np.inf, ridge=1e-9).radiance
    family = solve_families(rows, EmissionPrior.independent(np.ones((3, 3))), np.array([7, 7, 2])).radiance
    assert np.abs(alone[:2] / true[:2] - 1).max() > 0.5
    assert np.abs(family[:2] / 5.0 - 1).max() < 0.1 and np.abs(family[2] / 3 - 1).max() < 0.02
    single = solve_families(rows, EmissionPrior.independent(np.ones((3, 3))), np.arange(3)).radiance
    np.testing.assert_array_equal(single, solve_emission(rows, np.ones((3, 3))).radiance)


@pytest.mark.parametrize("soft", [True, False])
def test_pixels_that_noise_has_saturated_do_not_push(soft):
    """Noisy pixels around the saturation level: a hard bound is raised by every one that noise lifts above it."""
    rng = np.random.default_rng(4)
    n, level = 40_000, 2.0
    a = rng.uniform(0.5, 1.5, (n, 1, 3))
    y = 2.0 * a[:, 0] + 0.5 * rng.standard_normal((n, 3))
    bound = y > level
    rows = rows_of(a, observed=np.minimum(y, level), bound=bound)
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


def test_rows_with_a_common_error_count_as_few():
    rng = np.random.default_rng(12)
    a, y = _random(900)
    off = np.repeat(1 + 0.1 * rng.standard_normal((30, 1)), 30, 0)
    alone = solve_emission(_rows(a, a, y * off), np.ones((3, 3)))
    rows = replace(_rows(a, a, y * off), cluster=np.repeat(np.arange(30), 30))
    together = solve_emission(rows, np.ones((3, 3)))
    np.testing.assert_allclose(alone.radiance, together.radiance, rtol=0.03)  # only the prior has more weight
    assert (together.error > 1.5 * alone.error).any()


def test_prior_is_weighed_by_the_design_effect_of_the_rows():
    """Errors that many rows share, and a prior: the answer is near the mean of both, weighted by their variances."""
    rng = np.random.default_rng(13)
    objects, rows_each, true, start = 8, 400, 4.0, 5.0
    found, plain = [], []
    for _ in range(40):
        off = np.repeat(1 + 0.5 * rng.standard_normal((objects, 1)), rows_each, 0)
        a = rng.uniform(0.5, 1.5, (objects * rows_each, 1, 3))
        rows = replace(_rows(a, a, true * a[:, 0] * off), cluster=np.repeat(np.arange(objects), rows_each))
        found.append(solve_emission(rows, np.full((1, 3), start), prior_width=0.2).radiance[0])
        plain.append(solve_emission(replace(rows, cluster=None), np.full((1, 3), start), prior_width=0.2).radiance[0])
    # Data: standard deviation 0.5 * 4 / sqrt(8) = 0.7 around 4; prior: 1 around 5, which independent rows would outweigh.
    share = 1.0 / (1.0 + 0.71**2)
    assert np.mean(found) == pytest.approx(share * 4 + (1 - share) * 5, abs=0.15)
    assert np.mean(plain) == pytest.approx(4.0, abs=0.25)
    assert np.std(found) < 0.85 * np.std(plain)


@pytest.mark.parametrize("level", [0.6, 1.0, 1.5])
def test_indirect_light_tells_light_from_albedo(level):
    """All albedos wrong by one factor and no emitter seen: the share of photographed indirect light determines the level."""
    rng = np.random.default_rng(14)
    n, owner = 4000, np.repeat(np.arange(8), 500)
    a = (rng.random((n, 3)) ** 2)[:, :, None] * np.ones(3)  # many pixels see little of the emitters
    h = rng.uniform(2, 20, (n, 3))
    y = level * (np.einsum("ngc,gc->nc", a, TRUE) + h) * (1 + 0.1 * rng.standard_normal((n, 3)))
    rows = rows_of(a, observed=y, cached=[h], weight=1 / y**2)
    found = _gains(rows, owner)
    light = _light(rows, owner, found)
    assert np.median(found.gain) == pytest.approx(level, rel=0.06)
    np.testing.assert_allclose(light.sum(0), TRUE.sum(0), rtol=0.12)


def test_level_and_its_error_from_unlike_shares_of_photographed_light():
    """Albedos wrong by object, errors that the rows of an object share: the error of the level is the scatter of the level."""
    z = []
    for seed in range(24):
        rng = np.random.default_rng(seed)
        n, owner = 800, np.repeat(np.arange(20), 40)
        a = rng.uniform(0.05, 1, (n, 3))[:, :, None] * np.ones(3)
        h = rng.uniform(2, 20, (n, 3)) * np.exp(0.2 * rng.standard_normal((20, 1)))[owner]
        gain = np.exp(0.25 * rng.standard_normal((20, 3)))[owner]
        seen = gain * (np.einsum("ngc,gc->nc", a, TRUE) + h * np.exp(0.15 * rng.standard_normal((20, 1)))[owner])
        y = seen * (1 + 0.1 * rng.standard_normal((n, 3)))
        rows = rows_of(a, observed=y, cached=[h], weight=1 / y**2)
        found = _gains(rows, owner)
        light = _light(rows, owner, found)
        own = np.sqrt(found.level_error**2 - SHARED_LEVEL_ERROR**2)
        z.append(np.log(light.sum() / TRUE.sum()) / own)
    assert 0.5 < np.std(z) < 1.6 and abs(np.mean(z)) < 1.0


def test_light_is_raised_until_albedos_are_possible():
    """A base texture that is too bright would make the light too dim; nothing reflects more than it receives."""
    rng = np.random.default_rng(12)
    n, owner = 2000, np.repeat(np.arange(20), 100)
    base = rng.uniform(0.3, 0.9, (20, 3))
    a = rng.uniform(0.05, 1, (n, 3))[:, :, None] * np.ones(3)
    h = rng.uniform(2, 20, (n, 3))  # photographed light, which determines the level: gains of 1.6
    y = 1.6 * (np.einsum("ngc,gc->nc", a, TRUE) + h)
    rows = rows_of(a, observed=y, cached=[h], weight=1 / y**2)
    plain = _gains(rows, owner, shrinkage=1e-6, albedo=BaseAlbedo(base, level_error=np.inf))
    assert ((plain.gain * base).max(1)[owner] > 1).mean() > 0.2
    raised = _gains(rows, owner, shrinkage=1e-6, albedo=BaseAlbedo(base, True, np.inf))
    assert raised.level_raised > 0.1
    brightest = (raised.gain * base).max(1)
    assert (brightest[owner] > 1).mean() <= MAX_SHARE_ABOVE_WHITE
    assert np.quantile(brightest, 0.97) > 0.9  # and no more than is needed
    light = [_light(rows, owner, found).sum() for found in (plain, raised)]
    assert light[0] == pytest.approx(TRUE.sum(), rel=0.05) and light[1] > 1.2 * light[0]
    # Where albedos are possible as they are, nothing changes.
    dark = _gains(rows, owner, shrinkage=1e-6, albedo=BaseAlbedo(0.3 * base, True, np.inf))
    np.testing.assert_allclose(dark.gain, plain.gain, rtol=1e-12)
    assert dark.level_raised == 0
    # Nor where no level makes them possible: photographed light alone implies gains of 1.6, emitters give next to nothing.
    faint = rows_of(1e-3 * a, observed=1.6 * h, cached=[h], weight=1 / y**2)
    assert _gains(faint, owner, shrinkage=1e-6, albedo=BaseAlbedo(np.full((20, 3), 0.9), True, np.inf)).level_raised == 0


@pytest.mark.parametrize("seen", [False, True])
def test_the_level_of_the_light_is_weighed_against_that_of_the_base(seen):
    """Albedos that come out too bright as a whole ask for more light; a lamp seen unsaturated is as bright as it looks."""
    rng = np.random.default_rng(11)
    owner = np.repeat(np.arange(12), 100)
    base = rng.uniform(0.2, 0.6, (12, 3))
    a = np.exp(0.3 * rng.standard_normal((1200, 1, 1))) * np.ones((1200, 1, 3))
    h = np.ones((1200, 3)) * np.exp(0.03 * rng.standard_normal((12, 3)))[owner]
    truth = np.full((1, 3), 2.0)
    y = 1.5 * (np.einsum("ngc,gc->nc", a, truth) + h) * np.exp(0.02 * rng.standard_normal((1200, 3)))
    if seen:
        a, h, y = (np.concatenate(pair) for pair in ((a, np.ones((4, 1, 3))), (h, np.zeros((4, 3))), (y, np.tile(truth, (4, 1)))))
        owner = np.r_[owner, np.full(4, -1)]
    weight = np.where(owner[:, None] < 0, 1e4, 1.0) / y**2
    rows = rows_of(a, observed=y, cached=[h], weight=weight)

    def brightness(error):
        found = _gains(rows, owner, rounds=60, initial=np.ones((1, 3)), albedo=BaseAlbedo(base, level_error=error))
        return np.log(found.gain[:12]).mean(), found.level_moved

    (plain, still), (wide, some), (narrow, most) = (brightness(error) for error in (np.inf, 0.35, 0.05))
    assert still == 0.0
    if seen:
        np.testing.assert_allclose([wide, narrow], plain, rtol=1e-3)
        np.testing.assert_allclose([some, most], 0.0, atol=1e-3)
    else:
        assert plain > wide > narrow > -0.05
        assert 0.0 < some < most


@pytest.mark.parametrize("contrast, least, most", [(1.0, 0.45, 0.7), (0.02, 0.05, 0.5)])
def test_colour_of_the_light_is_weighed_against_that_of_the_base(contrast, least, most):
    """Where the share of photographed light hardly changes over an object, photographs do not know the colour of the light."""
    rng = np.random.default_rng(14)
    owner = np.repeat(np.arange(12), 100)
    base = rng.uniform(0.2, 0.6, (12, 3))
    a = np.exp(contrast * rng.standard_normal((1200, 1, 1))) * np.ones((1200, 1, 3))
    h = np.ones((1200, 3)) * np.exp(0.03 * rng.standard_normal((12, 3)))[owner] * [1.0, 1.0, 1.3]  # too much blue
    truth = np.array([[3.0, 2.0, 1.0]])
    y = (np.einsum("ngc,gc->nc", a, truth) + h / [1.0, 1.0, 1.3]) * np.exp(0.02 * rng.standard_normal((1200, 3)))
    rows = rows_of(a, observed=y, cached=[h], weight=1 / y**2)

    def cast(albedo):
        found = _gains(rows, owner, rounds=60, initial=np.ones((1, 3)), albedo=albedo)
        gain = np.log(found.gain.mean(0))
        return gain - gain.mean(), np.array(found.colour_moved)

    (plain, unmoved), (weighed, moved) = cast(None), cast(BaseAlbedo(base, level_error=np.inf))
    # The colour of the light moves against the colour of the gains, by no more than they allow.
    assert not unmoved.any() and moved @ (weighed - plain) < 0
    assert np.abs(plain).max() > 0.02
    assert least < np.linalg.norm(weighed) / np.linalg.norm(plain) < most


def test_emitters_within_their_error_are_insignificant():
    """Groups of a family are judged together, and the error that all light shares does not count."""
    radiance = np.array([[9.0], [1.0], [1.0], [4.0]]) * np.ones(3)
    own = np.array([[1.0], [0.6], [0.3], [1.0]]) * np.ones(3)

    def found(level, area=(1.0, 1.0, 1.0, 1.0), family=(0, 1, 2, 3)):
        error = np.hypot(own, level * radiance)
        return insignificant(radiance, error, np.full((4, 3), level), np.array(area), np.array(family)).tolist()

    assert found(0.0) == found(0.7) == [False, True, False, False]
    assert found(0.1, family=(0, 7, 7, 3)) == [False] * 4  # 2 against 0.9
    assert found(0.1, area=(1.0, 9.0, 1.0, 1.0), family=(0, 7, 7, 3)) == [False, True, True, False]
    assert insignificant(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0, int)).shape == (0,)


def test_colour_of_one_object_is_left_to_the_photographs():
    """A jackknife has nothing to leave out."""
    rng = np.random.default_rng(15)
    a = rng.uniform(0.5, 1.5, (200, 1, 1)) * np.ones((200, 1, 3))
    y = np.einsum("ngc,gc->nc", a, [[2.0, 2.0, 1.0]]) + 1.0
    rows = rows_of(a, observed=y, cached=[np.ones((200, 3)) * [1.0, 1.0, 1.2]], weight=1 / y**2)

    def gain(albedo):
        return _gains(rows, np.zeros(200, int), rounds=60, initial=np.ones((1, 3)), albedo=albedo).gain

    np.testing.assert_allclose(gain(BaseAlbedo(np.full((1, 3), 0.5), level_error=np.inf)), gain(None), rtol=1e-12)
    assert np.ptp(np.log(gain(None))) > 0.1


def test_level_is_unknown_where_nothing_determines_it():
    a, y = _random(400)
    rows, owner = _rows(a, a, y), np.repeat(np.arange(4), 100)
    assert _gains(rows, owner, False).level_error == np.inf
    # Without photographed light any level does as well as any other.
    assert _gains(rows, owner).level_error > 1
    anchored = np.r_[owner[:-3], [-1] * 3]
    a[-3:], y[-3:] = np.eye(3)[:, :, None], TRUE
    assert _gains(_rows(a, a, y), anchored).level_error < 0.05


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
    rows = rows_of(a, observed=y, cached=[h], weight=weight)
    share = (emitted[0] * weight[:n] * y[:n]).sum() / (sum(emitted) * weight[:n] * y[:n]).sum()
    return _gains(rows, owner, initial=TRUE), share


def test_lamp_in_sight_determines_its_own_light_alone():
    """Lamps out of sight have the error that all objects share, in proportion to their share of the light."""
    found, share = _room_with_lamps_in_sight(1.0, [2])
    assert 0.3 < share < 0.9
    assert (found.error_of_group[2] == 0).all() and found.error_of_group[:2] == pytest.approx(SHARED_LEVEL_ERROR, rel=0.2)
    assert found.level_error == pytest.approx((1 - share) * found.error_of_group[0, 0], rel=0.1)
    assert _room_with_lamps_in_sight(1.0, [0, 1, 2])[0].level_error < 0.02


def test_lamps_that_show_another_light_than_the_room_are_not_trusted():
    """All 'lamps' show twice the light that the room is lit by: a mirror image or a bright wall, say."""
    found = _room_with_lamps_in_sight(2.0, [0, 1, 2])[0]
    assert found.level_error == pytest.approx(np.log(2), rel=0.15)


@pytest.mark.parametrize("identifiable", [False, True])
def test_light_and_object_gains_together(identifiable):
    """Objects that face the lights differently, with albedos off by up to 2: solved plainly the light is wrong."""
    rng = np.random.default_rng(10)
    n, owner = 2000, np.repeat(np.arange(5), 400)
    facing = rng.uniform(0.05, 1, (5, 3))[owner]
    a = (rng.random((n, 3)) * facing)[:, :, None] * np.ones(3)
    h = rng.uniform(0, 2, (n, 3))
    gain = np.exp(rng.uniform(-0.7, 0.7, (5, 3)))
    y = gain[owner] * (np.einsum("ngc,gc->nc", a, TRUE) + h)
    if identifiable:  # one row sees each emitter
        a = np.concatenate([a, np.eye(3)[:, :, None] * np.ones(3)])
        h, y, owner = np.r_[h, np.zeros((3, 3))], np.r_[y, TRUE], np.r_[owner, [-1] * 3]
    weight = 1 / (y + 0.1) ** 2
    weight[n:] *= 1e6
    rows = rows_of(a, observed=y, cached=[h], weight=weight)
    found = _gains(rows, owner, identifiable, 200, 1e-6).gain
    of_row = np.where((owner >= 0)[:, None], found[owner], 1.0)
    radiance = solve_emission(rows.scaled(of_row, np.ones(len(owner))), np.ones((3, 3)), ridge=1e-9).radiance
    plain = solve_emission(rows, np.ones((3, 3)), ridge=1e-9).radiance

    def colour_free(e):
        return e if identifiable else e / e.mean(0)

    truth = TRUE if identifiable else TRUE / TRUE.mean(0)
    assert np.abs(colour_free(radiance) / truth - 1).max() < 0.03
    if not identifiable:
        assert np.abs(colour_free(plain) / truth - 1).max() > 0.2
        np.testing.assert_allclose((found / gain).std(0) / (found / gain).mean(0), 0, atol=0.02)
    else:
        np.testing.assert_allclose(found, gain, rtol=0.02)


def test_gains_without_reflecting_rows():
    a, y = _random(10)
    assert _gains(_rows(a, a, y), np.full(10, -1), False).gain.shape == (0, 3)


def _glossy_room(strength, seed=16, n=3000, objects=6, noise=0.0):
    """Rows whose gloss is `strength` (objects,) times as strong as predicted; (rows, owner, gain)."""
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
    return rows_of(diffuse, glossy, observed=y, cached=[h, k], weight=weight), owner, gain


def test_gloss_of_another_strength_than_predicted_does_not_dim_the_light():
    """Plaster predicted as glossy shows no lamps: with one gain for both lobes the light comes out too dim."""
    strength = np.array([0.0, 0.0, 0.1, 0.0, 1.0, 2.0])
    rows, owner, gain = _glossy_room(strength, noise=0.05)
    light = {}
    for part in (rows.without_lobes(), rows):
        found = _gains(part, owner, rounds=100, shrinkage=1e-6)
        light[part.has_lobes] = _light(part, owner, found).sum() / TRUE.sum()
        if not part.has_lobes:
            assert (found.gloss_gain == 1).all()
    assert light[False] < 0.9 and light[True] == pytest.approx(1, abs=0.03)
    np.testing.assert_allclose(found.gloss_gain, strength, atol=0.1)
    np.testing.assert_allclose(found.gain, gain, rtol=0.05)


def test_gloss_of_few_rows_stays_as_predicted():
    """Ten rows of an object do not outweigh the prediction; nor do rows without gloss."""
    strength = np.zeros(6)
    rows, owner, _ = _glossy_room(strength, n=60, noise=0.3)
    few = _gains(rows, owner).gloss_gain
    rows, owner, _ = _glossy_room(strength, n=6000, noise=0.3)
    many = _gains(rows, owner).gloss_gain
    assert few.min() > 0.4 and many.max() < 0.2
    together = rows.without_lobes()
    none = replace(
        rows, **{k: np.concatenate([v, 0 * v], 1) for k, v in (("matrix", together.matrix), ("cached", together.cached))}
    )
    matte, plain = (_gains(part, owner) for part in (none, together))
    np.testing.assert_allclose(matte.gain, plain.gain, rtol=1e-9)
    assert (matte.gloss_gain == 1).all() and matte.level_error == pytest.approx(plain.level_error, rel=1e-9)


def test_objects_without_rows_have_the_common_gain_that_goes_with_the_gloss_found():
    """Strong gloss, in truth a twentieth of the predicted one: subtracted as predicted it would leave objects dark."""
    rows, owner, _ = _glossy_room(np.full(6, 0.05), n=6000)
    cached = rows.cached * np.array([1.0, 2.5])[:, None, None]
    rows = replace(rows, cached=cached, observed=rows.observed + 0.05 * (cached - rows.cached)[0, 1])
    found = _gains(rows, owner, n_objects=8)
    assert found.gain[7].min() > 0.9 * found.gain[:6].min(0).min() and (found.gain[6] == found.gain[7]).all()


def test_saturated_rows_do_not_loosen_the_gloss():
    """Bounds that are met say nothing about its strength."""
    rows, owner, _ = _glossy_room(np.zeros(6), n=120, noise=0.3)
    one = _gains(rows, owner)
    n = len(owner)
    seen = np.concatenate([rows.observed] * 10)
    seen[n:] -= 100.0
    bound = np.concatenate([rows.lower_bound, np.ones((9 * n, 3), bool)])
    lobes = [np.concatenate([part] * 10, 2) for part in (rows.matrix, rows.cached)]
    many = EmissionRows(lobes[0], seen, lobes[1], np.concatenate([rows.weight] * 10), bound)
    ten = _gains(many, np.tile(owner, 10))
    np.testing.assert_allclose(ten.gloss_gain, one.gloss_gain, atol=0.1)


def test_gains_of_both_lobes_against_a_dense_solution():
    """At the level that was found, g and t of an object are the least-squares solution of its rows (4 unknowns)."""
    strength = np.array([0.5, 1.5, 0.8, 0.2, 1.0, 2.0])
    rows, owner, _ = _glossy_room(strength, noise=0.1)
    y = rows.observed
    found = _gains(rows, owner, rounds=300, shrinkage=1e-9)
    light = _light(replace(rows, weight=found.weight), owner, found, max_rounds=5)
    x, z = (np.einsum("ngc,gc->nc", rows.matrix[0, lobe], light) + rows.cached[0, lobe] for lobe in range(2))
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
    rows = rows_of(a, observed=y, cached=[h])
    found = _gains(rows, np.repeat([0, 1, 4], 100), n_objects=7)
    assert found.gain.shape == (7, 3) and found.gloss_gain.shape == (7,)
    np.testing.assert_allclose(found.gain[[2, 3, 5, 6]], np.tile(found.gain[[2]], (4, 1)))
    assert found.gain[2].min() >= found.gain[[0, 1, 4]].min() and found.gain[2].max() <= found.gain[[0, 1, 4]].max()


@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 1.0])
def test_a_shift_minimises_what_it_says(share):
    """(d / e)^2 + ((c - q d) / p)^2, also where the cast does not follow the light at all."""
    found = _weighed(lambda d: 0.4 - share * d, np.array(0.3), 0.2)
    d = np.linspace(-1, 1, 200_001)
    wanted = d[np.argmin((d / 0.3) ** 2 + ((0.4 - share * d) / 0.2) ** 2)]
    np.testing.assert_allclose(found, wanted, atol=2e-5)
