"""The level of an object by the photographs and by the base: what each may err by, and how a discrepancy is divided."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy import integrate, stats

from iif_core.camera.response import response
from iif_core.fitting import object_levels
from iif_core.fitting.direct import fit_affines
from iif_core.fitting.object_levels import compare_levels, level_deviation, prediction_scatter
from iif_core.fitting.problem import FitOptions
from iif_core.reflectance.material import IDENTITY
from tests.unit.planted_fit import problem_of


def _room(rng, n, light, base_error, kappa=1.0):
    """Objects with a light error of `light` and a base error of `base_error`; the base is 0.8 of the truth in the mean."""
    truth = rng.uniform(0.1, 0.8, (n, 1)) * np.ones((1, 3))
    smooth = light * rng.uniform(0.7, 1.4, n)
    log_light, log_base = kappa * smooth * rng.normal(size=n), base_error * rng.normal(size=n)
    return truth, 0.8 * truth * np.exp(log_base)[:, None], truth * np.exp(log_light)[:, None], smooth, log_light, log_base


@pytest.mark.parametrize(("light", "base_error"), [(0.05, 0.2), (0.15, 0.15), (0.4, 0.1)])
def test_the_result_is_better_than_both_estimates(light, base_error):
    """Over rooms of forty objects: errors of the level after the division, against those of either estimate alone.

    Where one is far better than the other, the result has to come close to it without knowing which one that is."""
    errors = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        _, base, shown, smooth, log_light, log_base = _room(rng, 40, light, base_error, kappa=1.3)
        levels = compare_levels(base, shown, np.full(40, 0.1), smooth, np.full(40, 100.0))
        left = log_light - np.log(levels.light_gain)
        errors.append([np.std(left), np.std(log_light), np.std(log_base)])
    result, photographs, of_base = np.sqrt(np.mean(np.square(errors), 0))
    assert result < 1.3 * min(photographs, of_base)
    assert result < 0.65 * max(photographs, of_base)
    if 0.5 < photographs / of_base < 2:  # otherwise little can be gained
        assert result < 0.9 * min(photographs, of_base)


def test_claimed_deviations_hold_the_error():
    """68 % intervals of the light's error hold it in 60 to 76 % of objects."""
    inside = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        _, base, shown, smooth, log_light, _ = _room(rng, 40, 0.12, 0.14, kappa=1.4)
        levels = compare_levels(base, shown, np.full(40, 0.1), smooth, np.full(40, 100.0))
        left = log_light - np.log(levels.light_gain)
        inside.append(np.abs(left - np.mean(left)) < levels.deviation)
    assert 0.6 < np.mean(inside) < 0.76


def test_where_the_base_tells_no_levels_the_photographs_do():
    """Nothing is divided, whatever the base says; the light keeps its whole error, which holds in 60 to 76 % of objects."""
    inside = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        _, base, shown, smooth, log_light, _ = _room(rng, 40, 0.12, 0.5, kappa=1.5)
        levels = compare_levels(base, shown, np.full(40, 0.1), smooth, np.full(40, 100.0), base_tells_levels=False)
        assert (levels.light_gain == 1).all() and not levels.facts()["divided"]
        inside.append(np.abs(log_light - np.mean(log_light)) < levels.deviation)
    assert 0.6 < np.mean(inside) < 0.76


def test_strong_disagreement_is_decided_by_the_smaller_claim():
    """A factor of three between both: the photographs are believed in steady light, the base where the light is uneven."""
    rng = np.random.default_rng(3)
    for certain, taken in ((True, 0.1), (False, 0.9)):
        _, base, shown, smooth, _, _ = _room(rng, 30, 0.04 if certain else 0.5, 0.1)
        shown[0] = 3.0 * base[0] / 0.8
        levels = compare_levels(base, shown, np.full(30, 0.1), smooth, np.full(30, 100.0))
        share = np.log(levels.light_gain[0]) / levels.discrepancy[0]
        assert share < taken if certain else share > taken


