"""The solvers on one problem, judged by one loss; patches; the settings of the scale."""

from dataclasses import replace

import numpy as np
import pytest

from iif_core.camera.response import response
from iif_core.fitting.clusters import patches
from iif_core.fitting.direct import fit_affines
from iif_core.fitting.pixels import prepare_pixels
from iif_core.fitting.problem import FitOptions, SgdOptions
from iif_core.fitting.reference_loss import reference_loss, reference_options, reference_problem
from iif_core.fitting.sgd import _gradient, fit_affines_sgd
from iif_core.reflectance.material import IDENTITY, apply_affines
from tests.errors import misset
from tests.unit.planted_fit import problem_of
from workflow.settings.affines import Affines


@pytest.fixture(scope="module")
def ldr():
    rng = np.random.default_rng(20)
    return problem_of(rng, 4, 500, value_of=lambda x: np.minimum(response("gamma", [1.9])(x), 1), noise=0.1, halves=2)[0]


def test_reference_loss_by_hand(ldr):
    """Eq. M.45, written with plain arrays."""
    from iif_core.fitting.levels import interpolate_levels

    affine = np.tile(IDENTITY, (4, 1)) * 0.9
    curve = response("gamma")
    got = reference_loss(ldr, affine, curve)
    one = ldr.merged()
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


def test_patches_are_neighbours():
    """Equal runs along a curve: a patch spans much less than its object; every object has some."""
    rng = np.random.default_rng(2)
    object_id = rng.integers(0, 3, 6000)
    position = np.c_[rng.uniform(0, 4, (6000, 2)), np.zeros(6000)]
    number = patches(object_id, position)
    for o in range(3):
        own = object_id == o
        sizes = np.bincount(number[own])
        assert 12 <= len(sizes) <= 200 and sizes.min() > 0 and np.ptp(sizes) <= 1
        spans = [np.ptp(position[own & (number == k)], axis=0)[:2].max() for k in range(len(sizes))]
        assert np.median(spans) < 1.2  # of 4
    assert patches(np.zeros(0, int), np.zeros((0, 3))).shape == (0,)
    assert len(np.unique(patches(np.zeros(5, int), np.zeros((5, 3))))) == 5


def test_covariance_sees_errors_that_neighbours_share():
    """One error for every 20 pixels: the claimed deviation grows as the true one does."""
    rng = np.random.default_rng(3)
    problem, _ = problem_of(rng, 1, 2000, truth=IDENTITY[None])
    opt = FitOptions(select=False, population=False, ridge=1e-9, robust_width=1e3, metallic_prior=2)
    gains, claimed = [], []

    for _ in range(30):
        shared = np.repeat(rng.normal(0, 0.05, (100, 3)), 20, 0)
        noisy = replace(problem, value=problem.value * np.exp(shared), cluster=np.repeat(np.arange(100), 20))
        fit = fit_affines(noisy, response("identity"), opt)
        gains.append(fit.affine[0, 0])
        claimed.append(np.sqrt(fit.covariance[0, 0, 0]))
    assert 0.7 < np.mean(claimed) / np.std(gains) < 1.5


@pytest.mark.parametrize(
    ("given", "key", "names"),
    [
        ({"white_patch": {"albedo": 0.9}}, "scale.white_patch", ("object", "view", "box")),
        (
            {"white_patch": {"object": "a", "view": "v", "box": [0, 0, 2, 2], "albedo": 0.9}},
            "scale.white_patch",
            ("object", "view"),
        ),
        ({"white_patch": {"view": "v", "albedo": 0.9}}, "scale.white_patch", ("object", "view", "box")),
        ({"lamp": {"emitter_id": 0, "radiance": [0, 0, 0]}}, "scale.lamp.radiance", ("[0.0, 0.0, 0.0]",)),
        ({}, "scale", ("white_patch, lamp, mean_albedo", "none")),
        ({"mean_albedo": 0.4, "lamp": {"emitter_id": 0, "radiance": [1, 1, 1]}}, "scale", ("white_patch", "lamp, mean_albedo")),
    ],
)
def test_known_scale_is_checked(given, key, names):
    with misset(key, "value_error", *names):
        Affines(scale=given)
    assert Affines(scale={"mean_albedo": 0.4}).scale.mean_albedo == 0.4
    assert Affines().scale == "found"
