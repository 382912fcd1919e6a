"""The lit room as a texture."""

import numpy as np

from iif_core.numerics.color import linear_from_srgb
from workflow.exporters.atlas import Atlas
from workflow.room.light import LitTexels
from workflow.room.unlit import mean_reflectance, unlit_picture


def plain(size, colour, roughness=1.0, metallic=0.0):
    full = np.ones((size, size), np.float32)
    return Atlas(np.full((size, size, 3), colour, np.float32), roughness * full, metallic * full, 0 * full, full > 0, full > 0)


def test_reflectance_is_bounded_and_that_of_a_mirror_is_its_colour():
    colours = np.linspace(0, 1, 5)[:, None].repeat(3, 1)
    for roughness in (0.0, 0.02, 0.5, 1.0):
        for metallic in (0.0, 1.0):
            found = mean_reflectance(colours, np.full(5, roughness), np.full(5, metallic))
            assert (found >= 0).all() and (np.diff(found[:, 0]) > 0).all()
    # Even light from everywhere comes back as k_s A_0 + A_1; averaged over all paths of light, a metal loses some to masking.
    metal = mean_reflectance(np.float32([[1, 0.5, 0.2]]), np.array([0.3]), np.array([1.0]))
    np.testing.assert_allclose(metal / metal[0, 0], [[1, 0.51, 0.22]], atol=0.02)
    assert 0.7 < metal[0, 0] <= 1


def test_light_is_interpolated_and_nothing_beyond_the_charts_is_dark():
    """A ramp of light on a coarse map: the fine picture follows it, and texels without surface take the nearest light."""
    coarse, fine = 8, 64
    row, column = np.nonzero(np.arange(64).reshape(8, 8) % 8 < 6)  # six columns have surface
    index = row * coarse + column
    one = np.zeros(len(index), np.int64)
    points = np.zeros((len(index), 3), np.float32)
    texels = LitTexels(coarse, index, points, points, one, np.ones(1), index, np.arange(len(index)))
    light = np.repeat(column[:, None] + 1.0, 3, 1).astype(np.float32)
    atlas = plain(fine, 0.8)
    shown = linear_from_srgb(unlit_picture(atlas, texels, light, 0.1).astype(float) / 255)
    factor = 0.1 * mean_reflectance(np.float32([0.8] * 3), np.float32(1), np.float32(0))[0]
    at = (np.arange(fine) + 0.5) / 8 - 0.5
    wanted = factor * (1 + np.clip(at, 0, 5))
    np.testing.assert_allclose(shown[20, :, 0], wanted, rtol=0.02, atol=0.004)
    assert unlit_picture(atlas, texels, np.zeros((0, 3)), 1.0).max() == 0
