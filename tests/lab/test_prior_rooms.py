"""Rooms, scans, photographs and captures of the laboratory."""

from __future__ import annotations

import numpy as np
import pytest

from lab.prior import cameras, captures, photographs, rooms, scan, sensor
from lab.prior.building import box


def test_a_seed_is_a_room():
    a, b, c = rooms.build(4), rooms.build(4), rooms.build(5)
    assert all(np.array_equal(p, q) for p, q in zip(a.mesh(), b.mesh(), strict=True))
    assert np.array_equal(a.materials.rows, b.materials.rows) and np.array_equal(a.sky, b.sky)
    assert len(a.mesh()[0]) != len(c.mesh()[0])


@pytest.mark.parametrize("seed", range(20, 26))
def test_rooms_are_closed_lit_and_finite(seed):
    room = rooms.build(seed)
    vertices, faces, own = room.mesh()
    assert np.isfinite(vertices).all() and faces.min() >= 0 and faces.max() < len(vertices)
    assert set(own) == set(range(len(room.parts)))
    names = [part.name for part in room.parts]
    assert {"floor", "ceiling", "north", "south", "west", "east"} <= set(names)
    assert room.emission().any() or ("window frame" in names and room.sky.max() > 1e-3)
    beyond = (*names[:6], "next room", "next lamp", "door")  # bounded by the test of doors
    inside = [part.shape[0] for part in room.parts if part.name not in beyond]
    low, high = np.concatenate(inside).min(0), np.concatenate(inside).max(0)
    assert (low > -0.35).all() and (high < room.size + 0.35).all()


def test_a_door_leads_to_a_closed_lit_room(llvm):
    """No ray leaves a room whose only opening is a door; rays reach the front of the lamp behind it."""
    from iif_core.light.transport.geometry import build_geometry, trace

    doors, lit = 0, 0
    for seed in range(60):
        room = rooms.build(seed)
        names = [part.name for part in room.parts]
        if "door" not in names or "window frame" in names:
            continue
        doors += 1
        vertices, faces, own = room.mesh()
        leaf, lamp, beyond = (room.parts[names.index(name)].shape[0] for name in ("door", "next lamp", "next room"))
        assert (np.r_[leaf, lamp].min(0) >= beyond.min(0) - 1e-9).all() and (
            np.r_[leaf, lamp].max(0) <= beyond.max(0) + 1e-9
        ).all()
        geometry, rng = build_geometry(vertices, faces, own), np.random.default_rng(seed)
        eyes = cameras.poses(room, 6, rng)[:, :3, 3]
        assert (eyes > 0).all() and (eyes < room.size).all()
        # Through the opening, and onto everything in the next room from a place in it.
        way = leaf.mean(0) + rng.normal(0, 0.6, (3000, 3)) - eyes[rng.integers(len(eyes), size=3000)]
        assert (trace(geometry, leaf.mean(0) - way, way)[0] >= 0).all()
        low = beyond.mean(0) * (1, 1, 0) + (0, 0, 0.3)
        face, _ = trace(geometry, low, rng.normal(size=(3000, 3)) * (1, 1, 0.7) + (0, 0, 1))
        shown = face[(face >= 0) & (own[face] == names.index("next lamp"))]
        lit += len(shown) > 0 and bool((geometry.normals[shown][:, 2] < 0.5).all())
        assert (face >= 0).all()
    assert doors >= 3 and lit >= doors - 1


def test_boxes_face_outward():
    vertices, faces = box((1, 2, 3), (0, 0, 0))
    corners = vertices[faces]
    volume = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    assert volume == pytest.approx(6)


def test_a_scan_without_faults_is_the_room_but_for_curtains(room):
    vertices, faces, own = scan.scan(room, scan.Faults(), np.random.default_rng(0))
    plain = [part for part in room.parts if part.delivered is None]
    assert len(faces) == sum(len((part.delivered or part.shape)[1]) for part in room.parts)
    first = plain[-1].shape[0]
    number = len(room.parts) - 1 - [part is plain[-1] for part in room.parts[::-1]].index(True)
    assert np.allclose(vertices[faces[own == number]].min((0, 1)), first.min(0), atol=1e-5)


def test_faults_have_the_size_that_they_state(room):
    rng = np.random.default_rng(1)
    points = rng.uniform(0, 4, (20_000, 3))
    moved = scan._waves(points, 0.5, rng)
    assert np.allclose(moved.std(0), 1, atol=0.35) and np.allclose(scan._waves(points[:1], 0.5, rng).shape, (1, 3))
    exact = scan.scan(room, scan.Faults(), rng)
    holes = scan.scan(room, scan.Faults(holes=5, hole=0.4), np.random.default_rng(2))
    area = [
        0.5 * np.linalg.norm(np.cross(v[f][:, 1] - v[f][:, 0], v[f][:, 2] - v[f][:, 0]), axis=1).sum()
        for v, f, _ in (exact, holes)
    ]
    assert 0.8 * area[0] < area[1] < area[0]
    lost = scan.scan(room, scan.Faults(lost=1.0), rng)
    assert len(set(lost[2])) < len(set(exact[2]))


