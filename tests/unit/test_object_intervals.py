"""Intervals of objects: closed forms, brute force, the definition of the conformal factor, and extremes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from iif_core.errors import InputError
from iif_core.fitting.intervals import (
    AlbedoIntervals,
    MeasuredErrors,
    MetallicIntervals,
    RoughnessIntervals,
    conformal_factor,
    mixture_quantile,
    pooled,
    student_width,
)
from iif_core.fitting.problem import Kinds

NOTHING = MeasuredErrors(*[1e-6] * 5, 1.0, 1.0, 1.0)
USUAL = MeasuredErrors(0.01, 0.4, 0.05, 0.1, 0.2, 1.0, 1.0, 1.0)
Q4 = stats.t.ppf(0.975, 4) / stats.t.ppf(stats.norm.cdf(1), 4)


def kinds(n=1, probability=(1.0, 0.0, 0.0), brightness=(0.0, 0.0, 0.0), roughness=(0.5, 0.0, 0.0), deviation=0.1, seen=1.0):
    rows = (np.tile(np.asarray(row, float), (n, 1)) for row in (probability, brightness, roughness, [deviation] * 3))
    return Kinds(*rows, seen=np.full(n, float(seen)), witnesses=np.zeros((n, 3)))


def albedo(value, level=0.1, pixels=1e12, room=0.0, errors=NOTHING, of=None, factor=1.0):
    value = np.atleast_2d(np.broadcast_to(value, (3,)))
    own = AlbedoIntervals.of(value, [level], [pixels], room, of or kinds(), errors)
    low, high = own.ends(factor)
    return low[0], high[0]


# -------------------------------------------------------------------------------------------------------- distributions


def test_student_width_has_the_normal_limit_and_that_of_cauchy():
    sigma = stats.norm.cdf(1)
    assert student_width(np.inf) == pytest.approx(1.959964, abs=1e-6)
    assert student_width(1e9) == pytest.approx(1.959964, abs=1e-6)
    assert student_width(1.0) == pytest.approx(np.tan(np.pi * 0.475) / np.tan(np.pi * (sigma - 0.5)))
    assert student_width(4.0) == pytest.approx(2.43, abs=0.005)


def test_pooled_errors_have_the_freedom_of_welch_and_satterthwaite():
    total, freedom = pooled([3.0, 1.0], [4.0, np.inf])
    assert total == 4.0 and freedom == pytest.approx(4.0 * 16.0 / 9.0)
    _, alike = pooled([2.0, 2.0, 2.0], [5.0, 5.0, 5.0])
    assert alike == pytest.approx(15.0)
    assert pooled([0.0, 2.0], [4.0, np.inf])[1] == np.inf


def test_quantile_of_a_mixture_is_that_of_its_samples():
    weight, middle, error, freedom = (np.array(v) for v in ([0.7, 0.3], [0.0, 3.0], [1.0, 0.5], [4.0, 7.0]))
    rng = np.random.default_rng(0)
    n = 400_000
    part = rng.random(n) < 0.3
    scale = error / stats.t.ppf(stats.norm.cdf(1), freedom)
    draws = np.where(part, middle[1] + scale[1] * rng.standard_t(7, n), scale[0] * rng.standard_t(4, n))
    for share in (0.025, 0.5, 0.7, 0.975):
        found = mixture_quantile(share, weight, middle, error, freedom)
        assert np.mean(draws < found) == pytest.approx(share, abs=4 * np.sqrt(share * (1 - share) / n)), share


def test_quantile_of_one_part_is_that_of_student():
    found = mixture_quantile(
        0.975, np.array([[2.0, 0.0]]), np.array([[1.0, 1e9]]), np.array([[0.5, 1.0]]), np.array([[4.0, 4.0]])
    )
    assert found == pytest.approx(1.0 + 0.5 * Q4)


def one_room(residual, *, probability=0.95, until=np.inf):
    return conformal_factor(residual, np.zeros(len(residual), int), until, probability)


@given(st.lists(st.floats(0, 100), min_size=1, max_size=80), st.sampled_from([0.5, 0.8, 0.95]))
def test_conformal_factor_is_the_order_statistic_of_its_definition(residual, probability):
    """The smallest q with #{r <= q} >= p (n + 1)."""
    n, ordered = len(residual), sorted(residual)
    needed = int(np.ceil(round(probability * (n + 1), 9)))
    expected = ordered[needed - 1] if needed <= n else np.inf
    assert one_room(residual, probability=probability) == expected


