"""The compiled loops against plain float64 NumPy, in single and half precision."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from iif_core.fusion import kernels
from iif_core.fusion.blocks import Block
from iif_core.fusion.options import FusionOptions
from iif_core.fusion.problem import LOWEST
from iif_core.fusion.sums import SegmentSums
from iif_core.reflectance.material import IDENTITY
from lab.published.fusion.divergence import reference_scale
from lab.published.fusion.sgd.pool import as_floats
from tests.errors import refused

NONE = np.zeros((0, 0), bool)


def pixels(seed=0, k=3, counts=(1, 700, 0, 256, 257), half=False):
    """values words, target, weight, start, values as float64."""
    rng = np.random.default_rng(seed)
    n = sum(counts)
    values = rng.random((k, 5, n)).astype(np.float16 if half else np.float32)
    target, weight = rng.random((5, n)).astype(np.float32), rng.random(n).astype(np.float32)
    start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    return kernels.as_words(values), target, weight, start, values.astype(np.float64)


def by_segment(start, array):
    return np.stack([array[..., a:b].sum(-1) for a, b in zip(start[:-1], start[1:], strict=True)])


def test_errors_of_maps_are_mean_squares_and_never_negative():
    """The texture is prediction 0, whose error is a difference of equal sums."""
    words, _, weight, start, v = pixels(counts=(90,) * 60)
    target, sums = v[0].astype(np.float32), SegmentSums(60, 3, np.ones(1))
    sums.gram[:] = kernels.gram(words, weight, start, NONE)
    sums.weight[:] = sums.gram[:, 0, 13]
    products = kernels.cross(words, target, weight, start, NONE), kernels.square(target, weight, start)
    found = sums.errors(np.arange(60), np.tile(IDENTITY, (60, 3, 1)), *products)
    each = by_segment(start, weight * (v - v[0]) ** 2) / sums.weight[:, None, None]
    np.testing.assert_allclose(found, np.stack([each[..., :3].mean(-1), each[..., 3], each[..., 4]], -1), atol=1e-6)
    assert found.min() == 0


@pytest.mark.parametrize("half", [False, True])
@pytest.mark.parametrize("masked", [False, True])
def test_moments_equal_float64(half, masked):
    words, target, weight, start, v = pixels(half=half)
    keep = np.random.default_rng(1).random((3, len(weight))) > 0.3 if masked else NONE
    w = weight.astype(np.float64) * (keep if masked else np.ones((3, 1)))  # (K, n)
    gram, cross = (f(words, *rest, start, keep) for f, rest in ((kernels.gram, (weight,)), (kernels.cross, (target, weight))))
    a, b, c, r, m = v.swapaxes(0, 1)
    one = np.ones_like(a)
    expected = [a * a, a * b, a * c, b * b, b * c, c * c, a, b, c, r * r, r, m * m, m, one]
    np.testing.assert_allclose(gram, np.stack([by_segment(start, w * e) for e in expected], -1), rtol=2e-6, atol=1e-6)
    t = target.astype(np.float64)
    expected = [t[i] * x for i in range(3) for x in (a, b, c, one)] + [t[3] * r, t[3] * one, t[4] * m, t[4] * one]
    np.testing.assert_allclose(cross, np.stack([by_segment(start, w * e) for e in expected], -1), rtol=2e-6, atol=1e-6)
    np.testing.assert_allclose(kernels.square(target, weight, start), by_segment(start, weight * t * t), rtol=2e-6, atol=1e-6)


@pytest.mark.parametrize("half", [False, True])
def test_mixture_and_disagreement_equal_numpy(half):
    words, target, weight, start, v = pixels(2, k=5, half=half)
    rng = np.random.default_rng(3)
    segments = len(start) - 1
    affine = (np.r_[np.eye(3, 4).ravel(), 1, 0, 1, 0] + 0.2 * rng.standard_normal((segments, 5, 16))).astype(np.float32)
    alpha = rng.dirichlet(np.ones(5), (segments, 3)).swapaxes(1, 2)
    of_pixel = np.repeat(np.arange(segments), np.diff(start))
    each = affine.astype(np.float64)[of_pixel].swapaxes(0, 1)  # (K, n, 16)
    corrected = np.stack(
        [(each[..., 4 * c : 4 * c + 3] * v[:, :3].swapaxes(1, 2)).sum(-1) + each[..., 4 * c + 3] for c in range(3)]
        + [each[..., 12 + 2 * p] * v[:, 3 + p] + each[..., 13 + 2 * p] for p in range(2)],
        1,
    )  # (K, 5, n)
    share = alpha[of_pixel].transpose(1, 2, 0)[:, [0, 0, 0, 1, 2]]
    mixed = np.clip((share * corrected).sum(0), LOWEST[:, None], 1)
    blend = (affine * alpha[..., np.repeat([0, 1, 2], [12, 2, 2])]).astype(np.float32)
    got = kernels.mixture(words, blend, start, LOWEST)
    np.testing.assert_allclose(got, mixed, atol=2e-6)
    usable = np.array([True, False, True, True, True])
    pixels_of_view = kernels.Pixels(words, got, target, weight, start)
    b_ref, votes = kernels.disagreement(pixels_of_view, affine, usable, kernels.sorting_network(4), LOWEST, 0.01)
    corrected = np.clip(corrected[usable], LOWEST[:, None], 1)
    np.testing.assert_allclose(b_ref, reference_scale(mixed, corrected), atol=4e-6)
    error = np.abs(corrected - target)
    nearest = np.flatnonzero(usable)[np.stack([error[:, :3].sum(1), error[:, 3], error[:, 4]], 1).argmin(0)]  # (3, n)
    for p in range(3):
        expected = np.zeros((segments, 5))
        np.add.at(expected, (of_pixel, nearest[p]), weight)
        flipped = np.abs(votes[..., p] - expected).sum() / 2  # near-ties may flip in float32
        assert flipped <= 0.003 * weight.sum()
        assert (votes[0, :, p] > 0).sum() == 1  # one pixel, one vote


@given(st.integers(1, 40))
@settings(deadline=None, max_examples=40)
def test_network_sorts_every_zero_one_sequence_it_is_shown(n):
    """The 0-1 principle: a network that sorts all sequences of 0 and 1 sorts everything; all thresholds, many orders."""
    network = kernels.sorting_network(n)
    rng = np.random.default_rng(n)
    rows = np.stack([rng.permutation(n) for _ in range(64)]) if n > 8 else None
    planes = (rows if rows is not None else np.array(list(np.ndindex(*(2,) * n)))).T.astype(np.float32).copy()
    expected = np.sort(planes, 0)
    for low, high in network:
        planes[low], planes[high] = np.minimum(planes[low], planes[high]), np.maximum(planes[low], planes[high])
    np.testing.assert_array_equal(planes, expected)


def test_network_has_as_few_comparators_as_batchers():
    assert [len(kernels.sorting_network(n)) for n in (1, 2, 4, 8, 16, 32)] == [0, 1, 5, 19, 63, 191]


@pytest.mark.parametrize("again", [0, 1])
def test_a_segment_of_two_views_is_refused_by_its_number(again):
    words, _, weight, start, _ = pixels(counts=(9, 9))
    sums = SegmentSums(8, 3, np.ones(1))
    first = Block(words, np.zeros(18, np.int32), weight, np.array([2, 5], np.int32), start, np.ones(3, bool), NONE, NONE)
    sums.add(first, FusionOptions())
    segments = np.array([[5, 7], [4, 5]][again], np.int32)
    with refused("segment 5 "):
        sums.add(replace(first, segments=segments), FusionOptions())


@pytest.mark.parametrize("k", [1, 2, 3, 8, 16, 17])
def test_medians_equal_numpy(k):
    words, *_, v = pixels(4, k=k, half=True)
    usable = np.ones(k, bool)
    got = kernels.medians(words, usable, kernels.sorting_network(k))
    np.testing.assert_allclose(got, np.median(v, 0), atol=1e-6)
    assert not kernels.medians(words, ~usable, kernels.sorting_network(0)).any()


def test_half_bits_are_widened_exactly():
    """Every half value from 0 to 1, subnormal ones included."""
    every = np.arange(0x3C01, dtype=np.uint16).view(np.float16)
    values = np.tile(every, (1, 5, 1))
    start = np.arange(len(every) + 1, dtype=np.int64)
    gram = kernels.gram(kernels.as_words(values), np.ones(len(every), np.float32), start, NONE)
    assert (gram[:, 0, 6] == every.astype(np.float64)).all()


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_gather_clamps_and_finite_pixels_finds_every_bad_value(dtype):
    maps = np.array([[-0.5, 0.0, 0.25, 1.0, 7.0], [np.nan, np.inf, -np.inf, 0.5, 0.5], [0.1, 0.2, 0.3, 0.4, 0.5]], dtype)
    words = kernels.as_words(np.stack([maps]))
    np.testing.assert_array_equal(kernels.finite_pixels(words), [[True, False, True]])
    values, inside = kernels.gather(words, np.array([2, 0]), np.array([True]))
    expected = np.array([[0.1, 0], [0.2, 0], [0.3, 0.25], [0.4, 1], [0.5, 1]], dtype).astype(np.float32)
    np.testing.assert_array_equal(as_floats(values)[0], expected)
    np.testing.assert_array_equal(inside, [[True, False]])


def test_cells_add_up_by_channel():
    total, summed = np.zeros((3, 5)), np.zeros((3, 5))
    cell, value = np.array([2, 0, 2], np.int32), np.arange(15, dtype=np.float32).reshape(5, 3)
    kernels.add_to_cells(total, summed, cell, value, np.array([[1.0, 2.0, 3.0]], np.float32))
    kernels.add_to_cells(total, summed, cell[:1], value[:, :1], np.arange(5, dtype=np.float32)[:, None])
    np.testing.assert_array_equal(total[0], [2] * 5)
    np.testing.assert_array_equal(total[2], 4 + np.arange(5))
    np.testing.assert_array_equal(summed[2], value[:, 0] + 3 * value[:, 2] + np.arange(5) * value[:, 0])
    means = kernels.cell_means(total, summed, np.full((3, 5), 9.0))
    np.testing.assert_array_equal(means[1], [9] * 5)
    np.testing.assert_allclose(means[0], value[:, 1])
