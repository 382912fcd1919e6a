"""Voxel keys and their hash table, against a dictionary."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from iif_core.surface import cells
from iif_core.surface.lookup import values_at
from tests.errors import refused

index = st.integers(0, cells.INDEX_LIMIT - 1)
key_parts = st.tuples(index, index, index, st.integers(-1, cells.INDEX_LIMIT - 2))


@settings(max_examples=100, deadline=None)
@given(st.lists(key_parts, max_size=200))
def test_keys_are_unique_and_reversible(parts):
    parts = np.array(parts, np.int64).reshape(-1, 4)
    keys = cells.pack_keys(parts[:, :3], parts[:, 3])
    assert keys.dtype == np.uint64
    ijk, objects = cells.unpack_keys(keys)
    assert (ijk == parts[:, :3]).all() and (objects == parts[:, 3]).all()
    assert len(np.unique(keys)) == len(np.unique(parts, axis=0))


@settings(max_examples=100, deadline=None)
@given(
    st.lists(st.integers(0, 2**64 - 1), max_size=300, unique=True),
    st.lists(st.integers(0, 2**64 - 1), max_size=50),
)
def test_table_is_a_dictionary(present, asked):
    table = cells.CellTable.build(np.array(present, np.uint64))
    rows = {key: row for row, key in enumerate(present)}
    found = table.lookup(np.array(present + asked, np.uint64))
    assert found.dtype == np.int32
    assert found.tolist() == [rows.get(key, -1) for key in present + asked]
    size = len(table.slots)
    assert size & (size - 1) == 0 and table.probes <= cells.MAX_PROBES


def test_large_dense_grid_and_reproducible_bytes():
    axis = np.arange(47)
    ijk = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    keys = cells.pack_keys(ijk, 5)
    table = cells.CellTable.build(keys)
    assert (table.lookup(keys) == np.arange(len(keys))).all()
    assert (table.lookup(cells.pack_keys(ijk, 6)) == -1).all()
    assert len(table.slots) <= 16 * len(keys)
    assert table.slots.tobytes() == cells.CellTable.build(keys).slots.tobytes()


def test_one_object_many_neighbours_do_not_collide_too_often():
    ijk = np.stack([np.arange(60000) % 300, np.arange(60000) // 300, np.full(60000, 1)], -1)
    table = cells.CellTable.build(cells.pack_keys(ijk, 0))
    h = cells.hash_words(*(x for x in cells._words(cells.pack_keys(ijk, 0))))
    used = len(np.unique(h & np.uint32(len(table.slots) - 1)))
    expected = len(table.slots) * (1 - np.exp(-60000 / len(table.slots)))
    assert used == pytest.approx(expected, rel=0.02)


@settings(max_examples=100, deadline=None)
@given(st.tuples(*[st.floats(-100, 100, width=32)] * 3), st.floats(0.003, 1))
def test_point_lies_in_its_voxel(point, edge):
    origin = np.array([-100.5, -100.25, -101], np.float32)
    ijk = cells.voxel_indices([point], edge, origin)
    assert ijk.dtype == np.int32
    low = origin.astype(np.float64) + ijk[0] * edge
    slack = 1e-6 * (np.abs(point) + 101) * 2 + 1e-6 * np.abs(ijk[0]) * edge
    assert (low - slack <= point).all() and (point <= low + edge + slack).all()


def test_grid_origin_keeps_round_walls_off_voxel_faces():
    corners = np.array([[0, 0, 0], [5, 4, 2.5]])
    origin = cells.grid_origin(corners, 0.025)
    walls = np.repeat(corners, 2, axis=0) + np.array([[-1e-5], [1e-5], [-1e-5], [1e-5]])
    ijk = cells.voxel_indices(walls, 0.025, origin)
    assert ijk.min() >= 1 and (ijk[0] == ijk[1]).all() and (ijk[2] == ijk[3]).all()


def test_bad_input_is_named():
    with refused("voxel indices", "-1 ... 0", "0 ... 65535", "grid_origin"):
        cells.pack_keys([[-1, 0, 0]])
    with refused("voxel indices", "0 ... 65536", "0 ... 65535", "grid_origin"):
        cells.pack_keys([[0, 65536, 0]])
    with refused("object ids", "65535 ... 65535", "-1 ... 65534"):
        cells.pack_keys([[0, 0, 0]], 65535)
    with refused("voxel edge", 0):
        cells.voxel_indices([[0, 0, 0]], 0, (0, 0, 0))
    with refused("voxel_indices", "points", "NaN"):
        cells.voxel_indices([[np.nan, 0, 0]], 1, (0, 0, 0))
    with refused("voxel edge", "1e-05", "1000000.0"):
        cells.voxel_indices([[1e6, 0, 0]], 1e-5, (0, 0, 0))
    with refused("CellTable.build", "keys"):
        cells.CellTable.build([3, 3])
    with refused("grid_origin: "):
        cells.grid_origin(np.zeros((0, 3)), 1)
    assert cells.CellTable.build([]).lookup([1, 2]).tolist() == [-1, -1]
    assert cells.voxel_indices(np.zeros((0, 3)), 1, (0, 0, 0)).shape == (0, 3)


def test_lowest_row_gets_a_slot_that_several_ask_for():
    """The table does not depend on how NumPy orders writes to one place: the same keys, slot by slot, in plain Python."""
    keys = np.random.default_rng(5).choice(1 << 40, 300, replace=False).astype(np.uint64)
    table = cells.CellTable.build(keys)
    low, high = (keys & np.uint64(0xFFFFFFFF)).astype(np.uint32), (keys >> np.uint64(32)).astype(np.uint32)
    h = cells.hash_words(low, high)
    step, size = cells.probe_step(h), len(table.slots)
    owner, waiting = {}, list(range(len(keys)))
    for probe in range(table.probes):
        asked = {}
        for row in waiting:
            slot = int((int(h[row]) + probe * int(step[row])) % size)
            if slot not in owner:
                asked.setdefault(slot, row)
        owner |= asked
        waiting = [row for row in waiting if row not in owner.values()]
    assert not waiting
    found = {int(slot): int(table.slots[slot, 2]) for slot in np.flatnonzero(table.slots[:, 2] != cells.EMPTY)}
    assert found == owner


def test_values_without_cells_are_those_of_the_object_and_far_points_find_none():
    means = np.float32([[1, 2], [3, 6]])
    none = np.zeros((0, 3), np.int32), np.zeros(0, np.int32), np.zeros((0, 2), np.float32)
    found, _ = values_at(np.zeros((4, 3)), [0, 1, -1, 7], 0.1, np.zeros(3), *none, means)
    np.testing.assert_array_equal(found, np.float32([[1, 2], [3, 6], [2, 4], [2, 4]]))
    one = np.int32([[1, 1, 1]]), np.int32([0]), np.float32([[8, 9]])
    points = [[0.15, 0.15, 0.15], [0.35, 0.35, 0.35], [-0.05, 0, 0], [1e4, 0, 0]]  # in the cell, around it, outside of the grid
    found, row = values_at(points, [0, 0, 0, 0], 0.1, np.zeros(3), *one, means)
    np.testing.assert_array_equal(found, np.float32([[8, 9], [8, 9], [1, 2], [1, 2]]))
    np.testing.assert_array_equal(row, [0, -1, -1, -1])  # around it nothing was observed, though its mean is known
    with refused("values_at", "object_values"):
        values_at(points, 0, 0.1, np.zeros(3), *one, means[:0])
    with refused("points", "NaN"):
        values_at([[np.nan, 0, 0]], [0], 0.1, np.zeros(3), *one, means)
