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


def test_a_view_that_is_exposed_for_the_lamp_tells_its_radiance():
    """Most photographs of a lamp are saturated; the one that is not shows how bright it is."""
    bound = np.ones((22, 3), bool)
    bound[18:] = False
    bound[20] = True  # a pixel of the short exposure
    got = pixels(np.zeros(22, int), np.repeat([3, 4, 7], (9, 9, 4)), bound).with_majority()
    np.testing.assert_array_equal(got.bound, bound)


def test_pixels_that_look_at_no_lamp_stay_as_they_are():
    bound = np.ones((4, 3), bool)
    bound[0] = False
    np.testing.assert_array_equal(pixels([-1] * 4, np.zeros(4, int), bound).with_majority().bound, bound)
