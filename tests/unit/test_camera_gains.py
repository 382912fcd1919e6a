"""Exposure, white balance and vignetting from shared surface: known gains, scenes without an effect, held-out views."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from iif_core.camera.calibration.choice import calibrate_response
from iif_core.camera.gains import CameraGains, GainRows, choose_gains, estimate, falloff, radius_squared
from iif_core.camera.overlap import PatchRows
from iif_core.camera.response import response
from iif_core.light.emission import response as calibrated_views
from tests.errors import refused

VIEWS = 10
VIGNETTING = np.array([-0.35, -0.12])


def planted(
    seed: int = 0,
    patches: int = 500,
    balance: float = 0.15,
    vignetting: np.ndarray = VIGNETTING,
    noise: float = 0.02,
    gloss: float = 0.1,
) -> tuple[GainRows, np.ndarray]:
    """Rows of a scene whose gains are known; one patch in ten is glossy: too bright in some views."""
    rng = np.random.default_rng(seed)
    gain = np.exp(rng.normal(0, 0.5, (VIEWS, 1)) + rng.normal(0, balance, (VIEWS, 3)))
    gain /= np.exp(np.log(gain).mean(0))
    patch, view = (x.ravel() for x in np.meshgrid(np.arange(patches), np.arange(VIEWS), indexing="ij"))
    seen = rng.random(len(patch)) < 0.5
    patch, view = patch[seen], view[seen]
    radius2 = rng.uniform(0, 1, len(patch))
    level = rng.normal(-2.5, 0.8, (patches, 3))
    shine = np.where(rng.random(patches) < 0.1, 1.0, 0.0)[patch] * np.abs(rng.standard_cauchy(len(patch))).clip(0, 3) * gloss
    log_y = level[patch] + np.log(gain[view]) + np.log(falloff(vignetting, radius2))[:, None] + shine[:, None]
    y = np.exp(log_y + noise * rng.standard_t(4, log_y.shape))
    return GainRows(patch, view, y, radius2, patch % 25), gain


def test_gains_within_one_per_cent_and_vignetting():
    rows, gain = planted()
    out = choose_gains(rows, VIEWS)
    assert out.evidence["white_balance"].included and out.evidence["vignetting"].included
    np.testing.assert_allclose(out.gain, gain, rtol=0.01)
    r2 = np.linspace(0, 1, 11)
    np.testing.assert_allclose(falloff(out.vignetting, r2), falloff(VIGNETTING, r2), rtol=0.01)
    np.testing.assert_allclose(np.log(out.gain).mean(0), 0.0, atol=1e-6)


@pytest.mark.parametrize("lost", ["between two groups", "in one view"])
def test_a_channel_that_ties_no_views_follows_the_others(lost):
    """Blue is saturated on all surface that two groups of views share, or in one view; red and green tell the exposures."""
    rows, gain = planted(balance=0.0, vignetting=np.zeros(2), noise=0.01, gloss=0.0)
    first, y = rows.view < VIEWS // 2, rows.y.copy()
    if lost == "in one view":
        y[rows.view == 3, 2] = np.nan
    else:
        y[np.where(rows.patch % 2 == 0, first, ~first), 2] = np.nan  # no patch is blue in both
    out = estimate(replace(rows, y=y), VIEWS, vignetting=False)
    assert out.estimated.all()
    np.testing.assert_allclose(out.gain, gain, rtol=0.01)


def test_exact_data_are_solved_exactly():
    rows, gain = planted(noise=0.0, gloss=0.0)
    out = estimate(rows, VIEWS)
    np.testing.assert_allclose(out.gain, gain, rtol=2e-3)  # the prior of the falloff pulls a little
    np.testing.assert_allclose(out.vignetting, VIGNETTING, atol=5e-3)


@pytest.mark.parametrize("seed", range(4))
def test_terms_that_no_scene_needs_stay_out(seed: int):
    rows, gain = planted(seed, balance=0.0, vignetting=np.zeros(2))
    out = choose_gains(rows, VIEWS)
    assert not out.evidence["white_balance"].included and not out.evidence["vignetting"].included
    assert out.is_plain
    np.testing.assert_allclose(out.gain, gain, rtol=0.01)


def test_each_term_by_itself():
    only_lens = choose_gains(planted(1, balance=0.0)[0], VIEWS)
    assert not only_lens.evidence["white_balance"].included and only_lens.evidence["vignetting"].included
    only_balance = choose_gains(planted(2, vignetting=np.zeros(2))[0], VIEWS)
    assert only_balance.evidence["white_balance"].included and not only_balance.evidence["vignetting"].included


def test_a_lens_that_falls_off_with_cos4():
    """The true curve is not in the family, but is matched within 1.5 %."""
    rows, _ = planted(3)
    tangent2 = 0.45 * rows.radius2  # half the diagonal at 34 degrees
    y = rows.y / falloff(VIGNETTING, rows.radius2)[:, None] / ((1 + tangent2) ** 2)[:, None]
    out = choose_gains(GainRows(rows.patch, rows.view, y, rows.radius2, rows.block), VIEWS)
    r2 = np.linspace(0, 1, 11)
    np.testing.assert_allclose(falloff(out.vignetting, r2), (1 + 0.45 * r2) ** -2.0, rtol=0.015)


def test_views_without_overlap_keep_one():
    rows, _ = planted(5)
    alone = rows.take(rows.view == 2)
    out = choose_gains(alone, VIEWS)
    np.testing.assert_array_equal(out.gain, 1.0)
    assert not out.estimated.any() and not out.evidence["vignetting"].included
    with refused("gains", "0..9", "0..2"):
        estimate(rows, 3)


def test_radius_is_one_in_the_corners():
    r2 = radius_squared(np.array([0, 63, 64 * 47, 64 * 48 - 1, 64 * 24 + 32]), 64, 48)
    np.testing.assert_allclose(r2[:4], 1.0, atol=0.05)
    assert r2[4] < 1e-3


def test_with_the_response_unknown_too():
    """8-bit values through gamma 1.9: chroma and vignetting to 1.5 %; the power of the exposures is a convention."""
    rows, gain = planted(6, patches=300)
    curve = response("gamma", [1.9])
    value = np.round(255 * curve(np.clip(rows.y, 0, 1))) / 255
    count = np.full(len(rows.view), 9)
    table = PatchRows(
        rows.patch.astype(np.uint64),
        np.zeros(len(count), np.int8),
        rows.block,
        rows.view,
        value,
        value >= 0.99,
        count,
        rows.radius2,
    )
    out = calibrate_response(table, np.ones(VIEWS), given=False)
    found = out.gains
    assert found.evidence["white_balance"].included and found.evidence["vignetting"].included
    power = np.polyfit(np.log(gain).mean(1), np.log(found.gain).mean(1), 1)[0]
    chroma, truth = (np.log(g) - np.log(g).mean(1, keepdims=True) for g in (found.gain, gain))
    level = np.log(gain).mean(1, keepdims=True)
    truth = truth - level * (level * truth).sum(0) / (level**2).sum()  # the same gauge: chroma does not go with exposure
    np.testing.assert_allclose(chroma, power * truth, atol=0.015)
    r2 = np.linspace(0, 1, 5)
    np.testing.assert_allclose(np.log(falloff(found.vignetting, r2)), power * np.log(falloff(VIGNETTING, r2)), atol=0.015)


def test_plain_gains():
    plain = CameraGains.plain(np.array([0.5, 2.0]))
    assert plain.is_plain
    np.testing.assert_allclose(plain.factor(1, np.array([0.0, 1.0])), 2.0)
    np.testing.assert_allclose(plain.exposure, [0.5, 2.0])


def test_balanced_light_shows_what_the_gains_say():
    """Stage affines uses one exposure per pixel; the light includes the ratios of the channels to it."""
    from workflow.fitting.inputs import balanced

    rng = np.random.default_rng(0)
    factor, lobes = rng.uniform(0.3, 3, (5, 3)), rng.uniform(0, 1, (5, 4, 3))
    exposure = np.exp(np.log(factor).mean(1))
    shown = exposure[:, None, None] * balanced(lobes, factor / exposure[:, None])
    np.testing.assert_allclose(shown, factor[:, None] * lobes)


def test_gains_of_views_that_are_not_used_are_those_of_the_start(monkeypatch):
    """Of a curve that is given, the gains of used views are found on their surface; of others nothing is known but the start."""
    start, found = CameraGains.plain(np.array([2.0, 3.0, 4.0])), CameraGains.plain(np.array([0.5, 1.0, 8.0]))
    found = replace(found, estimated=np.array([True, False, True]))
    monkeypatch.setattr(calibrated_views, "gain_rows", lambda rows, curve: SimpleNamespace(thinned=lambda: rows))
    monkeypatch.setattr(calibrated_views, "choose_gains", lambda rows, views: found if views == 3 else None)
    gains = calibrated_views._all_gains(start, np.array([0, 2]), SimpleNamespace(gains=None, response=None), None)
    np.testing.assert_array_equal(gains.gain[:, 1], [0.5, 3.0, 8.0])
    own = CameraGains(found.gain[[0, 2]], np.array([0.1, 0.2]), np.array([True, False]))
    gains = calibrated_views._all_gains(start, np.array([0, 2]), SimpleNamespace(gains=own), None)
    np.testing.assert_array_equal(gains.gain[:, 1], [0.5, 3.0, 8.0])
    np.testing.assert_array_equal(gains.estimated, [True, False, False])
    np.testing.assert_array_equal(gains.vignetting, [0.1, 0.2])
