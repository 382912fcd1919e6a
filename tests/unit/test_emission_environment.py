"""Texels of the environment as groups, and what a room lit from outside makes of them."""

import numpy as np
import pytest

from iif_core.light.emission.direct import solve_emission
from iif_core.light.emission.environment import HEIGHT, WIDTH, Sky, SkySums, cosine_directions, texels
from iif_core.light.emission.pixels import EmissionPixels
from iif_core.light.emission.problem import assemble
from iif_core.light.environment import direction_in, solid_angles
from iif_core.numerics.xp import NUMPY
from tests.unit.emission_systems import transport_of


def _middles():
    row, column = (i.astype(float) for i in np.indices((HEIGHT, WIDTH)))
    return np.stack(direction_in(NUMPY, row, column, 0.5, 0.5, HEIGHT, WIDTH), -1).reshape(-1, 3)


def test_texel_of_its_middle_at_any_length():
    ids = texels(_middles() * np.linspace(0.1, 9, HEIGHT * WIDTH)[:, None], HEIGHT, WIDTH)
    np.testing.assert_array_equal(ids, np.arange(HEIGHT * WIDTH))
    assert texels(np.zeros((1, 3)), HEIGHT, WIDTH)[0] < HEIGHT * WIDTH


def test_texels_of_similar_brightness_share_a_group_and_unseen_ones_another():
    sums, way = SkySums(), _middles()
    level = np.where(np.arange(len(way)) < 128, 4.0, 0.5)  # bright above, dark below; the lowest rows are not seen
    for texel in range(len(way) - 64):
        sums.add(np.tile(way[texel], (60, 1)), np.full((60, 3), level[texel]), np.zeros((60, 3), bool))
    sky = sums.groups()
    assert sky.size == 3 and sky.columns.shape == (HEIGHT, WIDTH)
    assert len(np.unique(sky.columns[:4])) == 1 and len(np.unique(sky.columns[4:14])) == 1
    assert (sky.columns[14:] == 2).all() and sky.pixels[2] == 0
    np.testing.assert_allclose(sky.radiance[sky.columns[0, 0]], 4)
    np.testing.assert_allclose(sky.radiance[2], sums.mean())


def test_sun_is_a_group_of_its_own_and_groups_are_few():
    sums, way = SkySums(), _middles()
    rng = np.random.default_rng(0)
    for texel, level in enumerate(rng.lognormal(0, 2, len(way))):
        sun = texel == 77
        value = np.full((50, 3), 0.9 if sun else level)
        sums.add(np.tile(way[texel], (50, 1)), value, np.full((50, 3), sun))
    sky = sums.groups(max_groups=8)
    sun = sky.columns.ravel()[77]
    assert sky.size <= 8 and (sky.columns == sun).sum() == 1 and sky.bounded.tolist() == (np.arange(sky.size) == sun).tolist()
    assert sky.pixels.sum() == sums.pixels == 50 * HEIGHT * WIDTH


@pytest.mark.parametrize("pixels", [0, 3])
def test_nothing_seen_is_one_group(pixels):
    sums = SkySums()
    sums.add(np.tile([0.0, 0, 1], (pixels, 1)), np.ones((pixels, 3)), np.zeros((pixels, 3), bool))
    sky = sums.groups()
    assert sky.size == 1 and (sky.columns == 0).all() and sky.pixels[0] == pixels
    assert np.isfinite(sky.radiance).all() and not sky.bounded[0] or pixels == 0


def test_groups_of_texels_are_solved_with_the_rest():
    """One emitter, a bright and a dark part of the sky, a part nobody sees; only the last is known by its light alone."""
    rng = np.random.default_rng(1)
    n, truth = 3000, np.array([5.0, 3.0, 0.4, 1.5])[:, None] * [1.0, 0.9, 0.8]
    a = rng.random((n, 4, 3))
    y = np.einsum("ngc,gc->nc", a, truth)
    noisy = transport_of(tuple(a * (1 + 0.2 * rng.standard_normal(a.shape)) for _ in range(2)))
    none = np.full(n, -1)
    pixels = EmissionPixels(y, np.zeros((n, 3), bool), np.arange(n) % 9, np.arange(n) % 4, np.arange(n), none)
    columns = np.repeat([0, 0, 1, 2], HEIGHT * WIDTH // 4).reshape(HEIGHT, WIDTH)
    sky = Sky(columns, np.array([500, 500, 0]), truth[1:] * [[1], [1], [0]], np.zeros(3, bool))
    problem = assemble(pixels, noisy, 4, None, sky)
    assert problem.anchor.sum() == 2 and problem.rows.cluster.shape == problem.owner.shape == (len(problem.rows.observed),)
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
    assert sky.size == 12 and sky.is_unseen and not sums.groups(min_pixels=1).is_unseen
    np.testing.assert_allclose(sky.radiance, 2.0)
    share = np.bincount(sky.columns.ravel(), solid_angles(*sky.columns.shape).ravel(), 12) / (4 * np.pi)
    np.testing.assert_allclose(share, 1 / 12, atol=0.03)
    up, down = sky.columns[0], sky.columns[-1]
    assert not set(up) & set(down)
