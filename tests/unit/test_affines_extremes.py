"""The fit at the extremes: finite, within bounds, and explained by `model`, `reason` and `converged`."""

from dataclasses import replace

import numpy as np
import pytest

from iif_core.camera.response import response
from iif_core.fitting.direct import fit_affines
from iif_core.fitting.gauge import Gauge, apply_gauge
from iif_core.fitting.problem import FitOptions, FitProblem
from iif_core.reflectance.material import IDENTITY, apply_affines
from tests.unit.planted_fit import LEVELS, problem_of, radiance_of, shading_of


def _checked(problem, family="identity", **options):
    """Fit; nothing that leaves it is not finite or out of range."""
    fit = fit_affines(problem, response(family), FitOptions(**options))
    value = apply_affines(fit.affine, np.where(problem.object_id < 0, 0, problem.object_id), np.nan_to_num(problem.base))
    for array in (fit.affine, fit.covariance, fit.residual, fit.history, fit.response.params, fit.response_covariance):
        assert np.isfinite(array).all()
    assert value.min() >= 0 and value.max() <= 1 and value[:, 3].min() >= 0.02
    assert (np.diagonal(fit.covariance, axis1=1, axis2=2) >= 0).all() and (np.diff(fit.history) <= 0).all()
    assert len(fit.model) == problem.n_objects and all(fit.model) and fit.reason
    assert np.isfinite(apply_gauge(problem, fit, Gauge("prior")).light_scale)
    return fit, value


def _uniform(material, n=300, seed=0, level=1.0):
    """One object of one material per row of `material` (O, 5), predicted 20 % too dark, as rough, as half a metal."""
    rng = np.random.default_rng(seed)
    material = np.asarray(material, float)
    truth = np.repeat(material, n, 0)
    texture = rng.uniform(0.8, 1.2, (len(truth), 1))
    truth[:, :3] *= texture
    base = truth.copy()
    base[:, :3] *= 0.8
    base[:, 3], base[:, 4] = 0.5, 0.5
    shading = [level * part for part in shading_of(rng, len(truth))]
    obj = np.repeat(np.arange(len(material)), n)
    diffuse, s0, s1 = ((part, part) for part in shading)
    value = radiance_of(truth, shading)
    problem = FitProblem(
        object_id=obj,
        n_objects=len(material),
        base=base,
        diffuse=diffuse,
        s0=s0,
        s1=s1,
        levels=LEVELS,
        value=value,
        exposure=np.ones(len(obj)),
        saturated=np.zeros((len(obj), 3), bool),
    )
    return problem, truth


def test_sharpest_and_roughest():
    problem, truth = _uniform([[0.05, 0.05, 0.05, 0.02, 0], [0.4, 0.3, 0.2, 1.0, 0], [0.3, 0.3, 0.3, 0.5, 0]])
    fit, value = _checked(problem)
    assert value[:300, 3].max() < 0.1 and value[300:600, 3].min() > 0.85
    assert np.abs(value[:, :3] - truth[:, :3]).mean() < 0.03


def test_black_metal_is_black():
    """With m = 1 and a = 0 only S1 is left, which no albedo explains (docs/method/numerics.md#black-metal)."""
    problem, truth = _uniform([[0.0, 0.0, 0.0, 0.3, 1], [0.5, 0.4, 0.3, 0.5, 0], [0.8, 0.7, 0.5, 0.3, 1]])
    fit, value = _checked(problem)
    assert value[:300, :3].max() < 0.05
    assert fit.model[2].endswith("metal") and value[600:, 4].min() == 1


@pytest.mark.parametrize("what", ["saturated", "black"])
def test_a_view_without_information(what):
    """All pixels of one view saturated, or black: the others decide."""
    problem, truth = problem_of(np.random.default_rng(1), 4, 300, value_of=lambda x: response("gamma")(0.5 * x), halves=2)
    value, saturated = problem.value.copy(), problem.saturated.copy()
    view = np.arange(len(value)) % 4 == 0
    value[view], saturated[view] = (0.99, True) if what == "saturated" else (0.0, False)
    clean, _ = _checked(problem, "gamma", free_response=False)
    fit, _ = _checked(replace(problem, value=value, saturated=saturated), "gamma", free_response=False)
    fitted, wanted = (apply_affines(f.affine, problem.object_id, problem.base)[:, :3].mean() for f in (fit, clean))
    assert fitted == pytest.approx(wanted, rel=0.35)


def test_everything_saturated():
    problem, _ = problem_of(np.random.default_rng(2), 2, 100, value_of=lambda x: response("ggcm")(x))
    everything = replace(problem, value=np.full_like(problem.value, 0.99), saturated=np.ones_like(problem.saturated))
    _checked(everything, "ggcm")


