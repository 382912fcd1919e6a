"""Light transport: determinism, rays, drawing of lights, materials of cells."""

import numpy as np
import pytest

from iif_core.reflectance import brdf
from iif_core.surface import cells
from iif_core.surface.lookup import values_at
from tests.errors import refused
from tests.unit.transport_rooms import constant_cache, merge, quad, repeated


def test_reruns_chunks_and_threads_do_not_change_a_bit(T, room):
    import drjit as dr

    pick = np.arange(0, len(room.points), 2)
    levels = [0.02, 0.3, 1.0]

    def everything(chunk):
        parts = (room.points[pick], room.normals[pick], room.wo[pick])
        du = np.float32([1 / 26, 0, 0])
        rendered = T.render(
            T.Scene(room.geometry, room.material, room.emitters, constant_cache(T, (1, 2, 3), low=(-6, -6, -3), count=12)),
            room.origin,
            room.directions[pick],
            T.PathOptions(8, 4, 9, chunk),
            (du, du),
        )
        scene, paths = T.Scene(room.geometry, room.material, room.emitters), T.PathOptions(8, 4, 9, chunk)
        caches = T.shading_caches(scene, *parts, levels, paths)
        points = T.ShadingPoints(*parts, room.base_color[pick], room.roughness[pick], room.metallic[pick])
        matrix = T.transport_matrix(scene, points, T.EmitterColumns(room.group, 2, room.side), paths)
        return b"".join(a.tobytes() for a in (rendered, *caches, *matrix))

    first = everything(1 << 18)
    assert first == everything(1 << 18)
    assert first == everything(333)
    dr.set_thread_count(1)
    try:
        assert first == everything(1 << 18)
    finally:
        dr.set_thread_count(2)