def test_nineteen_errors_are_the_fewest_for_95_percent():
    assert one_room(np.arange(19.0)) == 18.0
    assert one_room(np.arange(18.0)) == np.inf == one_room([])


def test_conformal_factor_holds_the_next_error_as_often_as_asked():
    rng = np.random.default_rng(1)
    draws = rng.exponential(size=(4000, 40))
    inside = [row[-1] <= one_room(row[:-1], probability=0.9) for row in draws]
    assert np.mean(inside) == pytest.approx(0.9, abs=4 * np.sqrt(0.09 / 4000))


def test_every_room_weighs_the_same_in_the_factor():
    """A room of many small errors does not outvote one of few large ones."""
    residual, room = np.r_[np.zeros(1000), 5.0, 5.0], np.r_[np.zeros(1000, int), 1, 1]
    found = [conformal_factor(residual, room, probability=share) for share in (0.4, 0.6)]
    assert found == [0.0, 5.0]


CLAIM = st.tuples(st.floats(0, 10), st.sampled_from([0.0, 1.0, 3.0, 5.0, 20.0, np.inf]), st.integers(0, 3))


@given(st.lists(CLAIM, max_size=60), st.sampled_from([0.5, 0.8, 0.95]))
def test_conformal_factor_counts_what_is_still_claimed(claims, probability):
    """By brute force: the least factor with which the means over rooms of what is claimed are held often enough."""
    residual, until, room = (np.array(column) for column in zip(*claims, strict=True)) if claims else np.zeros((3, 0))
    expected = np.inf
    for factor in sorted({*residual, *until}):
        shares = [(residual <= factor)[own].mean() for r in range(4) if (own := (room == r) & (until > factor)).any()]
        n = (until > factor).sum()
        if np.isfinite(factor) and shares and sum(shares) >= probability * len(shares) * (1 + 1 / n) * (1 - 1e-12):
            expected = factor
            break
    assert conformal_factor(residual, room, until, probability) == expected


def test_a_claim_that_has_grown_to_everything_holds_nothing():
    """Twenty narrow claims hold; nineteen that do not are 0 to 1 from 2 on, and are no claims any more with 2."""
    residual, until = np.r_[np.full(20, 1.0), np.full(19, 9.0)], np.r_[np.full(20, 30.0), np.full(19, 2.0)]
    assert one_room(residual, until=until) == 2.0 and one_room(residual) == 9.0


# -------------------------------------------------------------------------------------------------------------- albedo


def test_bright_albedo_has_a_factor_and_dark_albedo_an_offset():
    low, high = albedo(0.3)
    assert low[0] == pytest.approx(0.3 * np.exp(-0.1 * Q4), rel=1e-4) and high[0] == pytest.approx(
        0.3 * np.exp(0.1 * Q4), rel=1e-4
    )
    additive = replace(NOTHING, additive=0.02)
    low, high = albedo(0.0, errors=additive)  # the additive error alone, which is normal
    assert low[0] == 0.0 and high[0] == pytest.approx(0.02 * 1.959964, rel=0.01)
    borders = replace(NOTHING, additive=0.012, border=0.32)  # 0.32 / sqrt(400) = 0.016, and 0.02 with the additive error
    assert albedo(0.0, pixels=400, errors=borders)[1][0] == pytest.approx(high[0], rel=1e-6)
    low, high = albedo(0.5, level=1e-9, errors=additive)
    assert (low[0], high[0]) == pytest.approx((0.5 - 0.02 * 1.959964, 0.5 + 0.02 * 1.959964), rel=1e-4)


def test_relative_errors_add_up_in_squares():
    """Level of the object 0.03, room 0.1, hue 0.05."""
    low, high = albedo(0.3, level=0.03, room=0.1, errors=replace(NOTHING, hue=0.05))
    total, freedom = pooled(np.array([0.03, 0.1, 0.05]) ** 2, [4.0, np.inf, np.inf])
    expected = np.sqrt(total) * student_width(freedom)
    assert np.log(high[0] / 0.3) == pytest.approx(expected, rel=1e-3) == np.log(0.3 / low[0])


def test_freedom_is_that_of_the_errors_at_the_albedo():
    """In the dark the additive error, which is normal, prevails over that of the level, which has four degrees of freedom."""
    errors = replace(NOTHING, additive=0.02)
    for value in (0.02, 0.1, 0.5):
        own = AlbedoIntervals.of([[value] * 3], [0.1], [1e12], 0.0, kinds(), errors)
        freedom = pooled([(0.1 * value) ** 2, 0.02**2], [4.0, np.inf])[1]
        assert own.above[0] == pytest.approx([student_width(freedom)] * 3, rel=1e-6), value


