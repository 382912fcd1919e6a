"""The direct solver: it recovers planted textures, keeps their level and contrast, and withstands bad predictions."""

import os
import subprocess
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from iif_core.fusion.direct import solve_direct
from iif_core.fusion.gauge import covisible_parts
from iif_core.fusion.options import FusionOptions
from iif_core.fusion.problem import LOWEST, NEUTRAL, FusionProblem, object_means, prediction_faults
from iif_core.fusion.selection import selection_weights
from iif_core.numerics import laplace
from iif_core.surface.segments import interior, segment_table
from lab.published.fusion.variants import solve_variant
from lab.simulated import errors as simulate
from tests.errors import refused
from tests.oracles import scores as single

SIZE = 40
OBJECTS = 4


def surface(seed=0):
    """A 2 x 2 m wall of four textured objects on 3.3 cm cells: (object of cell, truth (n, 5))."""
    rng = np.random.default_rng(seed)
    n = 60
    y, x = np.mgrid[:n, :n] / n
    obj = (y > 0.5).astype(int) * 2 + (x > 0.5)
    wave = [np.sin(2 * np.pi * (rng.uniform(2, 9, OBJECTS)[obj] * x + rng.uniform(2, 9, OBJECTS)[obj] * y)) for _ in range(3)]
    checker = np.sign(np.sin(40 * x) * np.sin(40 * y))
    colour = rng.uniform(0.25, 0.6, (OBJECTS, 3))[obj] * (1 + 0.3 * np.stack(wave, -1) + 0.2 * checker[..., None])
    rough = np.clip(rng.uniform(0.3, 0.8, OBJECTS)[obj] + 0.1 * wave[0], 0.02, 1)
    metal = (obj == 2) * 0.8
    truth = np.concatenate([np.clip(colour, 0.02, 0.98), rough[..., None], metal[..., None]], -1)
    return obj.ravel(), truth.reshape(-1, 5)


def look(view, seed=0):
    """Cell of each pixel of one view: a window of the wall, shifted from view to view."""
    rng = np.random.default_rng(100 + view + 1000 * seed)
    dy, dx = rng.integers(0, 60 - SIZE + 1, 2)
    y, x = np.mgrid[:SIZE, :SIZE]
    return (y + dy) * 60 + x + dx


def problem_of(cell_maps, predictions, obj, border=1):
    maps = [obj[c].astype(np.int32) for c in cell_maps]
    segment_maps, table = segment_table(maps)
    weight = [np.where(interior(m, border), 1.0, 0.1) for m in maps]
    return FusionProblem(
        predictions=predictions,
        cell_of_pixel=[c.astype(np.int32) for c in cell_maps],
        segment_of_pixel=segment_maps,
        n_cells=len(obj),
        object_of_cell=obj.astype(np.int32),
        object_of_segment=table.object,
        weight=weight,
    )


@cache
def simulated(views=8, samples=6, seed=0, strength=1.0):
    obj, truth = surface(seed)
    cell_maps = [look(v, seed) for v in range(views)]
    predictions = []
    for v, cell in enumerate(cell_maps):
        t = truth[cell]
        predictions.append(simulate.simulate_predictions(t[..., :3], t[..., 3], t[..., 4], obj[cell], samples, v, seed, strength))
    return problem_of(cell_maps, predictions, obj), truth


def planted(views=6, samples=4, seed=0, spread=0.15):
    """Predictions that are exact affine maps of the truth, one map per view, object and k."""
    rng = np.random.default_rng(seed)
    obj, truth = surface(seed)
    truth = np.concatenate([0.2 + 0.5 * truth[:, :3], truth[:, 3:]], 1)  # so that nothing clips
    cell_maps = [look(v, seed) for v in range(views)]
    predictions = []
    for cell in cell_maps:
        gain = 1 + rng.uniform(-spread, spread, (samples, OBJECTS, 1))
        bias = rng.uniform(-0.3, 0.3, (samples, OBJECTS, 5)) * spread
        o = obj[cell]
        predictions.append(np.stack([truth[cell] * gain[k][o] + bias[k][o] for k in range(samples)]))
    return problem_of(cell_maps, predictions, obj, 0), truth


