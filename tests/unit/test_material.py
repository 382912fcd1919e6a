"""Order, limits and special values of materials and affine maps (Eq. R.14, R.15)."""

import numpy as np

from iif_core.fitting.shares import fair_shares
from iif_core.fusion import problem
from iif_core.reflectance import material


def test_numbers_are_ordered_by_row_then_roughness_then_metallic():
    rng = np.random.default_rng(0)
    theta, base = rng.uniform(0, 0.3, 16), rng.uniform(0.1, 0.5, (7, 5))
    a = theta[:12].reshape(3, 4)
    expected = np.c_[base[:, :3] @ a[:, :3].T + a[:, 3], theta[12] * base[:, 3] + theta[13], theta[14] * base[:, 4] + theta[15]]
    np.testing.assert_allclose(material.apply_affines(theta[None], np.zeros(7, int), base), np.clip(expected, material.LOWEST, 1))


def test_every_number_belongs_to_one_group():
    albedo = np.concatenate([material.GAINS, material.BIASES, material.CROSS_TERMS])
    assert sorted(albedo) == list(range(12)) and (material.IDENTITY[material.GAINS] == 1).all()
    every = np.arange(material.NUMBERS)
    assert [n for part in material.NUMBERS_OF.values() for n in every[part]] == list(every)
    assert tuple(material.NUMBERS_OF) == material.PROPERTIES
    np.testing.assert_array_equal(every[material.NUMBERS_OF["roughness"]], material.ROUGHNESS)
    np.testing.assert_array_equal(every[material.NUMBERS_OF["metallic"]], material.METALLIC)


def test_special_values_are_materials_and_maps():
    for value in (material.NEUTRAL, material.BLACK):
        np.testing.assert_array_equal(material.apply_affines(material.IDENTITY[None], np.zeros(1, int), value[None])[0], value)


def test_single_precision_copies_of_the_fusion_agree():
    pairs = (problem.LOWEST, material.LOWEST), (problem.NEUTRAL, material.NEUTRAL)
    for own, fact in pairs:
        assert own.dtype == np.float32
        np.testing.assert_array_equal(own, np.float32(fact))


def test_fair_shares_keep_the_same_number_of_pixels_of_every_object():
    counts = np.array([0, 3, 50, 400, 9000])
    kept = fair_shares(counts, 300) * counts
    np.testing.assert_allclose(kept, [0, 3, 50, 123.5, 123.5])
    assert (fair_shares(counts, 10_000) == 1).all()
