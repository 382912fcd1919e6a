from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from iif_core.camera.response import response
from iif_core.errors import InputError
from iif_core.fitting.descent import GaussianPrior
from iif_core.fitting.direct import fit_affines
from iif_core.fitting.gauge import Gauge, apply_gauge, is_divided, kept_brightness
from iif_core.fitting.levels import interpolate_levels
from iif_core.fitting.pixels import evaluate, prepare_pixels, run_in_threads
from iif_core.fitting.problem import FitOptions, FitProblem, albedo_uncertainty
from iif_core.fitting.selection import EVIDENCE_DISCOUNT, ROUGHNESS_GRID, Choice, Profile, choose_kinds
from iif_core.fitting.tone import make_tone
from iif_core.light.emission.gains import PRIOR_LEVEL_ERROR
from iif_core.reflectance.material import GAINS, IDENTITY, MATTE_ROUGHNESS, apply_affines, unclamped_material
from tests.errors import refused
from tests.unit.planted_fit import LEVELS, problem_of

EXACT = FitOptions(
    iterations=60,
    ridge=1e-13,
    robust_width=1e3,
    select=False,
    population=False,
    metallic_prior=2,
    response_ridge=1e-14,
    tolerance=1e-16,
)
PLAIN = {"select": False, "population": False}


def test_curvature_of_a_power_is_its_closed_form():
    """f = x^(1 / g): f'' / f'^2 = (1 - g) / f."""
    y = np.linspace(0.3, 0.9, 7)[:, None] * [1.0, 0.9, 1.1]
    exponents = np.array([[1.8], [2.2], [2.6]])
    tone = make_tone(response("gamma", exponents), y)
    np.testing.assert_allclose(tone.curvature_ratio(y), (1 - exponents.T) / y, rtol=5e-3)


def test_dark_pixels_do_not_move_the_knee_of_the_logarithmic_curve():
    value = np.linspace(0.1, 0.9, 9)[:, None] * np.ones(3)
    tones = [make_tone(response("identity"), np.concatenate([value, np.zeros((dark, 3))])) for dark in (0, 30)]
    assert tones[0].knee == tones[1].knee == pytest.approx(0.125) and tones[0].gain == tones[1].gain


@pytest.mark.parametrize("level", [0.01, 1.0, 100.0])
def test_pixels_without_light_are_left_out_at_any_level_of_the_light(level):
    problem, _ = problem_of(np.random.default_rng(0), 1, 200)
    share = np.r_[4e-4, 3e-3, np.ones(198)]
    light = np.full((200, 3), level) * share[:, None]
    px, _ = prepare_pixels(replace(problem, diffuse=(light,)), response("identity"))
    assert sorted(px.index) == [*range(1, 200)]