def test_factor_widens_on_the_scale():
    low, high = albedo(0.3, factor=2.0)
    assert np.log(high[0] / low[0]) == pytest.approx(4 * 0.1 * Q4, rel=1e-4)


def test_a_kind_that_is_not_excluded_widens_towards_it():
    plain = albedo(0.2)
    low, high = albedo(0.2, of=kinds(probability=(0.8, 0.2, 0.0), brightness=(0.0, 1.0, 0.0)))
    freedom = np.array([4.0, 4.0])
    expected = mixture_quantile(0.975, np.array([0.8, 0.2]), np.log(0.2) + np.array([0.0, 1.0]), np.full(2, 0.1), freedom)
    assert high[0] == pytest.approx(np.exp(expected), rel=1e-3) and high[0] > 0.5
    assert low[0] >= plain[0][0] - 1e-9  # less of the probability is on the dark side
    far = albedo(0.2, of=kinds(probability=(1.0 - 1e-9, 1e-9, 0.0), brightness=(0.0, 1.0, 0.0)))
    assert far[1][0] == pytest.approx(plain[1][0], rel=1e-3)


@pytest.mark.parametrize(
    "level, room, value", [(0.0, 0.1, 0.3), (np.nan, 0.1, 0.3), (np.inf, 0.1, 0.3), (0.1, np.nan, 0.3), (0.1, 0.1, np.nan)]
)
def test_what_is_not_known_lies_within_0_and_1(level, room, value):
    low, high = albedo(value, level=level, room=room)
    assert (low == 0).all() and (high == 1).all()


def test_stated_errors_of_the_model_are_held_as_often_as_claimed():
    rng = np.random.default_rng(2)
    n, errors = 20_000, USUAL
    truth, level, pixels = rng.uniform(0.02, 0.6, (n, 3)), rng.uniform(0.05, 0.1, n), rng.uniform(100, 1000, n)
    scale = 1.0 / stats.t.ppf(stats.norm.cdf(1), 4)
    relative = level * scale * rng.standard_t(4, n) + 0.1 * rng.normal(size=n)
    additive = np.hypot(0.01, 0.4 / np.sqrt(pixels))[:, None] * rng.normal(size=(n, 3))
    found = truth * np.exp(relative[:, None] + 0.05 * rng.normal(size=(n, 3))) + additive
    low, high = AlbedoIntervals.of(found, level, pixels, 0.1, kinds(n), errors).ends(1.0)
    assert np.mean((low <= truth) & (truth <= high)) == pytest.approx(0.95, abs=0.01)


# ------------------------------------------------------------------------------------------------- roughness, metallic


def test_roughness_has_the_errors_of_its_profile_and_of_its_kind():
    errors = replace(NOTHING, dielectric=0.05, metal=0.3)
    low, high = RoughnessIntervals.of([0.4, 0.9], kinds(2, deviation=0.12), errors).ends(0.8)
    half = 0.8 * Q4 * np.hypot(0.12, 0.05)
    assert low == pytest.approx([0.4 - half, 0.9 - half]) and high == pytest.approx([0.4 + half, 1.0])
    metal = RoughnessIntervals.of([0.4], kinds(probability=(0.0, 1.0, 0.0), deviation=0.12), errors)
    assert metal.above[0] == pytest.approx(Q4 * np.hypot(0.12, 0.3)) == metal.below[0]
    of = kinds(probability=(0.7, 0.3, 0.0), roughness=(0.4, 0.8, 0.0), deviation=0.12)
    (low,), (high,) = RoughnessIntervals.of([0.4], of, errors).ends(0.5)
    rng = np.random.default_rng(3)
    is_metal = rng.random(400_000) < 0.3
    error = np.hypot(0.12, np.where(is_metal, 0.3, 0.05)) / 1.1416
    ends = np.quantile(np.where(is_metal, 0.8, 0.4) + error * rng.standard_t(4, 400_000), [0.025, 0.975])
    assert [low, high] == pytest.approx(np.clip(0.4 + 0.5 * (ends - 0.4), 0, 1), abs=0.01)


def test_roughness_that_no_photograph_shows_is_0_to_1():
    own = RoughnessIntervals.of([0.4, 0.4, np.nan], kinds(3, seen=0.49), USUAL)
    low, high = own.ends(1.0)
    assert (low == 0).all() and (high == 1).all() and (own.until == 0).all()
    seen = RoughnessIntervals.of([0.4], kinds(seen=0.51), USUAL).ends(0.5)
    assert seen[0][0] > 0.01 and seen[1][0] < 0.99


