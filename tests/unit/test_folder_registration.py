"""`source.registration`: how its result changes cameras, frames and notes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import uniform_filter

from iif_core.camera.distortion import Distortion, Pinhole
from tests.unit.painted_room import FOCAL, HEIGHT, WIDTH, look, posed, room, twisted
from workflow.sources.folder_scene.camera import opencv_pose
from workflow.sources.folder_scene.frames import Frame
from workflow.sources.folder_scene.registration import register_frames

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def _frames(poses, metres):
    camera = Pinhole(4 * FOCAL, 4 * FOCAL, 2.0 * WIDTH, 2.0 * HEIGHT, 4 * WIDTH, 4 * HEIGHT)
    out = []
    for i, pose in enumerate(poses):
        matrix = pose.copy()
        matrix[:3, 3] /= metres
        name = f"{i:03d}"
        out.append(Frame(name, f"images/{name}.jpg", Path(name), 0, camera, Distortion("radial_tangential"), matrix @ OPENGL))
    return out


@pytest.fixture(scope="module")
def found():
    """The principal point is 2 pixels off in every photograph; view 2 is blurred, view 6 badly posed."""
    photos = room(12)
    photos = [replace(p, image=np.repeat(look(p.pose, (WIDTH / 2 + 2, HEIGHT / 2))[0][..., None], 3, -1)) for p in photos]
    photos[2] = replace(photos[2], image=uniform_filter(photos[2].image, (9, 11, 1)))
    bad = twisted(photos[6].pose, np.array([0.25, 0.3, 0.1]), np.array([0.3, 0.2, 0.1]))
    photos = posed(photos, [bad if k == 6 else p.pose for k, p in enumerate(photos)])
    frames, poses = _frames([p.pose for p in photos], 0.001), [p.pose for p in photos]
    return frames, poses, register_frames(frames, poses, [*photos[:-1], None], "opengl", 0.001)


def test_blurred_and_badly_posed_views_are_named(found):
    _, _, out = found
    assert set(out.left_out) == {"002", "006"}
    assert out.left_out["002"].startswith("blurred") and out.left_out["006"].startswith("badly posed")


def test_cameras_are_corrected_and_read_back(found):
    frames, poses, out = found
    assert out.facts["accepted"] and "lay beside the mesh by" in out.notes[0]
    (decision,) = out.plan
    assert decision["included"] and decision["value"] > decision["threshold"] and "photographs moved by" in decision["reason"]
    alike, other = ("all alike", "each for itself")[:: -1 if out.facts["each"] else 1]
    for text in (decision["reason"], out.notes[0]):
        assert alike in text and other not in text
    moved = [np.linalg.inv(poses[k]) @ out.poses[k] for k in range(11)]
    assert np.allclose(moved, moved[0], atol=1e-9) == (not out.facts["each"])
    json.dumps(out.facts, allow_nan=False)
    for frame, pose in zip(out.frames[:-1], out.poses[:-1], strict=True):
        np.testing.assert_allclose(opencv_pose(frame.matrix, "opengl", 0.001), pose, atol=1e-9)
    # Rotation, translation and principal point share the shift; the image of a point in front of the camera shows their sum.
    columns = []
    for k in (k for k in range(11) if k not in (2, 6)):
        camera, point = out.frames[k].camera, poses[k] @ [0.0, 0.0, 1.6, 1.0]
        x, _, z, _ = np.linalg.inv(out.poses[k]) @ point
        columns.append((camera.cx + camera.fx * x / z) / 4)
    # With a wrong pose among few photographs only about half of the 2 pixels is found (alone: test_registration, within 0.3).
    assert 0.7 < np.median(columns) - WIDTH / 2 < 2.5


def test_a_view_that_sees_nothing_stays_as_it_is(found):
    frames, poses, out = found
    assert out.frames[-1] is frames[-1] and out.poses[-1] is poses[-1] and "011" not in out.facts["views"]


def test_a_held_out_photograph_is_neither_judged_nor_left_out():
    photos = [replace(p, held=k == 2) for k, p in enumerate(room(12))]
    photos[2] = replace(photos[2], image=np.random.default_rng(0).random(photos[2].image.shape))
    frames, poses = _frames([p.pose for p in photos], 1.0), [p.pose for p in photos]
    out = register_frames(frames, poses, photos, "opengl", 1.0)
    assert not out.left_out and "002" not in out.facts["views"] and "001" in out.facts["views"]


def test_one_photograph_has_nothing_to_be_registered_with():
    photo = room(1)
    frames = _frames([photo[0].pose], 1.0)
    out = register_frames(frames, [photo[0].pose], photo, "opengl", 1.0)
    assert out.frames == frames and not out.left_out and not out.notes
