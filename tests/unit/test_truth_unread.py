"""Ground truth: nothing but scores may depend on it, and no other job can read it unless the settings ask for it."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

from tests.errors import refused
from tests.unit import own_scene as own
from workflow.artifacts import files as io
from workflow.artifacts import manifest as manifests
from workflow.artifacts.manifest import MANIFEST
from workflow.artifacts.store import ids_to_disk
from workflow.registry import STAGES
from workflow.runtime.job import Job
from workflow.scene.normal_form import CaptureReader

STAGES_RUN = (
    *("plan", "prior", "segmentation", "base", "emission", "shading", "second_look", "affines"),
    *("render", "unwrap", "export"),
)
"""All that is made before the scores, and what is made of the result beside them."""
SCENE = {
    "source": {"kind": "builtin", "scene": "tiny"},
    "capture": {"views": 4, "width": 32, "height": 32, "samples": 4, "dynamic_range": "ldr"},
    "prior": {"kind": "learned", "samples": 2},
    "segmentation": {"kind": "geometry"},
    "render": {"samples": 4},
}


@pytest.fixture(scope="module")
def captured(llvm, tmp_path_factory):
    root = tmp_path_factory.mktemp("truth")
    (root / "config/scenes").mkdir(parents=True)
    (root / "config/scenes/own.yaml").write_text(yaml.safe_dump(SCENE))
    own.run(root, "capture")
    return root


def spoil(folder):
    """Replace the truth of a capture by noise of the same form, with a manifest to match."""
    rng = np.random.default_rng(0)
    document = manifests.read(folder / MANIFEST)
    for name in document["files"]:
        path = folder / name
        if name.startswith("truth/"):
            channels = io.read_exr(path)
            io.write_exr(path, {key: rng.random(values.shape).astype(values.dtype) for key, values in channels.items()})
        elif name == "faces.parquet":
            columns = io.read_parquet(path)
            columns["instance_id"] = rng.integers(0, 3, len(columns["face_id"])).astype(np.int32)
            columns |= {f"emission_{c}": rng.random(len(columns["face_id"])).astype(np.float32) for c in "rgb"}
            io.write_parquet(path, columns, {})
        elif name == "instances.parquet":
            columns = io.read_parquet(path)
            io.write_parquet(path, {**columns, "name": [f"noise {i}" for i in columns["instance_id"]]}, {})
        elif name == "capture.json":
            facts = io.facts_in(path)
            io.write_json(path, {**facts, "response_truth": np.sort(rng.random((3, 101))).tolist()})
        document["files"][name] |= {"sha256": io.sha256_of(path), "bytes": path.stat().st_size}
    view = next(iter(document["files"][name] for name in document["files"] if name.startswith("photos/")))
    given = folder / "given/000.exr"
    io.write_exr(given, {"instance.id": ids_to_disk(rng.integers(0, 5, view["shape"]))})
    facts = {"sha256": io.sha256_of(given), "bytes": given.stat().st_size, "kind": "exr", "shape": view["shape"], "channels": {}}
    document["files"]["given/000.exr"] = facts
    manifests.write(folder / MANIFEST, document)


def made(root):
    """Bytes of every file of the stages after the capture, but manifests."""
    folder = Path(root) / "results/own"
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for stage in STAGES_RUN
        for path in sorted((folder / stage).rglob("*"))
        if path.is_file() and path.name != MANIFEST
    }


def test_noise_in_place_of_truth_changes_nothing_but_scores(captured, tmp_path):
    root = tmp_path / "run"
    shutil.copytree(captured, root)
    own.run(root, *STAGES_RUN)
    first = made(root)
    assert {name.split("/")[0] for name in first} == set(STAGES_RUN)
    for stage in STAGES_RUN:
        shutil.rmtree(root / "results/own" / stage)
    spoil(root / "results/own/capture")
    own.run(root, *STAGES_RUN)
    second = made(root)
    assert first.keys() == second.keys()
    assert [name for name in first if first[name] != second[name]] == []


@pytest.mark.parametrize(
    ("section", "truth", "ids"),
    [
        ({}, False, False),
        ({"segmentation": {"kind": "given"}}, False, True),
        ({"prior": {"kind": "simulated", "samples": 2}}, True, True),
    ],
)
def test_truth_is_read_where_the_settings_ask_for_it(captured, tmp_path, section, truth, ids):
    root = tmp_path / "run"
    shutil.copytree(captured, root)
    (root / "config/scenes/own.yaml").write_text(yaml.safe_dump({**SCENE, **section}))
    with own.working_in(root):
        for stage in (stage for stage in STAGES if "capture" in STAGES[stage].upstream):
            scores = STAGES[stage].scores
            reader = Job(stage, "own", "draft", 1).read("capture")
            capture = CaptureReader(reader)
            columns = capture.faces()
            assert ("emission_r" in columns) == ("response_truth" in capture.facts) == (truth or scores), stage
            assert ("instance_id" in columns) == (ids or scores), stage
            if truth or scores:
                assert capture.truth(capture.views[0]).valid.any()
            else:
                with refused("truth/000.exr", kind=AssertionError):
                    capture.truth(capture.views[0])
            if not (ids or scores):
                with refused("instances.parquet", kind=AssertionError):
                    reader.table("instances.parquet")