def oracle_psnr(problem, value, truth):
    """Albedo PSNR after the best affine map per view and object, mean over views (protocol `oracle_affine`)."""
    scores = []
    for cell in problem.cell_of_pixel:
        mask = cell >= 0
        fitted = single.oracle_affine(value[cell][..., :3], truth[cell][..., :3], mask, problem.object_of_cell[cell])
        scores.append(single.psnr(fitted, truth[cell][..., :3], mask))
    return np.mean(scores)


def seen(problem):
    return np.unique(np.concatenate([np.ravel(c) for c in problem.cell_of_pixel]))


# ------------------------------------------------------------------------------------------------------------- quality


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_selection_beats_corrections_beat_means(seed):
    problem, truth = simulated(seed=seed)
    psnr = {
        v: oracle_psnr(problem, solve_variant(problem, v).value, truth) for v in ("full", "uniform", "texel_mean", "object_mean")
    }
    assert psnr["full"] > psnr["uniform"] + 0.8
    assert psnr["uniform"] > psnr["texel_mean"] + 0.3
    assert psnr["texel_mean"] > psnr["object_mean"] + 3


def test_exact_predictions_are_returned_unchanged():
    problem, truth = simulated(strength=0.0)
    result = solve_direct(problem)
    cells = seen(problem)
    np.testing.assert_allclose(result.value[cells], truth[cells], atol=2e-3)
    assert (result.scale[cells] < 1.1 * laplace.SCALE_FLOOR).all()
    gains = result.affine_albedo[..., :3]
    np.testing.assert_allclose(gains, np.broadcast_to(np.eye(3), gains.shape), atol=0.02)


def test_affine_predictions_are_made_consistent():
    """With exact affine errors the texture is an affine map of the truth, far closer than the plain mean."""
    problem, truth = planted()
    full, mean = (
        solve_variant(problem, v, FusionOptions(sweeps=30, anneal=0.8, ridge=1e-3)).value for v in ("uniform", "texel_mean")
    )
    assert oracle_psnr(problem, full, truth) > 45
    assert oracle_psnr(problem, full, truth) > oracle_psnr(problem, mean, truth) + 10


def test_good_predictions_are_selected():
    """One clean prediction among patterns of noise, at a different k in every view."""
    problem, truth = planted(views=8, samples=5)
    rng = np.random.default_rng(1)
    good = rng.integers(0, 5, 8)
    predictions = [p.copy() for p in problem.predictions]
    for v, p in enumerate(predictions):
        for k in range(5):
            if k != good[v]:
                p[k] += 0.12 * rng.standard_normal(p[k].shape)
    problem = replace(problem, predictions=predictions)
    result = solve_direct(problem)
    view_of_segment = np.array(
        [next(v for v, m in enumerate(problem.segment_of_pixel) if (m == s).any()) for s in range(problem.n_segments)]
    )
    assert (result.weight.argmax(1) == good[view_of_segment][:, None]).mean() > 0.9
    assert result.history[-1]["entropy"] < 0.01
    hard = solve_direct(problem, FusionOptions(final_temperature=0))
    assert hard.history[-1]["entropy"] == 0.0


# --------------------------------------------------------------------------------------------------------------- gauge


def test_level_is_that_of_the_predictions_and_contrast_stays_over_many_sweeps():
    problem, truth = simulated()
    few, many = (solve_variant(problem, "uniform", FusionOptions(sweeps=n)) for n in (12, 150))
    weight = np.bincount(
        np.concatenate([c.ravel() for c in problem.cell_of_pixel]),
        np.concatenate([w.ravel() for w in problem.weight]),
        problem.n_cells,
    )
    level, _ = object_means(first_texture(problem), problem.object_of_cell, weight)
    np.testing.assert_allclose(many.object_value, level, atol=5e-3)
    cells = seen(problem)
    for o in range(OBJECTS):
        own = cells[problem.object_of_cell[cells] == o]
        assert many.value[own, :3].std() > 0.9 * few.value[own, :3].std() > 0.02
    assert many.history[-1]["change"] < 1e-5
    assert many.history[-1]["gain"] > 0.5


