"""Levels of parts that share no cell: parts, anchoring to the predictions, closing of seams."""

from dataclasses import replace

import numpy as np

from iif_core.fusion.direct import solve_direct
from iif_core.fusion.gauge import Parts, anchor_shifts, seam_shifts
from iif_core.fusion.options import FusionOptions
from iif_core.fusion.problem import FusionProblem
from iif_core.surface import cells


def two_sides(level=(0.4, 0.6), size=20, spread=0.15, k=6):
    """A wall whose left half is in one view and its right half in the other; the levels of the predictions scatter by
    `spread` about two different means."""
    cell = np.arange(2 * size * size, dtype=np.int32).reshape(size, 2 * size)
    x = np.linspace(0, 3, 2 * size)[None, :, None]
    wall = 0.05 * np.sin(7 * x) * np.ones((size, 1, 5))
    scatter = spread * np.linspace(-1, 1, k)[:, None, None, None]
    left, right = wall[:, :size] + level[0] + scatter, wall[:, size:] + level[1] + scatter
    across, down = (np.stack(p, -1).reshape(-1, 2) for p in ((cell[:, :-1], cell[:, 1:]), (cell[:-1], cell[1:])))
    pairs = np.concatenate([across, down])
    maps = [cell[:, :size].copy(), cell[:, size:].copy()]
    segments = [np.zeros((size, size), np.int32), np.ones((size, size), np.int32)]
    problem = FusionProblem(
        predictions=[left, right],
        cell_of_pixel=maps,
        segment_of_pixel=segments,
        n_cells=cell.size,
        object_of_cell=np.zeros(cell.size, np.int32),
        object_of_segment=np.zeros(2, np.int32),
    )
    return replace(problem, neighbours=pairs.astype(np.int32)), cell


def step(value, cell):
    size = cell.shape[0]
    return float((value[cell[:, size], 0] - value[cell[:, size - 1], 0]).mean())


def test_seam_between_parts_is_closed_and_the_mean_kept():
    problem, cell = two_sides()
    assert len(np.unique(solve_direct(problem).part_of_cell)) == 2
    open_, closed = (solve_direct(problem, FusionOptions(seams=s)) for s in (False, True))
    assert step(open_.value, cell) > 0.18
    assert abs(step(closed.value, cell)) < 0.1 * step(open_.value, cell)
    np.testing.assert_allclose(closed.value.mean(0), open_.value.mean(0), atol=1e-3)  # equal parts move by equal amounts


def test_true_edge_at_a_seam_stays():
    """An edge from 0.2 to 0.8 on whose levels the predictions agree is kept."""
    problem, cell = two_sides((0.2, 0.8), spread=0.0)
    result = solve_direct(problem)
    truth = np.concatenate([np.full((20, 20), 0.2), np.full((20, 20), 0.8)], 1)
    wave = 0.05 * np.sin(7 * np.linspace(0, 3, 40))
    np.testing.assert_allclose(result.value[cell, 0], truth + wave, atol=0.02)
    small, _ = two_sides((0.2, 0.8), spread=0.05)  # a jump of 0.6 is far beyond a spread of 0.03
    np.testing.assert_array_equal(solve_direct(small).value, solve_direct(small, FusionOptions(seams=False)).value)


def test_properties_are_closed_each_on_its_own():
    problem, cell = two_sides()
    maps = [p.copy() for p in problem.predictions]
    maps[0][..., 4], maps[1][..., 4] = 0.0, 1.0  # metal starts at the seam in every prediction
    value = solve_direct(replace(problem, predictions=maps)).value
    assert abs(step(value, cell)) < 0.03
    np.testing.assert_allclose([value[cell[:, 0], 4].max(), value[cell[:, -1], 4].min()], [0, 1], atol=0.02)


def test_corrections_move_with_the_seam():
    """The corrected predictions still equal the texture after the seam was closed."""
    problem, _ = two_sides()
    result = solve_direct(problem)
    for view in range(2):
        mixed = 0
        for k in range(6):
            v = problem.predictions[view][k].reshape(-1, 5)
            corrected = v[:, :3] @ result.affine_albedo[view, k, :, :3].T + result.affine_albedo[view, k, :, 3]
            mixed = mixed + result.weight[view, k, 0] * corrected
        np.testing.assert_allclose(mixed, result.value[problem.cell_of_pixel[view].ravel(), :3], atol=5e-3)


def test_connected_objects_have_no_seam_to_close():
    problem, _ = two_sides()
    shared = problem.cell_of_pixel[1].copy()
    shared[0, 0] = problem.cell_of_pixel[0][0, 0]  # one common cell
    joined = replace(problem, cell_of_pixel=[problem.cell_of_pixel[0], shared])
    result = solve_direct(joined)
    assert len(np.unique(result.part_of_cell[result.part_of_cell >= 0])) == 1
    np.testing.assert_array_equal(result.value, solve_direct(joined, FusionOptions(seams=False)).value)


