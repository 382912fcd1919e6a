"""A lamp that most of its pixels show saturated is not taken for what the few others show."""

import numpy as np

from iif_core.light.emission.pixels import EmissionPixels

DIM, BRIGHT = 0.4, 2.0


def pixels(group, view, bound):
    """Pixels that look at groups; those that are no bounds show less than the others."""
    group, bound = np.asarray(group), np.asarray(bound, bool)
    return EmissionPixels(
        radiance=np.where(bound, BRIGHT, DIM),
        bound=bound,
        object_id=np.zeros(len(group), int),
        view=np.asarray(view),
        tile=np.zeros(len(group), int),
        group=group,
    )


def test_the_few_pixels_of_a_saturated_lamp_are_lower_bounds_too():
    bound = np.zeros((20, 3), bool)
    bound[:6, 0], bound[:5, 1], bound[:9, 2] = True, True, True  # of ten pixels of group 0: most, half, most
    bound[10:14, 0] = True  # of eight of group 1: half
    got = pixels(np.repeat([0, 1, -1], (10, 8, 2)), np.zeros(20, int), bound).with_majority()
    assert got.bound[:10, 0].all() and got.bound[:10, 2].all()
    np.testing.assert_array_equal(got.bound[:10, 1], bound[:10, 1])
    np.testing.assert_array_equal(got.bound[10:], bound[10:])
    np.testing.assert_array_equal(got.radiance, np.where(bound, BRIGHT, DIM))  # each is bounded by what it shows itself


def test_a_shorter_exposure_tells_the_radiance_of_a_lamp():
    """Most photographs of a lamp are saturated. One that is not shows how bright it is, or less than that: only its rim."""
    short, rim, mixed = slice(18, 22), slice(22, 26), slice(26, 30)
    bound = np.ones((30, 3), bool)
    bound[short] = bound[rim] = False
    bound[27:30] = False  # one pixel of this view is saturated
    lamp = pixels(np.zeros(30, int), np.repeat([3, 4, 7, 8, 9], (9, 9, 4, 4, 4)), bound)
    lamp.radiance[short] = lamp.radiance[mixed] = 2 * BRIGHT
    lamp.radiance[18] = DIM  # a dark pixel does not spoil the view
    got = lamp.with_majority()
    assert not got.bound[short].any()
    assert got.bound[rim].all() and got.bound[mixed].all()
    np.testing.assert_array_equal(got.bound[:18], bound[:18])


def test_what_stands_before_a_lamp_is_not_the_lamp():
    """A shade that a mesh lacks is as bright as the lamp's bounds in one channel, and dark in the others. A warm lamp whose red
    is saturated and whose green is not shows its green; blue is no bound in most views and stays out of it."""
    shade, warm = slice(20, 24), slice(24, 28)
    bound = np.ones((28, 3), bool)
    bound[:, 2] = False
    bound[shade] = False
    bound[warm, 1] = False
    lamp = pixels(np.zeros(28, int), np.repeat(np.arange(7), 4), bound)
    lamp.radiance[shade] = [1.1 * BRIGHT, DIM, DIM]
    lamp.radiance[warm, 1] = 1.2 * BRIGHT
    got = lamp.with_majority().bound
    assert got[shade, :2].all() and not got[:, 2].any()
    np.testing.assert_array_equal(got[warm], bound[warm])


def test_a_few_bounds_that_are_too_high_hide_no_shorter_exposure():
    bound = np.ones((40, 3), bool)
    bound[36:] = False
    lamp = pixels(np.zeros(40, int), np.repeat(np.arange(10), 4), bound)
    lamp.radiance[:2] = 9 * BRIGHT  # noise
    lamp.radiance[36:] = 1.5 * BRIGHT
    np.testing.assert_array_equal(lamp.with_majority().bound, bound)


def test_pixels_that_look_at_no_lamp_stay_as_they_are():
    bound = np.ones((4, 3), bool)
    bound[0] = False
    np.testing.assert_array_equal(pixels([-1] * 4, np.zeros(4, int), bound).with_majority().bound, bound)
