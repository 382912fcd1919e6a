"""Results may not drift: counts, files and scores of tiny, and scores of the kitchen from photographs alone (snapshot.py)."""

import json

import pytest
from snapshot import DECIBELS, GATED, PATH, moved, take, worsened
from support import Workflow

from iif_core.evaluation import metrics
from workflow.artifacts.store import StageReader, material_maps
from workflow.scene.normal_form import CaptureReader

KITCHEN = "source: {kind: folder, path: REPOSITORY/examples/kitchen}\n"
SMALL = "capture: {views: 8, width: 96, height: 96}\n"
GAIN = 0.1
"""By how many dB the second look must improve on the base, and the fit on that."""


@pytest.fixture(scope="module")
def kitchen(repository, tmp_path_factory):
    """The user's path: the room of the README with fewer, smaller photographs, the default prior, objects from the mesh, and no
    truth but for the score, as far as its scores."""
    workflow = Workflow(repository, tmp_path_factory.mktemp("kitchen") / "run")
    workflow.write("kitchen", KITCHEN.replace("REPOSITORY", str(repository)))
    workflow.write_quality("draft", SMALL)
    result = workflow.run("results/kitchen/metrics/manifest.json")
    assert result.returncode == 0, result.stderr[-4000:]
    return workflow


def test_each_step_from_photographs_improves_on_the_one_before(kitchen):
    root = kitchen.folder / "results/kitchen"
    base, second, result = (_albedo_psnr(root, stage) for stage in ("base", "second_look", "affines"))
    assert second > base + GAIN, (base, second)
    assert result > second + GAIN, (second, result)


def _albedo_psnr(folder, stage):
    """Mean PSNR of the albedo after one gain for each photograph."""
    capture = CaptureReader(StageReader(folder / "capture", "capture", "kitchen"))
    maps, found = StageReader(folder / stage, stage, "kitchen"), []
    for view in capture.used:
        truth = capture.truth(view)
        masks = metrics.material_masks(truth.valid, capture.gbuffer(view)[1] >= 0, truth.emission, truth.roughness)
        albedo = material_maps(maps.exr(f"maps/{view.name}.exr"))["albedo"]
        scores = metrics.Target("albedo", truth.albedo, masks["albedo"]).scores(albedo, ("psnr",))
        found += [score.value for score in scores if score.protocol == "scaled"]
    return sum(found) / len(found)


def test_counts_files_and_scores_of_tiny_stay(finished):
    expected, found = json.loads(PATH.read_text())["tiny"], take(finished.folder, "tiny")
    assert found["counts"] == expected["counts"]
    assert found["structure"] == expected["structure"]
    assert _drift(found, expected, moved) == {}


def test_no_score_of_the_kitchen_gets_worse(kitchen):
    """Machines differ in the last bits of what the network says, and pieces of the mesh with it: counts may move, and
    scores for the better. Renew the snapshot then."""
    expected, found = json.loads(PATH.read_text())["kitchen"], take(kitchen.folder, "kitchen")
    assert _drift(found, expected, worsened) == {}


def _drift(found, expected, how):
    """Scores that moved too far: name -> (found, expected)."""
    pairs = {name: (found["scores"][name], value) for name, value in expected["scores"].items()}
    return {name: pair for name, pair in pairs.items() if how(name, *pair) > DECIBELS}


def test_the_gate_is_complete_and_closes():
    """All scores of the kitchen are gated, and a change that a reader of the results would notice does not pass."""
    expected = json.loads(PATH.read_text())
    assert set(expected["kitchen"]["scores"]) == {"/".join(key) for key in GATED}
    assert moved("albedo/psnr/raw", 25.0, 25.4) > DECIBELS and moved("albedo/psnr/raw", 25.0, 25.2) < DECIBELS
    assert moved("roughness/l2/raw", 0.040, 0.035) > DECIBELS and moved("metallic/l2/raw", 0.0, 5e-5) == 0.0
    assert worsened("albedo/psnr/raw", 24.6, 25.0) > DECIBELS and worsened("albedo/psnr/raw", 26.0, 25.0) == 0.0
    assert worsened("roughness/l2/raw", 0.040, 0.035) > DECIBELS and worsened("roughness/l2/raw", 0.020, 0.035) == 0.0
    assert worsened("emission/iou/raw", 0.8, 1.0) > DECIBELS and worsened("emission/iou/raw", 1.0, 0.8) == 0.0
