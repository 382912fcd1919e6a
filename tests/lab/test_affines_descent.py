"""The paper's optimiser of the materials and the direct solver on one problem, judged by one loss."""

from dataclasses import replace

import numpy as np
import pytest

from iif_core.camera.response import response
from iif_core.fitting.direct import fit_affines
from iif_core.fitting.pixels import prepare_pixels
from iif_core.reflectance.material import IDENTITY, apply_affines
from lab.published.fitting.reference_loss import merged, reference_loss, reference_options, reference_problem
from lab.published.fitting.sgd import SgdOptions, _gradient, fit_affines_sgd
from tests.unit.planted_fit import planted, problem_of


@pytest.fixture(scope="module")
def ldr():
    rng = np.random.default_rng(20)
    return problem_of(rng, 4, 500, value_of=lambda x: np.minimum(response("gamma", [1.9])(x), 1), noise=0.1, halves=2)[0]


@pytest.mark.long
def test_reference_loss_by_hand(ldr):
    """Eq. M.45, written with plain arrays."""
    from iif_core.fitting.levels import interpolate_levels

    affine = np.tile(IDENTITY, (4, 1)) * 0.9
    curve = response("gamma")
    got = reference_loss(ldr, affine, curve)
    one = merged(ldr)
    value = apply_affines(affine, one.object_id, one.base)
    a, r, m = value[:, :3], value[:, 3], value[:, 4:]
    s0, s1 = (interpolate_levels(s[0], one.levels, r)[0] for s in (one.s0, one.s1))
    shown = curve((1 - m) * a * one.diffuse[0] + (0.04 * (1 - m) + m * a) * s0 + s1)
    bright = one.value >= 0.9
    error = np.where(bright, np.minimum(shown - 0.9, 0), shown - one.value)
    assert bright.any() and not bright.all()
    assert got.data == pytest.approx(np.mean(error**2), rel=1e-6)
    assert got.roughness == pytest.approx(1e-3 * np.mean(1 - r), rel=1e-6)
    assert got.metallic == pytest.approx(5e-3 * m.mean(), abs=1e-9)
    assert got.total == pytest.approx(got.data + got.roughness + got.metallic)


@pytest.mark.parametrize("family", ["gamma", "identity"])
def test_reference_loss_in_parts_is_that_of_the_whole(ldr, family):
    """Pixels without light, and the curve of HDR residuals, follow from all pixels and not from those of a part."""
    rng, start = np.random.default_rng(3), response(family)
    order = np.argsort(ldr.diffuse[0].sum(1))  # the darkest come first
    problem = ldr.take(order)
    dim = np.where(np.arange(len(order))[:, None] < 80, 1e-6, 1.0)
    problem = replace(problem, diffuse=tuple(d * dim for d in problem.diffuse))
    affine = IDENTITY + 0.05 * rng.standard_normal((4, 16))
    whole, parts = reference_loss(problem, affine, start), reference_loss(problem, affine, start, chunk=100)
    assert len(order) > 300 and whole.total > 0
    for name in ("total", "data", "roughness", "metallic"):
        assert getattr(parts, name) == pytest.approx(getattr(whole, name), rel=1e-12)


@pytest.mark.parametrize("family", ["gamma", "ggcm"])
def test_gradient_of_the_reference_loss_against_differences(ldr, family):
    curve = response(family)
    problem = reference_problem(ldr, curve)
    px, tone = prepare_pixels(problem, curve)
    rng = np.random.default_rng(1)
    affine = np.tile(IDENTITY, (4, 1)) + 0.05 * rng.normal(size=(4, 16))
    affine[:, 15] += 0.3
    params = curve.params * 1.05
    g, g_w = _gradient(px, np.arange(len(px.obj)), affine, tone.at(params), 4)
    for k in range(16 + len(params)):
        values = []
        for sign in (1, -1):
            moved, p = affine.copy(), params.copy()
            if k < 16:
                moved[2, k] += sign * 1e-6
            else:
                p[k - 16] += sign * 1e-6
            values.append(reference_loss(ldr, moved, curve.with_params(p)).total)
        expected = (values[0] - values[1]) / 2e-6
        assert (g[2, k] if k < 16 else g_w[k - 16]) == pytest.approx(expected, rel=1e-3, abs=2e-6), k


def test_twins_are_judged_by_one_loss(ldr):
    """The direct solver on the reference loss is not above the paper's optimiser; both are below the start."""
    start = response("gamma")
    initial_population = reference_loss(ldr, np.tile(IDENTITY, (4, 1)), start).total
    direct = fit_affines(reference_problem(ldr, start), start, reference_options())
    found = reference_loss(ldr, direct.affine, direct.response).total
    for options in (SgdOptions(batch=200, epochs=5), SgdOptions("adam", batch=200, epochs=10, decay=0.7)):
        fit = fit_affines_sgd(ldr, start, options)
        after = reference_loss(ldr, fit.affine, fit.response).total
        assert after == pytest.approx(fit.history[-1]) and after < initial_population
        assert found <= after
        assert fit.covariance.shape == (4, 16, 16) and np.isfinite(fit.covariance).all() and len(fit.model) == 4
    assert direct.converged


def test_sgd_is_seeded(ldr):
    a, b, c = (fit_affines_sgd(ldr, response("gamma"), SgdOptions(batch=300, seed=s)) for s in (0, 0, 1))
    assert a.affine.tobytes() == b.affine.tobytes() and a.affine.tobytes() != c.affine.tobytes()


def test_diverging_sgd_is_a_named_result():
    problem, _ = problem_of(np.random.default_rng(10), 3, 200, truth=planted(np.random.default_rng(0), 3))
    with np.errstate(all="ignore"):
        fit = fit_affines_sgd(problem, response("identity"), SgdOptions(rate=1e308, batch=50))
    assert not fit.converged and "diverged" in fit.reason and np.isfinite(fit.affine).all()