def test_saturated_object_takes_what_the_others_have():
    """Bounds that are met say nothing: the object has the mean gain of the others, and they are as without it."""
    problem, truth = problem_of(np.random.default_rng(4), 5, 300, value_of=lambda x: response("gamma")(0.5 * x))
    own = problem.object_id == 4
    value, saturated = problem.value.copy(), problem.saturated.copy()
    value[own], saturated[own] = np.minimum(0.5 * value[own], 0.99), True
    fit, _ = _checked(replace(problem, value=value, saturated=saturated), "gamma", free_response=False)
    without, _ = _checked(replace(problem, object_id=np.where(own, -1, problem.object_id)), "gamma", free_response=False)
    np.testing.assert_allclose(fit.affine[4, :12], without.affine[4, :12], atol=0.02)
    np.testing.assert_allclose(fit.affine[:4], without.affine[:4], atol=0.02)
    assert without.model[4] == "population (0 pixels)" and fit.light_gain[4] == 1


def test_object_in_full_shadow_takes_what_the_others_have():
    """Pixels below a thousandth of the median light are left out (docs/method/numerics.md#pixels-without-light)."""
    problem, truth = problem_of(np.random.default_rng(3), 5, 300)
    dark = problem.object_id == 4
    parts = {}
    for name in ("diffuse", "s0", "s1"):
        parts[name] = tuple(np.where(dark.reshape(-1, *[1] * (x.ndim - 1)), 1e-7 * x, x) for x in getattr(problem, name))
    value = np.where(dark[:, None], 1e-7 * problem.value, problem.value)
    fit, _ = _checked(replace(problem, value=value, **parts))
    assert fit.model[4] == "population (0 pixels)" and not fit.free[4].any()
    gains = fit.affine[:4, [0, 5, 10]]
    assert (fit.affine[4, [0, 5, 10]] > gains.min(0) - 0.1).all() and (fit.affine[4, [0, 5, 10]] < gains.max(0) + 0.1).all()


def test_one_object_alone_and_of_one_pixel():
    problem, truth = problem_of(np.random.default_rng(4), 1, 400)
    fit, value = _checked(problem)
    assert np.abs(value[:, :3] - apply_affines(truth, problem.object_id, problem.base)[:, :3]).mean() < 0.02
    alone, _ = _checked(replace(problem, scatter=np.array([0.1])).take(slice(0, 1)))
    assert alone.model == ["identity (1 pixels)"] and (alone.affine == IDENTITY).all() and alone.converged


def test_five_thousand_objects():
    """Most have six pixels; the forty that have more give them gain and roughness."""
    rng = np.random.default_rng(5)
    truth = np.tile(IDENTITY, (5000, 1))
    truth[:, [0, 5, 10]] = 1.3 + 0.02 * rng.normal(size=(5000, 3))
    problem, _ = problem_of(rng, 5000, 6, truth=truth)
    more, _ = problem_of(rng, 40, 60, truth=truth[:40])
    names = ("object_id", "base", "value", "exposure", "saturated")
    joined = {name: np.concatenate([getattr(problem, name), getattr(more, name)]) for name in names}
    for name in ("diffuse", "s0", "s1"):
        joined[name] = (np.concatenate([getattr(problem, name)[0], getattr(more, name)[0]]),)
    fit, _ = _checked(replace(problem, **joined), iterations=15)
    assert fit.model[4999] == "population (6 pixels)" and fit.pixels[0] == 66
    np.testing.assert_allclose(fit.affine[4999, [0, 5, 10]], 1.3, atol=0.15)


def test_nan_in_a_photograph_is_one_pixel_less():
    problem, _ = problem_of(np.random.default_rng(6), 3, 200)
    value, diffuse = problem.value.copy(), problem.diffuse[0].copy()
    value[7, 1], value[8] = np.nan, np.inf
    diffuse[9, 2] = np.nan
    fit, _ = _checked(replace(problem, value=value, diffuse=(diffuse,)))
    keep = np.ones(600, bool)
    keep[7:10] = False
    without, _ = _checked(problem.take(np.flatnonzero(keep)))
    assert fit.pixels.tolist() == [197, 200, 200]
    np.testing.assert_allclose(fit.affine, without.affine, atol=1e-9)


def test_a_million_times_the_radiance():
    """HDR has no unit: the same materials, whatever the light is measured in."""
    problem, _ = problem_of(np.random.default_rng(7), 3, 200)
    loud = {name: tuple(1e6 * x for x in getattr(problem, name)) for name in ("diffuse", "s0", "s1")}
    fit, _ = _checked(problem)
    other, _ = _checked(replace(problem, value=1e6 * problem.value, **loud))
    np.testing.assert_allclose(other.affine, fit.affine, rtol=1e-4, atol=1e-5)


def test_one_pixel_of_a_million_does_not_decide():
    problem, truth = problem_of(np.random.default_rng(8), 3, 300, halves=2)
    value = problem.value.copy()
    value[5] = 1e6
    fit, got = _checked(replace(problem, value=value))
    assert np.abs(got[:, :3] - apply_affines(truth, problem.object_id, problem.base)[:, :3]).mean() < 0.02


def test_any_number_of_threads_gives_the_same_bytes():
    problem, _ = problem_of(np.random.default_rng(9), 6, 100, value_of=lambda x: response("gamma")(x), noise=0.1, halves=2)
    first, second = (fit_affines(problem, response("gamma"), FitOptions(iterations=5, threads=t)) for t in (1, 3))
    assert first.affine.tobytes() == second.affine.tobytes() and first.covariance.tobytes() == second.covariance.tobytes()