def test_history_has_an_entry_per_sweep():
    problem, _ = simulated()
    calls = []
    history = solve_direct(problem, FusionOptions(sweeps=5), lambda done, total: calls.append((done, total))).history
    assert [round(h["temperature"], 4) for h in history] == [1, 0.6, 0.36, 0.216, 0.1]
    assert all(np.isfinite(list(h.values())).all() for h in history)
    assert history[-1]["error_albedo"] < history[0]["error_albedo"]
    assert calls[0] == (1, 7) and calls[-1] == (7, 7)


# ---------------------------------------------------------------------------------------------------------- invariances


def test_order_of_predictions_does_not_matter():
    problem, _ = simulated()
    order = np.random.default_rng(0).permutation(6)
    a = solve_direct(problem)
    b = solve_direct(replace(problem, predictions=[p[order] for p in problem.predictions]))
    np.testing.assert_allclose(a.value, b.value, atol=5e-5)  # rounding of sums, over twelve sweeps
    np.testing.assert_allclose(a.weight[:, order], b.weight, atol=5e-3)


def test_doubled_views_change_nothing():
    problem, _ = simulated()
    n = problem.n_segments
    shifted = [np.where(m >= 0, m + n, -1) for m in problem.segment_of_pixel]
    twice = FusionProblem(
        predictions=[*problem.predictions] * 2,
        cell_of_pixel=[*problem.cell_of_pixel] * 2,
        segment_of_pixel=[*problem.segment_of_pixel, *shifted],
        n_cells=problem.n_cells,
        object_of_cell=problem.object_of_cell,
        object_of_segment=np.tile(problem.object_of_segment, 2),
        weight=[*problem.weight] * 2,
    )
    a, b = solve_direct(problem), solve_direct(twice)
    np.testing.assert_array_equal(2 * a.observations, b.observations)
    for name in ("value", "scale", "uncertainty", "object_value"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), atol=2e-5, err_msg=name)
    for name in ("weight", "affine_albedo", "error", "margin", "probability"):
        half = getattr(b, name)[:n]
        np.testing.assert_allclose(getattr(a, name), half, atol=5e-3, err_msg=name)
        np.testing.assert_allclose(half, getattr(b, name)[n:], atol=5e-3, err_msg=name)


def test_same_bytes_again_streamed_and_with_threads():
    problem, _ = simulated()
    first = solve_direct(problem)
    streamed = replace(problem, predictions=lambda view: simulated()[0].predictions[view])
    for other in (solve_direct(problem), solve_direct(streamed, threads=3)):
        for name, value in vars(first).items():
            if isinstance(value, np.ndarray):
                assert value.tobytes() == getattr(other, name).tobytes(), name


def test_half_precision_input():
    problem, _ = simulated()
    half = replace(problem, predictions=[p.astype(np.float16) for p in problem.predictions])
    a, b = (solve_variant(p, "uniform").value for p in (problem, half))
    np.testing.assert_allclose(a, b, atol=2e-3)


# ------------------------------------------------------------------------------------------------------------- oracles


