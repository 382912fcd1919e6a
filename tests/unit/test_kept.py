"""Files that people put into a deliverable: set apart, put back, never lost, whatever is killed between."""

import json
import shutil

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.errors import refused
from workflow.artifacts import kept
from workflow.artifacts import manifest as manifests
from workflow.artifacts.manifest import SCENE_SCHEMA
from workflow.trade import choose

WRITTEN = ("scene.glb", "maps/000.exr")


def published(target, version=0):
    """A deliverable as stage publish leaves it."""
    shutil.rmtree(target, ignore_errors=True)
    for name in WRITTEN:
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        (target / name).write_text(f"{name} {version}")
    files = {name: {"sha256": "0" * 64, "bytes": 1} for name in WRITTEN}
    manifests.write(target / "manifest.json", {"schema": SCENE_SCHEMA, "files": files}, settled=False)


NAMES = st.sampled_from(["room.blend", "renders/a.png", "renders/deep/b.png", "maps/c.txt", ".hidden", "scene.usda"])
STEPS = st.lists(
    st.one_of(st.tuples(st.just("put"), NAMES), st.sampled_from(["again", "killed", "fails", "replaced"])), max_size=12
)


@settings(max_examples=40, deadline=None)
@given(STEPS)
def test_nothing_is_lost_in_any_order(tmp_path_factory, steps):
    target = tmp_path_factory.mktemp("s") / "scenes/room"
    published(target)
    mine = {}
    for version, step in enumerate(steps, 1):
        if isinstance(step, tuple):
            if not target.exists():
                continue
            (target / step[1]).parent.mkdir(parents=True, exist_ok=True)
            (target / step[1]).write_text(f"mine {version}")
            mine[step[1]] = f"mine {version}"
        elif step == "again":  # hook, Snakemake removes the folder, the job publishes and puts back
            kept.set_apart(target)
            published(target, version)
            kept.put_back(target)
        elif step == "killed":  # between the hook and the end
            kept.set_apart(target)
        elif step == "fails":  # the folder is gone, and the hook for failed runs puts back
            kept.set_apart(target)
            shutil.rmtree(target, ignore_errors=True)
            kept.put_back(target)
        else:  # published by hand after a killed run
            kept.set_apart(target)
            published(target, version)
            kept.put_back(target)
        where = [target, kept.place_of(target)]
        found = {name: [(folder / name).read_text() for folder in where if (folder / name).is_file()] for name in mine}
        assert all(mine[name] in texts for name, texts in found.items()), (step, found, mine)
    kept.set_apart(target)
    published(target, 99)
    kept.put_back(target)
    assert {name: (target / name).read_text() for name in mine} == mine
    assert [(target / name).read_text() for name in WRITTEN] == [f"{name} 99" for name in WRITTEN]
    assert not kept.place_of(target).exists()


def test_without_a_manifest_the_record_of_the_stage_tells_what_was_published(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    target = tmp_path / "scenes/room"
    published(target)
    (target / "manifest.json").unlink()
    (target / "mine.txt").write_text("mine")
    (tmp_path / "results/room/publish").mkdir(parents=True)
    (tmp_path / "results/room/publish/published.json").write_text(json.dumps({"files": dict.fromkeys(WRITTEN, "0")}))
    assert kept.set_apart(target) == ["mine.txt"]


def test_a_name_that_the_workflow_takes_later_is_kept_beside(tmp_path):
    target = tmp_path / "room"
    published(target)
    (target / "scene.usda").write_text("mine")
    kept.set_apart(target)
    published(target, 2)
    (target / "scene.usda").write_text("of the workflow")
    kept.put_back(target)
    assert (target / "scene.own.usda").read_text() == "mine" and (target / "scene.usda").read_text() == "of the workflow"


def test_nothing_to_keep_leaves_no_trace(tmp_path):
    assert kept.set_apart(tmp_path / "none") == [] and kept.put_back(tmp_path / "none") == []
    published(tmp_path / "room")
    assert kept.set_apart(tmp_path / "room") == [] and not kept.place_of(tmp_path / "room").exists()


# ------------------------------------------------------------------------------------------- a cheaper quality asks first


@pytest.fixture
def scene(repository, tmp_path, monkeypatch):
    """A scene whose deliverable is of a given quality; returns a function that writes it."""
    (tmp_path / "config/scenes").mkdir(parents=True)
    (tmp_path / "config/scenes/room.yaml").write_text("source: {kind: folder, path: data/room}\n")
    monkeypatch.chdir(tmp_path)

    def finished(quality, views, size):
        capture = {"views": views, "width": size, "height": size}
        document = {"quality": quality, "settings": {"capture": capture, "prior": {"samples": 8}}}
        (tmp_path / "scenes/room").mkdir(parents=True, exist_ok=True)
        (tmp_path / "scenes/room/manifest.json").write_text(json.dumps(document))

    return finished


def test_a_cheaper_result_replaces_a_finished_one_only_if_told(scene):
    choose.refuse_cheaper("room", "draft", {})  # there is none yet
    scene("standard", 60, 512)
    with refused("scenes/room", "standard", "draft", "replace=yes"):
        choose.refuse_cheaper("room", "draft", {"quality": "draft"})
    for yes in ("yes", True, "True"):
        choose.refuse_cheaper("room", "draft", {"quality": "draft", "replace": yes})
    with refused("scenes/room"):
        choose.refuse_cheaper("room", "draft", {"replace": "no"})
    choose.refuse_cheaper("room", "standard", {})  # the same
    choose.refuse_cheaper("room", "paper", {})  # a dearer one
    scene("draft", 60, 512)
    choose.refuse_cheaper("room", "draft", {})  # the same quality with fewer photographs: the scene file was changed
    scene("of-long-ago", 60, 512)
    choose.refuse_cheaper("room", "draft", {})


@pytest.mark.parametrize("value", ["maybe", 3, "y"])
def test_what_replace_may_be(value):
    with refused("replace", value, "yes", "no"):
        choose.read({"replace": value}, 2)
