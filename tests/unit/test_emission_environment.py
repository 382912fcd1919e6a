"""Texels of the environment as groups, and what a room lit from outside makes of them."""

from dataclasses import replace

import numpy as np
import pytest

from iif_core.light.emission.direct import solve_emission
from iif_core.light.emission.emitters import likely_radiance
from iif_core.light.emission.environment import HEIGHT, WIDTH, Sky, SkySums, cosine_directions, sky_prior, texels
from iif_core.light.emission.pixels import EmissionPixels
from iif_core.light.emission.problem import assemble
from iif_core.light.environment import direction_in, solid_angles
from iif_core.numerics.xp import NUMPY
from tests.unit.emission_systems import rows_of, transport_of


def _middles():
    row, column = (i.astype(float) for i in np.indices((HEIGHT, WIDTH)))
    return np.stack(direction_in(NUMPY, row, column, 0.5, 0.5, HEIGHT, WIDTH), -1).reshape(-1, 3)


def test_texel_of_its_middle_at_any_length():
    ids = texels(_middles() * np.linspace(0.1, 9, HEIGHT * WIDTH)[:, None], HEIGHT, WIDTH)
    np.testing.assert_array_equal(ids, np.arange(HEIGHT * WIDTH))
    assert texels(np.zeros((1, 3)), HEIGHT, WIDTH)[0] < HEIGHT * WIDTH


def test_groups_are_directions_parted_by_what_is_seen():
    sums, way = SkySums(), _middles()
    seen = way[:, 2] > -0.3
    for texel in np.flatnonzero(seen):
        sums.add(np.tile(way[texel], (60, 1)), np.full((60, 3), 2.0 + way[texel, 2]), np.zeros((60, 3), bool))
    sky = sums.groups()
    column = sky.columns.ravel()
    assert 42 < sky.size <= 84 and (np.bincount(column, minlength=sky.size) > 0).all()
    for group in range(sky.size):
        own = column == group
        assert len(np.unique(seen[own])) == 1 and (sky.pixels[group] > 0) == seen[own][0]
        angle = np.degrees(np.arccos(np.clip(way[own] @ sky.direction[group], -1, 1)))
        assert angle.max() < 45
        if seen[own][0]:
            solid = solid_angles(HEIGHT, WIDTH).ravel()[own]
            np.testing.assert_allclose(sky.radiance[group], (solid * (2.0 + way[own, 2])).sum() / solid.sum(), rtol=1e-6)
    assert sky.pixels.sum() == sums.pixels and not sky.bounded.any() and not sky.is_unseen


def test_the_sun_is_a_group_of_its_own():
    sums, way = SkySums(), _middles()
    for texel in range(len(way)):
        sun = texel == 77
        sums.add(np.tile(way[texel], (50, 1)), np.full((50, 3), 9.0 if sun else 1.0), np.full((50, 3), sun))
    sky = sums.groups()
    sun = sky.columns.ravel()[77]
    assert (sky.columns == sun).sum() == 1 and sky.bounded.tolist() == (np.arange(sky.size) == sun).tolist()
    prior = sky_prior(sky)
    np.testing.assert_allclose(prior.initial[sun], 9.0)
    np.testing.assert_allclose(np.delete(prior.initial, sun, 0), 1.0)
    assert (np.delete(prior.correlation[sun], sun) == 0).all() and prior.width[sun] > 10 * prior.width[sun - 1]
    assert np.linalg.eigvalsh(prior.correlation).min() > 1e-3


@pytest.mark.parametrize("pixels", [0, 3])
def test_nothing_seen_is_forty_two_directions_and_three_pixels_are_one_more(pixels):
    sums = SkySums()
    sums.add(np.tile([0.0, 0, 1], (pixels, 1)), np.ones((pixels, 3)), np.zeros((pixels, 3), bool))
    sky = sums.groups()
    assert sky.size == 42 + (pixels > 0) and sky.pixels.sum() == pixels and not sky.bounded.any()
    np.testing.assert_allclose(sky.radiance, 1.0 if pixels else 0.0)
    sky = SkySums().groups()
    share = np.bincount(sky.columns.ravel(), solid_angles(*sky.columns.shape).ravel(), 42) / (4 * np.pi)
    np.testing.assert_allclose(share, 1 / 42, atol=0.012)


