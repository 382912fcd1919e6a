"""A sun that no camera sees: where it may stand, and which disc of light explains what it falls on."""

import numpy as np
import pytest

from iif_core.light.emission.direct import EmissionPrior, solve_families
from iif_core.light.emission.environment import HEIGHT, WIDTH, SkySums, middles, sky_prior, sun_prior
from iif_core.light.emission.problem import EmissionProblem
from iif_core.light.emission.sun import (
    FINER,
    RADII,
    Disc,
    SunEvidence,
    SunQuestion,
    around,
    direct_light,
    discs,
    is_needed,
    size_of_sun,
    sun_texels,
    with_columns,
    with_sun,
)
from iif_core.light.environment import solid_angles
from tests.unit.emission_systems import rows_of
from workflow.decisions import light as decisions

FINE = (FINER * HEIGHT, FINER * WIDTH)


def _sky():
    """Cameras see what is near the horizon; one texel there is saturated."""
    sums, way = SkySums(), middles(HEIGHT, WIDTH)
    for texel in np.flatnonzero(np.abs(way[:, 2]) < 0.3):
        hidden = texel == 7 * WIDTH
        sums.add(np.tile(way[texel], (60, 1)), np.full((60, 3), 9.0 if hidden else 2.0), np.full((60, 3), hidden))
    return sums.groups()


def test_a_sun_may_stand_where_no_camera_sees_the_sky_unsaturated():
    texels, way = sun_texels(_sky()), middles(HEIGHT, WIDTH)
    assert 7 * WIDTH in texels
    np.testing.assert_array_equal(np.setdiff1d(texels, [7 * WIDTH]), np.flatnonzero(np.abs(way[:, 2]) >= 0.3))


@pytest.mark.parametrize("texel", [0, 5 * WIDTH + 3, 8 * WIDTH, HEIGHT * WIDTH - 1])
def test_discs_around_a_texel(texel):
    sky = SkySums().groups()
    near = around(sky, texel)
    found = discs(sky, texel, near)
    assert len(found) < 100 * len(RADII)
    fine, solid = middles(*FINE), solid_angles(*FINE).ravel()
    assert len(found) % len(RADII) == 0 and len(found) > 5 * len(RADII)
    for number, disc in enumerate(found):
        own = near[disc.texels]
        assert disc.radius == pytest.approx(RADII[number % len(RADII)] * np.pi / FINE[0])
        assert (fine[own] @ disc.direction >= np.cos(disc.radius) - 1e-6).all()
        # No disc is cut off where the rays end.
        whole = np.flatnonzero(fine @ disc.direction >= np.cos(disc.radius) - 1e-9) if disc.radius else own
        np.testing.assert_array_equal(np.sort(own), whole)
        if disc.radius > 0.1:
            assert solid[own].sum() == pytest.approx(2 * np.pi * (1 - np.cos(disc.radius)), rel=0.2)


def test_a_disc_contains_nothing_that_cameras_see_unsaturated():
    sky = _sky()
    clear = np.ones(HEIGHT * WIDTH, bool)
    clear[sun_texels(sky)] = False
    clear = clear.reshape(HEIGHT, WIDTH).repeat(FINER, 0).repeat(FINER, 1).ravel()
    for texel in (7 * WIDTH, 5 * WIDTH + 3):  # the saturated one, and one next to what is seen
        near = around(sky, texel)
        found = discs(sky, texel, near)
        assert len(found) >= FINER**2 * len(RADII) and all(len(disc.texels) for disc in found)
        assert not clear[near].any() and max(disc.texels.max() for disc in found) < len(near)


def test_the_sun_takes_its_texels_from_the_sky():
    sky = _sky()
    near = around(sky, 2 * WIDTH)
    disc = max(discs(sky, 2 * WIDTH, near), key=lambda disc: disc.radius)
    lit = with_sun(sky, Disc(disc.direction, disc.radius, near[disc.texels]))
    assert lit.size == sky.size + 1 == lit.sun + 1 and lit.columns.shape == FINE and not lit.is_unseen
    own = lit.columns == lit.sun
    assert own.sum() == len(disc.texels)
    np.testing.assert_array_equal(lit.columns[~own], sky.columns.repeat(FINER, 0).repeat(FINER, 1)[~own])
    solid = solid_angles(*FINE)
    assert lit.texel_weight.sum() == pytest.approx(1) and sky.texel_weight is None
    assert lit.texel_weight[own].sum() == pytest.approx(0.5 + 0.5 * solid[own].sum() / (4 * np.pi))
    before, prior = sky_prior(sky), sky_prior(lit)
    np.testing.assert_array_equal(prior.initial[:-1], before.initial)
    np.testing.assert_allclose(prior.correlation[:-1, :-1], before.correlation, atol=1e-12)
    assert (prior.correlation[-1] == np.eye(lit.size)[-1]).all()
    np.testing.assert_allclose(prior.initial[-1], 2.0)
    # Its irradiance is at most some ten times the irradiance of a sky of the mean radiance.
    assert prior.width[-1] * solid[own].sum() == pytest.approx(10 * np.pi)
    asked = with_columns(sky, 3)
    assert asked.size == sky.size + 3 and (asked.pixels[-3:] == 0).all() and asked.direction is None


def test_light_of_a_texel_that_fills_the_hemisphere_is_the_albedo():
    """Above a horizontal surface albedo / pi x int cos = albedo; nothing comes from below, or where rays meet surface."""
    way, solid = middles(*FINE), solid_angles(*FINE).ravel()
    albedo = np.array([[0.8, 0.5, 0.1]])
    light = direct_light(albedo, way[None, :, 2], np.ones((1, len(way)), bool), solid)
    assert light.shape == (1, len(way), 3) and light.dtype == np.float32
    np.testing.assert_allclose(light.sum(1), albedo, rtol=1e-3)
    assert (light[0, way[:, 2] <= 0] == 0).all()
    assert not direct_light(albedo, way[None, :, 2], np.zeros((1, len(way)), bool), solid).any()


