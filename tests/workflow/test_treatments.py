"""Odd captures that are treated, not refused: the run ends, and the deliverable says what was done."""

import json

import pytest
from support import treatment


def _without_emitters(workflow, target):
    path = workflow.folder / "config/scenes/tiny.yaml"
    path.write_text(path.read_text().replace("rows: 2000", "rows: 2000, min_observations: 1000000"))
    result = workflow.run(target)
    assert result.returncode == 0, result.stderr[-2000:]
    return json.loads((workflow.folder / "results/tiny/emission/emission.json").read_text())["notes"]


@pytest.mark.long
def test_no_emitter_seen(workflow):
    """Nothing counts as an emitter: light comes from the radiance cache alone, and the stage says so."""
    assert treatment("no emitter seen") in _without_emitters(workflow, "results/tiny/affines/manifest.json")


@pytest.mark.long
def test_a_room_without_emitters_is_delivered(workflow):
    """The same room to the end of the run."""
    _without_emitters(workflow, "scenes/tiny")
    assert (workflow.folder / "scenes/tiny/scene.glb").is_file()


@pytest.mark.long
def test_one_view_only_and_one_prediction(workflow):
    """V = 1, K = 1: no overlap between views, no choice between predictions."""
    path = workflow.folder / "config/scenes/tiny.yaml"
    path.write_text(path.read_text().replace("views: 4", "views: 1").replace("samples: 3", "samples: 1"))
    result = workflow.run("scenes/tiny")
    assert result.returncode == 0, result.stderr[-2000:]
    assert len(list((workflow.folder / "scenes/tiny/maps").glob("*.exr"))) == 1


@pytest.mark.long
def test_low_dynamic_range(workflow):
    """The same room as 8-bit photographs: a response is fitted and published."""
    path = workflow.folder / "config/scenes/tiny.yaml"
    path.write_text(path.read_text().replace("dynamic_range: hdr", "dynamic_range: ldr"))
    result = workflow.run("scenes/tiny")
    assert result.returncode == 0, result.stderr[-2000:]
    assert (workflow.folder / "scenes/tiny/camera_response.parquet").is_file()