@pytest.mark.parametrize(
    ("d", "s", "c"), [(0.0, 0.1, 0.1), (0.3, 0.1, 0.02), (-1.5, 0.12, 0.6), (2.0, 0.05, 0.05), (0.4, 0.5, 0.03)]
)
def test_division_agrees_with_adaptive_integration(d, s, c):
    """Likelihood, mean and deviation of the light's part against scipy's quadrature of the product of both densities."""

    def product(x, power=0):
        return x**power * stats.t.pdf(x, 4, scale=c) * stats.t.pdf(d - x, 4, scale=s)

    corners = sorted({0.0, d, *(q * c for q in (-3, 3)), *(d + q * s for q in (-3, 3))})
    total, first = (integrate.quad(product, -60, 60, (p,), points=corners, limit=400)[0] for p in range(2))
    log_likelihood, mean, deviation = (x[0] for x in object_levels._divide(*(np.array([x]) for x in (d, s, c))))
    height = stats.t.pdf(0, 4) ** 2
    assert np.exp(log_likelihood) * height == pytest.approx(total, rel=5e-3)
    assert mean == pytest.approx(first / total, abs=3e-3 * max(s, c))
    fine = np.concatenate([np.linspace(-40 * c, 40 * c, 20001), d + np.linspace(-40 * s, 40 * s, 20001)])
    fine.sort()
    share = np.cumsum(np.gradient(fine) * product(fine)) / total
    low, high = np.interp([0.1587, 0.8413], share, fine)
    assert deviation == pytest.approx(0.5 * (high - low), rel=0.05)


def test_smooth_errors_are_told_from_noise():
    """White scatter over the patches gives no smooth error, a slow change over them gives nearly all of it."""
    rng = np.random.default_rng(0)
    owner, patches = np.repeat(np.arange(4), 60), np.tile(np.arange(60), 4)
    weight, pixels = np.ones(240), np.full(4, 1000.0)
    white = object_levels._smooth_error_of_light(0.2 * rng.normal(size=240), weight, owner, pixels)
    slow = object_levels._smooth_error_of_light(0.2 * np.sqrt(2) * np.sin(patches / 60 * 2 * np.pi), weight, owner, pixels)
    assert np.sqrt(np.mean(white**2)) < 0.08
    np.testing.assert_allclose(slow, 0.2, rtol=0.05)


def test_smooth_error_of_the_room_is_that_of_its_large_objects():
    """An object of one patch has the error of the room, in which objects count by their pixels."""
    owner = np.r_[np.repeat([0, 1], 60), 2]
    wave = np.sin(np.arange(60) / 60 * 2 * np.pi) * np.sqrt(2)
    step = np.r_[0.3 * wave, 0.1 * wave, 0.0]
    found = [
        object_levels._smooth_error_of_light(step, np.ones(121), owner, np.array(pixels))[2]
        for pixels in ([1000.0, 1.0, 50.0], [1.0, 1000.0, 50.0])
    ]
    np.testing.assert_allclose(found, [0.3, 0.1], rtol=0.05)


def test_scatter_of_predictions_is_that_of_their_gains():
    """Predictions that are off by known factors; objects that nothing shows have the scatter of the room."""
    rng = np.random.default_rng(1)
    gains = np.exp(rng.normal(0, 0.15, (400, 8)))
    affine = np.einsum("sk,ci->skci", 1 / gains, np.eye(3, 4))
    owner = np.arange(400) % 4
    scatter = prediction_scatter(affine, np.ones(400), owner, np.full((5, 3), 0.4))
    np.testing.assert_allclose(scatter, 0.15, rtol=0.12)
    assert (prediction_scatter(affine[:0], np.ones(0), owner[:0], np.full((2, 3), 0.4)) == object_levels.UNKNOWN_SCATTER).all()


_values = hnp.arrays(np.float64, (5, 3), elements=st.floats(1e-8, 1e6))


@settings(max_examples=60, deadline=None)
@given(
    base=_values,
    shown=_values,
    scatter=hnp.arrays(np.float64, 5, elements=st.floats(0, 1e3)),
    smooth=hnp.arrays(np.float64, 5, elements=st.floats(0, 1e3)),
    pixels=hnp.arrays(np.float64, 5, elements=st.sampled_from([0.0, 1.0, 1e9])),
    base_tells_levels=st.booleans(),
)
def test_any_levels_give_finite_gains(base, shown, scatter, smooth, pixels, base_tells_levels):
    """No estimate, however far off, gives a factor that is not finite, or that goes beyond both estimates."""
    levels = compare_levels(base, shown, scatter, smooth, pixels, base_tells_levels)
    for array in (levels.light_gain, levels.deviation, levels.gain, levels.discrepancy):
        assert np.isfinite(array).all()
    assert (levels.light_gain > 0).all() and (levels.deviation >= 0).all()
    low, high = np.minimum(levels.discrepancy, 0), np.maximum(levels.discrepancy, 0)
    slack = 0.02 * (levels.light_error + levels.base_error)
    assert (np.log(levels.light_gain) > low - slack).all() and (np.log(levels.light_gain) < high + slack).all()
    assert all(np.isfinite(x) for x in levels.facts().values())