def test_zenith_that_no_camera_sees_is_found_from_what_it_lights():
    """A sky that brightens towards an unseen zenith; rows see each direction through noise. A mean for all that is unseen, as the
    prior alone has it, would be off by half; directions to which no row responds follow their neighbours."""
    rng = np.random.default_rng(4)
    sums, way = SkySums(), _middles()
    level = np.where(way[:, 2] > 0, 1.0 + 4.0 * way[:, 2], 0.3)
    for texel in np.flatnonzero(np.abs(way[:, 2]) < 0.3):
        sums.add(np.tile(way[texel], (60, 1)), np.full((60, 3), level[texel]), np.zeros((60, 3), bool))
    sky = sums.groups()
    solid, column = solid_angles(HEIGHT, WIDTH).ravel(), sky.columns.ravel()
    truth = np.bincount(column, solid * level, sky.size) / np.bincount(column, solid, sky.size)
    # Each row sees a few directions above; none sees the ground.
    n = 1500
    a = rng.random((n, sky.size)) * (rng.random((n, sky.size)) < 0.1) * (sky.direction[:, 2] > -0.1)
    y = a @ truth
    a = np.repeat(a[:, :, None], 3, 2)
    noisy = [a * (1 + 0.3 * rng.standard_normal(a.shape)) for _ in range(2)]
    rows = rows_of(tuple(noisy), observed=np.repeat(y[:, None], 3, 1) * (1 + 0.05 * rng.standard_normal((n, 3))))
    found = sky_prior(sky).solve(rows)
    top = sky.direction[:, 2] > 0.7
    np.testing.assert_allclose(found.radiance[top].mean(1), truth[top], rtol=0.1)
    below = sky.direction[:, 2] < -0.5
    assert (found.radiance[below] < sky.radiance[sky.pixels > 0].mean()).all() and (found.determined[below] < 0.5).all()


