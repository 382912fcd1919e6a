"""The grid of cells that pixels fall into, values of cells at any point, and size and weight of pixels."""

import numpy as np

from iif_core.fusion.gauge import parts_per_object
from iif_core.fusion.pixels import FOOTPRINT_WEIGHTS, pixel_weights, relative_footprints, surface_tangents
from iif_core.surface.cell_grid import CellValues, build_cell_grid, median_footprint, smallest_edge
from iif_core.surface.cells import unpack_keys

CORNERS = np.array([[0.0, 0, 0], [1, 1, 1]])


def views(seed=0, n=500):
    rng = np.random.default_rng(seed)
    return [(rng.random((n, 3)).astype(np.float32), rng.integers(0, 3, n)) for _ in range(3)]


def test_pixels_of_a_cell_share_voxel_and_object():
    seen = views()
    grid, rows = build_cell_grid(seen, CORNERS, 0.25)
    assert (np.diff(grid.keys.astype(object)) > 0).all()
    cell, points, objects = np.concatenate(rows), np.concatenate([p for p, _ in seen]), np.concatenate([o for _, o in seen])
    voxel, object_id = unpack_keys(grid.keys)
    np.testing.assert_array_equal(voxel[cell], np.floor((points - grid.origin) / np.float32(0.25)))
    np.testing.assert_array_equal(object_id[cell], objects)
    np.testing.assert_array_equal(grid.object_id, object_id)
    assert len(np.unique(cell)) == len(grid)
    for i in (0, len(grid) // 2, len(grid) - 1):
        np.testing.assert_allclose(grid.centre[i], points[cell == i].mean(0), rtol=1e-5)


def test_a_grid_of_no_pixels_is_empty():
    assert len(build_cell_grid([], CORNERS, 0.1)[0]) == 0
    nothing = (np.zeros((0, 3), np.float32), np.zeros(0, int))
    grid, rows = build_cell_grid([nothing], CORNERS, 0.1)
    assert len(grid) == 0 and rows[0].shape == (0,)


def test_smallest_edge_fits_into_the_keys():
    edge = smallest_edge(100 * CORNERS)
    points = (100 * CORNERS).astype(np.float32)
    assert len(build_cell_grid([(points, np.zeros(2, int))], points, edge)[0]) == 2


def test_median_footprint_leaves_out_views_without_surface():
    assert median_footprint([(np.array([1.0, 2, 9]), 100.0), (np.zeros(0), 50.0), (np.array([8.0]), 100.0)]) == 0.05
    assert median_footprint([(np.zeros(0), 50.0)]) is None


def test_values_come_from_the_cell_the_block_around_or_the_fallback():
    points = np.array([[0.1, 0.1, 0.1], [0.2, 0.1, 0.1], [2.0, 2.0, 2.0]], np.float32)
    grid, (rows,) = build_cell_grid([(points, np.zeros(3, int))], np.array([[0.0, 0, 0], [3, 3, 3]]), 0.1)
    values = np.arange(6, dtype=np.float32).reshape(3, 2)
    near = grid.origin + 0.1 * (4 * (unpack_keys(grid.keys)[0][rows[2]] // 4) + 0.5)  # the block's first voxel
    asked = np.concatenate([points, [near], [[0.9, 0.9, 0.9]], points[:1]]).astype(np.float32)
    objects = np.array([0, 0, 0, 0, 0, 1])
    got, cell = CellValues(grid, values).at(asked, objects, np.full((6, 2), -5.0))
    np.testing.assert_array_equal(got[:3], values[rows])
    np.testing.assert_array_equal(cell, [*rows, -1, -1, -1])
    np.testing.assert_array_equal(got[3], values[rows[2]])
    np.testing.assert_array_equal(got[4:], -5.0)  # far from all cells, and another object's


def test_footprints_grow_with_depth_and_slope():
    direction = np.broadcast_to([0.0, 0.0, 1.0], (1, 4, 3))
    normal = np.array([[[0, 0, -1.0], [0, 0, -1.0], [0, np.sqrt(0.75), 0.5], [0, 0, -1.0]]])
    depth = np.array([[1.0, 2.0, 1.0, 0.0]])
    (size,) = relative_footprints([(depth, direction, normal, 50.0)])
    np.testing.assert_allclose(size, [[1 / np.sqrt(2), np.sqrt(2), 1.0, 1.0]])


def test_pixel_weights():
    interior, valid = np.array([[True, True, False, True]]), np.array([[True, True, True, False]])
    footprint = np.array([[0.5, 100.0, 1.0, 1.0]])
    np.testing.assert_allclose(pixel_weights(interior, valid, 0.1), [[1, 1, 0.1, 0]])
    np.testing.assert_allclose(pixel_weights(interior, valid, 0.1, footprint, 1.0), [[2, FOOTPRINT_WEIGHTS[0], 0.1, 0]])


def test_tangents_at_grazing_angles_are_limited():
    direction = np.stack([*np.meshgrid(np.linspace(-0.1, 0.1, 5), np.linspace(-0.1, 0.1, 4)), np.ones((4, 5))], -1)
    normal = np.broadcast_to([1.0, 0, 1e-9], direction.shape)  # a plane that contains the line of sight
    tangent = surface_tangents(np.full((4, 5), 2.0), direction, normal)
    across = 2.0 * np.linalg.norm(np.gradient(direction, axis=1), axis=-1)
    assert (np.linalg.norm(tangent[..., 0, :], axis=-1) <= 5.0 * across * (1 + 1e-6)).all() and np.isfinite(tangent).all()
    assert not surface_tangents(np.zeros((4, 5)), direction, normal).any()


def test_parts_per_object_names_objects_in_several_parts():
    assert parts_per_object(np.array([3, 3, 3, 7, 7, 8]), np.array([0, 1, 1, 2, 2, -1])) == {3: 2}
    assert parts_per_object(np.zeros(0, int), np.zeros(0, int)) == {}
