import numpy as np
import pytest

from iif_core.camera.exposure import estimate_gains
from iif_core.errors import InputError


def _scene(rng, n_views=6, n_cells=300, pixels=8000, noise=0.0):
    truth = rng.normal(0, 0.7, n_views)
    truth -= truth.mean()
    surface = np.exp(rng.normal(-1, 1, (n_cells, 3)))
    cell, view = rng.integers(0, n_cells, pixels), rng.integers(0, n_views, pixels)
    value = surface[cell] * np.exp(truth[view])[:, None] * np.exp(rng.normal(0, noise, (pixels, 3)))
    return cell, view, value, truth


def test_planted_gains_exactly():
    cell, view, value, truth = _scene(np.random.default_rng(0))
    out = estimate_gains(cell, view, value, 6)
    np.testing.assert_allclose(np.log(out.gain), truth, atol=1e-9)
    assert out.estimated.all() and (out.group == 0).all() and out.residual < 1e-9


def test_gross_outliers_do_not_matter_and_error_is_honest():
    rng = np.random.default_rng(1)
    cell, view, value, truth = _scene(rng, noise=0.1)
    bad = rng.random(len(cell)) < 0.15
    value[bad] *= np.exp(rng.uniform(0, 4, (bad.sum(), 1)))  # highlights: always brighter
    out = estimate_gains(cell, view, value, 6)
    assert np.abs(np.log(out.gain) - truth).max() < 0.03
    assert 0.0005 < out.error.max() < 0.02
    plain = np.array([np.log(value[view == v]).mean() for v in range(6)])
    assert np.abs(plain - plain.mean() - truth).max() > 0.03  # the mean of the view's values is worse


def test_gauge_and_invariance_to_scale():
    cell, view, value, _ = _scene(np.random.default_rng(2), noise=0.05)
    a, b = estimate_gains(cell, view, value, 6), estimate_gains(cell, view, 37.0 * value, 6)
    assert abs(np.log(a.gain).sum()) < 1e-9
    np.testing.assert_allclose(a.gain, b.gain, rtol=1e-8)


def test_two_islands_and_a_lonely_view():
    rng = np.random.default_rng(3)
    surface = np.exp(rng.normal(0, 1, 40))
    gains = np.array([2.0, 0.5, 3.0, 12.0, 7.0])
    rows = [(c, v) for v in (0, 1) for c in range(20)] + [(c, v) for v in (2, 3) for c in range(20, 40)]
    rows += [(40 + c, 4) for c in range(20)]
    cell, view = np.array(rows).T
    value = np.r_[surface, np.ones(20)][cell] * gains[view]
    out = estimate_gains(cell, view, value, 6)
    np.testing.assert_allclose(out.gain, [2, 0.5, 0.5, 2, 1, 1], rtol=1e-8)
    assert out.estimated.tolist() == [True] * 4 + [False] * 2
    assert out.group[0] == out.group[1] != out.group[2] == out.group[3] and (out.group[4:] == -1).all()


@pytest.mark.parametrize("n", [0, 1, 5])
def test_nothing_shared(n):
    out = estimate_gains(np.arange(n), np.zeros(n, int), np.ones(n), 3)
    assert (out.gain == 1).all() and not out.estimated.any() and out.pairs == 0


def test_zero_nan_and_masked_values_are_left_out():
    cell, view, value, truth = _scene(np.random.default_rng(4))
    value[::7] = np.nan
    value[1::7] = 0
    value[2::7] = -1
    cell[3::7] = -1
    out = estimate_gains(cell, view, value, 6)
    np.testing.assert_allclose(np.log(out.gain), truth, atol=1e-9)
    none = estimate_gains(cell, view, np.full_like(value, np.nan), 6)
    assert (none.gain == 1).all()


def test_refused():
    with pytest.raises(InputError):
        estimate_gains(np.zeros(3, int), np.array([0, 1, 5]), np.ones(3), 3)
    with pytest.raises(InputError):
        estimate_gains(np.zeros(3, int), np.zeros(2, int), np.ones(3), 3)


@pytest.mark.parametrize("kind", ["black", "huge", "constant", "one bright pixel"])
def test_extreme_photographs_stay_finite_and_bounded(kind):
    cell, view, value, truth = _scene(np.random.default_rng(5), noise=0.02)
    if kind == "black":
        value[view == 2] = 0.0
    elif kind == "huge":
        value *= 1e6
    elif kind == "constant":
        value[:] = 0.5
    else:
        value[7] = 1e6
    out = estimate_gains(cell, view, value, 6)
    assert np.isfinite(out.gain).all() and np.isfinite(out.error).all() and np.isfinite(out.residual)
    if kind == "black":
        assert not out.estimated[2] and out.gain[2] == 1
        truth[2] = np.nan
    known = np.isfinite(truth)
    expected = np.zeros(6) if kind == "constant" else truth - np.nanmean(truth)
    np.testing.assert_allclose(np.log(out.gain)[known], expected[known], atol=0.02)