def test_groups_of_texels_are_solved_with_the_rest():
    """One emitter, a bright and a dark part of the sky, a part nobody sees; only the last is known by its light alone."""
    rng = np.random.default_rng(1)
    n, truth = 3000, np.array([5.0, 3.0, 0.4, 1.5])[:, None] * [1.0, 0.9, 0.8]
    a = rng.random((n, 4, 3))
    y = np.einsum("ngc,gc->nc", a, truth)
    noisy = transport_of(tuple(a * (1 + 0.2 * rng.standard_normal(a.shape)) for _ in range(2)))
    none = np.full(n, -1)
    pixels = EmissionPixels(
        radiance=y, bound=np.zeros((n, 3), bool), object_id=np.arange(n) % 9, view=np.arange(n) % 4, tile=np.arange(n), group=none
    )
    columns = np.repeat([0, 0, 1, 2], HEIGHT * WIDTH // 4).reshape(HEIGHT, WIDTH)
    sky = Sky(columns, np.array([500, 500, 0]), truth[1:] * [[1], [1], [0]], np.zeros(3, bool))
    problem = assemble(pixels, noisy, 4, None, sky)
    assert problem.anchor.sum() == 2 and (problem.owner[problem.anchor] == -1).all()
    assert problem.rows.cluster.shape == problem.owner.shape == (len(problem.rows.observed),)
    found = solve_emission(problem.rows, np.ones((4, 3)))
    np.testing.assert_allclose(found.radiance, truth, rtol=0.03)
    np.testing.assert_allclose(found.radiance[1:3], truth[1:3], rtol=2e-3)


def test_cosine_directions():
    rng = np.random.default_rng(2)
    normal = np.tile([0.0, 0.6, 0.8], (40_000, 1))
    way = cosine_directions(normal, rng)
    cosine = (way * normal).sum(1)
    np.testing.assert_allclose(np.linalg.norm(way, axis=1), 1, atol=1e-9)
    assert (cosine >= -1e-9).all()
    np.testing.assert_allclose([cosine.mean(), (cosine**2).mean()], [2 / 3, 1 / 2], atol=0.005)


def test_directions_of_an_open_mesh_are_unseen_and_share_the_sphere():
    sums = SkySums()
    sums.add(np.array([[0.0, 0, 1]] * 5), np.full((5, 3), 2.0), np.zeros((5, 3), bool))
    sky = sums.directions()
    assert sky.size == 12 and sky.direction is None and sky.is_unseen and not sums.groups(min_pixels=1).is_unseen
    np.testing.assert_allclose(sky.radiance, 2.0)
    share = np.bincount(sky.columns.ravel(), solid_angles(*sky.columns.shape).ravel(), 12) / (4 * np.pi)
    np.testing.assert_allclose(share, 1 / 12, atol=0.03)
    up, down = sky.columns[0], sky.columns[-1]
    assert not set(up) & set(down)


def test_light_from_where_no_camera_looks_has_likely_colours():
    """A direction that noise made red comes near the others, as bright as before; a sun, and what cameras see, stay."""
    sums = SkySums()
    sums.add(np.array([[0.0, 0, 1]] * 5), np.full((5, 3), 2.0), np.zeros((5, 3), bool))
    unseen = sums.directions()
    np.testing.assert_allclose(unseen.solid_angle.sum(), 4 * np.pi)
    radiance = np.full((13, 3), 1.0)
    radiance[[3, 5]] = [0.9, 0.0, 0.0]
    error = np.full((13, 3), 0.3)
    area = np.ones(1)
    found = likely_radiance(radiance, error, area, unseen)
    np.testing.assert_allclose(found.mean(1), radiance.mean(1))
    assert (found[[3, 5]].max(1) < 2 * found[[3, 5]].min(1)).all() and found[0].tolist() == [1.0, 1.0, 1.0]
    with_sun = likely_radiance(radiance, error, area, replace(unseen, sun=2))
    assert with_sun[3].tolist() == [0.9, 0.0, 0.0] and with_sun[5, 1] > 0.1
    seen = replace(unseen, pixels=np.ones_like(unseen.pixels))
    np.testing.assert_array_equal(likely_radiance(radiance, error, area, seen), radiance)
    np.testing.assert_array_equal(likely_radiance(radiance[:1], error[:1], area, None), radiance[:1])


def test_mean_through_sheets():
    """Texels seen directly and through one and three sheets: what is reflected in front counts by how much light passes."""
    way = _middles()[100]
    sums, level, cloth = SkySums(), 5.0, 0.2
    for sheets, pixels in ((0, 10), (1, 40), (3, 80)):
        share = 0.5**sheets
        shown = level * share + (cloth if sheets else 0.0)
        sums.add(np.tile(way, (pixels, 1)), np.full((pixels, 3), shown), np.zeros((pixels, 3), bool), np.full(pixels, share))
    sky = sums.groups(min_pixels=5)
    seen = sky.pixels > 0
    extra = cloth * (40 * 0.5 + 80 * 0.125) / (10 + 40 * 0.25 + 80 / 64)
    np.testing.assert_allclose(sky.radiance[seen], level + extra, rtol=1e-6)
    np.testing.assert_allclose(sums.mean(), level + extra, rtol=1e-6)
    assert sky.pixels.sum() == 130


def test_seen_and_unseen_part_of_a_direction_with_the_same_middle():
    towards = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    field = Sky(np.zeros((1, 1), np.int32), np.array([9, 0, 9]), np.ones((3, 3)), np.zeros(3, bool), towards)
    related = sky_prior(field).correlation
    assert np.linalg.eigvalsh(related)[0] > 1e-3
    np.testing.assert_allclose(np.diag(related), 1.0)
    assert related[0, 1] > 0.98 > related[0, 2]