@pytest.mark.parametrize("objects", [[], [1, 3], [1, 2], [0, 1, 2, 3]])
def test_chosen_objects_keep_their_pixels_and_clusters(objects):
    problem, _ = problem_of(np.random.default_rng(0), 4, 60)
    px, _ = prepare_pixels(replace(problem, cluster=np.arange(240) // 7), response("identity"))
    some = px.only(np.array(objects, int))
    np.testing.assert_array_equal(some.index, px.index[np.isin(px.obj, objects)])
    assert some.starts[0] == 0 and some.starts[-1] == len(some.obj) == 60 * len(objects)

    def sizes(pixels, o):
        return np.diff(pixels.starts)[pixels.first[o] : pixels.first[o + 1]].tolist()

    assert [sizes(some, i) for i in range(len(objects))] == [sizes(px, o) for o in objects]


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_threads_share_the_objects_by_their_pixels(threads):
    px, _ = prepare_pixels(problem_of(np.random.default_rng(0), 8, 60)[0], response("identity"))
    objects, found = np.array([0, 1, 3, 4, 6, 7]), []
    run_in_threads(found.append, px, objects, threads)
    found.sort(key=lambda part: part[0])
    np.testing.assert_array_equal(np.concatenate(found), objects)
    assert [len(part) for part in found] == [len(objects) // threads] * threads  # all have as many pixels


def test_planted_affines_are_recovered_from_clean_hdr():
    problem, truth = problem_of(np.random.default_rng(0))
    out = fit_affines(problem, response("identity"), EXACT)
    np.testing.assert_allclose(out.affine, truth, atol=1e-6)
    assert np.all(np.diff(out.history) <= 0) and out.residual.max() < 1e-6 and out.light_scale == 1


@pytest.mark.parametrize("halves", [1, 2])
def test_planted_affines_and_gamma_from_clean_ldr(halves):
    problem, truth = problem_of(np.random.default_rng(1), value_of=lambda x: response("gamma", [1.9])(x), halves=halves)
    out = fit_affines(problem, response("gamma"), EXACT)
    np.testing.assert_allclose(out.response.params, 1.9, atol=1e-6)
    np.testing.assert_allclose(out.affine, truth, atol=1e-5)
    assert np.all(np.diff(out.history) <= 0)


def test_calibrated_response_is_a_prior():
    """A precise prior holds the response; with a vague one the photographs decide."""
    problem, _ = problem_of(np.random.default_rng(1), value_of=lambda x: response("gamma", [1.9])(x))
    for precision, expected in ((1e9, 2.1), (1e-9, 1.9)):
        opt = FitOptions(**{**EXACT.__dict__, "response_ridge": 1e-5, "response_prior": (np.array([2.1]), precision * np.eye(1))})
        out = fit_affines(problem, response("gamma", [2.0]), opt)
        np.testing.assert_allclose(out.response.params, expected, atol=1e-4)
        assert np.all(np.diff(out.history) <= 0)


def test_planted_ggcm_per_channel():
    curve = response("ggcm", [[-0.8, 0.2, 0.0], [-0.7, 0.0, 0.1], [-0.6, -0.2, 0.0]])
    problem, truth = problem_of(np.random.default_rng(2), value_of=lambda x: curve(x))
    out = fit_affines(problem, response("ggcm", [[-0.8, 0, 0]] * 3), EXACT)
    np.testing.assert_allclose(out.response.params, curve.params, atol=1e-3)
    np.testing.assert_allclose(out.affine, truth, atol=1e-3)


@pytest.mark.parametrize("family", ["identity", "gamma"])
def test_gradient_and_normal_matrix_against_differences(family):
    """Every term at once: robust weights, two halves, saturation, out-of-range values, regularisers, ridge."""
    rng = np.random.default_rng(3)
    problem, _ = problem_of(rng, n_objects=2, per_object=40, noise=0.2, halves=2, value_of=lambda x: np.clip(x, 0, 1) ** 0.5)
    saturated = problem.value > 0.8
    problem = FitProblem(**{**problem.__dict__, "saturated": saturated})
    problem.base[:, 4] = rng.uniform(0.1, 0.9, 80)
    start = response(family)
    px, tone = prepare_pixels(problem, start)
    opt = FitOptions(roughness_weight=1e-3, metallic_weight=5e-3)
    prior = GaussianPrior(np.tile(IDENTITY, (2, 1)), np.tile(0.3 * np.eye(16), (2, 1, 1)))
    t = np.tile(IDENTITY, (2, 1)) + rng.normal(0, 0.1, (2, 16))
    t[1, 0] += 2.0  # some albedos above 1
    t[1, 13] -= 0.4  # some roughness below the range
    params = start.params.ravel() * 1.07
    terms = evaluate(px, t, tone.at(params), opt, True)
    gradient = terms.g.copy()
    gradient[:, :16] += prior.gradient(t)
    assert gradient.shape == (2, 16 + tone.size)
    for o in range(2):
        for k in range(16 + tone.size):
            values = []
            for sign in (1, -1):
                moved, p = t.copy(), params.copy()
                if k < 16:
                    moved[o, k] += sign * 1e-7
                else:
                    p[k - 16] += sign * 1e-7
                values.append((evaluate(px, moved, tone.at(p), opt, False).cost + prior.cost(moved))[o])
            assert gradient[o, k] == pytest.approx((values[0] - values[1]) / 2e-7, rel=2e-4, abs=2e-4), (o, k)
    np.testing.assert_allclose(terms.h, terms.h.transpose(0, 2, 1))


def test_noise_in_the_cache_raises_gamma_and_two_halves_cure_it():
    """A plain joint fit overestimates gamma; two independent halves do not (docs/method/numerics.md#noise-in-cached-shading)."""
    rng = np.random.default_rng(4)
    problem, truth = problem_of(
        rng, n_objects=8, per_object=3000, value_of=lambda x: response("gamma", [1.9])(x), noise=0.5, halves=2
    )
    opt = FitOptions(iterations=25, ridge=1e-6, robust_width=1.0, metallic_prior=2, **PLAIN)
    mean = {name: (0.5 * (getattr(problem, name)[0] + getattr(problem, name)[1]),) for name in ("diffuse", "s0", "s1")}
    plain = fit_affines(FitProblem(**{**problem.__dict__, **mean}), response("gamma"), opt)
    two = fit_affines(problem, response("gamma"), opt)
    assert plain.response.params[0] > 2.05
    assert abs(two.response.params[0] - 1.9) < 0.4 * (plain.response.params[0] - 1.9)
    assert np.all(np.diff(two.history) <= 0)


def test_constant_object_gets_gains_and_stays_finite():
    rng = np.random.default_rng(5)
    base = np.c_[np.full((400, 3), [0.3, 0.4, 0.2]), np.full(400, 0.5), np.zeros(400)]
    base[200:, :3] *= rng.uniform(0.5, 1.5, (200, 1))  # object 1: one direction of colour
    truth = np.tile(IDENTITY, (2, 1))
    truth[:, [0, 5, 10]] = [[1.5, 0.8, 1.2], [0.7, 1.1, 0.9]]
    problem, _ = problem_of(rng, 2, 200, truth=truth, base=base)
    out = fit_affines(problem, response("identity"), EXACT)
    assert [m.split(", metallic")[0] for m in out.model] == ["gain, roughness", "gain+bias, roughness"]
    np.testing.assert_allclose(out.affine[:, :12], truth[:, :12], atol=1e-5)
    assert (out.free[0, :12].reshape(3, 4)[:, :3] == np.eye(3, dtype=bool)).all() and not out.free[0, 12]
    assert np.isfinite(out.covariance).all()


def test_tiny_absent_and_broken_objects_keep_the_identity():
    rng = np.random.default_rng(6)
    problem, truth = problem_of(rng, 3, 300)
    obj = problem.object_id.copy()
    obj[obj == 2] = np.where(np.arange(300) < 12, 2, -1)
    obj[:3] = 77  # out of range: left out, not an index error
    value = problem.value.copy()
    value[5] = np.nan
    value[6] = np.inf
    problem = FitProblem(**{**problem.__dict__, "object_id": obj, "value": value, "n_objects": 5})
    out = fit_affines(problem, response("identity"), EXACT)
    np.testing.assert_array_equal(out.affine[2:], np.tile(IDENTITY, (3, 1)))
    np.testing.assert_allclose(out.affine[:2], truth[:2], atol=1e-6)
    assert out.model[2] == "identity (12 pixels)" and out.model[4] == "identity (0 pixels)"
    assert out.pixels.tolist()[2:] == [12, 0, 0] and np.isfinite(out.residual).all()


def test_all_saturated_object_does_not_darken():
    rng = np.random.default_rng(7)
    problem, _ = problem_of(rng, 2, 200, truth=np.tile(IDENTITY, (2, 1)), value_of=lambda x: response("gamma")(x))
    saturated = np.repeat([[False], [True]], 200, 0).repeat(3, 1)
    low = FitProblem(**{**problem.__dict__, "saturated": saturated, "value": np.where(saturated, 1e-3, problem.value)})
    out = fit_affines(low, response("gamma"), FitOptions(**PLAIN))
    np.testing.assert_allclose(out.affine[1], IDENTITY, atol=1e-3)  # every bound is met
    assert np.isfinite(out.covariance).all() and out.residual[1] == 0
    raised = response("gamma")(1.3 * response("gamma").inverse(problem.value))
    high = FitProblem(**{**problem.__dict__, "saturated": saturated, "value": np.where(saturated, raised, problem.value)})
    out = fit_affines(high, response("gamma"), FitOptions(**PLAIN))
    assert out.affine[1, [0, 5, 10]].min() > 1.15  # bounds that are not met raise the albedo


def test_saturated_pixels_do_not_bias():
    problem, truth = problem_of(np.random.default_rng(8), value_of=lambda x: response("gamma", [1.9])(x))
    saturated = problem.value > 0.6
    clipped = FitProblem(**{**problem.__dict__, "saturated": saturated, "value": np.minimum(problem.value, 0.6)})
    out = fit_affines(clipped, response("gamma"), EXACT)
    np.testing.assert_allclose(out.response.params, 1.9, atol=1e-4)
    np.testing.assert_allclose(out.affine[:, :12], truth[:, :12], atol=1e-3)


def test_metal_is_found_where_it_pays_and_only_there():
    rng = np.random.default_rng(9)
    n = 500
    base = np.c_[rng.uniform(0.4, 0.6, (2 * n, 3)), np.full(2 * n, 0.35), np.full(2 * n, 0.1)]
    truth = np.tile(IDENTITY, (2, 1))
    truth[:, 14] = 0
    truth[:, 15] = [0, 1]  # object 1 is a metal, predicted as 0.1 like everything else
    problem, _ = problem_of(rng, 2, n, truth=truth, base=base)
    out = fit_affines(problem, response("identity"), FitOptions())
    fitted = apply_affines(out.affine, problem.object_id, base)
    assert fitted[n:, 4].min() > 0.9 and out.model[1].endswith("metal")
    assert fitted[:n, 4].max() < 0.12
    np.testing.assert_allclose(fitted[n:, :3], base[n:, :3], atol=0.05)


def test_an_object_of_metal_and_paint_keeps_the_metallic_that_was_predicted():
    rng = np.random.default_rng(9)
    n = 600
    base = np.c_[rng.uniform(0.4, 0.6, (3 * n, 3)), np.full(3 * n, 0.35), np.full(3 * n, 0.05)]
    base[:n, 4] = np.where(np.arange(n) % 2, 0.95, 0.05)
    problem, _ = problem_of(rng, 3, n, truth=np.tile(IDENTITY, (3, 1)), base=base)
    out = fit_affines(problem, response("identity"), FitOptions())
    np.testing.assert_array_equal(out.affine[:, 14:], [[1, 0], [0, 0], [0, 0]])


def _lambertian(rng, n, albedo, dim=1.0):
    """(problem, base) of one object without any lobe; the cached light is `dim` times the true one; HDR, with noise."""
    base = np.c_[rng.uniform(0.6, 0.7, (n, 3)), np.full(n, 0.5), np.zeros(n)]
    problem, _ = problem_of(rng, 1, n, truth=IDENTITY[None], base=base)
    value = albedo * problem.diffuse[0] * np.exp(rng.normal(0, 0.03, (n, 3)))
    dimmer = {name: tuple(dim * x for x in getattr(problem, name)) for name in ("diffuse", "s0", "s1")}
    return replace(problem, value=value, **dimmer), base


@pytest.mark.parametrize("dim", [1.0, 0.9])
def test_white_wall_in_light_that_is_too_dim_gets_no_gloss(dim):
    """The wall shows more than an albedo of 1 explains, which only a lobe could add if the fit bounded the albedo there."""
    problem, base = _lambertian(np.random.default_rng(17), 800, 0.98, dim)
    out = fit_affines(problem, response("identity"), FitOptions())
    fitted = apply_affines(out.affine, problem.object_id, base)
    assert fitted[:, 3].mean() > 0.8 and fitted[:, :3].max() <= 1.0
    if dim < 1:
        glossy = fit_affines(problem, response("identity"), FitOptions(brightest=1.0))
        assert apply_affines(glossy.affine, problem.object_id, base)[:, 3].mean() < fitted[:, 3].mean() - 0.04
        assert glossy.residual[0] > 1.2 * out.residual[0]


def test_what_has_no_lobe_is_rough():
    problem, base = _lambertian(np.random.default_rng(18), 800, 0.3)
    out = fit_affines(problem, response("identity"), FitOptions())
    fitted = apply_affines(out.affine, problem.object_id, base)
    assert fitted[:, 3].mean() > 0.85 and (fitted[:, 4] == 0).all()


def test_rough_metal_is_taken_for_a_dielectric():
    """The two look alike (docs/method/fitting.md#selection-of-kind-and-roughness); a smooth metal is recognised."""
    rng = np.random.default_rng(19)
    base = np.c_[rng.uniform(0.4, 0.6, (1000, 3)), np.full(1000, 0.5), np.full(1000, 0.5)]
    for roughness, metal in ((0.9, 0.0), (0.3, 1.0)):
        truth = IDENTITY[None].copy()
        truth[0, 12:] = [0, roughness, 0, 1]
        problem, _ = problem_of(rng, 1, 1000, truth=truth, base=base)
        out = fit_affines(problem, response("identity"), FitOptions())
        assert (apply_affines(out.affine, problem.object_id, base)[:, 4] == metal).all()


def test_wrong_local_minimum_of_roughness_is_left():
    rng = np.random.default_rng(10)
    n = 600
    base = np.c_[rng.uniform(0.02, 0.1, (n, 3)), np.full(n, 0.95), np.zeros(n)]
    truth = IDENTITY[None].copy()
    truth[0, 13] = -0.8  # a dark, glossy thing predicted as rough
    problem, _ = problem_of(rng, 1, n, truth=truth, base=base)
    out = fit_affines(problem, response("identity"), FitOptions())
    assert abs(apply_affines(out.affine, problem.object_id, base)[:, 3].mean() - 0.15) < 0.03


def test_outliers_are_shrugged_off():
    rng = np.random.default_rng(11)
    problem, truth = problem_of(rng, value_of=lambda x: response("gamma")(x))
    value = problem.value.copy()
    bad = rng.random(len(value)) < 0.1
    value[bad] = rng.uniform(0, 1, (bad.sum(), 3))
    spoilt = FitProblem(**{**problem.__dict__, "value": value})
    opt = dict(iterations=30, ridge=1e-6, free_response=False, **PLAIN)
    robust = fit_affines(spoilt, response("gamma"), FitOptions(robust_width=0.02, **opt))
    plain = fit_affines(spoilt, response("gamma"), FitOptions(robust_width=1e3, **opt))
    error = [np.abs(o.affine[:, :12] - truth[:, :12]).max() for o in (robust, plain)]
    assert error[0] < 0.1 and error[0] < 0.3 * error[1]


def test_fireflies_in_one_half_do_not_matter():
    problem, truth = problem_of(np.random.default_rng(12), value_of=lambda x: response("gamma")(x), halves=2)
    problem.diffuse[0][::50] *= 300.0
    opt = FitOptions(iterations=30, ridge=1e-6, free_response=False, **PLAIN)
    out = fit_affines(problem, response("gamma"), opt)
    np.testing.assert_allclose(out.affine[:, :12], truth[:, :12], atol=0.02)


def test_values_out_of_range_come_back():
    """The start puts every albedo above 1, where the clamp has no gradient; the fit still finds the answer."""
    rng = np.random.default_rng(13)
    base = np.c_[rng.uniform(1.5, 2.5, (500, 3)), np.full(500, 0.5), np.zeros(500)]
    truth = np.tile(IDENTITY, (1, 1))
    truth[0, [0, 5, 10]] = 0.2
    problem, _ = problem_of(rng, 1, 500, truth=truth, base=base)
    out = fit_affines(problem, response("identity"), EXACT)
    np.testing.assert_allclose(out.affine, truth, atol=1e-4)


def test_scale_pins():
    """Every gauge divides the albedo numbers by one factor, multiplies the light by it, and gives the level that it names."""
    problem, truth = problem_of(np.random.default_rng(14))
    free = fit_affines(problem, response("identity"), EXACT)
    patch = problem.object_id == 2
    true_patch = apply_affines(truth, problem.object_id, problem.base)[patch, :3].mean()
    dimmer = replace(problem, **{n: tuple(0.8 * x for x in getattr(problem, n)) for n in ("diffuse", "s0", "s1")})
    dim = fit_affines(dimmer, response("identity"), EXACT)  # light 0.8 of the truth: albedos 1.25 times as bright
    assert dim.affine[:, :12] == pytest.approx(truth[:, :12] / 0.8, rel=0.2, abs=0.05)
    for gauge, level, where in (
        (Gauge("prior"), problem.base[:, :3].mean(), slice(None)),
        (Gauge("mean_albedo", 0.3), 0.3, slice(None)),
        (Gauge("white_patch", true_patch, patch), true_patch, patch),
    ):
        pinned = apply_gauge(problem, free, gauge)
        np.testing.assert_allclose(pinned.affine[:, :12] * pinned.light_scale, free.affine[:, :12], rtol=1e-9)
        np.testing.assert_array_equal(pinned.affine[:, 12:], free.affine[:, 12:])
        fitted = apply_affines(pinned.affine, problem.object_id, problem.base)[where, :3]
        np.testing.assert_allclose(fitted.mean(), level, rtol=1e-3)
        assert pinned.facts["scale"]["kind"] == gauge.kind and np.isfinite(pinned.facts["scale"]["relative_error"])
    for gauge in (Gauge("white_patch", true_patch, patch), Gauge("lamp", factor=1.25)):
        found = apply_gauge(dimmer, dim, gauge)  # one known albedo or lamp gives the level of all
        fitted, wanted = (apply_affines(t, problem.object_id, problem.base)[:, :3].mean() for t in (found.affine, truth))
        assert fitted == pytest.approx(wanted, rel=0.03) and found.light_scale == pytest.approx(1.25, rel=0.02)
    assert apply_gauge(problem, free, Gauge("found")).affine is free.affine
    gap = problem.base.copy()
    gap[0, 1] = np.nan  # a pixel without a value in one channel does not count
    without = replace(problem, object_id=np.where(np.arange(len(gap)) == 0, -1, problem.object_id))
    spoilt, expected = (apply_gauge(p, free, Gauge("prior")).light_scale for p in (replace(problem, base=gap), without))
    assert spoilt == pytest.approx(expected, rel=1e-12)


def test_an_uncertain_level_is_averaged_with_the_prior():
    problem, _ = problem_of(np.random.default_rng(14))
    free = fit_affines(problem, response("identity"), EXACT)
    fitted = np.maximum(unclamped_material(free.affine[problem.object_id], problem.base)[:, :3], 0.0).mean(1)
    prior = np.exp(np.median(np.log(fitted / problem.base[:, :3].mean(1))))
    assert abs(np.log(prior)) > 0.02
    for error, share, left in (
        (PRIOR_LEVEL_ERROR, 0.5, PRIOR_LEVEL_ERROR / np.sqrt(2)),
        (np.inf, 1.0, PRIOR_LEVEL_ERROR),
        (1e-6, 0.0, 1e-6),
    ):
        pinned = apply_gauge(problem, free, Gauge("found", error=error))
        assert np.log(pinned.light_scale) == pytest.approx(share * np.log(prior), abs=1e-9)
        assert pinned.facts["scale"]["relative_error"] == pytest.approx(left, rel=1e-6)


def test_scale_refused():
    for wrong, named in (
        ({"kind": "other"}, ("'other'", "mean_albedo")),
        ({"kind": "mean_albedo"}, ("mean_albedo", "0.0", 1)),
        ({"kind": "white_patch", "albedo": 0.9}, ("white_patch", "pixels")),
        ({"kind": "lamp", "factor": 0}, ("lamp", 0)),
    ):
        with refused("scale", *named):
            Gauge(**wrong)


def test_covariance_is_of_the_right_size():
    """Spread of the fitted gain over repeated noise against the reported standard deviation."""
    rng = np.random.default_rng(15)
    problem, _ = problem_of(rng, 1, 400, truth=IDENTITY[None])
    opt = FitOptions(ridge=1e-9, robust_width=1e3, metallic_prior=2, **PLAIN)
    gains, reported = [], []
    for _ in range(60):
        noisy = problem.value * np.exp(rng.normal(0, 0.05, problem.value.shape))
        out = fit_affines(FitProblem(**{**problem.__dict__, "value": noisy}), response("identity"), opt)
        gains.append(out.affine[0, 0])
        reported.append(np.sqrt(out.covariance[0, 0, 0]))
    assert 0.6 < np.mean(reported) / np.std(gains) < 1.7


@pytest.mark.parametrize("as_metal, kind", [(1.0, 1), (4.0, 0), (0.2, 0)])
def test_a_metal_must_be_as_bright_as_its_base_suggests(as_metal, kind):
    """The photographs slightly prefer a metal; it is refused if its albedo would be far brighter or darker than its base."""
    objects, base = 8, np.full((8, 5), 0.4)
    cost = np.full((objects, 3, len(ROUGHNESS_GRID)), np.inf)
    cost[:, 0] = 5.0
    cost[1:, 1] = 9.0
    cost[0, 1, :5] = 0.0
    affine = np.zeros((*cost.shape, 16))
    affine[..., GAINS] = np.exp(0.05 * np.arange(objects))[:, None, None, None]
    affine[0, 1][:, GAINS] = as_metal
    assert chosen(cost, affine, base).kind.tolist() == [kind] + [0] * (objects - 1)
    # A dielectric that is too dark does not become a metal.
    cost[0, 1, :5], affine[0, 0][:, GAINS] = 9.0, 0.2
    assert chosen(cost, affine, base).kind.tolist() == [0] * objects
    # Of three objects none tells what is usual.
    cost[0, 1, :5], affine[0, 0][:, GAINS] = 0.0, 1.0
    assert chosen(cost[:3], affine[:3], base[:3]).kind.tolist() == [1, 0, 0]


@pytest.mark.parametrize("slope, tells", [(0.1, True), (0.0, False), (-0.1, False)])
def test_the_base_tells_which_of_two_objects_is_rougher(slope, tells):
    """Two objects of which the photographs say nothing, among forty whose roughness they tell."""
    rng = np.random.default_rng(7)
    truth = rng.choice(ROUGHNESS_GRID, 42)
    truth[:2] = 0.22, 0.84
    cost = np.full((42, 3, len(ROUGHNESS_GRID)), np.inf)
    cost[:, 0] = 50.0 * (ROUGHNESS_GRID - truth[:, None]) ** 2
    cost[:2, 0] = 0.0
    base = np.full((42, 5), 0.4)
    base[:, 3] = 0.45 + slope * (truth - 0.5) + 0.01 * rng.standard_normal(42)
    base[:2, 3] = 0.45 + slope * (truth[:2] - 0.5)
    found = chosen(cost, np.zeros((*cost.shape, 16)), base).roughness
    assert found[1] - found[0] == pytest.approx(truth[1] - truth[0], abs=0.15) if tells else abs(found[1] - found[0]) < 0.05
    np.testing.assert_allclose(found[2:], truth[2:], atol=0.1)


def test_what_is_as_likely_at_every_roughness_stays_so():
    """Without evidence the posterior stays as flat as the first histogram: smoothing loses nothing at its ends."""
    cost = np.full((30, 3, len(ROUGHNESS_GRID)), np.inf)
    cost[:, 0] = 0.0
    found = chosen(cost, np.zeros((*cost.shape, 16)), np.full((30, 5), 0.4))
    np.testing.assert_allclose(found.roughness, ROUGHNESS_GRID.mean(), rtol=1e-12)
    np.testing.assert_allclose(found.deviation, ROUGHNESS_GRID.std(), rtol=1e-12)


def test_what_the_evidence_leaves_open_is_kept():
    """Object 0 tells nothing, object 1 its roughness; the albedo of a metal would be brighter by exp(0.5)."""
    cost = np.full((12, 3, len(ROUGHNESS_GRID)), np.inf)
    cost[:, :2] = 0.0
    cost[1:, 0] += 40.0 * np.abs(ROUGHNESS_GRID - 0.57)
    cost[1:, 1] += 2.0 + 40.0 * np.abs(ROUGHNESS_GRID - 0.32)
    affine = np.tile(IDENTITY, (*cost.shape, 1))
    affine[:, 1, :, :12] *= np.exp(0.5)
    choice = chosen(cost, affine, np.full((12, 5), 0.3))
    kinds = choice.kinds
    assert (choice.kind == 0).all() and kinds.seen[0] == pytest.approx(0.0, abs=0.05) and kinds.seen[1] > 0.9
    np.testing.assert_allclose(kinds.probability.sum(1), 1.0)
    assert 0.0 < kinds.probability[1, 1] < 0.05 and kinds.probability[1, 2] < 1e-100
    np.testing.assert_allclose(kinds.brightness[:, :2], [[0.0, 0.5]] * 12, atol=1e-12)
    assert kinds.roughness[1, :2] == pytest.approx([0.57, 0.32], abs=0.03)
    everything = kinds.among(np.arange(1, 13), 14)
    assert not everything.probability[[0, 13]].any() and everything.seen[2] == kinds.seen[1]


def chosen(cost: np.ndarray, affine: np.ndarray, base: np.ndarray) -> Choice:
    objects = len(cost)
    found = Profile(cost, affine, np.full(objects, 1.0 / EVIDENCE_DISCOUNT))
    return choose_kinds(found, np.ones(objects, bool), base, np.full(objects, 100))


def test_uncertainty_and_application_without_objects():
    base = np.c_[np.full((4, 3), 0.5), np.full(4, -1.0), np.full(4, 2.0)]
    none = np.full(4, -1)
    got = apply_affines(np.zeros((0, 16)), none, base)
    np.testing.assert_allclose(got[0], [0.5, 0.5, 0.5, 0.02, 1.0])
    spread = albedo_uncertainty(np.zeros((0, 16)), np.zeros((0, 16, 16)), none, base, np.full((4, 3), 0.1))
    np.testing.assert_allclose(spread, 0.1)
    t = IDENTITY[None] * 2.0
    double = albedo_uncertainty(t, np.zeros((1, 16, 16)), np.zeros(4, int), base, np.full((4, 3), 0.1))
    np.testing.assert_allclose(double, 0.2)
    # No distribution on [0, 1] has a larger standard deviation than 0.5, whatever the numbers say.
    unknown = albedo_uncertainty(t, np.full((1, 16, 16), 9.0), np.zeros(4, int), base, np.full((4, 3), 0.1))
    np.testing.assert_allclose(unknown, 0.5)


def test_nothing_to_fit():
    problem, _ = problem_of(np.random.default_rng(16), 1, 30)
    empty = FitProblem(**{**problem.__dict__, "object_id": np.full(30, -1)})
    out = fit_affines(empty, response("ggcm"))
    np.testing.assert_array_equal(out.affine[0], IDENTITY)
    assert out.converged and np.isfinite(out.history).all() and (out.response.params == response("ggcm").params).all()


def test_interpolation_is_exact_at_levels_and_clamped_outside():
    s = np.random.default_rng(17).random((10, 10, 3))
    for j in range(10):
        np.testing.assert_allclose(interpolate_levels(s, LEVELS, np.full(10, LEVELS[j]))[0], s[:, j], atol=1e-12)
    np.testing.assert_allclose(interpolate_levels(s, LEVELS, np.full(10, 7.0))[0], s[:, -1])
    np.testing.assert_allclose(interpolate_levels(s, LEVELS, np.full(10, -7.0))[0], s[:, 0])
    flat = interpolate_levels(np.repeat(s[:, :1], 10, 1), LEVELS, np.linspace(0, 1, 10))  # no slope, as where no light arrives
    np.testing.assert_allclose(flat, [s[:, 0], 0 * s[:, 0]], atol=1e-12)


def test_same_bytes_twice():
    rng = np.random.default_rng(18)
    problem, _ = problem_of(rng, noise=0.1, halves=2, value_of=lambda x: response("ggcm")(x))
    a, b = (fit_affines(problem, response("ggcm"), FitOptions()) for _ in range(2))
    assert a.affine.tobytes() == b.affine.tobytes() and a.history == b.history


def test_refused():
    problem, _ = problem_of(np.random.default_rng(19), 1, 30)
    for change in (
        {"value": problem.value[:5]},
        {"diffuse": ()},
        {"levels": LEVELS[::-1]},
        {"s0": (problem.s0[0][:, :3],)},
    ):
        with pytest.raises(InputError):
            FitProblem(**{**problem.__dict__, **change})


def test_without_lobes_only_albedo_is_fitted():
    problem, truth = problem_of(np.random.default_rng(0))
    out = fit_affines(problem, response("identity"), FitOptions(lobes=False))
    rough = np.array([problem.base[problem.object_id == o, 3].mean() for o in range(problem.n_objects)])
    assert not out.free[:, 12:].any() and out.free[:, :12].any()
    np.testing.assert_allclose(out.affine[:, 13], np.maximum(rough, MATTE_ROUGHNESS), atol=1e-5)
    assert (out.affine[:, [12, 14, 15]] == 0).all() and np.isfinite(out.covariance).all()


def test_without_metals_every_object_is_a_dielectric():
    problem, _ = problem_of(np.random.default_rng(0))
    metals = fit_affines(problem, response("identity"), FitOptions())
    none = fit_affines(problem, response("identity"), FitOptions(metals=False))
    assert (none.affine[:, 14:] == 0).all() and np.isfinite(none.affine).all()
    assert none.free[:, :14].sum() == metals.free[:, :14].sum()


def test_brightness_that_is_kept_is_the_median_of_what_is_lit():
    before = np.array([[1.0, 2.0, 3.0], [4.0, 4.0, 4.0], [9.0, 0.0, 0.0], [0.0, 0.0, 0.0], [5.0, 5.0, 5.0]])
    after = np.array([[0.5, 1.0, 1.5], [1.0, 1.0, 1.0], [1.0, 1.0, 1.0], [1.0, 1.0, 1.0], [0.0, 0.0, 0.0]])
    assert kept_brightness(before, after) == pytest.approx(3.0)
    assert kept_brightness(before[3:], after[3:]) == kept_brightness(before[:0], after[:0]) == 1.0
    assert kept_brightness(np.float32([[1e-30] * 3]), np.float32([[1e30] * 3])) == pytest.approx(1e-60)


def test_objects_that_keep_their_base_are_not_divided():
    fit = SimpleNamespace(model=["diag, dielectric", "identity (3 pixels)", "population (12 pixels)"])
    assert is_divided(fit).tolist() == [True, False, True]
