"""Kernels of light transport are compiled once, and not for each view, scene or number of emitters."""

import contextlib

import numpy as np
import pytest

from iif_core.light.transport.arrays import on_device
from tests.unit.transport_rooms import ROOM_MATERIALS, Room

SLOW_OPERATIONS = 1000
"""Smaller kernels, such as those that copy results, compile in milliseconds."""


@contextlib.contextmanager
def recorded(kernels):
    """Add the hashes of the kernels of a path tracer that are launched inside to a set."""
    import drjit as dr

    dr.kernel_history_clear()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        yield
        history = [entry for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT]
        kernels |= {entry["hash"] for entry in history if entry["operation_count"] >= SLOW_OPERATIONS}


@pytest.mark.parametrize("shape", [(7,), (5, 3), (0,), (1, 1)])
def test_values_reach_the_device(T, shape):
    import mitsuba as mi

    values = np.arange(100, dtype=np.float32)[3 : 3 + int(np.prod(shape))].reshape(shape)
    for kind in (mi.Float, mi.UInt32, mi.Int32):
        assert on_device(values[::-1], kind).numpy().tolist() == values[::-1].ravel().tolist()
    assert on_device(np.uint32([0, 2**32 - 1]), mi.UInt32).numpy().tolist() == [0, 2**32 - 1]


def cells_around(T, room, edge, number):
    """Materials and cache of a room in voxels that differ in size, origin and number."""
    from iif_core.surface.cells import voxel_indices

    rng, origin = np.random.default_rng(number), (-0.1 * number, -0.2, -0.3)
    ijk = np.unique(voxel_indices(rng.uniform((0, 0, 0), (4, 3, 2.5), (number, 3)), edge, origin), axis=0)
    values = rng.uniform(0.1, 0.9, (len(ijk), 5))
    material = T.CellMaterials(edge, origin, ijk, rng.integers(-1, 5, len(ijk)), values, ROOM_MATERIALS[: 2 + number % 3])
    return material, T.RadianceCache(edge, origin, ijk, values[:, :3])


def everything(T, room, number, seed):
    """Render, shade and trace the transport of some points of a room."""
    material, cache = cells_around(T, room, 0.1 + 0.01 * number**0.5, number)
    pick = np.arange(seed, len(room.points), 3)
    paths = T.PathOptions(8, 4, seed)
    scene = T.Scene(room.geometry, material, room.emitters, cache)
    parts = (room.points[pick], room.normals[pick], room.wo[pick])
    T.render(scene, room.origin, room.directions[pick], paths, (room.directions[pick], np.float32([0.01 * seed, 0, 0])))
    T.shading_caches(scene, *parts, [0.1, 0.5], paths)
    points = T.ShadingPoints(*parts, room.base_color[pick], room.roughness[pick], room.metallic[pick])
    emitting = np.flatnonzero(room.group >= 0)
    group = np.full(len(room.group), -1)
    group[emitting] = np.arange(len(emitting)) % min(1 + seed, len(emitting))
    T.transport_matrix(scene, points, T.EmitterColumns(group, group.max() + 1, room.side), paths)
    T.trace(room.geometry, room.points[pick], room.directions[pick])


def test_other_views_scenes_and_seeds_compile_nothing(T, room):
    first, later = set(), set()
    with recorded(first):
        everything(T, room, 300, 0)
    other = Room(T)
    with recorded(later):
        for number, seed in ((20, 1), (5000, 2), (800, 3)):
            everything(T, other, number, seed)
    assert len(first) == 3
    assert later == first
