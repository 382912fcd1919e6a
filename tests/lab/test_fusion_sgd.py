"""The paper's optimiser: gradients against automatic differentiation, fits of planted scenes, edge cases."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from iif_core.fusion.direct import solve_direct
from iif_core.fusion.kernels import as_words
from iif_core.fusion.problem import LOWEST, NEUTRAL, FusionProblem
from iif_core.reflectance.material import IDENTITY, unclamped_material
from lab.published.fusion.hashgrid.levels import HashGridOptions
from lab.published.fusion.reference_loss import loss_of_result
from lab.published.fusion.sgd import engine, kernels, solve
from lab.published.fusion.sgd import pool as sgd_pool
from lab.published.fusion.sgd.options import SgdOptions, sgd_options
from lab.published.fusion.sgd.solve import SgdState, converged, solve_sgd
from lab.published.fusion.variants import solve_variant
from tests.errors import refused
from tests.oracles import torch_sgd
from tests.oracles.label_loss import label_loss
from tests.unit.test_fusion_direct import OBJECTS, SIZE, oracle_psnr, planted, problem_of, seen, simulated, surface

TERMS = ("data", "label", "regulariser", "entropy", "gain")
QUICK = sgd_options(iterations=300, batch=4096)
CASES = ("cells", 1), ("cells", 2), ("hashgrid", 1)
SMALL_GRID = HashGridOptions(levels=6, log2_entries=12, base_resolution=8, growth=1.6, hidden=16)


# ----------------------------------------------------------------------------------------------------------- gradients


def state(k, seed=0, n=150, segments=4, spread=0.15, low=0.0):
    """Parameters and a batch sorted by segment, float64."""
    rng = np.random.default_rng(seed)
    affine = np.tile(IDENTITY, (segments, k, 1)) + spread * rng.standard_normal((segments, k, 16))
    usable = np.ones((segments, k), bool)
    if k > 2:
        usable[1, 0] = usable[1, 2] = False
    return {
        "values": rng.uniform(low, 1 - low, (n, k, 5)),
        "raw": 1.5 * rng.standard_normal((n, 10)),
        "affine": affine,
        "z": rng.standard_normal((segments, k, 3)),
        "segment": np.sort(rng.integers(0, segments, n)),
        "usable": usable,
        "share": rng.dirichlet(np.ones(n)),
    }


def compiled(p, options, temperature=0.3, divisor=0.7, real=np.float64):
    """Terms of the loss and gradients from the closed forms."""
    alpha, log_alpha = softmax(p["z"] / divisor, p["usable"])
    start, segment = sgd_pool.runs(p["segment"])
    d_affine, d_alpha, votes = (np.zeros((*p["usable"].shape, m), real) for m in (16, 3, 3))
    d_raw, error, sums = np.empty(p["raw"].shape, real), np.zeros(alpha.shape), np.zeros((len(segment), 5))
    pixels = np.arange(len(p["raw"]), dtype=np.int32)
    values, share, raw = (p[name].astype(real) for name in ("values", "share", "raw"))
    batch = kernels.Batch(start, segment, values, pixels, share, raw)
    maps = (a.astype(real) for a in (p["affine"], alpha, log_alpha))
    tables = kernels.SegmentTables(*maps, p["usable"], *kernels.selection_networks(alpha.shape[1]))
    settings = engine.loss_settings(options, temperature, real)
    out = kernels.Gradients(d_raw, d_affine, d_alpha, votes, error, sums)
    kernels.batch_loss(0, len(segment), batch, tables, settings, out)
    d_z = engine.logit_slope(alpha.astype(real), d_alpha, votes, options.label_weight, divisor)
    return dict(zip(TERMS, sums.sum(0), strict=True)), {"raw": d_raw, "affine": d_affine, "z": d_z}, error


def softmax(y, usable):
    y = np.where(usable[..., None], y, -np.inf)
    power = np.exp(y - y.max(1, keepdims=True))
    alpha = power / power.sum(1, keepdims=True)
    with np.errstate(divide="ignore"):
        return alpha, np.where(alpha > 0, np.log(alpha), 0)


def automatic(p, options, temperature=0.3, divisor=0.7):
    """Terms of the loss and gradients by torch."""
    t = {name: torch.from_numpy(a) for name, a in p.items()}
    wanted = [t[name].requires_grad_() for name in ("raw", "affine", "z")]
    batch = torch_sgd.TorchBatch(*(t[name] for name in ("raw", "values", "segment", "share")))
    tables = torch_sgd.TorchTables(*(t[name] for name in ("affine", "z", "usable")))
    found = torch_sgd.torch_losses(batch, tables, temperature, divisor, options)
    o = options
    loss = o.data_weight * found["data"] + o.label_weight * found["label"] + o.regulariser * found["regulariser"]
    slopes = dict(zip(("raw", "affine", "z"), (g.numpy() for g in torch.autograd.grad(loss, wanted)), strict=True))
    return {name: float(found[name].detach()) for name in TERMS}, slopes, found["error"].numpy()


@pytest.mark.long
@pytest.mark.parametrize("k", [1, 2, 5, 16])
@pytest.mark.parametrize(
    "options",
    [
        sgd_options(),
        sgd_options("paper"),
        sgd_options(median_gradient=True, data_weight=0.0),
        sgd_options("paper", median_gradient=False, label_weight=3.0, regulariser=0.0),
        sgd_options("paper", clamp_gradient="inward", scale_floor=0.2),
    ],
)
def test_closed_form_gradients_equal_automatic_ones(k, options):
    p = state(k)
    terms, slopes, error = compiled(p, options)
    expected, expected_slopes, each = automatic(p, options)
    assert terms == pytest.approx(expected, rel=1e-12)
    for name, slope in slopes.items():
        np.testing.assert_allclose(slope, expected_slopes[name], rtol=1e-9, atol=1e-13, err_msg=name)
    by_segment = np.zeros_like(error)
    np.add.at(by_segment, p["segment"], p["share"][:, None, None] * each)
    np.testing.assert_allclose(error, by_segment, rtol=1e-10, atol=1e-15)


@pytest.mark.parametrize("options", [sgd_options("paper"), sgd_options("paper", scale_floor_kind="smooth", data_weight=2.0)])
@pytest.mark.parametrize("name", ["raw", "affine", "z"])
def test_gradients_equal_finite_differences(options, name):
    """q is a constant for the gradient, so the label loss is compared only in z, on which q does not depend."""
    options = replace(options, label_weight=1.0 if name == "z" else 0.0)
    p = state(5, low=0.3, spread=0.03)
    _, slopes, _ = compiled(p, options)

    def loss(x):
        terms, _, _ = compiled({**p, name: x}, options)
        parts = options.data_weight * terms["data"] + options.regulariser * terms["regulariser"]
        return parts + options.label_weight * terms["label"]

    rng, h = np.random.default_rng(1), 1e-6
    for _ in range(12):
        at = tuple(rng.integers(0, n) for n in p[name].shape)
        step = np.zeros_like(p[name])
        step[at] = h
        numeric = (loss(p[name] + step) - loss(p[name] - step)) / (2 * h)
        assert slopes[name][at] == pytest.approx(numeric, rel=2e-5, abs=2e-9)


def test_label_loss_trains_only_the_logits():
    p = state(5)
    options = sgd_options(data_weight=0.0, regulariser=0.0)
    for _, slopes, _ in (compiled(p, options), automatic(p, options)):
        assert not slopes["raw"].any() and not slopes["affine"].any()
        assert (np.abs(slopes["z"]).max((1, 2)) > 1e-4).all()
        np.testing.assert_allclose(slopes["z"].sum(1), 0, atol=1e-15)


def test_clamped_values_have_an_inward_gradient_or_none():
    """For a pixel whose corrected albedo is far too bright, only `inward` changes the map, and it darkens it."""
    p = state(1, n=1, segments=1, spread=0.0)
    p["values"][:], p["raw"][:], p["affine"][0, 0, 3] = 0.9, -1.0, 0.5
    dead, inward = (compiled(p, sgd_options(regulariser=0.0, clamp_gradient=g))[1]["affine"][0, 0] for g in ("dead", "inward"))
    assert dead[3] == 0 and inward[3] > 0 and dead[7] == inward[7] > 0
    p["raw"][:] = 9.0  # the texture is brighter still, so a step leads outwards
    assert compiled(p, sgd_options(regulariser=0.0, scale_floor=0.5))[1]["affine"][0, 0, 3] >= 0


@pytest.mark.long
def test_single_precision_is_close():
    p = state(16, n=3000, segments=7)
    options = sgd_options("paper", median_gradient=False)  # the median may be another element
    (terms, slopes, _), (exact, expected, _) = compiled(p, options, real=np.float32), compiled(p, options)
    assert terms == pytest.approx(exact, rel=3e-6)
    for name in slopes:
        np.testing.assert_allclose(slopes[name], expected[name], atol=2e-5 * np.abs(expected[name]).max())


@pytest.mark.long
def test_half_precision_pools_are_read_as_they_are():
    p = state(6, n=100)
    options = sgd_options()
    half = p["values"].astype(np.float16)
    out = []
    for pool in (as_words(half), half.astype(np.float32)):
        sums, d_raw = np.zeros((4, 5)), np.zeros((100, 10), np.float32)
        start, segment = sgd_pool.runs(p["segment"])
        alpha, log_alpha = (a.astype(np.float32) for a in softmax(p["z"], p["usable"]))
        rest = [np.zeros((4, 6, m), np.float32) for m in (16, 3, 3)]
        share, raw, affine = (p[name].astype(np.float32) for name in ("share", "raw", "affine"))
        batch = kernels.Batch(start, segment, pool, np.arange(100, dtype=np.int32), share, raw)
        tables = kernels.SegmentTables(affine, alpha, log_alpha, p["usable"], *kernels.selection_networks(6))
        gradients = kernels.Gradients(d_raw, *rest, np.zeros((4, 6, 3)), sums)
        kernels.batch_loss(0, 4, batch, tables, engine.loss_settings(options, 0.3, np.float32), gradients)
        out.append((sums, d_raw))
    np.testing.assert_array_equal(out[0][0], out[1][0])
    np.testing.assert_array_equal(out[0][1], out[1][1])


@pytest.mark.parametrize("n", [1, 2, 3, 4, 7, 8, 12, 16, 21])
def test_selection_networks_find_the_lower_median(n):
    values = np.random.default_rng(n).integers(0, 9, (n, kernels.TILE)).astype(np.float64)
    networks, lengths = kernels.selection_networks(21)
    found = values.copy()
    kernels._select(found, networks[n], lengths[n], kernels.TILE)
    np.testing.assert_array_equal(found[(n - 1) // 2], np.sort(values, 0)[(n - 1) // 2])


def test_exponential():
    x = np.linspace(-80, 80, 64 * 500).astype(np.float32)
    found = x.copy()
    for low in range(0, len(x), 64):
        kernels._exp_float(found[low : low + 64], 64)
    np.testing.assert_allclose(found, np.exp(x.astype(np.float64)), rtol=4e-7)
    ends = np.array([0, -0.0, -np.inf, -1e30, 88], np.float32)
    kernels._exp_float(ends, 5)
    assert ends[0] == ends[1] == 1 and (0 <= ends[2:4]).all() and (ends[2:4] < 2e-38).all() and np.isfinite(ends[4])


@pytest.mark.long
def test_adam_is_that_of_torch():
    rng = np.random.default_rng(0)
    start = rng.standard_normal(1000).astype(np.float32)
    ours, theirs = start.copy(), torch.from_numpy(start.copy()).requires_grad_()
    adam, optimiser = engine.Adam(ours), torch.optim.Adam([theirs], lr=0.01)
    for step in range(20):
        gradient = (rng.standard_normal(1000) * (rng.random(1000) < 0.3)).astype(np.float32)
        adam.gradient[:], theirs.grad = gradient, torch.from_numpy(gradient.copy())
        adam.step(0.01 / (1 + step))
        optimiser.param_groups[0]["lr"] = 0.01 / (1 + step)
        optimiser.step()
    np.testing.assert_allclose(ours, theirs.detach().numpy(), atol=2e-6)
    assert not adam.gradient.any()


# ----------------------------------------------------------------------------------------------------------- schedules


def test_published_schedules():
    """81 multiplications in 8080 steps, the first after the first step (Eq. F.17); rate halved after 2, 4, 6, 8 epochs."""
    paper = sgd_options("paper")
    temperature = [sgd_pool.temperature_at(paper, step, 8080) for step in (0, 1, 100, 101, 8079)]
    np.testing.assert_allclose(temperature, 0.85 ** np.array([0, 1, 1, 2, 81]))
    assert temperature[-1] == pytest.approx(1.9e-6, rel=0.02)
    rate = [sgd_pool.learning_rate_at(paper, step, 8080) for step in (0, 1615, 1616, 8079)]
    np.testing.assert_allclose(rate, 0.01 * 0.5 ** np.array([0, 0, 1, 4]))
    few = [sgd_pool.learning_rate_at(paper, step, 240) for step in (0, 47, 48, 96, 144, 192, 239)]  # ten epochs of 24 steps
    np.testing.assert_allclose(few, 0.01 * 0.5 ** np.array([0, 0, 1, 2, 3, 4, 4]))


@pytest.mark.parametrize("steps", [10, 81, 1000])
def test_safe_schedules_do_not_depend_on_the_number_of_steps(steps):
    options = sgd_options(temperature_floor=0.0)
    temperature = [sgd_pool.temperature_at(options, step, steps) for step in range(steps)]
    assert temperature[0] == 1 and temperature[-1] == pytest.approx(0.85 ** (81 - 81 / steps), rel=0.2)
    assert min(sgd_pool.temperature_at(SgdOptions(), step, steps) for step in range(steps)) == 1e-3
    rate = [sgd_pool.learning_rate_at(options, step, steps) for step in range(steps)]
    np.testing.assert_allclose(np.unique(rate), 0.01 / 2.0 ** np.arange(5)[::-1])


def test_batches_are_permutations():
    batches = sgd_pool.batches(10, 3, np.random.default_rng(0))
    first, second = ([next(batches) for _ in range(3)] for _ in range(2))
    for epoch in (first, second):
        assert len(np.unique(np.concatenate(epoch))) == 9 and all((np.diff(b) > 0).all() for b in epoch)
    assert any((a != b).any() for a, b in zip(first, second, strict=True))


# -------------------------------------------------------------------------------------------------------------- solver


@pytest.mark.parametrize(
    ("texture", "threads"), [("hashgrid", 2), *(pytest.param(*case, marks=pytest.mark.long) for case in CASES)]
)
def test_a_descent_goes_on_from_the_end_of_any_epoch(texture, threads):
    """The selection is fixed between the second and the third state, and the history is written between two of them."""
    problem, _ = simulated()
    problem = on_a_wall(problem) if texture == "hashgrid" else problem
    pixels = sum(int((np.ravel(c) >= 0).sum()) for c in problem.cell_of_pixel)
    own = {"texture": texture, "grid": SMALL_GRID, "choice": "argmin", "choose_at": 0.5}
    options = sgd_options("paper", batch=pixels // 4, iterations=17, records=5, **own)
    states = []

    def keep(state_of):
        state = state_of()
        copied = {name: array.copy() for name, array in state.arrays.items()}
        states.append(SgdState(copied, json.loads(json.dumps(state.facts))))

    whole = solve_sgd(problem, options, threads=threads)
    kept = solve_sgd(problem, options, threads=threads, keep=keep)
    assert [state.facts["step"] for state in states] == [4, 8, 12, 16]
    assert "fixed" not in states[1].arrays and "fixed" in states[2].arrays
    for fit in (kept, *(solve_sgd(problem, options, threads=threads, load=lambda at=state: at) for state in states)):
        for name in ("value", "scale", "corrections", "alpha"):
            np.testing.assert_array_equal(getattr(fit, name), getattr(whole, name), err_msg=name)
        assert fit.history == whole.history


@pytest.mark.long
def test_loss_falls_in_the_history():
    problem, truth = simulated()
    calls = []
    fit = solve_sgd(problem, sgd_options(iterations=800), lambda done, total: calls.append((done, total)))
    before, after = fit.history[0], fit.history[-1]
    assert after["data"] < 0.7 * before["data"] and calls[-1] == (800, 800)
    assert converged(fit.history) and not converged(fit.history[:40])
    assert before["temperature"] == 1 and after["temperature"] == 1e-3 and after["entropy"] == 0
    assert before["learning_rate"] == 0.01 and after["step"] == 800 and 0.5 < after["gain"] < 1.5
    found = loss_of_result(problem, fit)
    assert found.total == pytest.approx(after["total"], rel=0.02)
    regulariser = found.regulariser_albedo + found.regulariser_roughness + found.regulariser_metallic
    assert regulariser == pytest.approx(after["regulariser"], rel=0.02)
    mean = solve_variant(problem, "texel_mean")
    assert oracle_psnr(problem, fit.value, truth) > oracle_psnr(problem, mean.value, truth) + 0.3
    assert fit.value.shape == fit.scale.shape == (problem.n_cells, 5) and fit.scale.min() >= 0.01
    assert (fit.value >= LOWEST).all() and (fit.value <= 1).all()


def test_flat_and_falling_histories():
    def history(total):
        return [{"total": float(x) + 5.0, "label_part": 5.0} for x in total]

    assert converged(history(np.full(100, 0.3))) and converged(history(np.zeros(100)))
    assert not converged(history(np.linspace(2, 1, 100))) and not converged(history(np.ones(14)))
    noise = 0.3 + 0.002 * np.random.default_rng(0).standard_normal(200)
    assert converged(history(noise)) and not converged(history(noise), 1e-6)


@pytest.mark.long
def test_good_predictions_are_selected_and_the_texture_found():
    """One affine map of the truth among patterns of noise, at a different k in every view."""
    problem, truth = planted(views=8, samples=5, spread=0.03)
    rng = np.random.default_rng(1)
    good = rng.integers(0, 5, 8)
    predictions = [p.copy() for p in problem.predictions]
    for v, p in enumerate(predictions):
        for k in range(5):
            if k != good[v]:
                p[k] = np.clip(p[k] + 0.12 * rng.standard_normal(p[k].shape), 0, 1)
    problem = replace(problem, predictions=predictions)
    fit = solve_sgd(problem, sgd_options(iterations=1200))
    view_of_segment = np.array(
        [next(v for v, m in enumerate(problem.segment_of_pixel) if (m == s).any()) for s in range(problem.n_segments)]
    )
    assert (fit.alpha.argmax(1) == good[view_of_segment][:, None]).mean() > 0.95
    assert oracle_psnr(problem, fit.value, truth) > 38


@pytest.mark.long
@pytest.mark.parametrize("preset", ["safe", "paper"])
def test_loss_of_the_solver_is_the_reference_loss(preset, monkeypatch):
    """With all pixels in one batch and steps of size 0, the first history entry is the loss of the result."""
    problem, _ = simulated()
    options = sgd_options(preset, texture="cells", init="mean", iterations=1, batch=1 << 20, learning_rate=1e-30)
    used = []
    for each in (engine.Engine, torch_sgd.TorchEngine):
        monkeypatch.setattr(solve, "Engine", lambda *arguments, make=each: used.append(make(*arguments)) or used[-1])
        fit = solve_sgd(problem, replace(options, choice="soft"))
        first, temperature = fit.history[0], fit.history[-1]["temperature"]
        expected = loss_of_result(problem, fit)
        corrections = (fit.affine_albedo, fit.affine_roughness, fit.affine_metallic)
        label = label_loss(problem, fit.value, corrections, used[-1].weights(temperature)[1], temperature)
        assert first["total"] == pytest.approx(expected.total + label, rel=1e-5)
        assert first["data"] == pytest.approx(expected.data, rel=1e-5)
        assert first["label"] == pytest.approx(label, rel=1e-5)


def test_loss_with_moved_corrections_is_the_reference_loss():
    problem, _ = simulated()
    fit = solve_sgd(problem, sgd_options(iterations=120, batch=1 << 20, learning_rate=0.02))
    assert np.abs(fit.corrections - IDENTITY).max() > 1e-3
    assert loss_of_result(problem, fit).total == pytest.approx(fit.history[-1]["total"], rel=2e-3)  # one step later
    base = np.random.default_rng(0).random((7, 5)).astype(np.float32)
    mapped = unclamped_material(np.tile(fit.corrections[3, 2], (7, 1)), base)
    expected = base[:, :3] @ fit.affine_albedo[3, 2, :, :3].T + fit.affine_albedo[3, 2, :, 3]
    np.testing.assert_allclose(mapped[:, :3], expected, rtol=1e-5)
    for channel, (gain, bias) in ((3, fit.affine_roughness[3, 2]), (4, fit.affine_metallic[3, 2])):
        np.testing.assert_allclose(mapped[:, channel], gain * base[:, channel] + bias, rtol=1e-5)


@pytest.mark.long
@pytest.mark.parametrize("preset", ["safe", "paper"])
def test_steps_are_those_of_automatic_differentiation(preset, monkeypatch):
    problem, _ = simulated()
    options = sgd_options(preset, texture="cells", iterations=8, batch=1024, median_gradient=False, records=8)
    a = solve_sgd(problem, options)
    monkeypatch.setattr(solve, "Engine", torch_sgd.TorchEngine)
    b = solve_sgd(problem, options)
    for x, y in zip(a.history, b.history, strict=True):
        assert {n: v for n, v in x.items() if n != "step"} == pytest.approx({n: v for n, v in y.items() if n != "step"}, rel=1e-4)
    for x, y in ((a.value, b.value), (a.scale, b.scale)):  # Adam's steps have the size of a gradient's sign
        np.testing.assert_allclose(x, y, atol=0.02)
        assert np.abs(x - y).mean() < 1e-5


def test_same_bytes_again_streamed_and_with_threads():
    problem, _ = simulated()
    options = replace(QUICK, iterations=60)
    first = solve_sgd(problem, options, threads=1)
    streamed = replace(problem, predictions=lambda view: simulated()[0].predictions[view])
    for other in (solve_sgd(problem, options, threads=2), solve_sgd(streamed, options, threads=3)):
        for name in ("value", "scale", "corrections", "alpha"):
            assert getattr(first, name).tobytes() == getattr(other, name).tobytes()
        assert first.history == other.history
    other = solve_sgd(problem, replace(options, seed=1))
    assert first.value.tobytes() != other.value.tobytes()


def test_order_of_predictions_does_not_matter():
    problem, _ = simulated()
    order = np.random.default_rng(0).permutation(6)
    a = solve_sgd(problem, QUICK)
    b = solve_sgd(replace(problem, predictions=[p[order] for p in problem.predictions]), QUICK)
    assert (a.alpha[:, order].argmax(1) == b.alpha.argmax(1)).mean() > 0.95
    assert b.history[-1]["total"] == pytest.approx(a.history[-1]["total"], rel=0.02)


def test_one_prediction_needs_no_selection():
    problem, truth = simulated(samples=1)
    fit = solve_sgd(problem, QUICK)
    assert (fit.alpha == 1).all() and all(h["label"] == h["entropy"] == 0 for h in fit.history)
    assert np.isfinite(fit.value).all() and fit.history[-1]["data"] < fit.history[0]["data"]
    paper = solve_sgd(problem, sgd_options("paper", texture="cells", iterations=5))
    assert np.isfinite(paper.value).all() and (paper.alpha == 1).all()


def test_equal_predictions_share():
    problem, truth = simulated(strength=0.0, samples=1)
    tripled = replace(problem, predictions=[np.repeat(p, 3, 0) for p in problem.predictions])
    for choice in ("argmin", "soft"):
        fit = solve_sgd(tripled, replace(QUICK, choice=choice))
        np.testing.assert_allclose(fit.alpha, 1 / 3, atol=1e-6)
    cells = seen(problem)
    assert np.abs(fit.value - truth)[cells].mean() < 5e-3
    assert np.median(fit.scale[cells]) < 0.03


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_predictions_that_are_not_finite_are_dropped_as_in_the_direct_solver(value):
    problem, _ = simulated()
    predictions = [p.copy() for p in problem.predictions]
    predictions[2][3] = value
    predictions[4][1, 5, 5, 0] = value
    predictions[0][:] = value
    problem = replace(problem, predictions=predictions)
    fit, direct = solve_sgd(problem, replace(QUICK, iterations=30)), solve_direct(problem)
    np.testing.assert_array_equal(sgd_pool.gather(problem, QUICK).observations, direct.observations)
    for name in ("value", "scale", "corrections", "alpha"):
        assert np.isfinite(getattr(fit, name)).all()
    segments = np.unique(problem.segment_of_pixel[2])
    assert (fit.alpha[segments, 3] == 0).all()
    np.testing.assert_allclose(fit.alpha[segments].sum(1), 1, atol=1e-6)
    assert (fit.alpha[np.unique(problem.segment_of_pixel[0])] == 0).all()


def test_coldest_temperatures_stay_finite():
    problem, _ = simulated()
    options = sgd_options("paper", texture="cells", iterations=20, batch=512, anneal_schedule="fraction", anneal=0.7)
    fit = solve_sgd(problem, options)
    assert fit.history[-1]["temperature"] < 2e-11
    for array in (fit.value, fit.scale, fit.corrections, fit.alpha):
        assert np.isfinite(array).all()
    assert np.isfinite([list(h.values()) for h in fit.history]).all()
    np.testing.assert_allclose(fit.alpha.sum(1), 1, atol=1e-5)
    frozen = solve_sgd(problem, replace(options, anneal=0.01))  # to the smallest by which float32 can divide
    assert frozen.history[-1]["temperature"] == 1e-30 and np.isfinite(frozen.value).all()


def test_unseen_cells_and_objects_of_one_pixel():
    obj = np.array([0, 0, 1, 2, 2])
    problem = problem_of([np.array([[0, 2, -1]])], [np.full((2, 1, 3, 5), 0.3)], obj, 0)
    fit = solve_sgd(problem, sgd_options(iterations=5))
    np.testing.assert_allclose(fit.value[[0, 1, 2]], 0.3, atol=0.03)
    np.testing.assert_array_equal(fit.value[1], fit.value[0])
    np.testing.assert_array_equal(fit.value[3:], [NEUTRAL] * 2)
    assert np.isfinite(fit.scale).all()


@pytest.mark.parametrize("level", [0.0, 0.5, 1.0])
def test_constant_colour(level):
    obj, _ = surface()
    cells = [np.arange(SIZE * SIZE).reshape(SIZE, SIZE)] * 2
    problem = problem_of(cells, [np.full((2, SIZE, SIZE, 5), level)] * 2, obj)
    fit = solve_sgd(problem, replace(QUICK, iterations=50))
    assert np.isfinite(fit.value).all()
    np.testing.assert_allclose(fit.value[: SIZE * SIZE], max(level, 0.02), atol=0.03)


def test_values_outside_the_unit_interval_are_not_misread():
    """The compiled loop cannot read half bits of numbers below 0 or above 1; such maps become float32."""
    problem, _ = simulated()
    odd = [p.astype(np.float16) for p in problem.predictions]
    odd[1][2, 3, 4] = [-0.25, 1.5, 0.5, 1.25, -0.0]
    pools = [sgd_pool.gather(replace(problem, predictions=p), QUICK) for p in (odd, [p.astype(np.float32) for p in odd])]
    np.testing.assert_array_equal(pools[0].values, pools[1].values)
    inside = sgd_pool.gather(replace(problem, predictions=[np.clip(p, 0, 1) for p in odd]), QUICK)
    assert inside.values.dtype == np.uint16


# ------------------------------------------------------------------------------------------------------------ hash grid


def on_a_wall(problem):
    """Surface points of the test wall: cell (row, column) of 60 x 60 at 2 m."""
    points = []
    for cell in problem.cell_of_pixel:
        y, x = np.divmod(np.maximum(np.ravel(cell), 0), 60)
        points.append(np.stack([x / 30, y / 30, 0.1 + 0 * x], 1).astype(np.float32))
    tangents = [np.tile(np.float32([[1 / 30, 0, 0], [0, 1 / 30, 0]]), (len(p), 1, 1)) for p in points]
    return replace(problem, point=points, tangent=lambda view: tangents[view])


@pytest.mark.long
@pytest.mark.parametrize("preset", ["safe", "paper"])
def test_hash_grid_texture(preset):
    problem, truth = simulated()
    problem = on_a_wall(problem)
    options = sgd_options(preset, texture="hashgrid", grid=SMALL_GRID, iterations=150, batch=4096)
    fit = solve_sgd(problem, options)
    assert fit.history[-1]["data"] < 0.8 * fit.history[0]["data"]
    cells = seen(problem)
    assert np.abs(fit.value - truth)[cells, :3].mean() < 0.2 and np.isfinite(fit.scale).all()
    other = solve_sgd(problem, options, threads=1)
    assert fit.value.tobytes() == other.value.tobytes()


def test_points_are_normalised_by_a_cube():
    problem, _ = simulated()
    pool = sgd_pool.gather(on_a_wall(problem), sgd_options(texture="hashgrid", jitter=True))
    low, high = 0.0, max(np.ravel(c).max() // 60 for c in problem.cell_of_pixel) / 30
    high = max(high, max((np.ravel(c) % 60).max() for c in problem.cell_of_pixel) / 30)
    low = min(min((np.ravel(c) % 60).min(), np.ravel(c).min() // 60) for c in problem.cell_of_pixel) / 30
    low = min(low, 0.1)
    edge = 1.02 * (high - low)
    assert pool.box == pytest.approx((low - 0.01 * (high - low), high + 0.01 * (high - low)), rel=1e-5)
    np.testing.assert_allclose(pool.coordinates[:, 2], (0.1 - pool.box[0]) / edge, rtol=1e-4)
    np.testing.assert_allclose(pool.tangent[:, 0, 0], 1 / 30 / edge, rtol=1e-4)


def test_jitter_moves_the_points():
    problem = on_a_wall(simulated()[0])
    options = sgd_options(texture="hashgrid", grid=SMALL_GRID, iterations=20, batch=2048)
    still, moved = (solve_sgd(problem, replace(options, jitter=j)) for j in (False, True))
    assert np.abs(still.value - moved.value).max() > 1e-4
    without = solve_sgd(replace(problem, tangent=None), replace(options, jitter=True))
    assert without.value.tobytes() == still.value.tobytes()


# ---------------------------------------------------------------------------------------------------------------- errors


def test_bad_calls_are_refused():
    problem, _ = simulated()
    with refused("base sgd", "FusionProblem.point"):
        solve_sgd(problem, sgd_options("paper"))
    with refused("base sgd", "cell", "segment", "weight"):
        solve_sgd(
            FusionProblem(
                predictions=[],
                cell_of_pixel=[],
                segment_of_pixel=[],
                n_cells=3,
                object_of_cell=np.zeros(3, int),
                object_of_segment=np.zeros(0, int),
            ),
            QUICK,
        )
    with refused("base sgd", "1 of 8", "memory"):
        solve_sgd(problem, replace(QUICK, memory=1000))
    with refused("segment 0"):
        solve_sgd(replace(problem, segment_of_pixel=[problem.segment_of_pixel[0]] * 8), QUICK)
    with refused("view 0", "cell id", 10):
        solve_sgd(replace(problem, n_cells=10, object_of_cell=np.zeros(10, int)), QUICK)
    fewer = [problem.predictions[0], *(p[:3] for p in problem.predictions[1:])]
    with refused("view 1", 3, "view 0", 6):
        solve_sgd(replace(problem, predictions=fewer), QUICK)
    assert OBJECTS == 4


def test_a_loss_that_explodes_is_named():
    problem, _ = simulated()
    with refused("base sgd", "step 1", "learning_rate"):
        solve_sgd(problem, replace(QUICK, learning_rate=1e30))
