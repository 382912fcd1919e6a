"""What predictions with known errors say about each object, and how selection, levels and gauge use it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from iif_core.camera.response import response
from iif_core.fitting import object_levels
from iif_core.fitting.direct import fit_affines
from iif_core.fitting.gauge import Gauge, apply_gauge
from iif_core.fitting.object_levels import compare_levels, relative_error_of_base, shared_light_error
from iif_core.fitting.predictions import PredictionErrors
from iif_core.fitting.problem import SHARED_LIGHT_ERROR, FitOptions
from iif_core.fitting.selection import EVIDENCE_DISCOUNT, ROUGHNESS_GRID, Profile, choose_kinds
from iif_core.light.emission.gains import PRIOR_LEVEL_ERROR
from tests.errors import refused
from tests.unit.planted_fit import problem_of

ERRORS = PredictionErrors(0.15, 0.25, (0.57, 0.6, 0.9, 0.2), (3.4, 1.1))


def test_odds_and_roughness_are_those_of_the_formulas():
    np.testing.assert_allclose(ERRORS.metal_log_odds(np.array([0.5, 0.25])), [3.4, 3.4 + 1.1 * np.log(1 / 3)])
    grid = np.linspace(0, 1, 11)
    expected = stats.t.pdf(grid - 0.6 - 0.9 * (0.61 - 0.57), 4, scale=0.2)
    np.testing.assert_allclose(ERRORS.roughness_prior(np.array([0.61]), grid)[0], expected / expected.max(), rtol=1e-12)


@given(st.lists(st.floats(0, 1), min_size=1, max_size=9), st.floats(-1e3, 1e3))
def test_any_prediction_gives_finite_odds(metallic, roughness):
    odds = ERRORS.metal_log_odds(np.array(metallic))
    assert np.isfinite(odds).all() and np.abs(odds).max() < 12
    density = ERRORS.roughness_prior(np.array([roughness]), ROUGHNESS_GRID)
    assert np.isfinite(density).all() and density.max() == 1 and density.min() >= 0


@pytest.mark.parametrize(
    "change",
    [
        {"level": 0.0},
        {"brightness": "much"},
        {"roughness": [0.5, 0.5, 0.2]},
        {"roughness": [0.5, 0.5, -0.2, 0.1]},
        {"metal": [np.nan, 1.0]},
        {"metal": None},
    ],
)
def test_facts_survive_and_wrong_ones_are_refused(change):
    assert PredictionErrors.from_facts(ERRORS.facts(), "recipe") == ERRORS
    with refused("recipe", "object_errors"):
        PredictionErrors.from_facts(ERRORS.facts() | change, "recipe")


def chosen(metallic, evidence_for_metal, stated, brighter=0.0, given=None, roughness=3):
    """Choice for objects that look alike but for the predicted metallic (O,), the photographs' evidence (O,), and how much
    brighter than the base a metal would be; metals have the roughness of a number of the grid."""
    objects = len(metallic)
    cost = np.full((objects, 3, len(ROUGHNESS_GRID)), np.inf)
    cost[:, 0, 3] = evidence_for_metal
    cost[:, 1, roughness] = 0.0
    base = np.full((objects, 5), 0.4)
    base[:, 4] = metallic
    affine = np.zeros((*cost.shape, 16))
    affine[..., [0, 5, 10]] = 1.0
    affine[:, 1, :, :12] *= np.exp(np.broadcast_to(brighter, objects))[:, None, None]
    found = Profile(cost, affine, np.full(objects, 1.0 / EVIDENCE_DISCOUNT))
    return choose_kinds(found, np.ones(objects, bool), base, np.full(objects, 100), given, stated)


def log_odds(choice):
    dielectric, metal, as_predicted = choice.kinds.probability.T
    np.testing.assert_allclose(as_predicted, 0.0, atol=1e-250)
    return np.log(metal) - np.log(dielectric)


def test_the_base_decides_between_metal_and_dielectric_where_photographs_do_not():
    """Evidence of e^3 for metal outweighs the rarity of metals (0.85 to 0.1), unless the prediction says otherwise."""
    metallic, evidence = np.array([1e-3, 0.05, 0.6, 0.9]), np.array([3.0, 3.0, 3.0, -30.0])
    np.testing.assert_array_equal(chosen(metallic, evidence, None).kind, [1, 1, 1, 0])
    np.testing.assert_array_equal(chosen(metallic, evidence, ERRORS).kind, [0, 0, 1, 0])


def test_odds_of_metal_are_those_of_rooms_with_truth():
    """Each of the three witnesses alone, by hand (Eq. M.56): ln odds = c + 0.38 s + 0.7 sgn(e) ln(1 + |e|) + 1.22 x."""
    metallic, evidence = np.array([0.5, 0.5, 0.9, 0.5, 0.5, 0.5]), np.array([0.0, 99.0, 0.0, -99.0, 0.0, 0.0])
    odds = log_odds(chosen(metallic, evidence, ERRORS, brighter=np.array([0.0, 0.0, 0.0, 0.0, 0.5, 9.0])))
    usual = -1.74 + 0.38 * 3.4
    by_hand = [0.0, 0.7 * np.log(100.0), 0.38 * 1.1 * np.log(9.0), -0.7 * np.log(100.0), 0.61, 1.83]
    np.testing.assert_allclose(odds - usual, by_hand, atol=1e-9)
    # The odds of an object do not depend on what the others are.
    np.testing.assert_allclose(log_odds(chosen(metallic[:1], evidence[:1], ERRORS)), odds[:1], atol=1e-9)


def test_a_rough_metal_is_none_and_a_known_one_is_one():
    some = np.array([0.9]), np.array([300.0])
    assert chosen(*some, ERRORS).kind == [1]
    assert chosen(*some, ERRORS, roughness=6).kind == [0]  # rougher than `ROUGHEST_METAL`
    for metallic in (0.0, 1.0):
        known = chosen(*some, ERRORS, given=np.array([[np.nan, metallic]]), roughness=6)
        np.testing.assert_allclose(known.kinds.probability[0, 1], metallic, atol=1e-12)


@given(
    st.lists(st.floats(0, 1), min_size=5, max_size=5), st.lists(st.floats(-1e12, 1e12), min_size=5, max_size=5), st.floats(-30, 9)
)
def test_any_evidence_gives_probabilities(metallic, evidence, brighter):
    probability = chosen(np.array(metallic), np.array(evidence), ERRORS, brighter).kinds.probability
    assert (probability >= 0).all()
    np.testing.assert_allclose(probability.sum(1), 1.0, rtol=1e-12)


def test_witnesses_of_metal_are_written_as_they_are():
    """However much the photographs speak against a metal, its brightness is what it is; what is known by hand is no witness."""
    some = np.array([0.5]), np.array([-1e6])
    witnesses = chosen(*some, ERRORS, brighter=1.4).kinds.witnesses
    assert witnesses[0, 0] == pytest.approx(3.4) and witnesses[0, 1] < -9e5 and witnesses[0, 2] == pytest.approx(1.4)
    known = chosen(*some, ERRORS, given=np.array([[np.nan, 1.0]])).kinds
    np.testing.assert_array_equal(known.witnesses[0, 1:], 0.0)
    assert not chosen(*some, None).kinds.witnesses.any()


def test_roughness_follows_the_base_where_photographs_say_nothing():
    cost = np.full((6, 3, len(ROUGHNESS_GRID)), np.inf)
    cost[:, 0] = 0.0
    base = np.full((6, 5), 0.4)
    base[:, 3], base[:, 4] = np.linspace(0.45, 0.7, 6), 0.0
    found = Profile(cost, np.zeros((*cost.shape, 16)), np.full(6, 1.0 / EVIDENCE_DISCOUNT))
    rough = choose_kinds(found, np.ones(6, bool), base, np.full(6, 100), None, ERRORS).roughness
    density = ERRORS.roughness_prior(base[:, 3], ROUGHNESS_GRID)
    np.testing.assert_allclose(rough, density @ ROUGHNESS_GRID / density.sum(1), rtol=1e-9)  # whatever the others are
    cost[:, 0] = 1e3 * (ROUGHNESS_GRID - 0.2) ** 2  # photographs that know are believed
    rough = choose_kinds(found, np.ones(6, bool), base, np.full(6, 100), None, ERRORS).roughness
    np.testing.assert_allclose(rough, 0.22, atol=0.02)


def test_an_error_that_is_stated_is_not_learnt_again():
    """The base errs by 0.2 and its predictions agree to 0.02: the light, which is right, is believed to be."""
    rng = np.random.default_rng(3)
    truth = rng.uniform(0.1, 0.8, (60, 1)) * np.ones((1, 3))
    size = relative_error_of_base(truth.mean(1))
    base = truth * np.exp(0.2 * size * rng.normal(size=60))[:, None]
    shown = truth * np.exp(0.05 * rng.normal(size=60))[:, None]
    scatter, smooth, pixels = np.full(60, 0.02), np.full(60, 0.05), np.full(60, 100.0)
    levels = compare_levels(base, shown, scatter, smooth, pixels, stated=0.2, shared=0.05)
    # Of the stated error, 0.8 is the base's alone.
    np.testing.assert_allclose(levels.base_error, 0.16 * relative_error_of_base(base.mean(1)), rtol=1e-12)
    assert np.std(np.log(levels.light_gain)) < 0.09
    # Light that explains the photographs badly is believed less.
    worse = compare_levels(base, shown, scatter, smooth, pixels, stated=0.2, shared=0.3)
    assert np.std(np.log(worse.light_gain)) > 1.5 * np.std(np.log(levels.light_gain))


def test_error_of_the_light_on_an_object_from_what_the_light_leaves_unexplained():
    assert [shared_light_error(misfit) for misfit in (0.01, 0.04)] == pytest.approx([0.07, 0.14])
    assert [shared_light_error(misfit) for misfit in (0.0, -1e-4, 1e9)] == [0.03, 0.03, 0.6]
    assert all(shared_light_error(unknown) == SHARED_LIGHT_ERROR for unknown in (None, np.inf, np.nan))
    assert relative_error_of_base(np.array([0.3]))[0] == 1 and np.isfinite(relative_error_of_base(np.array([0.0, 9.0]))).all()


def test_the_light_tells_the_level_of_a_metal_more_than_its_base_does():
    # Twice as bright as the base says: of a dielectric the light is blamed, of a certain metal the base, of a doubtful one less.
    base, shown = np.full((60, 3), 0.2), np.full((60, 3), 0.2)
    shown[:3] *= 2.0
    rest = np.full(60, 0.05), np.full(60, 0.05), np.full(60, 100.0)
    metal = np.zeros(60)
    metal[1:3] = 1.0, 0.55
    levels = compare_levels(base, shown, *rest, stated=0.19, shared=0.25, metal=metal)
    plain = compare_levels(base, shown, *rest, stated=0.19, shared=0.25)
    dielectric, certain, doubtful = np.log(levels.light_gain[:3]) / np.log(2.0)
    assert certain < 0.35 < doubtful < 0.75 and certain < dielectric
    np.testing.assert_allclose(levels.light_gain[[0, *range(3, 60)]], plain.light_gain[[0, *range(3, 60)]], rtol=0.02)
    # Where both errors are learnt, they are.
    learnt = (compare_levels(base, shown, *rest, metal=found) for found in (metal, None))
    assert len({levels.light_gain.tobytes() for levels in learnt}) == 1


def test_an_error_that_base_and_light_share_is_claimed_nevertheless():
    """A base that was predicted under the fit's own wrong light agrees with the fit: no discrepancy shows the error. What rooms
    of known materials say of it is claimed; what is learnt from the discrepancies is far too small."""
    inside = {None: [], 0.2: []}
    for seed in range(20):
        rng = np.random.default_rng(seed)
        truth, smooth = rng.uniform(0.1, 0.8, (40, 1)) * np.ones((1, 3)), rng.uniform(0.06, 0.12, 40)
        shared = 2.2 * smooth * rng.standard_t(4, 40)
        base, shown = truth * np.exp(shared + 0.05 * rng.normal(size=40))[:, None], truth * np.exp(shared)[:, None]
        for stated, found in inside.items():
            levels = compare_levels(base, shown, np.full(40, 0.1), smooth, np.full(40, 100.0), stated=stated)
            found.append(np.abs(shared) < 1.142 * levels.light_error)  # the central 68 % of Student's t
            if stated is not None:  # even light on an object may be wrong as a whole
                light_error = np.hypot(1.5 * smooth, 0.12)
                np.testing.assert_allclose(levels.light_error, light_error, rtol=1e-12)
                part, deviation = object_levels._divide(levels.discrepancy, levels.base_error, light_error)[1:]
                np.testing.assert_allclose(levels.light_gain, np.exp(part), rtol=1e-12)
                np.testing.assert_allclose(levels.deviation, deviation, rtol=1e-12)
    assert 0.6 < np.mean(inside[0.2]) < 0.76 and np.mean(inside[None]) < 0.5


def test_a_level_that_the_prior_knows_better_counts_more():
    problem, _ = problem_of(np.random.default_rng(14))
    free = fit_affines(problem, response("identity"), FitOptions())
    weak, strong = (
        apply_gauge(problem, free, Gauge("found", error=0.1, prior_error=error)) for error in (PRIOR_LEVEL_ERROR, 0.1)
    )
    assert np.log(strong.light_scale) / np.log(weak.light_scale) == pytest.approx(0.5 * (1 + 3.5**2), rel=1e-9)
    assert strong.facts["scale"]["relative_error"] == pytest.approx(0.1 / np.sqrt(2))


def test_statements_change_nothing_where_nothing_is_open():
    """Exact photographs decide everything by themselves."""
    problem, truth = problem_of(np.random.default_rng(5))
    plain, stated = (
        fit_affines(problem, response("identity"), FitOptions(prediction_errors=e, light_error=0.03)) for e in (None, ERRORS)
    )
    np.testing.assert_allclose(stated.affine[:, 13:], plain.affine[:, 13:], atol=0.05)