def _question(sun=None, radiance=(3000.0, 2700.0, 2000.0), seed=0):
    """Surface of six objects with wrong albedos under a smooth sky of five groups, and 24 texels, each of which lights a tenth of
    the surface; texel `sun` shines."""
    rng = np.random.default_rng(seed)
    n, solid = 1500, 2.4e-3
    owner = np.arange(n) % 6
    sky = np.repeat(rng.random((n, 5, 1)), 3, 2)
    patches = np.repeat((rng.random((n, 24, 1)) < 0.1) * rng.random((n, 24, 1)), 3, 2) * solid / np.pi
    cached = np.repeat(0.3 + 0.1 * rng.random((n, 1)), 3, 1)
    gain = rng.uniform(0.6, 1.5, (6, 3))[owner]
    truth = np.array([1.0, 1.2, 0.8, 1.1, 0.9])
    shown = np.einsum("ngc,g->nc", sky, truth) + cached
    if sun is not None:
        shown = shown + patches[:, sun] * radiance
    matrix = np.concatenate([sky, patches], 1)
    noisy = tuple(matrix * (1 + 0.1 * rng.standard_normal(matrix.shape)) for _ in range(2))
    rows = rows_of(noisy, observed=gain * shown * (1 + 0.02 * rng.standard_normal(shown.shape)), cached=(cached,))
    problem = EmissionProblem(rows, owner, np.zeros(n, bool), np.ones(n))
    prior = EmissionPrior.independent(np.ones((5, 3)))
    return SunQuestion(problem, prior, np.full(24, solid), np.ones(3), None, 6)


def test_the_texel_of_the_sun_is_found_and_its_radiance():
    question = _question(sun=17)
    none = question.look()
    assert question.decrease([np.array([i]) for i in range(24)], none).argmax() == 17
    lit = question.look(np.array([17]))
    assert is_needed(none.misfit, lit.misfit) and lit.misfit < 0.3 * none.misfit
    np.testing.assert_allclose(lit.radiance[-1], [3000, 2700, 2000], rtol=0.12)


def test_without_a_sun_none_is_found():
    question = _question()
    none = question.look()
    best = np.argsort(-question.decrease([np.array([i]) for i in range(24)], none))[:3]
    assert not any(is_needed(none.misfit, question.look(np.array([i])).misfit) for i in best)


def test_a_sun_of_two_texels_has_one_radiance():
    question = _question(sun=4)
    both = question.look(np.array([4, 9]))
    alone = question.look(np.array([4]))
    assert len(both.radiance) == 6 and alone.misfit < both.misfit < question.look().misfit
    matrix = question.problem.rows.matrix
    together = question._together(matrix, np.array([4, 9]))
    np.testing.assert_array_equal(together, matrix[:, :, :, 5 + 4] + matrix[:, :, :, 5 + 9])


@pytest.mark.parametrize(
    "decreases, number, narrow",
    [
        ([0.5, 0.5, 0.5, 0.5, 0.5], 0, 1.0),
        ([0.4, 0.48, 0.5, 0.5, 0.5], 1, 0.96),
        ([0.1, 0.2, 0.3, 0.4, 0.5], 4, 0.4),
        ([0.0, 0.0, 0.0, 0.0, 0.0], 0, 0.0),
    ],
)
def test_the_smallest_disc_that_is_as_good(decreases, number, narrow):
    found = size_of_sun(np.array(decreases))
    assert found.narrow == pytest.approx(narrow) and found.is_sharp == (narrow >= 0.75)
    assert found.number == number


def test_decision():
    disc = Disc(np.array([0.0, 0.6, 0.8]), np.radians(4.2), np.arange(9))
    found = decisions.sun(SunEvidence(disc, 0.1, 0.04, 0.9))
    assert found["included"] and found["value"] == pytest.approx(0.6) and "(0.00, 0.60, 0.80)" in found["reason"]
    wide, weak = (decisions.sun(SunEvidence(disc, 0.1, with_it, narrow)) for with_it, narrow in ((0.04, 0.6), (0.0951, 1.0)))
    assert not wide["included"] and "bright part of the sky" in wide["reason"]
    assert not weak["included"] and "part of the sky" not in weak["reason"] and "was not found on" in weak["reason"]
    none = decisions.sun(SunEvidence(None, 0.0, 0.0))
    assert not none["included"] and none["value"] == 0.0 and not decisions.sun(None)["included"]


@pytest.mark.parametrize(
    "without, with_it, needed", [(0.1, 0.09, True), (0.1, 0.096, False), (0.0, -0.1, False), (-0.1, -0.2, False)]
)
def test_a_misfit_that_noise_makes_negative_cannot_fall(without, with_it, needed):
    assert is_needed(without, with_it) == needed


def test_a_sun_beside_a_sky_that_no_camera_sees_keeps_a_prior_of_its_own():
    """All groups of such a sky are one family around a common radiance; in it the sun would vanish."""
    question = _question(sun=17)
    look = question.look(np.array([17]))
    prior = question.prior.beside(sun_prior(question.mean, question.solid_angle[17]))
    rows = question._of(np.array([17])).solve_object_gains(prior, None, 6)[0].rows
    family, width = np.array([-9, -9, -9, -9, -9, -1]), np.full(6, 0.5)
    found = solve_families(rows, prior, family, width)
    np.testing.assert_allclose(found.radiance[-1], look.radiance[-1], rtol=0.1)
    assert solve_families(rows, prior, np.full(6, -9), width).radiance[-1].max() < 0.1 * found.radiance[-1].min()