@settings(deadline=None)
@given(st.floats(0, 1), st.floats(0.001, 1.0))
def test_roughness_is_claimed_until_its_interval_is_0_to_1(value, deviation):
    own = RoughnessIntervals.of([value], kinds(deviation=deviation), USUAL)
    until = own.until[0]
    (low,), (high,) = own.ends(until * (1 + 1e-9))
    assert low == pytest.approx(0, abs=1e-12) and high == pytest.approx(1, abs=1e-12)
    (low,), (high,) = own.ends(until * (1 - 1e-6))
    assert low > 0 or high < 1


def test_metallic_excludes_what_is_rarer_than_one_in_twenty():
    probability = np.array([[0.96, 0.04, 0.0], [0.94, 0.06, 0.0], [0.04, 0.96, 0.0], [0.5, 0.01, 0.49], [0.0, 0.0, 0.0]])
    own = MetallicIntervals.of(
        [0.0, 0.0, 1.0, 0.3, 0.0], Kinds(probability, *[np.zeros((5, 3))] * 3, seen=np.ones(5), witnesses=np.zeros((5, 3)))
    )
    low, high = own.ends(1.0)
    assert low.tolist() == [0.0, 0.0, 1.0, 0.0, 0.0] and high.tolist() == [0.0, 1.0, 1.0, 1.0, 1.0]
    low, high = own.ends(1.2)  # odds of 24 to 1 become 14 to 1
    assert high[0] == 1.0 and low[2] == 0.0
    needed = own.residual([1.0, 0.0, 0.0, 0.3, 1.0])
    assert needed[0] == pytest.approx(np.log(24) / np.log(19)) == needed[2]
    assert needed[1] == needed[3] == needed[4] == 0.0


# ------------------------------------------------------------------------------------------------------------ extremes

ANY = st.one_of(st.floats(0, 1), st.sampled_from([0.0, 1.0, 1e-300, 1e300, np.inf, np.nan]))
PROBABILITIES = st.tuples(ANY, ANY, ANY).map(lambda p: p if np.isfinite(p).all() and 0 < sum(p) < 1e6 else (0.0, 0.0, 0.0))


@settings(max_examples=300, deadline=None)
@given(ANY, ANY, ANY, ANY, PROBABILITIES, st.floats(-50, 50), ANY, st.sampled_from([1e-3, 1.0, 1e3]))
def test_intervals_are_within_0_and_1_whatever_is_known(value, level, pixels, room, probability, shift, deviation, factor):
    of = kinds(probability=probability, brightness=(0.0, shift, -shift), roughness=(value, value, value), deviation=deviation)
    with np.errstate(all="raise", under="ignore"):
        made = [
            AlbedoIntervals.of([[value] * 3], [level], [pixels], room, of, USUAL).ends(factor),
            RoughnessIntervals.of([value], of, USUAL).ends(factor),
            MetallicIntervals.of([value], of).ends(factor),
        ]
    for low, high in made:
        assert ((0 <= low) & (low <= high) & (high <= 1)).all()


@settings(max_examples=200, deadline=None)
@given(st.floats(0.02, 0.98), st.floats(0.02, 0.98), st.floats(0.01, 1.0), st.floats(0.0, 0.5), st.floats(-2, 2))
def test_an_interval_of_the_residual_just_reaches_the_truth(value, truth, level, other, shift):
    of = kinds(
        probability=(1 - other, other, 0.0), brightness=(0.0, shift, 0.0), roughness=(value, 0.5, 0.5), deviation=level / 3
    )
    for own in (AlbedoIntervals.of([[value] * 3], [level], [100], 0.1, of, USUAL), RoughnessIntervals.of([value], of, USUAL)):
        factor = float(np.max(own.residual([truth])))
        low, high = (float(np.ravel(end)[0]) for end in own.ends(max(factor, 1e-12)))
        assert (high if truth > value else low) == pytest.approx(truth, abs=1e-6)


@pytest.mark.parametrize(
    "spoilt", [{"hue": 0.0}, {"hue": None}, {"albedo": float("nan")}, {"border": float("inf")}, {"metallic": "1"}]
)
def test_spoilt_constants_are_refused(spoilt):
    whole = {"additive": 0.01, "hue": 0.05, "border": 1.0, "dielectric": 0.1, "metal": 0.2}
    whole |= {"albedo": 1.2, "roughness": 1.0, "metallic": 1.0}
    assert MeasuredErrors.from_facts(whole, "f").albedo == 1.2
    with pytest.raises(InputError):
        MeasuredErrors.from_facts(whole | spoilt, "f")
