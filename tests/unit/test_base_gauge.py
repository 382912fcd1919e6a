"""Levels that no view ties together: parts, anchors, seams."""

from dataclasses import replace

import numpy as np

from iif_core import cells
from iif_core.base.direct import BaseOptions, solve_base
from iif_core.base.gauge import Parts, anchor_shifts, covisible_parts, seam_shifts
from iif_core.base.problem import BaseProblem


def two_sides(level=(0.4, 0.6), size=20):
    """One wall, its left half in one view and its right half in the other; the predictions' levels differ."""
    cell = np.arange(2 * size * size, dtype=np.int32).reshape(size, 2 * size)
    x = np.linspace(0, 3, 2 * size)[None, :, None]
    wall = 0.05 * np.sin(7 * x) * np.ones((size, 1, 5))
    left, right = (wall[:, :size] + level[0])[None], (wall[:, size:] + level[1])[None]
    pairs = np.concatenate(
        [np.stack([cell[:, :-1].ravel(), cell[:, 1:].ravel()], 1), np.stack([cell[:-1], cell[1:]], -1).reshape(-1, 2)]
    )
    maps = [cell[:, :size].copy(), cell[:, size:].copy()]
    segments = [np.zeros((size, size), np.int32), np.ones((size, size), np.int32)]
    problem = BaseProblem([left, right], maps, segments, cell.size, np.zeros(cell.size, np.int32), np.zeros(2, np.int32))
    return replace(problem, neighbours=pairs.astype(np.int32)), cell


def step(value, cell):
    size = cell.shape[0]
    return float((value[cell[:, size], 0] - value[cell[:, size - 1], 0]).mean())


def test_seam_between_parts_is_closed_and_the_mean_kept():
    problem, cell = two_sides()
    assert covisible_parts(problem).count == 2
    open_, closed = (solve_base(problem, BaseOptions(seams=s)) for s in (False, True))
    assert step(open_.value, cell) > 0.18
    assert abs(step(closed.value, cell)) < 0.1 * step(open_.value, cell)
    np.testing.assert_allclose(closed.value.mean(0), open_.value.mean(0), atol=1e-3)  # equal parts meet half-way


def test_corrections_move_with_the_seam():
    """T v is still the texture: what moved is the gauge."""
    problem, _ = two_sides()
    result = solve_base(problem)
    for view in range(2):
        v = problem.predictions[view].reshape(-1, 5)
        albedo = v[:, :3] @ result.affine_albedo[view, 0, :, :3].T + result.affine_albedo[view, 0, :, 3]
        np.testing.assert_allclose(albedo, result.value[problem.cell_of_pixel[view].ravel(), :3], atol=5e-3)


def test_objects_that_hang_together_have_no_seam_to_close():
    problem, _ = two_sides()
    shared = np.minimum(problem.cell_of_pixel[1], problem.cell_of_pixel[1].min() + 5)
    shared[0, 0] = problem.cell_of_pixel[0][0, 0]  # one common cell
    joined = replace(problem, cell_of_pixel=[problem.cell_of_pixel[0], shared])
    parts = covisible_parts(joined)
    assert parts.count == 1
    a, b = (solve_base(joined, BaseOptions(seams=s)).value for s in (False, True))
    np.testing.assert_array_equal(a, b)


def test_small_part_moves_to_the_large_one():
    texture = np.concatenate([np.full((100, 5), 0.5), np.full((10, 5), 0.7)])
    parts = Parts(np.arange(2, dtype=np.int32), np.repeat([0, 1], [100, 10]).astype(np.int32), 2)
    pairs = np.stack([np.arange(90, 100), np.arange(100, 110)], 1)
    shift, count = seam_shifts(parts, texture, np.ones(110), pairs)
    assert count.tolist() == [10, 10]
    assert abs(shift[0]).max() < 0.02 and (shift[1] < -0.12).all()
    few, _ = seam_shifts(parts, texture, np.ones(110), pairs[:1])
    assert abs(few).max() < abs(shift).max()  # one pair says little


def test_seams_of_nothing():
    empty = Parts(np.zeros(0, np.int32), np.full(4, -1, np.int32), 0)
    assert seam_shifts(empty, np.zeros((4, 5)), np.zeros(4), np.array([[0, 1]]))[0].shape == (0, 5)
    parts = Parts(np.zeros(1, np.int32), np.zeros(4, np.int32), 1)
    assert not seam_shifts(parts, np.random.default_rng(0).random((4, 5)), np.ones(4), np.array([[0, 1], [2, 3]]))[0].any()


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
