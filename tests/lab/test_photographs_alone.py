"""What the benchmark of photographs alone says of cameras and meshes that are off by known amounts."""

import json

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from iif_core.camera.pinhole import look_at
from lab.benchmarks.photographs_alone import geometry, similarity, walk
from lab.packing import OPENGL
from lab.rooms import build

TURN, SCALE, SHIFT = Rotation.from_euler("xyz", [20, -35, 110], degrees=True).as_matrix(), 2.5, np.array([1.0, -2.0, 3.0])


def test_the_similarity_is_that_by_which_places_were_moved():
    places = np.random.default_rng(0).normal(size=(12, 3))
    scale, turn, shift = similarity(places, SCALE * places @ TURN.T + SHIFT)
    assert scale == pytest.approx(SCALE) and np.allclose(turn, TURN) and np.allclose(shift, SHIFT)


def write(folder, poses, mesh):
    folder.mkdir()
    camera = {"w": 64, "h": 48, "fl_x": 50.0, "fl_y": 50.0, "cx": 32.0, "cy": 24.0}
    frames = [{"file_path": f"{i:03d}.png", **camera, "transform_matrix": pose.tolist()} for i, pose in enumerate(poses)]
    (folder / "transforms.json").write_text(json.dumps({"frames": frames}))
    mesh.export(folder / "mesh.ply")


def test_a_room_in_another_frame_is_right_and_one_that_is_off_is_off_by_as_much(tmp_path):
    room = trimesh.creation.box((4.0, 3.0, 2.5))
    room.invert()
    room = room.subdivide().subdivide()
    eyes = [(np.cos(a), np.sin(a), 0.2) for a in np.linspace(0, 5, 6)]
    poses = [look_at(eye, (0, 0, 0), (0, 0, 1)) @ OPENGL for eye in eyes]
    write(tmp_path / "true", poses, room)

    def found(name, poses, mesh):  # in a frame of its own
        moved = [np.block([[TURN.T @ p[:3, :3], (TURN.T @ (p[:3, 3] - SHIFT) / SCALE)[:, None]], [np.eye(4)[3]]]) for p in poses]
        write(tmp_path / name, moved, trimesh.Trimesh((mesh.vertices - SHIFT) @ TURN / SCALE, mesh.faces, process=False))
        return geometry(tmp_path / "true", tmp_path / name)

    same = found("same", poses, room)
    assert same["placed"] == 6 and same["metre"] == pytest.approx(SCALE - 1)
    assert max(same[name] for name in ("angle_most", "place_most", "mesh_90", "depth_90", "no_surface")) < 1e-3
    assert same["complete"] == 1.0
    # -------- the last camera turned by 3 degrees, a wall 20 cm too far out, another one missing --------
    turned = poses[-1].copy()
    turned[:3, :3] = Rotation.from_euler("z", 3, degrees=True).as_matrix() @ turned[:3, :3]
    far = room.copy()
    far.vertices[far.vertices[:, 0] > 1.99, 0] += 0.2
    far.update_faces(~(far.vertices[far.faces][..., 1] > 1.49).all(1))
    off = found("off", [*poses[:-1], turned], far)
    assert off["angle_most"] == pytest.approx(3.0, abs=1e-3) and off["angle"] < 1e-3
    area = 2 * (4 * 3 + 4 * 2.5 + 3 * 2.5)
    assert off["complete"] == pytest.approx(1 - (3 * 2.5 + 4 * 2.5) / area, abs=0.02)
    assert 0.02 < off["no_surface"] < 0.4 and off["mesh_90"] == pytest.approx(0.2, abs=0.03)


def test_a_walk_stands_free_and_goes_in_steps():
    room = build("kitchen")
    shots = walk(room, 40)
    assert all(room.is_free(eye) for eye in shots[:, 0])
    assert np.linalg.norm(np.diff(shots[:, 0], axis=0), axis=1).max() < 0.5
