"""The rooms of the test bed: furnished, photographed from inside, closed where no window is open."""

import numpy as np
import pytest

from iif_core.surface.triangles import face_geometry
from lab import rooms
from lab.rooms.bed import KINDS, environment


@pytest.fixture(scope="module", params=KINDS)
def room(request):
    return rooms.build(request.param)


def test_rooms_are_furnished_and_the_same_every_time(room):
    again = rooms.build(room.name)
    for name in ("vertices", "faces", "object_id", "emission", "shots"):
        np.testing.assert_array_equal(getattr(room, name), getattr(again, name))
    assert len(room.names) >= 20 and len(np.unique(room.object_id)) == len(room.names)
    albedo, roughness, metallic = room.materials.numpy(room.vertices[room.faces[:, 0]], room.object_id)
    assert (albedo >= 0).all() and (albedo <= 1).all() and (roughness >= 0.02).all() and (roughness <= 1).all()
    assert set(np.unique(metallic)) <= {0.0, 1.0}


def test_cameras_stand_free_and_apart(room):
    eyes = np.array([pose[:3, 3] for pose in room.cameras(24)])
    assert all(room.is_free(eye, 0.05) for eye in eyes)
    apart = np.linalg.norm(eyes[:, None] - eyes[None], axis=2) + 10 * np.eye(24)
    assert apart.min() > 0.1


def test_light_enters_as_the_kind_says(llvm, room):
    """No ray of a camera leaves a room without an open window; a room is lit by something."""
    from iif_core.light.transport.geometry import build_geometry, trace

    geometry = build_geometry(room.vertices, room.faces, room.object_id)
    rng = np.random.default_rng(0)
    way = rng.normal(size=(4000, 3))
    escaped = [float((trace(geometry, pose[:3, 3], way)[0] < 0).mean()) for pose in room.cameras(12)]
    light = KINDS[room.name][1]
    assert (max(escaped) > 0.003) == (light.sky is not None)
    assert light.sky is not None or room.emission.any()
    assert (room.environment is None) == (light.sky is None)


@pytest.mark.parametrize("name", ["blinds", "curtains"])
def test_what_hangs_in_a_window_is_closed_in_the_mesh_that_is_delivered(name):
    room = rooms.build(name)
    scan = room.scan
    assert len(room.scanned) == KINDS[name][1].windows
    for number in room.scanned:
        gaps = face_geometry(room.vertices, room.faces[room.object_id == number])[1].sum()
        closed = face_geometry(scan.vertices, scan.faces[scan.object_id == number])[1].sum()
        assert 0.3 < gaps / closed < 1.2 if name == "blinds" else 0.4 < gaps / closed < 0.6
        assert not scan.emission[scan.object_id == number].any()
    others = ~np.isin(room.object_id, list(room.scanned))
    assert np.count_nonzero(others) == np.count_nonzero(~np.isin(scan.object_id, list(room.scanned)))


def test_one_object_has_all_materials():
    scan = rooms.build("single").scan
    assert scan.names == ("room",) and not scan.object_id.any() and len(np.unique(scan.material_id)) >= 20


def test_the_sun_stands_where_it_should():
    light = KINDS["sun"][1]
    sky = environment(light)
    row, column = np.unravel_index(sky.sum(-1).argmax(), sky.shape[:2])
    assert abs(90 - (row + 0.5) * 180 / 64 - light.sun[0]) < 3 and abs((column + 0.5) * 360 / 128 - light.sun[1]) < 3
    assert sky.min() > 0 and np.isfinite(sky).all()


@pytest.mark.parametrize("name", ["tiny", "curtains"])
def test_finer_meshes_are_the_same_room(name):
    coarse, fine = rooms.build(name), rooms.build(name, 2)
    for one, other in ((coarse, fine), (coarse.scan, fine.scan)):
        assert len(other.faces) == 16 * len(one.faces)
        (normal, area), (finer, areas) = (face_geometry(r.vertices, r.faces) for r in (one, other))
        np.testing.assert_allclose(areas.reshape(-1, 16).sum(1), area, rtol=1e-3, atol=1e-9)  # float32 vertices
        near = np.repeat(area > 1e-5, 16)
        assert ((finer * np.repeat(normal, 16, 0)).sum(1)[near] > 0.999).all()
        np.testing.assert_array_equal(other.object_id, np.repeat(one.object_id, 16))
        np.testing.assert_array_equal(other.emission, np.repeat(one.emission, 16, 0))
    edges = np.sort(fine.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1)
    assert len(np.unique(edges, axis=0)) < 2 * len(fine.faces)  # neighbours share the new vertices