def test_lanes_and_seeds_are_independent(T, room):
    n = 4000
    same = (repeated(room.origin, n), repeated(room.directions[len(room.directions) // 2], n))

    def run(seed):
        scene = T.Scene(room.geometry, room.material, room.emitters)
        return T.render(scene, *same, T.PathOptions(1, 5, seed))[:, 0].astype(np.float64)

    a, b, c = run(0), run(1), run(2**63 + 1)
    assert len(np.unique(a)) > 0.5 * n
    for left, right in ((a, b), (a, c), (b, c), (a[:-1], a[1:]), (a[:-2], a[2:])):
        assert abs(np.corrcoef(left, right)[0, 1]) < 4 / np.sqrt(n)


def test_trace_agrees_with_open3d(T, room):
    open3d = pytest.importorskip("open3d")
    rng = np.random.default_rng(1)
    origins = rng.uniform((0.1, 0.1, 0.1), (3.9, 2.9, 2.4), (20000, 3)).astype(np.float32)
    directions = (rng.normal(size=(20000, 3)) * rng.uniform(0.1, 5, (20000, 1))).astype(np.float32)
    face, t = T.trace(room.geometry, origins, directions, chunk=7001)
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(open3d.core.Tensor(room.vertices.astype(np.float32)), open3d.core.Tensor(room.faces.astype(np.uint32)))
    other = scene.cast_rays(open3d.core.Tensor(np.concatenate([origins, directions], 1)))
    assert np.mean(face == other["primitive_ids"].numpy().astype(np.int64)) > 0.9995
    np.testing.assert_allclose(t, other["t_hit"].numpy(), rtol=1e-4)
    missed, far = T.trace(room.geometry, [[9, 9, 9]], [[1, 0, 0]])
    assert missed.tolist() == [-1] and np.isinf(far).all()
    empty = T.trace(room.geometry, np.zeros((0, 3)), np.zeros((0, 3)))
    assert empty[0].dtype == np.int32 and empty[0].shape == empty[1].shape == (0,)


def test_degenerate_faces_keep_their_ids(T):
    vertices, faces = quad((-1, -1, 0), (2, 0, 0), (0, 2, 0))
    vertices = np.concatenate([vertices, [[0, 0, 0.5], [0.5, 0, 0.5], [1, 0, 0.5]]])  # a sliver without area
    faces = np.array([[4, 5, 6], faces[0], [4, 4, 5], faces[1]])
    geometry = T.build_geometry(vertices, faces, np.arange(4))
    assert geometry.areas.tolist() == [0, 2, 0, 2]
    assert np.allclose(np.linalg.norm(geometry.normals, axis=1), 1)
    face, t = T.trace(geometry, [[0.5, -0.5, 1], [-0.5, 0.5, 1], [0.25, 0, 1]], repeated((0, 0, -1), 3))
    assert face[:2].tolist() == [1, 3] and face[2] in (1, 3) and np.allclose(t, 1)
    emitters = T.Emitters(geometry, np.ones((4, 3)))
    assert set(emitters.slots) == {1, 3} and emitters.pdf_area[[0, 2]].tolist() == [0, 0]
    colours = T.FaceMaterials(np.tile([0.5, 0.5, 0.5, 0.5, 0], (4, 1)))
    assert np.isfinite(
        T.render(T.Scene(geometry, colours, emitters), [0, 0, 1], repeated((0.1, 0, -1), 5), T.PathOptions(8, 3, 0))
    ).all()


def test_light_slots_have_the_density_they_report(T):
    rng = np.random.default_rng(0)
    parts = [quad((x, 0, 0), (w, 0, 0), (0, 1, 0)) for x, w in enumerate(rng.uniform(0.01, 0.9, 40))]
    geometry = T.build_geometry(*merge(parts))
    weight = np.where(np.arange(80) % 3 == 0, 0, rng.uniform(0, 1, 80) ** 8)
    emitters = T.Emitters(geometry, np.zeros((80, 3)), sampling_weight=weight)
    counts = np.bincount(emitters.slots, minlength=80)
    np.testing.assert_allclose(emitters.pdf_area * geometry.areas, counts / len(emitters.slots), rtol=1e-6)
    assert ((counts > 0) == (weight > 0)).all() and counts.sum() == len(emitters.slots)
    assert np.abs(counts / counts.sum() - weight / weight.sum()).max() < 80 / len(emitters.slots)
    assert np.sum(emitters.pdf_area * geometry.areas) == pytest.approx(1)


def test_rounding_does_not_decide_between_faces_of_equal_weight(T):
    """100 faces of equal area share 4096 slots, some one more than others: which ones does not depend on the last bits."""
    geometry = T.build_geometry(*merge([quad((x, 0, 0), (0.9, 0, 0), (0, 1, 0)) for x in range(50)]))
    rng = np.random.default_rng(2)
    slots = []
    for _ in range(10):
        weight = np.where(np.arange(100) % 2, 0.3, 0.7) * (1 + rng.integers(-4, 5, 100) * np.finfo(np.float32).eps)
        slots.append(T.Emitters(geometry, np.zeros((100, 3)), sampling_weight=weight).slots)
    assert all((one == slots[0]).all() for one in slots)


def test_sampling_weights_do_not_change_the_mean(T, room):
    n, direction = 6000, room.directions[len(room.directions) // 2]
    means = []
    for weight in (None, room.geometry.areas, np.where(room.group == 0, 1.0, 0.0), np.zeros(len(room.faces))):
        emitters = T.Emitters(room.geometry, room.radiance, room.side, sampling_weight=weight)
        seen = T.render(
            T.Scene(room.geometry, room.material, emitters),
            repeated(room.origin, n),
            repeated(direction, n),
            T.PathOptions(32, 3, 4),
        )
        means.append((seen[:, 0].mean(), seen[:, 0].std() / np.sqrt(n)))
    for mean, error in means[1:]:
        assert abs(mean - means[0][0]) < 3.5 * np.hypot(error, means[0][1])


def test_cell_materials_read_what_numpy_reads(T, room):
    import mitsuba as mi

    edge = 0.11
    origin = cells.grid_origin(room.vertices, edge)
    ijk = cells.voxel_indices(room.points, edge, origin)
    keys = np.unique(cells.pack_keys(ijk, room.object))[::2]  # half of the cells were never seen
    rng = np.random.default_rng(3)
    values = rng.uniform(0, 1, (len(keys), 5)).astype(np.float32)
    values[:10, 3] = 0  # below the smallest roughness
    means = rng.uniform(0.1, 1, (3, 5)).astype(np.float32)
    material = T.CellMaterials(edge, origin, *cells.unpack_keys(keys), values, means)
    objects = np.where(np.arange(len(ijk)) % 50 == 0, -1, room.object).astype(np.int32)
    far = np.array([[1e9, 0, 0], [-1e9, 0, 0], [2, 1, 1e4]], np.float32)
    points = np.concatenate([room.points, far]).astype(np.float32)
    objects = np.concatenate([objects, [0, 1, 2]]).astype(np.int32)
    color, roughness, metallic = material(mi.Point3f(points.T), mi.UInt32(0), mi.Int32(objects), mi.Bool(True))
    got = np.column_stack([color.numpy().T, roughness.numpy(), metallic.numpy()])

    table = cells.CellTable.build(keys)
    row = np.append(table.lookup(cells.pack_keys(ijk, objects[: len(ijk)])), [-1, -1, -1])
    fallback = np.where(objects[:, None] >= 0, means[objects], means.mean(0))
    coarse_ijk, coarse_object, coarse = cells.coarse_cells(*cells.unpack_keys(keys), values)
    around = cells.CellTable.build(cells.pack_keys(coarse_ijk, coarse_object))
    near = np.append(around.lookup(cells.pack_keys(ijk >> cells.COARSE_SHIFT, objects[: len(ijk)])), [-1, -1, -1])
    assert 0 < np.mean((row < 0) & (near >= 0)) < np.mean(row < 0)  # all three cases occur
    fallback = np.where(near[:, None] >= 0, coarse[near], fallback)
    expected = np.where(row[:, None] >= 0, values[row], fallback)
    expected[:, 3] = np.maximum(expected[:, 3], brdf.R_MIN)
    assert 0.2 < np.mean(row >= 0) < 0.8
    np.testing.assert_array_equal(got, expected.astype(np.float32))
    on_host, _ = values_at(room.points, objects[: len(ijk)], edge, origin, *cells.unpack_keys(keys), values, means)
    on_host[:, 3] = np.maximum(on_host[:, 3], brdf.R_MIN)
    np.testing.assert_array_equal(on_host, got[: len(ijk)])
    assert np.isfinite(room.render(T, 2, seed=0)).all()
    rendered = T.render(T.Scene(room.geometry, material, room.emitters), room.origin, room.directions, T.PathOptions(2, 3, 0))
    assert np.isfinite(rendered).all() and rendered.mean() > 0


def test_repainted_materials_are_those_built_anew(T, room):
    import mitsuba as mi

    edge, origin = 0.11, cells.grid_origin(room.vertices, 0.11)
    seen = cells.unpack_keys(np.unique(cells.pack_keys(cells.voxel_indices(room.points, edge, origin), room.object))[::2])
    rng = np.random.default_rng(4)
    before, after = ((rng.uniform(0.1, 1, (len(seen[0]), 5)), rng.uniform(0.1, 1, (n, 5))) for n in (3, 4))
    first = T.CellMaterials(edge, origin, *seen, *before)
    at = mi.Point3f(room.points.T), mi.UInt32(0), mi.Int32(room.object.astype(np.int32)), mi.Bool(True)

    def read(material):
        colour, roughness, metallic = material(*at)
        return np.column_stack([colour.numpy().T, roughness.numpy(), metallic.numpy()])

    old = read(first)
    np.testing.assert_array_equal(read(first.repainted(*after)), read(T.CellMaterials(edge, origin, *seen, *after)))
    np.testing.assert_array_equal(read(first), old)
    with refused("CellMaterials", "object_values"):
        first.repainted(before[0], np.zeros((0, 5)))