def test_corrections_equal_ridge_regression_in_float64():
    """After one sweep from the median of K = 3, maps and errors are those of a ridge regression on the weighted pixels."""
    problem, _ = simulated(samples=3)
    result = solve_direct(problem, FusionOptions(sweeps=1))
    texture = first_texture(problem)
    level = base_level_shift(problem, result)
    for segment in (0, 5):
        view = next(v for v, m in enumerate(problem.segment_of_pixel) if (m == segment).any())
        pixels = problem.segment_of_pixel[view] == segment
        w = fit_weight(problem, view)[pixels]
        t = texture[problem.cell_of_pixel[view][pixels]]
        o = problem.object_of_segment[segment]
        for k in range(3):
            x = problem.predictions[view][k][pixels].astype(np.float64)
            ridge = 0.01 * w.sum() * max(1, 30 / len(w))
            inside = ((x[:, :3] > 0) & (x[:, :3] < 1)).all(1)
            fitted = np.empty((pixels.sum(), 5))
            for rows, channels, target in (
                (inside, slice(0, 3), np.eye(4, 3)),
                (slice(None), slice(3, 4), np.eye(2, 1)),
                (slice(None), slice(4, 5), np.eye(2, 1)),
            ):
                design = np.c_[x[:, channels], np.ones(len(x))]
                a, b, c = design[rows], t[rows, channels], w[rows]
                solution = np.linalg.solve(
                    a.T @ (c[:, None] * a) + ridge * np.eye(a.shape[1]), a.T @ (c[:, None] * b) + ridge * target
                )
                fitted[:, channels] = design @ solution
                found = (
                    result.affine_albedo[segment, k].T
                    if channels.start == 0
                    else (result.affine_roughness if channels.start == 3 else result.affine_metallic)[segment, k][:, None]
                )
                expected = solution.copy()
                expected[-1] += level[o, channels]
                np.testing.assert_allclose(found, expected, atol=1e-5)
            mean_square = (w[:, None] * (fitted - t) ** 2).sum(0) / w.sum()
            np.testing.assert_allclose(
                result.error[segment, k], [mean_square[:3].mean(), mean_square[3], mean_square[4]], rtol=1e-4, atol=1e-9
            )


def fit_weight(problem, view):
    """Pixel weights in the fit of the maps; they are close to 0 where a single view sees the cell."""
    views = sum(np.bincount(np.unique(c), minlength=problem.n_cells) for c in problem.cell_of_pixel)
    return problem.weight[view] * (1 - 1 / np.maximum(views, 1) + 0.01)[problem.cell_of_pixel[view]]


def first_texture(problem):
    total, summed = np.zeros(problem.n_cells), np.zeros((problem.n_cells, 5))
    for cell, p, w in zip(problem.cell_of_pixel, problem.predictions, problem.weight, strict=True):
        np.add.at(total, cell.ravel(), w.ravel())
        middle = np.clip(np.median(p.astype(np.float64), 0), LOWEST, 1)
        np.add.at(summed, cell.ravel(), (w[..., None] * middle).reshape(-1, 5))
    return summed / np.maximum(total, 1e-30)[:, None]


def base_level_shift(problem, result):
    """Shift of each object that brings the mean of the selected, corrected predictions to the mean of the median prediction."""
    wanted, found, total = (np.zeros((OBJECTS, 5)) for _ in range(3))
    texture = first_texture(problem)
    for view, segments in enumerate(problem.segment_of_pixel):
        for s in np.unique(segments):
            o, pixels = problem.object_of_segment[s], segments == s
            w, x = fit_weight(problem, view)[pixels], problem.predictions[view][:, pixels].astype(np.float64)
            t, mixture = texture[problem.cell_of_pixel[view][pixels]], 0
            ridge = 0.01 * w.sum() * max(1, 30 / len(w))
            for k in range(3):
                inside = ((x[k, :, :3] > 0) & (x[k, :, :3] < 1)).all(1)
                out = np.empty_like(t)
                for rows, c, eye, p in (
                    (inside, slice(0, 3), np.eye(4, 3), 0),
                    (slice(None), slice(3, 4), np.eye(2, 1), 1),
                    (slice(None), slice(4, 5), np.eye(2, 1), 2),
                ):
                    design = np.c_[x[k][:, c], np.ones(len(w))]
                    a = design[rows]
                    solution = np.linalg.solve(
                        a.T @ (w[rows, None] * a) + ridge * np.eye(a.shape[1]),
                        a.T @ (w[rows, None] * t[rows, c]) + ridge * eye,
                    )
                    out[:, c] = result.weight[s, k, p] * (design @ solution)
                mixture = mixture + out
            whole = problem.weight[view][pixels][:, None]
            found[o] += (whole * np.clip(mixture, LOWEST, 1)).sum(0)
            wanted[o] += (whole * np.clip(np.median(x, 0), LOWEST, 1)).sum(0)
            total[o] += whole.sum()
    return (wanted - found) / np.maximum(total, 1e-30)


