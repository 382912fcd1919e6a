"""Fusion of extreme inputs: many objects, few pixels, large ids, odd units, values that are not finite."""

from dataclasses import replace

import numpy as np
import pytest

from iif_core.fusion.direct import solve_direct
from iif_core.fusion.options import FusionOptions
from iif_core.fusion.pixels import surface_tangents
from iif_core.fusion.problem import LOWEST, FusionProblem
from iif_core.fusion.selection import selection_weights
from iif_core.surface.cells import grid_origin, pack_keys, voxel_indices
from tests.errors import refused
from tests.unit.test_fusion_direct import simulated
from workflow.artifacts.scratch import Scratch


def every_array_is_finite(result):
    return all(np.isfinite(v).all() for v in vars(result).values() if isinstance(v, np.ndarray))


def test_ten_thousand_objects_of_a_few_pixels():
    rng = np.random.default_rng(0)
    n = 10_000
    truth = rng.uniform(0.1, 0.9, (n, 5))
    cell = np.arange(4 * n, dtype=np.int32)  # four cells per object, seen in two views
    objects = cell // 4
    predictions = [np.clip(truth[objects] + 0.02 * rng.standard_normal((3, 4 * n, 5)), 0, 1) for _ in range(2)]
    segments = [objects, n + objects]
    problem = FusionProblem(
        predictions=predictions,
        cell_of_pixel=[cell, cell],
        segment_of_pixel=segments,
        n_cells=4 * n,
        object_of_cell=objects,
        object_of_segment=np.tile(np.arange(n, dtype=np.int32), 2),
    )
    result = solve_direct(problem)
    assert every_array_is_finite(result) and result.value.shape == (4 * n, 5)
    assert np.abs(result.object_value - truth).mean() < 0.02


@pytest.mark.parametrize("temperature", [1e-3, 1e-6, 1e-12])
def test_cold_selection_in_float32_inputs_equals_float64(temperature):
    error = np.random.default_rng(1).uniform(1e-8, 1e-2, (500, 16))
    single, double = (selection_weights(error.astype(t), temperature) for t in (np.float32, np.float64))
    assert np.isfinite(single).all() and (np.abs(single.sum(-1) - 1) < 1e-12).all()
    gap = np.diff(np.partition(error, 1, -1)[:, :2], axis=-1)[:, 0] > 1e-6 * error.max(-1)
    np.testing.assert_array_equal(single[gap].argmax(-1), double[gap].argmax(-1))


@pytest.mark.parametrize("temperature", [1e-12, 0.0, 1e12])
def test_solver_at_extreme_temperatures(temperature):
    problem, truth = simulated()
    options = FusionOptions(temperature=max(temperature, 1e-12), final_temperature=temperature)
    result = solve_direct(problem, options)
    assert every_array_is_finite(result)
    entropy = result.history[-1]["entropy"]
    assert entropy == pytest.approx(np.log(len(problem.predictions[0])), abs=1e-6) if temperature > 1 else entropy < 1e-6


def test_scale_to_zero():
    """Predictions that agree exactly have every scale at the floor, none below and none NaN."""
    problem, truth = simulated()
    maps = [np.broadcast_to(p[:1], p.shape).copy() for p in problem.predictions]
    for floor in (1e-2, 1e-6):
        result = solve_direct(replace(problem, predictions=maps), FusionOptions(scale_floor=floor))
        assert every_array_is_finite(result) and result.scale.min() >= np.float32(floor)
    assert (result.margin == 0).all()


@pytest.mark.parametrize("value", [0.0, 1.0])
@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_predictions_at_the_ends_of_the_range(value, dtype):
    problem, _ = simulated()
    maps = [np.full(p.shape, value, dtype) for p in problem.predictions]
    result = solve_direct(replace(problem, predictions=maps))
    assert every_array_is_finite(result)
    np.testing.assert_allclose(result.value, np.maximum(np.full_like(result.value, value), LOWEST), atol=1e-4)


def test_one_view_misses_the_mesh():
    problem, truth = simulated()
    blind = replace(
        problem,
        cell_of_pixel=[*problem.cell_of_pixel, np.full_like(problem.cell_of_pixel[0], -1)],
        segment_of_pixel=[*problem.segment_of_pixel, np.full_like(problem.segment_of_pixel[0], -1)],
        predictions=[*problem.predictions, np.full_like(problem.predictions[0], np.nan)],
        weight=[*problem.weight, problem.weight[0]],
    )
    a, b = solve_direct(problem), solve_direct(blind)
    np.testing.assert_array_equal(a.value, b.value)


