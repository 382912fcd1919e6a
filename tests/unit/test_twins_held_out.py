"""Used photographs that repeat held-out ones are held out too."""

import json
import shutil

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tests.errors import refused
from tests.unit import own_scene as own
from workflow.sources.folder_scene.held_out import TWIN_PIXELS, hold_out


def pose(at=(0.0, 0.0, 0.0), degrees=0.0):
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = Rotation.from_euler("y", degrees, degrees=True).as_matrix(), at
    return out


def held(split, poses, digests=None, focal=100.0, depth=2.0):
    n = len(split)
    return hold_out(split, digests or [str(i) for i in range(n)], poses, np.full(n, focal), np.full(n, depth))


def test_the_same_file_under_two_names_is_held_out_twice():
    found = held(["train", "test", "train"], [pose((i, 0, 0)) for i in range(3)], ["a", "b", "b"])
    assert found.split == ["train", "test", "test"] and found.twins == {2: 1}
    np.testing.assert_allclose(found.distance, [1.0])  # to what is still used


@pytest.mark.parametrize(
    ("other", "repeats"),
    [
        (pose((0.019, 0, 0)), True),  # 100 * .019 / 2 = .95 pixels
        (pose((0.021, 0, 0)), False),
        (pose(degrees=0.56), True),  # 100 * .0098 = .98 pixels
        (pose(degrees=0.58), False),
        (pose((0.012, 0, 0), 0.4), False),  # .6 + .7
    ],
)
def test_a_picture_from_the_same_place_to_a_pixel_is_a_twin(other, repeats):
    found = held(["test", "train", "train"], [pose(), other, pose((3, 0, 0))])
    assert (found.split[1] == "test") is repeats and (1 in found.twins) is repeats


def test_what_moves_by_more_than_a_pixel_is_no_twin():
    """Surface in the middle of the picture, at the median depth, projected into both cameras."""
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(-0.05, 0.05, (200, 2)), np.full((200, 1), 2.0)], 1)
    for _ in range(50):
        other = pose(rng.normal(0, 0.01, 3), rng.normal(0, 0.3))
        local = (points - other[:3, 3]) @ other[:3, :3]
        moved = 100 * np.abs(local[:, :2] / local[:, 2:] - points[:, :2] / points[:, 2:]).max()
        if moved > 1.05 * TWIN_PIXELS:
            assert held(["test", "train"], [pose(), other]).split[1] == "train"


def test_twins_of_twins_stay_so_that_a_video_does_not_vanish():
    found = held(["test"] + ["train"] * 9, [pose((0.015 * i, 0, 0)) for i in range(10)])
    assert found.split == ["test", "test"] + ["train"] * 8


def test_a_camera_that_sees_no_surface_has_no_twin_by_place():
    assert held(["test", "train"], [pose(), pose()], depth=np.nan).split[1] == "train"
    assert held(["test", "train"], [pose(), pose()], ["a", "a"], depth=np.nan).split[1] == "test"


def test_nothing_is_said_where_nothing_is_held_out():
    found = held(["train", "train"], [pose(), pose()], ["a", "a"])
    assert found.split == ["train", "train"] and not found.facts(["x", "y"]) and not found.notes(["x", "y"])


@given(st.lists(st.sampled_from(["train", "test"]), min_size=1, max_size=12), st.integers(0, 2**32 - 1))
def test_what_was_asked_for_stays_held_out_and_no_twin_is_used(split, seed):
    rng = np.random.default_rng(seed)
    poses = [pose(rng.integers(0, 3, 3) * 0.01, rng.integers(0, 2)) for _ in split]
    digests = [str(rng.integers(0, 4)) for _ in split]
    found = held(split, poses, digests)
    assert all(now == "test" for now, asked in zip(found.split, split, strict=True) if asked == "test")
    used = {digests[i] for i, one in enumerate(found.split) if one == "train"}
    assert not used & {digests[i] for i, one in enumerate(split) if one == "test"}


def test_a_copied_photograph_cannot_raise_the_held_out_score(tmp_path):
    """Photograph 3 is a copy of photograph 1, which is held out, under another name and with a pose of its own."""
    path = own.project(tmp_path, {}, {"test_every": 2})
    document, _ = own.photographed(path)
    files = [path / frame["file_path"] for frame in document["frames"]]
    shutil.copy(files[1], files[2])
    document["frames"][2]["transform_matrix"] = document["frames"][1]["transform_matrix"]
    own.write_transforms(path, document)
    capture = own.run(tmp_path, "capture")
    assert [view.split for view in capture.views] == ["train", "test", "test", "test"]
    assert capture.facts["held_out"]["twins"] == {"002": "001"}
    assert any("002" in note and "001" in note for note in capture.facts["notes"])


def test_a_room_where_all_photographs_repeat_held_out_ones_is_refused(tmp_path):
    path = own.project(tmp_path, {}, {"test_every": 2})
    document, _ = own.photographed(path)
    document["frames"] = document["frames"][:2]
    shutil.copy(path / document["frames"][1]["file_path"], path / document["frames"][0]["file_path"])
    document["frames"][0]["transform_matrix"] = document["frames"][1]["transform_matrix"]
    own.write_transforms(path, json.loads(json.dumps(document)))
    with refused("transforms.json", "capture.test_every"):
        own.run(tmp_path, "capture")
