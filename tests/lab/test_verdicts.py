"""The benchmark of the verdict: what its rows say, how thresholds are chosen, what is done to captures."""

from __future__ import annotations

import json

import numpy as np
import pytest

from lab.benchmarks import verdicts
from lab.benchmarks.verdicts import GOOD, LIGHTS, SPOILS, TUNED, Taken, cases
from workflow.report import calibration
from workflow.report.verdict import GREEN, LIMITS, Evidence


@pytest.fixture(scope="module")
def rows():
    return [row for row in verdicts.read_rows(verdicts.FILE) if row["status"] == "done"]


def test_the_report_says_what_the_rows_say(rows):
    """By the thresholds of the product: no green is wrong in more than 5 %, or next to a shining table."""
    colours = [verdicts.judged(row["evidence"]) for row in rows]
    found, said = verdicts.counted(rows, colours), json.loads(calibration.FILE.read_text())
    assert said["captures"] == len(rows)
    assert {light: {c: v for c, v in said["lights"][light].items() if c != "left_out"} for light in LIGHTS} == found
    for light in LIGHTS:
        assert found[light][GREEN]["right"] >= verdicts.HOLDS * found[light][GREEN]["of"] > 0
        assert said["lights"][light]["left_out"]["right"] >= verdicts.HOLDS * said["lights"][light]["left_out"]["of"] > 0
    assert any(row["severe"] for row in rows)
    assert all(GREEN not in [found[light] for light in LIGHTS] for row, found in zip(rows, colours, strict=True) if row["severe"])


def test_the_thresholds_are_those_that_the_rows_choose(rows):
    assert verdicts.chosen(rows, verdicts.greens_of(rows)) == {name: LIMITS[name].amber for name in TUNED}


def test_a_wrong_green_costs_a_threshold():
    """Two captures whose misfit alone tells them apart: if the second is wrong, the threshold lies between them."""

    def row(misfit, right):
        evidence = Evidence(
            escape=0.0, edges=0.4, agreement=0.9, photographs=8, photographed=0.9, lamps=1, doubtful_area=0.0, misfit=misfit,
            held_out=25.0, held_out_views=2, used=25.0, prior="learned", uncertainty=0.05, level="found", level_error=0.1,
        )  # fmt: skip
        return {"spoil": "good", "evidence": evidence, "right": dict.fromkeys(LIGHTS, right), "severe": not right}

    both_right, one_wrong = ([row(0.045, True), row(0.07, right)] for right in (True, False))
    assert verdicts.chosen(both_right, verdicts.greens_of(both_right))["misfit"] == 0.08
    assert verdicts.chosen(one_wrong, verdicts.greens_of(one_wrong))["misfit"] == 0.05


def test_limits_are_put_back():
    before = dict(LIMITS)
    with pytest.raises(KeyError), verdicts.limits({"misfit": 0.01}):
        assert LIMITS["misfit"].amber == 0.01
        raise KeyError
    assert before == LIMITS


def test_every_spoil_is_in_the_list():
    listed = cases()
    assert len(set(listed)) == len(listed) and {spoil for _, spoil in listed} == set(SPOILS)
    assert {room for room, spoil in listed if spoil in GOOD} == set(verdicts.ROOMS)
    for beginning in (20, 40, 60):  # good and spoilt from the start, in many rooms
        some = listed[:beginning]
        assert 0.2 <= np.mean([spoil in GOOD for _, spoil in some]) <= 0.4 and len({room for room, _ in some}) >= 8


@pytest.mark.parametrize("name", sorted(SPOILS))
def test_a_spoilt_capture_is_still_one(name):
    """A box of a room, its lamp in the middle of the ceiling: files can be written, and the mesh goes back to the room."""
    import trimesh

    box = trimesh.creation.box((4.0, 3.0, 2.5)).subdivide().subdivide().subdivide()
    centres = box.vertices[box.faces].mean(1)
    shines = (centres[:, 2] > 1.2) & (np.hypot(*centres[:, :2].T) < 0.5)
    rng = np.random.default_rng(0)
    photos = [rng.integers(0, 256, (verdicts.SIZE, verdicts.SIZE, 3)).astype(np.uint8) for _ in range(10)]
    poses = [trimesh.transformations.translation_matrix([0.1 * i, 0, 0]) for i in range(10)]
    taken = Taken(
        [f"{i:03d}" for i in range(10)], photos, poses, [66.0] * 10,
        [i % 5 == 4 for i in range(10)], box.vertices, box.faces, shines,
    )  # fmt: skip
    found = SPOILS[name][0](taken, np.random.default_rng(1))
    assert shines.any() and len(found.names) == len(found.photos) == len(found.poses) == len(found.focal) == len(found.held_out)
    assert not all(found.held_out) and len(found.faces) == len(found.shines) > 0
    assert all(np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3)) for pose in found.poses)
    back = np.linalg.inv(found.moved)
    assert np.allclose(found.vertices @ back[:3, :3].T + back[:3, 3], box.vertices)
    parts = ("photos", "poses", "focal", "vertices", "faces", "axes", "names")
    same = [np.array_equal(np.array(getattr(found, part)), np.array(getattr(taken, part))) for part in parts]
    assert all(same) == (name in (*GOOD, "other_light", "lamp_unseen"))