def test_ids_above_sixteen_bits():
    """Objects, segments and cells beyond 65,535 stay distinct (docs/method/numerics.md#ids-beyond-sixteen-bits)."""
    problem, truth = simulated()
    shift = 70_000
    result = solve_direct(problem)
    moved = solve_direct(
        replace(
            problem,
            object_of_cell=problem.object_of_cell + shift,
            object_of_segment=np.concatenate([np.full(shift, shift, np.int32), problem.object_of_segment + shift]),
            segment_of_pixel=[np.where(s >= 0, s + shift, -1).astype(np.int32) for s in problem.segment_of_pixel],
        )
    )
    np.testing.assert_array_equal(moved.value, result.value)
    np.testing.assert_array_equal(moved.object_value[shift:], result.object_value)
    with refused("object ids", "70000 ... 70000", "-1 ... 65534"):
        pack_keys(np.ones((1, 3)), 70_000)  # the cell grid has 16 bits for objects: refused, never wrapped


@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_millimetres_and_kilometres_make_the_same_cells(unit):
    rng = np.random.default_rng(2)
    points = rng.uniform(0, 5, (20_000, 3)).astype(np.float32)
    edge = 0.01
    keys = [voxel_indices(points * np.float32(s), edge * s, grid_origin(points * np.float32(s), edge * s)) for s in (1.0, unit)]
    assert (keys[0] == keys[1]).all(1).mean() > 0.995  # float32 rounds a few points over a face


@pytest.mark.long
def test_memory_bound_changes_nothing(tmp_path):
    """Predictions that do not fit into memory are read again, or mapped from a file, and give the same bytes."""
    problem, _ = simulated()
    reads = []

    def read(view):
        reads.append(view)
        return problem.predictions[view]

    streamed = replace(problem, predictions=read)
    kept, again = (solve_direct(streamed, FusionOptions(sweeps=4, memory=m)) for m in (1 << 30, 0))
    n_views = len(problem.cell_of_pixel)
    assert len(reads) == n_views + n_views * 7  # once; then start, sums, four sweeps, scales
    reads.clear()
    spilt = solve_direct(streamed, FusionOptions(sweeps=4, memory=0, spill=Scratch(tmp_path)), threads=2)
    assert len(reads) == n_views
    assert not list(tmp_path.iterdir())  # the file has no name
    for name, value in vars(kept).items():
        if isinstance(value, np.ndarray):
            np.testing.assert_array_equal(value, getattr(again, name), err_msg=name)
            np.testing.assert_array_equal(value, getattr(spilt, name), err_msg=name)


def test_tangents_lead_to_the_point_of_the_next_pixel():
    """On a tilted plane, the point of a pixel plus its tangent is the point of its neighbour."""
    h, w, f = 6, 8, 50.0
    u, v = np.meshgrid(np.arange(w) + 0.5 - w / 2, np.arange(h) + 0.5 - h / 2)
    direction = np.stack([u / f, v / f, np.ones_like(u)], -1)
    normal = np.array([0.3, -0.2, -1.0])
    depth = (normal[2] * 2.0) / (direction @ normal)  # plane through (0, 0, 2)
    points = depth[..., None] * direction
    tangent = surface_tangents(depth, direction, np.broadcast_to(normal / np.linalg.norm(normal), direction.shape))
    # to first order: half of the step to the left and half of that to the right
    np.testing.assert_allclose(tangent[:, 1:-1, 0], (points[:, 2:] - points[:, :-2]) / 2, atol=3e-5)
    np.testing.assert_allclose(tangent[1:-1, :, 1], (points[2:] - points[:-2]) / 2, atol=3e-5)


def test_nan_where_there_is_no_surface_changes_nothing():
    problem, _ = simulated()
    hole = [c.copy() for c in problem.cell_of_pixel]
    maps = [p.copy() for p in problem.predictions]
    for c, p in zip(hole, maps, strict=True):
        c[:4] = -1
        p[:, :4] = np.nan
    a = solve_direct(replace(problem, cell_of_pixel=hole))
    b = solve_direct(replace(problem, cell_of_pixel=hole, predictions=maps))
    assert not b.dropped
    np.testing.assert_array_equal(a.value, b.value)


@pytest.mark.parametrize("factor", [1e-3, 1e6])
def test_units_of_the_weights_do_not_matter(factor):
    problem, _ = simulated()
    a, b = solve_direct(problem), solve_direct(replace(problem, weight=[w * factor for w in problem.weight]))
    np.testing.assert_allclose(a.value, b.value, atol=2e-3)


def test_integer_maps_are_refused():
    problem, _ = simulated()
    maps = [(255 * p).astype(np.uint8) for p in problem.predictions]
    with refused("view 0", "uint8"):
        solve_direct(replace(problem, predictions=maps))