def test_a_view_without_usable_predictions_connects_nothing():
    problem, cell = two_sides()
    across = np.tile(cell[:, 10:30].ravel()[:, None], 1).reshape(20, 20).astype(np.int32)
    blind = replace(
        problem,
        predictions=[*problem.predictions, np.full_like(problem.predictions[0], np.nan)],
        cell_of_pixel=[*problem.cell_of_pixel, across],
        segment_of_pixel=[*problem.segment_of_pixel, np.full((20, 20), 2, np.int32)],
        object_of_segment=np.zeros(3, np.int32),
    )
    a, b = solve_direct(problem), solve_direct(blind)
    np.testing.assert_array_equal(a.value, b.value)
    np.testing.assert_array_equal(a.part_of_cell == a.part_of_cell[0], b.part_of_cell == b.part_of_cell[0])


def test_small_part_moves_to_the_large_one():
    texture = np.concatenate([np.full((100, 5), 0.5), np.full((10, 5), 0.7)])
    parts = Parts(np.arange(2, dtype=np.int32), np.repeat([0, 1], [100, 10]).astype(np.int32), 2)
    pairs = np.stack([np.arange(90, 100), np.arange(100, 110)], 1)
    shift, count = seam_shifts(parts, texture, np.ones(110), pairs, np.ones((2, 5)))
    assert count.tolist() == [10, 10]
    assert abs(shift[0]).max() < 0.02 and (shift[1] < -0.12).all()
    few, _ = seam_shifts(parts, texture, np.ones(110), pairs[:1], np.ones((2, 5)))
    assert abs(few).max() < abs(shift).max()  # one pair moves the parts less than ten


def test_seams_of_nothing():
    empty = Parts(np.zeros(0, np.int32), np.full(4, -1, np.int32), 0)
    assert seam_shifts(empty, np.zeros((4, 5)), np.zeros(4), np.array([[0, 1]]), np.zeros((0, 5)))[0].shape == (0, 5)
    parts = Parts(np.zeros(1, np.int32), np.zeros(4, np.int32), 1)
    assert not seam_shifts(
        parts, np.random.default_rng(0).random((4, 5)), np.ones(4), np.array([[0, 1], [2, 3]]), np.ones((1, 5))
    )[0].any()


def test_anchor_gives_each_part_the_wanted_level():
    parts = Parts(np.array([0, 0, 1], np.int32), np.array([0, 0, 1, -1], np.int32), 2)
    weight = np.array([2.0, 1.0, 4.0, 0.0])
    level, texture = np.random.default_rng(0).random((2, 4, 5))
    moved = texture[:3] + anchor_shifts(parts, level, texture, weight)[parts.of_cell[:3]]
    np.testing.assert_allclose((weight[:2, None] * moved[:2]).sum(0), (weight[:2, None] * level[:2]).sum(0))
    np.testing.assert_allclose(moved[2], level[2])


def test_neighbour_pairs_equal_brute_force():
    rng = np.random.default_rng(0)
    ijk = np.unique(rng.integers(1, 7, (120, 3)), axis=0)
    keys = np.sort(cells.pack_keys(ijk, rng.integers(0, 2, len(ijk))))
    ijk, objects = cells.unpack_keys(keys)
    near = (np.abs(ijk[:, None] - ijk[None]).max(-1) == 1) & (objects[:, None] == objects[None])
    expected = {(a, b) for a, b in np.argwhere(np.triu(near))}
    got = {tuple(sorted(pair)) for pair in cells.neighbour_pairs(keys).tolist()}
    assert got == {tuple(map(int, pair)) for pair in expected} and len(got) > 50
    assert cells.neighbour_pairs(np.zeros(0, np.uint64)).shape == (0, 2)


def test_coarse_cells_are_the_means_of_the_fine_ones():
    ijk = np.array([[1, 1, 1], [3, 3, 3], [4, 4, 4], [3, 3, 3]])
    coarse, objects, values = cells.coarse_cells(ijk, [0, 0, 0, 1], np.arange(20.0).reshape(4, 5))
    rows = {(*c, o): v.tolist() for c, o, v in zip(coarse.tolist(), objects.tolist(), values, strict=True)}
    assert rows == {
        (0, 0, 0, 0): [2.5, 3.5, 4.5, 5.5, 6.5],
        (1, 1, 1, 0): [10, 11, 12, 13, 14],
        (0, 0, 0, 1): [15, 16, 17, 18, 19],
    }
