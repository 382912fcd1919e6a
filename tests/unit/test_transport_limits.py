"""Light transport: extremes of the furnished room, far from the origin, bad input."""

import numpy as np
import pytest

from tests.errors import refused
from tests.unit.transport_rooms import box, constant_cache, lambertian, quad


def test_extremes_are_finite(T, room):
    mirror = T.FaceMaterials(np.tile([0, 0, 0, 0, 1.0], (len(room.faces), 1)))  # black metal, r clamped to 0.02
    bright = T.Emitters(room.geometry, room.radiance * 1e6, room.side)
    grazing = room.normals * 1e-6 + np.cross(room.normals, (0.3, 0.5, 0.8))
    behind = np.cross(room.normals, (0.3, 0.5, 0.8))
    some = slice(0, 300)
    for material in (mirror, room.material):
        for wo in (grazing, behind, room.wo):
            caches = T.shading_caches(
                T.Scene(room.geometry, material, bright),
                room.points[some],
                room.normals[some],
                wo[some],
                [0.02, 1],
                T.PathOptions(8, 6, 0),
            )
            matrix = T.transport_matrix(
                T.Scene(room.geometry, material, None),
                T.ShadingPoints(room.points[some], room.normals[some], wo[some], np.zeros((300, 3)), np.zeros(300), np.ones(300)),
                T.EmitterColumns(room.group, 2, room.side),
                T.PathOptions(8, 6, 0),
            )
            for value in (*caches, *matrix):
                assert np.isfinite(value).all() and (value >= 0).all()
        assert np.isfinite(
            T.render(T.Scene(room.geometry, material, bright), room.origin, room.directions, T.PathOptions(4, 12, 0))
        ).all()
    dark = T.Emitters(room.geometry, np.zeros((len(room.faces), 3)))
    assert not T.render(T.Scene(room.geometry, room.material, dark), room.origin, room.directions, T.PathOptions(2, 4, 0)).any()


def test_light_beyond_float32_is_named_and_does_not_travel(T, room):
    """A few paths to surface of 3e38 add up to infinity."""
    scene = T.Scene(room.geometry, room.material, T.Emitters(room.geometry, np.full((len(room.faces), 3), 3e38)))
    at, paths = (room.points[:50], room.normals[:50], room.wo[:50]), T.PathOptions(8, 2, 0)
    with pytest.raises(ArithmeticError, match="of 150 "):
        T.render(scene, room.origin, room.directions[:50], paths)
    with pytest.raises(ArithmeticError):
        T.shading_caches(scene, *at, [0.02, 1], paths)
    shaded = T.ShadingPoints(*at, np.ones((50, 3)), np.ones(50), np.zeros(50))
    cached = T.Scene(room.geometry, room.material, None, constant_cache(T, [[3e38] * 3]))
    with pytest.raises(ArithmeticError):
        T.transport_matrix(cached, shaded, T.EmitterColumns(room.group, 2, room.side), paths)


def test_sums_over_the_lanes_of_a_point(llvm):
    """Two points of three lanes, with two rows of two numbers a lane; one number that is not finite is named."""
    from iif_core.light.transport.arrays import Batch

    values = np.arange(24, dtype=np.float32).reshape(2, 3, 2, 2)
    batch = Batch(slice(5, 7), 3, 15)
    np.testing.assert_array_equal(batch.collect_rows(llvm.Float(values.ravel()), 2, 2), values.sum(1))
    np.testing.assert_array_equal(batch.collect(llvm.Float(values[:, :, 0, 0].ravel())), values[:, :, 0, 0].sum(1))
    for wrong in (np.nan, np.inf):
        values[1, 2, 0, 0] = wrong
        with pytest.raises(ArithmeticError, match="1 of 8 "):
            batch.collect_rows(llvm.Float(values.ravel()), 2, 2)
        with pytest.raises(ArithmeticError, match="1 of 2 "):
            batch.collect(llvm.Float(values[:, :, 0, 0].ravel()))


def test_far_from_the_origin_nothing_shadows_itself(T):
    """At 5 km a float32 hit is off by 5e-4 m: the offset along the normal must grow with it (Eq. S.12)."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_euler("xyz", (0.4, 0.7, 1.1)).as_matrix()
    corners, faces = box((-1, -1, -1), (1, 1, 1), inward=True)
    directions = np.random.default_rng(0).normal(size=(3000, 3))
    material, rho = lambertian(0.5)
    seen = []
    for shift in (np.zeros(3), np.array([5000.0, -4000, 3000])):
        geometry = T.build_geometry(corners @ turn.T + shift, faces, np.zeros(12, np.int32))
        emitters = T.Emitters(geometry, np.ones((12, 3)), np.ones(12), sampling_weight=np.zeros(12))
        seen.append(T.render(T.Scene(geometry, material, emitters), shift, directions, T.PathOptions(32, 1, 0))[:, 0])
    assert 1 + rho < seen[0].mean() < 1 + rho + 0.01
    assert seen[1].mean() == pytest.approx(seen[0].mean(), rel=5e-3)


def test_bad_input_is_named(T, room):
    square = quad((0, 0, 0), (1, 0, 0), (0, 1, 0))
    with refused("mesh", "1e-12", 1):
        T.build_geometry(np.zeros((3, 3)), [[0, 1, 2]], [0])
    with refused("0 ... 9", "0 ... 3"):
        T.build_geometry(square[0], [[0, 1, 9]], [0])
    with refused("faces", "NaN"):
        T.build_geometry(np.full((4, 3), np.nan), square[1], [0, 0])
    with refused("object_id", "(1,)", "(2,)"):
        T.build_geometry(*square, [0])
    geometry = T.build_geometry(*square, [0, 0])
    with refused("emitter radiance", -1):
        T.Emitters(geometry, -np.ones((2, 3)))
    with refused("emitter side", "(2,)"):
        T.Emitters(geometry, np.ones((2, 3)), [2, 0])
    with refused("face_values", "NaN"):
        T.FaceMaterials(np.full((2, 5), np.nan))
    with refused("roughness levels", "[0.5, 0.1]", "[0.02, 1]"):
        T.shading_caches(
            T.Scene(room.geometry, room.material, room.emitters),
            room.points,
            room.normals,
            room.wo,
            [0.5, 0.1],
            T.PathOptions(1, 1, 0),
        )
    with refused("samples=0", "max_bounces=5"):
        room.render(T, 0, seed=0)
    with refused("directions"):
        T.render(T.Scene(room.geometry, room.material, room.emitters), [0, 0, 0], np.zeros((1, 3)), T.PathOptions(1, 1, 0))
    with refused("emitter_of_face", "(40,)", "-1 ... 0"):
        T.transport_matrix(
            T.Scene(room.geometry, room.material, None),
            T.ShadingPoints(room.points, room.normals, room.wo, room.base_color, room.roughness, room.metallic),
            T.EmitterColumns(room.group, 1, room.side),
            T.PathOptions(1, 1, 0),
        )
    none = np.zeros((0, 3), np.float32)
    assert T.render(T.Scene(room.geometry, room.material, room.emitters), none, none, T.PathOptions(1, 1, 0)).shape == (0, 3)
    assert T.shading_caches(
        T.Scene(room.geometry, room.material, room.emitters), none, none, none, [0.5], T.PathOptions(1, 1, 0)
    )[1].shape == (0, 1, 3)