@pytest.mark.parametrize("fewest", [300, 301])
def test_an_object_of_the_fewest_pixels_has_a_level_of_its_own(fewest):
    """Six objects of 300 pixels, one of them in light that was computed half as bright as it is."""
    problem, _ = problem_of(np.random.default_rng(5), 6, 300)
    for cached in (problem.diffuse, problem.s0, problem.s1):
        cached[0][problem.object_id == 0] *= 0.5
    found = fit_affines(problem, response("identity"), FitOptions(min_pixels=fewest))
    assert (found.light_gain[0] != 1) == (fewest == 300)


def test_uneven_light_leaves_the_level_to_the_base_and_the_gloss_alone():
    """For one object in six, the light was computed half as bright as it is, and unevenly. The level of this object follows the
    base, not the light. The roughness of the other objects stays as in a fit in the right light."""
    rng = np.random.default_rng(5)
    truth = np.tile(IDENTITY, (6, 1))
    truth[:, [0, 5, 10]] = 1.25  # the base is too dark by one factor everywhere
    problem, _ = problem_of(rng, 6, 2400, truth=truth)
    right = fit_affines(problem, response("identity"), FitOptions())
    rows = problem.object_id == 0
    slow = np.exp(0.45 * np.sin(np.linspace(0, 9, rows.sum())))[:, None] / 2.0
    for cached in (problem.diffuse, problem.s0, problem.s1):
        cached[0][rows] *= slow if cached[0].ndim == 2 else slow[:, None]
    found = fit_affines(problem, response("identity"), FitOptions())
    level = found.affine[:, [0, 5, 10]].mean(1)
    assert abs(np.log(level[0] / 1.25)) < 0.25  # twice as bright without the base
    np.testing.assert_allclose(np.log(level[1:] / 1.25), 0, atol=0.06)
    assert found.light_gain[0] > 1.5
    spread = np.sqrt(found.covariance[0, 0, 0]), np.sqrt(right.covariance[0, 0, 0])
    assert spread[0] > 3 * spread[1]
    np.testing.assert_allclose(found.affine[1:, 13], right.affine[1:, 13], atol=0.05)


def test_deviation_of_the_level_is_that_of_drawn_numbers():
    rng = np.random.default_rng(2)
    affine = np.tile(IDENTITY, (2, 1)) + rng.normal(0, 0.05, (2, 16))
    root = rng.normal(0, 0.02, (2, 16, 16))
    base = np.array([[0.3, 0.4, 0.6], [0.05, 0.1, 0.02]])
    claimed = level_deviation(affine, root @ root.transpose(0, 2, 1), base)
    drawn = affine[:, None] + np.einsum("oij,onj->oni", root, rng.normal(size=(2, 40000, 16)))
    level = np.einsum("onci,oi->on", drawn[..., :12].reshape(2, -1, 3, 4)[..., :3], base) + drawn[..., 3:12:4].sum(2)
    np.testing.assert_allclose(claimed, level.std(1) / level.mean(1), rtol=0.03)
    assert (level_deviation(np.zeros((1, 16)), np.ones((1, 16, 16)), base[:1]) == 0).all()


def test_gain_of_objects_that_were_not_fitted():
    """Affines whose gains trade with offsets: what counts is how bright they make the base."""
    from iif_core.fitting.object_levels import ObjectLevels, gain_of_the_rest

    base = np.array([[0.5, 0.4, 0.3], [0.2, 0.3, 0.6], [0.7, 0.7, 0.7]])
    true = np.array([1.5, 1.2, 0.9])
    affine = np.zeros((3, 16))
    for o, slope in enumerate((0.2, 1.0, -0.3)):
        for c in range(3):
            affine[o, 4 * c + c], affine[o, 4 * c + 3] = slope, (true[c] - slope) * base[o, c]
    one = np.ones(3)
    levels = ObjectLevels(base, base * true, 0 * one, 0.1 * one, 0.1 * one, true, one, 0.1 * one, 1000 * one)
    gain, error = gain_of_the_rest(levels, affine)
    np.testing.assert_allclose(gain, true, rtol=1e-6)
    # The error of the base, and that of a mean of three; 1.142 is the 84 % quantile of Student's t with four degrees of freedom.
    assert error == pytest.approx(1.142 * np.sqrt(0.1**2 + 2 * 0.1**2 / 3))
    unsure = ObjectLevels(base, base * true, 0 * one, 1.0 * one, 0.1 * one, true, one, 0.1 * one, 1000 * one)
    assert gain_of_the_rest(unsure, affine)[1] > 0.5