def test_scale_equals_the_closed_form():
    """A cell seen by three one-pixel views: its scale is the mean of d + b_r e^(-d / b_r)."""
    values = np.array([[0.3, 0.34, 0.4], [0.5, 0.52, 0.6], [0.42, 0.44, 0.46]])  # views x K
    predictions = [np.repeat(v[:, None, None], 5, 2) for v in values]
    problem = FusionProblem(
        predictions=predictions,
        cell_of_pixel=[np.zeros(1, int)] * 3,
        segment_of_pixel=[np.array([i]) for i in range(3)],
        n_cells=1,
        object_of_cell=np.zeros(1, int),
        object_of_segment=np.zeros(3, int),
    )
    result = solve_variant(problem, "texel_mean")
    mean = values.mean(1)
    assert result.value[0, 1] == pytest.approx(values.mean())
    b_ref = np.maximum(np.sort(np.abs(values - mean[:, None]), 1)[:, 1], 0.01)
    expected = laplace.scale_contribution(mean - values.mean(), b_ref).mean()
    np.testing.assert_allclose(result.scale[0], expected, rtol=1e-5)


@pytest.mark.parametrize("seed", range(4))
def test_selection_at_zero_temperature_is_the_argmin(seed):
    rng = np.random.default_rng(seed)
    error = rng.random((50, 7))
    cold, nearly = selection_weights(error, 0.0), selection_weights(error, 1e-6)
    np.testing.assert_array_equal(cold, np.eye(7)[error.argmin(1)])
    np.testing.assert_allclose(nearly, cold, atol=1e-12)


def test_selection_equals_softmax_in_float64():
    error = np.array([0.1, 0.4, 0.2])
    expected = np.exp(-error / (0.7 * (0.2 + 1e-6)))
    np.testing.assert_allclose(selection_weights(error, 0.7), expected / expected.sum(), rtol=1e-12)


def test_selection_at_the_limits():
    np.testing.assert_array_equal(selection_weights(np.array([0.3, 0.1, 0.1]), 0.0), [0, 0.5, 0.5])
    np.testing.assert_array_equal(selection_weights(np.zeros(2), 0.0), [0.5, 0.5])
    np.testing.assert_array_equal(selection_weights(np.zeros(2), 1.0, np.array([False, True])), [0, 1])
    np.testing.assert_array_equal(selection_weights(np.ones(3), 1.0, np.zeros(3, bool)), 0)
    assert np.isfinite(selection_weights(np.array([1e-30, 1e30]), 1e-3)).all()
    assert selection_weights(np.ones((4, 1)), 0.0).tolist() == [[1.0]] * 4


# ------------------------------------------------------------------------------------------------------ bad predictions


def finite(result):
    return all(
        np.isfinite(a).all()
        for a in (
            result.value,
            result.scale,
            result.weight,
            result.affine_albedo,
            result.affine_roughness,
            result.error,
            result.object_value,
        )
    )


def test_one_prediction_is_used_as_it_is_but_corrected():
    problem, truth = simulated(samples=1)
    result = solve_direct(problem)
    assert finite(result) and (result.weight == 1).all() and result.history[-1]["entropy"] == 0
    mean = solve_variant(problem, "texel_mean")
    assert oracle_psnr(problem, result.value, truth) > oracle_psnr(problem, mean.value, truth)


