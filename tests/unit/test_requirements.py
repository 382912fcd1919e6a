"""Evidence and probes: held-out likelihood in closed form, planted light, planted gloss, and the extremes."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from iif_core.numerics.xp import NUMPY
from iif_core.reflectance import brdf
from iif_core.reflectance.directional_albedo import COSINES, directional_albedo, uniform_lobes
from iif_core.requirements.evidence import NOTHING, folds_of_blocks, held_out_evidence, laplace_log_likelihood
from iif_core.requirements.probes import GlossRows, LightRows, gloss_evidence, light_evidence

BLOCKS, EACH = 60, 20


def blocks():
    return np.repeat(np.arange(BLOCKS), EACH)


# ----------------------------------------------------------------------------------------------------------- evidence


def test_likelihood_is_a_density():
    x = np.linspace(-60, 60, 240_001)
    density = np.exp(laplace_log_likelihood(x, 1.7))
    assert density.sum() * (x[1] - x[0]) == pytest.approx(1.0, abs=1e-6)


def test_gain_is_that_of_the_closed_form():
    """Half the residuals at half the scale: log 2 nats a row, whatever the folds."""
    rng = np.random.default_rng(0)
    noise = rng.laplace(size=BLOCKS * EACH)
    found = held_out_evidence(noise, 0.5 * noise, folds_of_blocks(blocks(), 0), blocks())
    assert found.gain == pytest.approx(len(noise) * np.log(2), rel=1e-12)
    assert found.error == pytest.approx(0.0, abs=1e-9) and found.pays and found.rows == len(noise)


def test_error_is_that_of_the_sums_of_blocks():
    """Over many draws, the gains scatter as the error says."""
    gains, errors = [], []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        signal, noise = np.repeat(rng.normal(size=BLOCKS), EACH), rng.laplace(size=BLOCKS * EACH)
        found = held_out_evidence(noise + 0.3 * signal, noise, folds_of_blocks(blocks(), seed), blocks())
        gains.append(found.gain)
        errors.append(found.error)
    assert np.std(gains) == pytest.approx(np.mean(errors), rel=0.3)


def test_folds_hold_whole_blocks_and_are_even():
    fold = folds_of_blocks(blocks(), 3).reshape(BLOCKS, EACH)
    assert (fold == fold[:, :1]).all() and np.bincount(fold[:, 0]).tolist() == [BLOCKS // 2] * 2


@pytest.mark.parametrize("rows", [0, 1, 3])
def test_too_little_says_nothing(rows):
    r, block = np.ones(rows), np.zeros(rows, int)
    assert held_out_evidence(r, r, folds_of_blocks(block, 0), block) == NOTHING
    assert not NOTHING.pays


def test_what_is_not_finite_is_left_out():
    noise = np.random.default_rng(0).laplace(size=BLOCKS * EACH)
    spoilt = noise.copy()
    spoilt[::7] = [np.nan, np.inf] * 85 + [np.nan] * (len(spoilt[::7]) - 170)
    found = held_out_evidence(spoilt, 0.5 * noise, folds_of_blocks(blocks(), 0), blocks())
    assert np.isfinite([found.gain, found.error]).all() and found.rows == np.isfinite(spoilt).sum()


@settings(max_examples=30, deadline=None)
@given(scale=st.sampled_from([0.0, 1e-300, 1e-30, 1.0, 1e30, 1e300]), seed=st.integers(0, 99))
def test_finite_at_any_scale(scale, seed):
    noise = scale * np.random.default_rng(seed).laplace(size=BLOCKS * EACH)
    found = held_out_evidence(noise, 0.5 * noise, folds_of_blocks(blocks(), seed), blocks())
    assert np.isfinite([found.gain, found.error]).all()


# -------------------------------------------------------------------------------------------------------------- light


def light_rows(outside=0.0, lamps=0.0, noise=0.1, unit=1.0, seed=0):
    """Surface of three albedos in the light of walls, of saturated lamps and of the outside."""
    rng = np.random.default_rng(seed)
    n = BLOCKS * EACH
    known, saturated, escaping = rng.gamma(4, 0.25, n), rng.random(n) ** 4, rng.random(n) ** 4
    group = rng.integers(0, 3, n)
    light = known + lamps * saturated + outside * escaping
    radiance = np.array([0.2, 0.5, 0.8])[group] * light * np.exp(noise * rng.laplace(size=n))
    return LightRows(
        radiance=unit * radiance, known=unit * known, saturated=saturated, escaping=escaping, group=group, block=blocks()
    )


@pytest.mark.parametrize("outside", [0.0, 3.0])
@pytest.mark.parametrize("lamps", [0.0, 3.0])
def test_planted_light_is_found_and_no_other(outside, lamps):
    found = light_evidence(light_rows(outside, lamps), 0)
    assert found["environment"].pays == (outside > 0) and found["emitters"].pays == (lamps > 0)


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_units_of_radiance_do_not_matter(unit):
    one, other = (light_evidence(light_rows(3.0, unit=u), 0)["environment"] for u in (1.0, unit))
    assert other.gain == pytest.approx(one.gain, rel=1e-6)


def test_points_in_the_dark_are_no_trouble():
    rows = light_rows(3.0)
    rows = replace(rows, known=0 * rows.known)
    assert all(np.isfinite([e.gain, e.error]).all() for e in light_evidence(rows, 0).values())
    few = rows.take(slice(4))
    assert set(light_evidence(few, 0).values()) == {NOTHING}


# -------------------------------------------------------------------------------------------------------------- gloss


def gloss_rows(strength, noise=0.02, gain=0.0, seed=0):
    """Pairs of photographs of three objects, of which the last reflects `strength` times a lobe."""
    rng = np.random.default_rng(seed)
    n = BLOCKS * EACH
    group, view = rng.integers(0, 3, n), np.stack([rng.integers(0, 4, n), rng.integers(4, 8, n)], 1)
    lobes = rng.gamma(1.0, 0.05, (n, 2, 3))
    shown = np.where((group == 2)[:, None], strength * lobes[:, :, 1], 0)
    radiance = (0.8 + shown) * np.exp(noise * rng.laplace(size=(n, 2)) + gain * (view == 5))
    return GlossRows(radiance=radiance, lobes=lobes, view=view, point=np.arange(n) // 2, group=group, block=blocks())


def test_planted_gloss_is_found_on_its_object():
    rows = gloss_rows(1.0)
    assert gloss_evidence(rows, 0).pays

    def part(keep):
        return rows.take(keep)

    assert gloss_evidence(part(rows.group == 2), 0).pays and not gloss_evidence(part(rows.group != 2), 0).pays


def test_matte_surface_is_not_taken_for_gloss():
    """At most a few of twenty draws: the decision is made at one standard error."""
    assert sum(gloss_evidence(gloss_rows(0.0, seed=seed), seed).pays for seed in range(20)) <= 4


def test_exposures_that_are_slightly_wrong_are_no_gloss():
    evidence = gloss_evidence(gloss_rows(0.0, gain=0.2), 0)
    assert not evidence.pays or evidence.gain < 3 * evidence.error
    assert gloss_evidence(gloss_rows(1.0, gain=0.2), 0).pays


def test_lobes_without_end_stay_finite():
    rows = gloss_rows(0.0)
    evidence = gloss_evidence(replace(rows, lobes=1e30 * rows.lobes), 0)
    assert np.isfinite([evidence.gain, evidence.error]).all()
    few = rows.take(slice(4))
    assert gloss_evidence(few, 0) == NOTHING


def test_one_block_of_surface_says_nothing():
    light, gloss = light_rows(3.0), gloss_rows(1.0)
    assert set(light_evidence(replace(light, block=0 * light.block), 0).values()) == {NOTHING}
    assert gloss_evidence(replace(gloss, block=0 * gloss.block), 0) == NOTHING


def test_groups_of_one_fold_are_no_evidence():
    """A level that only the held-out rows could tell is not known."""
    light = light_rows(3.0)
    assert light_evidence(replace(light, group=light.block), 0)["environment"] == NOTHING


# ------------------------------------------------------------------------------------------------------ uniform lobes


@pytest.mark.parametrize("roughness", [0.3, 0.6, 0.9, 1.0])
def test_directional_albedo_is_the_integral_over_the_hemisphere(roughness):
    """Two roads to one number: half vectors by the midpoint rule, and a grid of directions of light."""
    table = directional_albedo(np.array([roughness]))[:, 0]
    steps = 1500
    z = (np.arange(steps) + 0.5) / steps
    phi = 2 * np.pi * (np.arange(steps) + 0.5) / steps
    sine = np.sqrt(1 - z**2)
    wi = (sine[:, None] * np.cos(phi), sine[:, None] * np.sin(phi), np.broadcast_to(z[:, None], (steps, steps)))
    for number in (8, 16, 32):
        cosine = COSINES[number]
        wo = (np.sqrt(1 - cosine**2), 0.0, cosine)
        NoL, NoV, NoH, VoH, sin2_h = brdf.half_angles(NUMPY, (0.0, 0.0, 1.0), wi, wo)
        _, spec, fc = brdf.lobes(NUMPY, NoL, NoV, NoH, VoH, sin2_h, roughness)
        solid = 2 * np.pi / steps**2
        expected = [(spec * (1 - fc)).sum() * solid, (spec * fc).sum() * solid]
        assert table[:, number] == pytest.approx(expected, rel=0.02, abs=2e-4)


def test_no_more_is_reflected_than_arrives():
    table = directional_albedo(np.linspace(0.02, 1, 12))
    assert np.isfinite(table).all() and (table >= 0).all() and (table.sum(0) <= 1.02).all()


def test_uniform_lobes_are_the_light_times_the_albedo():
    diffuse = np.random.default_rng(0).random((2, 5, 3)).astype(np.float32)
    s0, s1 = uniform_lobes(diffuse, np.ones(5), np.array([0.5, 1.0]))
    table = directional_albedo(np.array([0.5, 1.0]))[:, :, -1]
    assert s0.shape == s1.shape == (2, 5, 2, 3) and s0.dtype == np.float32
    np.testing.assert_allclose(s0, diffuse[:, :, None] * table[0][:, None], rtol=1e-6)
    np.testing.assert_allclose(s1, diffuse[:, :, None] * table[1][:, None], rtol=1e-6, atol=1e-9)


def test_hardly_any_ray_outside_says_nothing():
    rows = light_rows(3.0)
    few = np.where(np.arange(len(rows.escaping)) < 5, rows.escaping, 0)
    assert light_evidence(replace(rows, escaping=few), 0)["environment"] == NOTHING
