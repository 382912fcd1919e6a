"""Camera response from shared surface: known curves, choice of the family, size of the errors, extreme input."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from iif_core.camera.calibration.choice import CANDIDATES, calibrate_response, candidates, gain_rows, power_of_exposures
from iif_core.camera.gains import CameraGains, estimate
from iif_core.camera.overlap import PatchRows, join_rows, no_rows, patch_rows
from iif_core.camera.response import response
from iif_core.light.emission import photographs as of_photographs
from iif_core.light.emission import response as of_light
from lab.simulated.photographs import response_curve

EXPOSURES = np.array([0.25, 0.5, 1.0, 2.0, 4.0, 0.25, 1.0, 4.0])
X = np.linspace(0, 1, 101)[:, None].repeat(3, 1)


def _rows(rng, curve, exposure=EXPOSURES, n_patches=500, gloss=0.02, blocks=20, rounding=True, common=0.0):
    """Patches seen by every view; `common`: error that the patches of a block share in a view."""
    n_views = len(exposure)
    surface = np.exp(rng.normal(-1.3, 1.0, (n_patches, 3)))
    patch, view = (part.ravel() for part in np.meshgrid(np.arange(n_patches), np.arange(n_views), indexing="ij"))
    block = patch % blocks
    shift = gloss * rng.standard_t(4, (len(patch), 3)) + common * rng.normal(size=(blocks, n_views))[block, view][:, None]
    value = curve(np.clip(exposure[view, None] * surface[patch] * np.exp(shift), 0, 1))
    value = np.round(255 * value) / 255 if rounding else value
    count = np.full(len(patch), 9)
    zero = np.zeros(len(patch), np.int8)
    return PatchRows(patch.astype(np.uint64), zero, block, view, value, value >= 0.99, count), exposure


def _rms(found, truth):
    return 100 * np.sqrt(np.mean((found(X) - truth(X)) ** 2, 0)).max()


@pytest.mark.parametrize(
    ("truth", "family", "limit"),
    [
        (response("gamma", [1.9]), "gamma", 0.2),
        (response_curve("srgb"), "srgb", 1e-9),
        (response_curve("filmic"), "spline", 0.9),
        (response_curve("soft"), "spline", 0.9),
    ],
    ids=["gamma 1.9", "srgb", "filmic", "soft"],
)
def test_known_exposures_give_curve_and_family(truth, family, limit):
    rows, exposure = _rows(np.random.default_rng(1), truth)
    out = calibrate_response(rows, exposure)
    assert out.response.family == family and family in out.reason
    assert _rms(out.response, truth) < limit
    assert [entry["family"] for entry in out.candidates] == list(CANDIDATES)
    if out.response.names:
        assert out.after < 0.05 and out.after < 0.5 * out.before


def test_exact_data_give_exact_parameters():
    truth = response("ggcm", [[-0.7, 0.3, -0.1], [-0.8, 0.0, 0.0], [-0.75, 0.1, 0.2]])
    out = calibrate_response(*_rows(np.random.default_rng(5), truth, gloss=0.0, rounding=False), families=("ggcm",))
    assert _rms(out.response, truth) < 0.1


def test_a_glossy_block_and_outliers_do_not_matter():
    rng = np.random.default_rng(6)
    truth = response_curve("filmic")
    rows, exposure = _rows(rng, truth)
    rows.value[rows.block < 4] = np.clip(
        rows.value[rows.block < 4] * np.exp(rng.normal(0, 0.4, ((rows.block < 4).sum(), 3))), 0, 1
    )
    bad = rng.random(len(rows.view)) < 0.05
    rows.value[bad] = rng.uniform(0, 1, (bad.sum(), 3))
    rows.clipped[:] = rows.value >= 0.99
    assert _rms(calibrate_response(rows, exposure, ("spline",)).response, truth) < 1.0


def test_claimed_errors_cover_the_truth():
    """Correlated errors of the patches of an object make standard errors of independent rows far too small."""
    square = []
    for seed in range(8):
        rows, exposure = _rows(np.random.default_rng(seed), response("gamma", [1.9]), n_patches=300, common=0.1)
        out = calibrate_response(rows, exposure, ("gamma",))
        square.append((out.response.params.ravel() - 1.9) ** 2 / np.diag(out.covariance))
    assert 0.3 < np.mean(square) < 2.5  # some 40 if rows were independent


def test_equal_exposures_or_no_overlap_say_so_and_take_the_simplest():
    rng = np.random.default_rng(7)
    rows, _ = _rows(rng, response("gamma", [1.8]), n_patches=300)
    same = calibrate_response(rows, np.ones(8))
    assert same.response.family == "srgb" and "less than 1 stop" in same.reason
    fixed = calibrate_response(rows, np.ones(8), ("ggcm",))
    np.testing.assert_array_equal(fixed.response.params, response("ggcm", np.tile([-0.8, 0, 0], (3, 1))).params)
    apart = calibrate_response(rows.take(rows.patch % 8 == rows.view), EXPOSURES)
    assert apart.rows == 0 and "less than 1 stop" in apart.reason


@pytest.mark.parametrize("kind", ["saturated", "black", "one view", "nan", "constant", "bright", "flat curve", "none"])
def test_extremes_are_finite_and_explained(kind):
    rng = np.random.default_rng(8)
    rows, exposure = _rows(rng, response("gamma", [1.8]), n_patches=150)
    if kind == "saturated":
        rows.value[:], rows.clipped[:] = 1.0, True
    elif kind == "black":
        rows.value[rows.view == 2] = 0.0
    elif kind == "one view":
        rows = rows.take(rows.view == 0)
    elif kind == "nan":
        rows.value[:] = np.nan
    elif kind == "constant":
        rows.value[:], rows.clipped[:] = 0.5, False
    elif kind == "bright":
        exposure = exposure * 1e6
    elif kind == "flat curve":
        rows.value[:] = np.where((rows.value > 0.3) & (rows.value < 0.6), 0.45, rows.value)
    else:
        rows = no_rows()
    out = calibrate_response(rows, exposure)
    assert np.isfinite(out.response(X)).all() and (np.diff(out.response(X), axis=0) > 0).all()
    assert np.isfinite(out.covariance).all() and np.isfinite([out.before, out.after, out.stops]).all() and out.reason
    if kind in ("saturated", "one view", "nan", "none"):
        assert out.rows == 0 and out.response.family == "srgb"
    if kind in ("black", "bright"):
        assert out.response.family == "gamma" and abs(out.response.params.mean() - 1.8) < 0.05


def test_which_families_a_setting_allows():
    assert candidates("auto", "hdr") == ("identity",) and candidates("auto", "ldr") == CANDIDATES
    assert candidates("gamma", "ldr") == ("gamma",) and candidates("gamma", "hdr") == ("identity",)
    for family in ("identity", "srgb"):
        out = calibrate_response(no_rows(), np.ones(0), (family,))
        assert out.response.family == family and out.reason


def _photograph(rng, n=4000, patches=40):
    patch = rng.integers(0, patches, n).astype(np.uint64)
    value = np.linspace(0.1, 1.1, patches)[patch.astype(int), None] * (1 + 0.01 * rng.normal(size=(n, 3)))
    normal = np.where(patch[:, None] % 2 == 0, [0, 0, 1.0], [0.1, -0.9, 0])
    return patch, normal, (patch // 4).astype(int), np.clip(value, 0, 1)


def test_patch_rows_are_medians_of_even_surface():
    rng = np.random.default_rng(0)
    patch, normal, block, value = _photograph(rng)
    value[patch == 3] = rng.uniform(0.1, 0.9, ((patch == 3).sum(), 3))  # uneven
    value[(patch == 7) & (rng.random(len(patch)) < 0.2)] = 0.95  # a few highlights
    value[patch == 11] = np.nan
    rows = patch_rows(patch, normal, block, value, 5)
    assert 3 not in rows.patch and 11 not in rows.patch and (rows.view == 5).all()
    at = int(np.flatnonzero(rows.patch == 7)[0])
    np.testing.assert_allclose(rows.value[at], 0.1 + 7 / 39, atol=0.01)
    np.testing.assert_array_equal(rows.facing, np.where(rows.patch % 2 == 0, 4, 3))
    assert rows.clipped[rows.patch == 39].all() and not rows.clipped[rows.value[:, 0] < 0.98].any()


def test_saturation_begins_at_its_value():
    """Of 40 pixels, 0, 11, 29 and 31 are as bright as `saturation`: a mean, none, none, a bound."""
    for bright, known, bound in ((0, 0.49, False), (11, np.nan, False), (29, np.nan, False), (31, 0.5, True)):
        value = np.where(np.arange(40)[:, None] < bright, 0.5, [0.49, 0.49, 0.2])
        value[:, 2] = 0.2  # so that there is a row
        rows = patch_rows(np.zeros(40, np.uint64), np.tile([0, 0, 1.0], (40, 1)), np.zeros(40, int), value, 0, saturation=0.5)
        np.testing.assert_allclose(rows.value, [[known, known, 0.2]])
        np.testing.assert_array_equal(rows.clipped, [[bound, bound, False]])


def test_patch_rows_pass_through_a_curve():
    """The row of f(radiance) is f of the row of radiance."""
    patch, normal, block, value = _photograph(np.random.default_rng(1))
    f = response("gamma")
    plain, curved = (patch_rows(patch, normal, block, v, 0, saturation=2.0) for v in (value, f(value)))
    np.testing.assert_allclose(f(plain.value), curved.value, atol=2e-4)


def test_thinning_keeps_the_same_patches_in_every_view_and_joining_numbers_them():
    rng = np.random.default_rng(2)
    parts = [patch_rows(*_photograph(rng), view, share=0.5) for view in range(3)]
    assert {*parts[0].patch} == {*parts[1].patch} and 5 < len(parts[0].patch) < 35
    rows = join_rows([*parts, no_rows()])
    assert (np.bincount(rows.patch.astype(int)) == 3).all()
    assert len(patch_rows(*(a[:0] for a in _photograph(rng)), 0).patch) == 0


@pytest.mark.parametrize(
    ("truth", "limit"), [(response("gamma", [1.9]), 0.5), (response_curve("filmic"), 1.0)], ids=["gamma", "filmic"]
)
def test_unknown_exposures_give_the_curve_up_to_a_power(truth, limit):
    """f(x^(1 / p)) with exposures e^p gives the same photographs: all but the power is estimated."""
    rows, exposure = _rows(np.random.default_rng(3), truth)
    out = calibrate_response(rows, np.ones(8), ("srgb", "spline"), given=False)
    assert "power" in out.gauge and np.exp(np.mean(np.log(out.exposure))) == pytest.approx(1.0)
    power = np.polyfit(np.log(exposure), np.log(out.exposure), 1)[0]
    np.testing.assert_allclose(np.log(out.exposure), power * np.log(exposure), atol=0.03)
    known = calibrate_response(rows, exposure, ("spline",))
    assert known.gauge == "" and (known.exposure == exposure).all()
    error = 100 * np.sqrt(np.mean((out.response(X**power) - truth(X)) ** 2, 0)).max()
    assert error < limit


LONG = pytest.mark.long


@pytest.mark.parametrize(
    ("power", "families"),
    [
        pytest.param(0.8, CANDIDATES, id="0.8 all"),
        pytest.param(1.25, ("ggcm",), id="1.25 one", marks=LONG),
        pytest.param(1.25, CANDIDATES, id="1.25 all", marks=LONG),
        pytest.param(0.8, ("ggcm",), id="0.8 one", marks=LONG),
    ],
)
def test_stated_exposures_tell_the_power(power, families):
    """The camera's curve is sRGB of a power of the radiance, which photographs alone take for sRGB. Files state exposures within
    5 %."""
    rng, srgb = np.random.default_rng(7), response("srgb")
    rows, exposure = _rows(rng, lambda x: srgb(x**power))
    stated = 3e-4 * exposure * np.exp(0.05 * rng.standard_normal(8))
    without, out = (calibrate_response(rows, np.ones(8), families, given=False, stated=said) for said in (None, stated))
    slopes = [np.polyfit(np.log(exposure), np.log(found.exposure), 1)[0] for found in (without, out)]
    assert abs(np.log(slopes[0] / power)) < 0.12 and abs(np.log(slopes[1])) < 0.05
    # The curve has the power that goes with them.
    seen = srgb(X**power)
    inside = (seen[:, 1] > 0.05) & (seen[:, 1] < 0.95)
    logs = np.log(out.response.inverse(seen[inside]))[:, 1]
    assert np.polyfit(np.log(X[inside, 1]), logs, 1)[0] == pytest.approx(1.0, abs=0.06)
    assert "state" in out.gauge and "state" not in without.gauge


def test_stated_exposures_tell_the_power_of_a_curve_that_is_not_known():
    """Too few rows for a curve: what is taken as sRGB is taken as sRGB of a power."""
    srgb = response("srgb")
    rows, exposure = _rows(np.random.default_rng(8), lambda x: srgb(x**1.2), n_patches=20)
    plain, out = (calibrate_response(rows, np.ones(8), given=False, stated=said) for said in (None, exposure))
    slopes = [np.polyfit(np.log(exposure), np.log(found.exposure), 1)[0] for found in (plain, out)]
    assert abs(slopes[0] - 1.2) < 0.06 and abs(slopes[1] - 1.0) < 0.04
    assert (plain.response.family, out.response.family) == ("srgb", "sampled") and "power 1.2" in out.reason
    assert np.abs(out.response(X) - srgb(X**1.2)).max() < 0.02
    assert not out.rows and "state" in out.gauge and not plain.gauge
    np.testing.assert_allclose(out.response.inverse(out.response(X)), X, atol=1e-4)


def test_what_is_stated_vaguely_is_believed_in_part():
    """Noise of 0.3 on what is stated: the power that remains is that of one posterior mean, however often gains are found."""
    srgb, rng = response("srgb"), np.random.default_rng(9)
    rows, exposure = _rows(rng, lambda x: srgb(x**1.25))
    stated = exposure * np.exp(0.3 * rng.standard_normal(8))
    plain = calibrate_response(rows, np.ones(8), ("srgb",), given=False)
    slope, error = power_of_exposures(_gains_of(rows), stated)
    believed = 1.0 + (slope - 1.0) * 0.01 / (0.01 + error**2)
    assert 0.2 < (believed - 1.0) / (slope - 1.0) < 0.8 and plain.gauge == ""
    out = calibrate_response(rows, np.ones(8), ("srgb", "spline"), given=False, stated=stated)
    assert power_of_exposures(out.exposure, stated)[0] == pytest.approx(slope / believed, abs=0.005)
    assert "state" not in out.gauge


def _gains_of(rows):
    return estimate(gain_rows(rows, response("srgb")).thinned(), 8, white_balance=False).exposure


@pytest.mark.parametrize(
    ("power", "seeds"), [(1.1, [0]), pytest.param(1.1, [1, 2], marks=LONG), pytest.param(0.9, [0, 1, 2], marks=LONG)]
)
def test_curve_and_exposures_have_one_power_whatever_family_is_chosen(power, seeds):
    """Few, noisy rows, for which sRGB is good enough: it gets the power too."""
    srgb = response("srgb")
    for seed in seeds:
        rng = np.random.default_rng(seed)
        rows, exposure = _rows(rng, lambda x: srgb(x**power), n_patches=60, blocks=6, gloss=0.1, common=0.1)
        out = calibrate_response(rows, np.ones(8), given=False, stated=exposure)
        of_exposures = np.polyfit(np.log(exposure), np.log(out.exposure), 1)[0]
        seen = srgb(X**power)
        inside = (seen[:, 1] > 0.1) & (seen[:, 1] < 0.9)
        of_curve = np.polyfit(np.log(X[inside, 1]), np.log(out.response.inverse(seen[inside]))[:, 1], 1)[0]
        assert abs(of_exposures - of_curve) < 0.04, (seed, out.response.family)


@pytest.mark.long
def test_groups_of_views_that_share_nothing_have_constants_of_their_own():
    """The second room is four times as bright for its cameras; all that is stated is exact, and changes nothing."""
    srgb = response("srgb")
    first, second = (_rows(np.random.default_rng(seed), srgb)[0] for seed in (1, 2))
    apart = replace(second, patch=second.patch + np.uint64(10_000), view=second.view + 8)
    names = ("patch", "facing", "block", "view", "value", "clipped", "count")
    rows = PatchRows(*(np.concatenate([getattr(part, name) for part in (first, apart)]) for name in names))
    stated = np.concatenate([EXPOSURES, 4.0 * EXPOSURES])
    plain, out = (calibrate_response(rows, np.ones(16), given=False, stated=said) for said in (None, stated))
    assert out.response.family == plain.response.family == "srgb"
    np.testing.assert_allclose(out.exposure, plain.exposure, rtol=0.02)
    slope, error = power_of_exposures(stated**1.1 * np.repeat([1.0, 9.0], 8), stated, np.repeat([0, 1], 8))
    assert slope == pytest.approx(1.1) and np.isfinite(error)


def test_vignetting_has_the_power_of_the_exposures():
    found = CameraGains(np.array([[0.5] * 3, [1.0, 2.0, 4.0], [7.0] * 3]), np.array([-0.6, 0.1]), np.array([True, True, False]))
    raised = found.raised(1.2)
    np.testing.assert_allclose(raised.vignetting, [-0.72, 0.12])
    np.testing.assert_allclose(np.diff(np.log(raised.gain[:2]), axis=0), 1.2 * np.diff(np.log(found.gain[:2]), axis=0))
    np.testing.assert_allclose(np.log(raised.gain[:2]).mean(), np.log(found.gain[:2]).mean(), atol=1e-12)
    np.testing.assert_array_equal(raised.gain[2], 7.0)  # not estimated


def test_power_of_exposures():
    stated = np.array([0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4])
    assert power_of_exposures(5.0 * stated**1.2, stated)[0] == pytest.approx(1.2)
    rng = np.random.default_rng(0)
    draws = np.array([power_of_exposures(stated**0.9 * np.exp(0.1 * rng.standard_normal(7)), stated) for _ in range(400)])
    away = (draws[:, 0] - 0.9) / draws[:, 1]
    assert abs(draws[:, 0].mean() - 0.9) < 0.01 and 0.7 < np.std(away) < 1.3
    # Four photographs that differ little are not believed much.
    few = np.exp(np.array([-0.4, -0.1, 0.1, 0.4]))
    draws = np.array([power_of_exposures(few * np.exp(0.15 * rng.standard_normal(4)), few) for _ in range(400)])
    believed = np.where(np.isfinite(draws[:, 1]), (draws[:, 0] - 1.0) * 0.01 / (0.01 + draws[:, 1] ** 2), 0.0)
    assert np.sqrt(np.mean(believed**2)) < 0.1
    merged = stated.copy()
    merged[2] *= 8.0  # the file of one photograph states another exposure
    assert abs(power_of_exposures(stated**1.1, merged)[0] - 1.1) < 0.08


@pytest.mark.parametrize(
    "stated",
    [
        np.full(6, np.nan),
        np.array([1.0, 2.0, 4.0, np.nan, np.nan, np.nan]),
        np.ones(6),
        np.array([0.0, -1.0, np.inf, 1.0, 2.0, 4.0]),
        np.array([32.0, 16.0, 8.0, 4.0, 2.0, 1.0]),
        np.array([1.0, 1.01, 1.02, 1.03, 1.04, 1.05]),
    ],
    ids=["none", "three", "the same", "three of use", "of other photographs", "no difference"],
)
def test_what_tells_no_power_changes_nothing(stated):
    found = np.array([1.0, 2.0, 4.0, 8.0, 16.0, 32.0])
    assert power_of_exposures(found, stated) == (1.0, np.inf)


def test_unknown_exposures_without_overlap_stay_what_they_were():
    rows, _ = _rows(np.random.default_rng(4), response("gamma"), n_patches=200)
    out = calibrate_response(rows.take(rows.patch % 8 == rows.view), np.full(8, 3.0), given=False)
    np.testing.assert_allclose(out.exposure, 3.0)
    assert out.response.family == "srgb" and out.reason


def test_stated_exposures_go_with_their_photographs(monkeypatch):
    """Of five views the second is held out; what is stated of the others arrives in their order."""
    asked = []

    def found(rows, exposure, families, saturation, given, stated):
        asked.append(stated)
        return SimpleNamespace(response=response("srgb"), reason="", gains=CameraGains.plain(np.ones(4)))

    monkeypatch.setattr(of_light, "calibrate_response", found)
    monkeypatch.setattr(of_light, "_shared_surface", lambda photos: replace(no_rows(), view=np.zeros(0, np.int32)))
    views, sensor = [0, 2, 3, 4], of_photographs.Sensor(response("identity"), False)
    log = SimpleNamespace(say=lambda text: None)
    photos = Photos(views, CameraGains.plain(np.ones(5)), sensor, log)
    of_light.calibrated(photos, ("srgb",), None, False, np.array([1.0, 99.0, 2.0, np.nan, 4.0]))
    np.testing.assert_array_equal(asked, [[1.0, 2.0, np.nan, 4.0]])
    of_light.calibrated(photos, ("srgb",), None, False)
    assert asked[1] is None


@dataclass(frozen=True)
class Photos:
    """As much of `Photographs` as the calibration reads; a view is its number."""

    views: list
    gains: CameraGains
    sensor: of_photographs.Sensor
    log: SimpleNamespace

    def number(self, view):
        return view