def test_two_predictions_that_tie_share():
    obj, _ = surface()
    cell = look(0)
    red, green = (np.full((SIZE, SIZE, 5), 0.5) for _ in range(2))
    red[..., 0], red[..., 1] = 0.6, 0.4
    green[..., 0], green[..., 1] = 0.4, 0.6
    result = solve_direct(problem_of([cell], [np.stack([red, green])], obj))
    np.testing.assert_allclose(result.weight, 0.5, atol=5e-3)  # rounding of sums shifts the weights a little
    np.testing.assert_allclose(result.value[cell], 0.5, atol=1e-6)


def test_equal_predictions():
    problem, truth = simulated(strength=0.0, samples=1)
    tripled = replace(problem, predictions=[np.repeat(p, 3, 0) for p in problem.predictions])
    result = solve_direct(tripled)
    np.testing.assert_allclose(result.weight, 1 / 3, atol=1e-6)
    np.testing.assert_allclose(result.value, solve_direct(problem).value, atol=1e-6)


def test_all_predictions_wrong():
    obj, _ = surface()
    cells = [look(v) for v in range(4)]
    rng = np.random.default_rng(0)
    result = solve_direct(problem_of(cells, [rng.random((4, SIZE, SIZE, 5)) for _ in cells], obj))
    assert finite(result) and result.value.min() >= 0 and result.value.max() <= 1
    assert np.median(result.scale) > 3 * laplace.SCALE_FLOOR  # the reported scale is large too


@pytest.mark.parametrize("level", [0.0, 0.5, 1.0])
def test_constant_colour_is_rank_one(level):
    obj, _ = surface()
    cells = [look(v) for v in range(3)]
    result = solve_direct(problem_of(cells, [np.full((2, SIZE, SIZE, 5), level)] * 3, obj))
    assert finite(result)
    np.testing.assert_allclose(result.value, np.maximum(np.broadcast_to(level, (len(obj), 5)), LOWEST), atol=1e-5)


def test_constant_views_of_an_object_are_joined_without_a_seam():
    """Grey 0.4 in one view and 0.6 in the other give one texture between them, without a seam."""
    obj = np.zeros(400, int)
    cells = [np.arange(300).reshape(15, 20), np.arange(100, 400).reshape(15, 20)]
    predictions = [np.full((1, 15, 20, 5), 0.4), np.full((1, 15, 20, 5), 0.6)]
    result = solve_direct(problem_of(cells, predictions, obj, 0), FusionOptions(sweeps=60))
    assert np.ptp(result.value[:, 0]) < 0.06
    assert result.value[:, 0].mean() == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_predictions_that_are_not_finite_are_dropped_and_named(value):
    problem, truth = simulated()
    predictions = [p.copy() for p in problem.predictions]
    predictions[2][3] = value
    predictions[4][1, 5, 5, 0] = value
    result = solve_direct(replace(problem, predictions=predictions))
    assert finite(result)
    assert [(d.view, d.k) for d in result.dropped] == [(2, 3), (4, -1)]
    assert "100 %" in result.dropped[0].reason and "1 pixels" in result.dropped[1].reason
    segments = np.unique(problem.segment_of_pixel[2])
    assert (result.weight[segments, 3] == 0).all()
    np.testing.assert_allclose(result.weight[segments].sum(1), 1, atol=1e-6)


def test_blank_map_among_others_is_dropped():
    problem, _ = simulated()
    predictions = [p.copy() for p in problem.predictions]
    predictions[0][2] = 0
    result = solve_direct(replace(problem, predictions=predictions))
    assert [(d.view, d.k, d.reason) for d in result.dropped] == [(0, 2, "albedo is constant over the picture")]


def test_a_view_without_any_usable_prediction_does_not_count():
    problem, _ = simulated()
    predictions = [p.copy() for p in problem.predictions]
    predictions[0][:] = np.nan
    result = solve_direct(replace(problem, predictions=predictions))
    rest = solve_direct(replace(problem, weight=[0 * problem.weight[0], *problem.weight[1:]]))
    np.testing.assert_allclose(result.value, rest.value, atol=1e-9)
    assert (result.weight[np.unique(problem.segment_of_pixel[0])] == 0).all()


