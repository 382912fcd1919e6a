"""Material truth of a pixel: the mean over what it shows."""

from __future__ import annotations

import numpy as np
import pytest

from lab.sources.footprint import Seen, over_pixels
from workflow.scene.normal_form import Truth, View

SIDE = 6
VIEW = View(0, "000", SIDE, SIDE, 3.0, 3.0, SIDE / 2, SIDE / 2, np.eye(4), 1.0, "train")


def look(colour, known=lambda x, y: np.ones_like(x, bool), face=lambda x, y: np.zeros_like(x, int)):
    """Return a camera of a wall at depth 1 whose materials are functions of the place, in pixels of `VIEW`."""

    def at(view):
        rays = view.directions()
        x, y = rays[..., 0] * VIEW.fx + VIEW.cx, rays[..., 1] * VIEW.fy + VIEW.cy
        seen, value = face(x, y), colour(x, y)
        albedo = np.where((seen >= 0)[..., None], np.stack([value, value / 2, value / 4], -1), 0)
        flat = np.where(seen >= 0, value, 0)
        emission = np.repeat(flat[..., None], 3, -1)
        valid = known(x, y) & (seen >= 0)
        return Seen((seen >= 0).astype(np.float32), seen, Truth(albedo, flat, flat / 2, emission, 0 * albedo, valid))

    return at


def stripes(x, y):
    """Four stripes a pixel, dark and bright by turns: a pixel's centre lies on the edge of a bright one."""
    return np.where(np.floor(4 * x) % 2 == 0, 0.9, 0.1)


def test_texture_finer_than_a_pixel_has_its_mean():
    found = over_pixels(VIEW, look(stripes), np.zeros(1, int))
    np.testing.assert_allclose(found.truth.albedo, np.broadcast_to([0.5, 0.25, 0.125], (SIDE, SIDE, 3)), rtol=1e-12)
    np.testing.assert_allclose(found.truth.roughness, 0.5, rtol=1e-12)
    np.testing.assert_allclose(found.truth.metallic, 0.25, rtol=1e-12)
    centre = look(stripes)(VIEW)
    assert np.abs(centre.truth.roughness - 0.5).min() > 0.3  # at its centre no pixel has it
    np.testing.assert_array_equal(found.truth.emission, centre.truth.emission)
    np.testing.assert_array_equal(found.face, centre.face)


def test_all_sixteen_points_count():
    def product(x, y):
        return ((4 * x).astype(int) % 4 + 1) * ((4 * y).astype(int) % 4 + 2.0)

    found = over_pixels(VIEW, look(product), np.zeros(1, int))
    np.testing.assert_allclose(found.truth.roughness, 2.5 * 3.5, rtol=1e-12)  # along a diagonal it would be 10


def test_a_gradient_has_the_value_of_the_centre():
    found = over_pixels(VIEW, look(lambda x, y: 0.1 + 0.03 * x + 0.05 * y), np.zeros(1, int))
    x, y = np.meshgrid(np.arange(SIDE) + 0.5, np.arange(SIDE) + 0.5)
    np.testing.assert_allclose(found.truth.roughness, 0.1 + 0.03 * x + 0.05 * y, rtol=1e-6)


@pytest.mark.parametrize("cut", [2.3, 2.8])
def test_only_the_object_of_the_centre_counts(cut):
    bright_beyond = look(lambda x, y: np.where(x < cut, 0.2, 0.8), face=lambda x, y: (x >= cut).astype(int))
    two = over_pixels(VIEW, bright_beyond, np.array([0, 1])).truth.roughness
    assert set(two.round(12).ravel()) == {0.2, 0.8}
    one = over_pixels(VIEW, bright_beyond, np.array([7, 7])).truth.roughness
    share = np.mean(2 + (np.arange(4) + 0.5) / 4 >= cut)
    np.testing.assert_allclose(one[:, 2], 0.2 + 0.6 * share, rtol=1e-6)


def test_points_without_truth_do_not_count_and_pixels_without_keep_the_centre():
    def known(x, y):
        return (y > 1) & ((4 * x) % 1 < 0.9)

    def colour(x, y):
        return np.where((y > 1) & (x % 1 > 0.5), np.nan, 0.3)

    half = look(colour, lambda x, y: known(x, y) & (x % 1 <= 0.5))
    found = over_pixels(VIEW, half, np.zeros(1, int)).truth
    np.testing.assert_array_equal(found.valid, half(VIEW).truth.valid)
    np.testing.assert_allclose(found.roughness[1:], 0.3)
    beside = look(lambda x, y: 0.1 * x, lambda x, y: (y > 1) & (x % 1 < 0.4))  # no centre has a truth
    np.testing.assert_array_equal(over_pixels(VIEW, beside, np.zeros(1, int)).truth.roughness, beside(VIEW).truth.roughness)
    nothing = over_pixels(VIEW, look(stripes, known=lambda x, y: np.zeros_like(x, bool)), np.zeros(1, int)).truth
    np.testing.assert_array_equal(nothing.albedo, look(stripes)(VIEW).truth.albedo)


def test_where_nothing_is_there_is_nothing():
    sky = look(lambda x, y: 0.4 + 0 * x, face=lambda x, y: np.where(y < 3.1, -1, 0))
    for owner in (np.zeros(1, int), np.array([0, -1])):
        found = over_pixels(VIEW, sky, owner).truth
        assert not found.albedo[:3].any()
        np.testing.assert_allclose(found.roughness[3:], 0.4)
