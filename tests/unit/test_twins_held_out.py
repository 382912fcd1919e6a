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
from workflow.sources.folder_scene.held_out import TWIN_PIXELS, asked, hold_out


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


def walk(count, step):
    """A camera that walks along a line and looks to its side, 2 m from the surface."""
    return [pose((step * i, 0, 0)) for i in range(count)], np.ones(count), np.full(count, 2.0)


def runs(split):
    """Lengths of the stretches that are held out."""
    return [len(run) for run in "".join("x" if one == "test" else " " for one in split).split()]


@pytest.mark.parametrize(
    ("step", "lengths"),
    [
        (0.3, [1] * 25),  # .15 of the picture, and 1 / 8 is held out
        (0.1, [13, 12]),  # .05: stretches of 4 / (8 * .05) = 10
        (0.01, [25]),  # 100 would be more than there are
        (0.0, [25]),
    ],
)
def test_a_video_loses_stretches_and_the_same_share(step, lengths):
    found = asked(*walk(200, step), every=8)
    assert runs(found.split) == lengths and found.split.count("test") == 25 and len(found.split) == 200
    assert found.blocks == (len(lengths) if step < 0.25 else 0)
    np.testing.assert_allclose(found.step, step / 2)


def test_half_of_a_stretch_is_as_far_from_what_is_used_as_the_share_asks():
    poses, focal, depth = walk(1000, 0.02)
    found = asked(poses, focal, depth, every=8)
    held = hold_out(found.split, [str(i) for i in range(1000)], poses, 100 * focal, depth)
    assert np.median(held.distance) / 2 >= 0.9 / 8 and len(runs(found.split)) == 2
    alone = ["test" if i % 8 == 7 else "train" for i in range(1000)]
    assert np.median(hold_out(alone, [str(i) for i in range(1000)], poses, 100 * focal, depth).distance) < 0.05


@given(st.integers(2, 60), st.integers(2, 12), st.floats(0, 2))
def test_the_share_is_kept_whatever_the_capture(count, every, step):
    found = asked(*walk(count, step), every=every)
    assert len(found.split) == count and found.split.count("test") == count // every


def test_what_is_held_out_is_in_the_plan(tmp_path):
    path = own.project(tmp_path, {"alignment": "off", "registration": "off"}, {"test_every": 3})
    document, _ = own.photographed(path, 6)
    found = {item["component"]: item for item in own.run(tmp_path, "capture").facts["plan"]}["held_out_stretches"]
    assert not found["included"] and found["value"] > found["threshold"] == pytest.approx(1 / 3)
    for number, frame in enumerate(document["frames"]):  # nearly one place, in steps of some pixels
        frame["transform_matrix"] = (
            np.array(document["frames"][0]["transform_matrix"]) + 0.05 * number * np.eye(4, k=3)
        ).tolist()
    own.write_transforms(path, document)
    capture = own.run(tmp_path, "capture")
    found = {item["component"]: item for item in capture.facts["plan"]}["held_out_stretches"]
    assert found["included"] and found["value"] < found["threshold"]
    assert runs([view.split for view in capture.views]) == [2]
    document["test_filenames"] = [document["frames"][4]["file_path"]]
    own.write_transforms(path, document)
    capture = own.run(tmp_path, "capture")
    found = {item["component"]: item for item in capture.facts["plan"]}["held_out_stretches"]
    assert [view.name for view in capture.views if view.split == "test"] == ["004"] and found["status"] == "forced"


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