def test_nothing_usable_at_all_gives_neutral():
    obj, _ = surface()
    result = solve_direct(problem_of([look(0)], [np.full((2, SIZE, SIZE, 5), np.nan)], obj))
    np.testing.assert_array_equal(result.value, np.broadcast_to(NEUTRAL, (len(obj), 5)))
    assert finite(result) and len(result.dropped) == 2 and (result.object_cells == 0).all()


def test_clipped_albedo_does_not_bend_the_correction():
    """Of a prediction that is 1.4 times too bright and clips at 1, the gain is found from the pixels that do not clip."""
    rng = np.random.default_rng(0)
    truth = rng.uniform(0.2, 0.85, (400, 5))
    cells = [np.arange(400).reshape(20, 20)] * 2
    predictions = [truth.reshape(1, 20, 20, 5), np.clip(1.4 * truth, 0, 1).reshape(1, 20, 20, 5)]
    problem = problem_of(cells, predictions, np.zeros(400, int), 0)
    problem = replace(problem, weight=[np.ones((20, 20)), np.full((20, 20), 1e-3)])  # the texture is the first view's
    options = FusionOptions(sweeps=1, ridge=1e-9)
    with_care, without = (solve_direct(problem, replace(options, clip_share=s)) for s in (0.6, 0.0))
    np.testing.assert_allclose(with_care.affine_albedo[1, 0, :, :3], np.eye(3) / 1.4, atol=2e-3)
    assert abs(without.affine_albedo[1, 0, 0, 0] - 1 / 1.4) > 0.02


def test_objects_of_one_pixel_and_unseen_cells():
    obj = np.array([0, 0, 1, 2, 2])
    cell = np.array([[0, 2, -1]])
    predictions = [np.full((2, 1, 3, 5), 0.3)]
    result = solve_direct(problem_of([cell], predictions, obj, 0))
    assert finite(result)
    np.testing.assert_allclose(result.value[[0, 1, 2]], 0.3, atol=1e-6)  # cell 1 is not seen and takes its object's mean
    np.testing.assert_array_equal(result.value[3:], [NEUTRAL] * 2)
    assert result.observations.tolist() == [1, 0, 1, 0, 0] and result.views.tolist() == [1, 0, 1, 0, 0]
    assert result.object_cells.tolist() == [1, 1, 0]


def test_border_pixels_weigh_little():
    obj = np.zeros(100, int)
    cell = np.arange(100).reshape(10, 10)
    good, bad = np.full((1, 10, 10, 5), 0.4), np.full((1, 10, 10, 5), 0.8)
    problem = problem_of([cell, cell], [good, bad], obj, 0)
    result = solve_variant(replace(problem, weight=[np.ones((10, 10)), np.full((10, 10), 0.1)]), "texel_mean")
    np.testing.assert_allclose(result.value, (0.4 + 0.08) / 1.1, atol=1e-6)


def test_prediction_faults():
    maps = np.random.default_rng(0).random((4, 10, 10, 5)).astype(np.float32)
    maps[1, :2, 0] = np.nan
    maps[2, ..., :3] = 0.5
    faults = prediction_faults(maps)
    assert faults[0] == faults[3] == "" and "2 %" in faults[1] and "constant" in faults[2]
    assert prediction_faults(np.full((2, 3, 3, 5), 0.5)) == ["", ""]  # all predictions constant: a plain wall


# --------------------------------------------------------------------------------------------------- helpers and errors


def test_object_means():
    value = np.array([[0.2] * 5, [0.4] * 5, [0.9] * 5])
    mean, cells = object_means(value, np.array([0, 0, 2]), np.array([3.0, 1.0, 0.0]), 5)
    np.testing.assert_allclose(mean[0], 0.25)
    np.testing.assert_allclose(mean[1:], [NEUTRAL] * 4)
    assert cells.tolist() == [2, 0, 0, 0, 0]