def test_a_misplaced_camera_is_rigid_and_off_by_what_is_stated():
    pose = np.eye(4)
    rng = np.random.default_rng(0)
    off = np.stack([scan.misplaced(pose, scan.Faults(turn=0.002, shift=0.005), rng) for _ in range(400)])
    assert np.allclose(off[:, :3, :3] @ off[:, :3, :3].transpose(0, 2, 1), np.eye(3), atol=1e-12)
    assert off[:, :3, 3].std() == pytest.approx(0.005, rel=0.1)
    assert off[:, 0, 1].std() == pytest.approx(0.002, rel=0.15)
    assert np.array_equal(scan.misplaced(pose, scan.Faults(), rng), pose)


def test_cameras_stand_upright_in_free_places(room):
    poses = cameras.poses(room, 12, np.random.default_rng(0))
    eyes = poses[:, :3, 3]
    assert (eyes > 0).all() and (eyes < room.size).all()
    assert (poses[:, 2, 1] < -0.5).all(), "the camera's y axis points down"
    low, high = room.obstacles[:, 0], room.obstacles[:, 1]
    inside = ((eyes[:, None] > low) & (eyes[:, None] < high)).all(2).any(1)
    assert not inside.any()


def test_photographs_rise_with_radiance_and_follow_the_seed():
    ramp = np.linspace(0.01, 1, 64)[None, None, :, None] * np.ones((2, 16, 1, 3))
    metered = np.ones((2, 16, 64), bool)
    shares = []
    for seed in range(40):
        a, b = (sensor.photograph(ramp, metered, np.random.default_rng(seed)) for _ in range(2))
        assert np.array_equal(a.values, b.values) and (a.exposure > 0).all()
        shares.append(a.is_hdr)
        mean = a.values.astype(float).mean((0, 1, 3))
        smooth = mean.reshape(8, 8).mean(1)
        assert (np.diff(smooth) > -1e-3 * smooth.max()).all()
    assert 0.02 < np.mean(shares) < 0.35


def test_a_capture_survives_its_file(capture, tmp_path):
    capture.save(tmp_path / "11.npz")
    again = captures.load(tmp_path / "11.npz")
    assert again.facts == capture.facts and again.facts["generator"] == rooms.VERSION
    for name in ("vertices", "triangles", "instance", "poses"):
        assert np.array_equal(getattr(again, name), getattr(capture, name))
    assert np.array_equal(again.photographs.values, capture.photographs.values)
    assert np.array_equal(again.truth.albedo, capture.truth.albedo)
    view = again.used[1]
    assert np.array_equal(again.gbuffer(view)[1], capture.gbuffer(view)[1])
    assert not list(tmp_path.glob(".*")), "no temporary file stays"


def test_truth_is_the_material_of_what_a_pixel_shows(llvm, room):
    from iif_core.camera.pinhole import pixel_directions
    from iif_core.light.transport.geometry import build_geometry, trace

    size, focal = 40, 30.0
    poses = cameras.poses(room, 2, np.random.default_rng(3))
    radiance, truth = photographs.render(room, poses, focal, photographs.Session(2, size, 1), 0, None)
    assert np.isfinite(radiance).all() and (radiance >= 0).all() and radiance.max() > 0
    vertices, faces, part = room.mesh()
    geometry = build_geometry(vertices, faces, part)
    ways = np.stack([pixel_directions(focal, focal, size / 2, size / 2, size, size, p) for p in poses]).reshape(-1, 3)
    origins = np.repeat(poses[:, :3, 3], size * size, 0)
    face, depth = trace(geometry, origins, ways)
    hit = face >= 0
    depth = np.where(hit, depth, 0)
    albedo, rough, metal = room.materials.numpy(origins + depth[:, None] * ways, part[np.maximum(face, 0)])
    plain = hit & (np.abs(np.asarray(truth.albedo, np.float32).reshape(-1, 3) - albedo).max(1) < 0.01)
    assert plain[hit].mean() > 0.5, "most pixels lie within one tone of their pattern"
    assert np.median(np.abs(truth.roughness.ravel()[hit] / 255 - rough[hit])) < 0.01
    # Metallic does not vary within an object.
    assert np.array_equal(truth.metallic.ravel()[hit], np.rint(255 * metal[hit]).astype(np.uint8))
    assert not truth.albedo.reshape(-1, 3)[~hit].any() and not truth.valid.ravel()[~hit].any()


def test_objects_are_mostly_pieces_and_errors_common():
    drawn = [scan.draw_faults(np.random.default_rng(seed)) for seed in range(200)]
    exact = np.mean([not (f.bulge or f.grain or f.holes or f.lost or f.turn or f.shift) for f in drawn])
    assert scan.EXACT - 0.1 < exact < scan.EXACT + 0.15
    assert photographs.PIECES == pytest.approx(2 / 3)