def test_parts_of_an_object_that_share_no_cell():
    pairs = [(np.array([0, 0]), np.array([0, 1])), (np.array([1, 1]), np.array([1, 2])), (np.array([2]), np.array([3]))]
    parts = covisible_parts(3, 5, pairs)
    assert parts.of_segment[0] == parts.of_segment[1] != parts.of_segment[2]
    assert parts.count == 2
    np.testing.assert_array_equal(parts.of_cell, [*parts.of_segment[[0, 0, 1, 2]], -1])


def test_no_views():
    result = solve_direct(
        FusionProblem(
            predictions=[],
            cell_of_pixel=[],
            segment_of_pixel=[],
            n_cells=3,
            object_of_cell=np.zeros(3, int),
            object_of_segment=np.zeros(0, int),
        )
    )
    np.testing.assert_array_equal(result.value, [NEUTRAL] * 3)


@pytest.mark.parametrize(
    ("change", "names"),
    [
        ({"predictions": [np.zeros((2, SIZE, SIZE, 3))] * 8}, ("predictions", f"(2, {SIZE}, {SIZE}, 3)", "(K, H, W, 5)")),
        ({"predictions": [np.zeros((2, 4, 4, 5))] * 8}, ("predictions", 16, SIZE * SIZE)),
        ({"n_cells": 10, "object_of_cell": np.zeros(10, int)}, ("cell id", 10)),
        ({"object_of_segment": np.zeros(2, int)}, ("segment id", 2)),
        ({"scale": lambda view: np.ones((3, SIZE, SIZE))}, ("scales", f"(3, {SIZE}, {SIZE})", "(H, W, 3)")),
        ({"scale": lambda view: np.ones((4, 4, 3))}, ("scales", "(4, 4, 3)", "(H, W, 3)")),
    ],
)
def test_inputs_that_do_not_fit_are_refused(change, names):
    problem, _ = simulated()
    with refused("view 0", *names):
        solve_direct(replace(problem, **change))


def test_a_segment_in_two_views_is_refused():
    problem, _ = simulated()
    same = [problem.segment_of_pixel[0]] * 8
    with refused("segment 0"):
        solve_direct(replace(problem, segment_of_pixel=same))


@pytest.mark.long
def test_same_bytes_whatever_the_threads_of_blas():
    """Uses odd sizes that OpenBLAS spreads over threads; their number is fixed when NumPy is imported."""
    program = """
import hashlib, numpy as np
from iif_core.fusion.direct import solve_direct
from iif_core.fusion.problem import FusionProblem
rng = np.random.default_rng(0)
maps = rng.random((2, 8, 40001, 5)).astype(np.float32)
cell = [rng.permutation(40001) // 3 for _ in range(2)]
segment = [np.full(40001, i) for i in range(2)]
problem = FusionProblem(
    predictions=list(maps),
    cell_of_pixel=cell,
    segment_of_pixel=segment,
    n_cells=13334,
    object_of_cell=np.zeros(13334, int),
    object_of_segment=np.zeros(2, int),
)
result = solve_direct(problem)
print(hashlib.sha256(result.value.tobytes() + result.scale.tobytes() + repr(result.history).encode()).hexdigest())
"""
    digests = set()
    for threads in ("1", "2"):
        environment = {**os.environ, "OPENBLAS_NUM_THREADS": threads, "OMP_NUM_THREADS": threads}
        done = subprocess.run(
            [sys.executable, "-c", program],
            env=environment,
            capture_output=True,
            text=True,
            check=False,
            cwd=Path(__file__).resolve().parents[2],
        )
        assert done.returncode == 0, done.stderr
        digests.add(done.stdout)
    assert len(digests) == 1


def test_a_failed_prediction_overflows_nothing_at_low_temperatures():
    """Its error is smaller than every usable one's."""
    with np.errstate(all="raise", under="ignore"):
        weight = selection_weights([1.0, 5.0, 0.9], 1e-4, [True, True, False])
    assert weight.tolist() == [1.0, 0.0, 0.0]
