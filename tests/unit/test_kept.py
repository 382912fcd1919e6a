"""Files that people put into a deliverable are carried into the next one, and never lost, whatever is killed between."""

import json
import shutil

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.errors import refused
from workflow.artifacts import kept, swap
from workflow.artifacts import manifest as manifests
from workflow.artifacts.manifest import SCENE_SCHEMA
from workflow.trade import choose

WRITTEN = ("scene.glb", "maps/000.exr")


def published(target, version=0, names=WRITTEN):
    """A deliverable as stage publish leaves it."""
    shutil.rmtree(target, ignore_errors=True)
    for name in names:
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        (target / name).write_text(f"{name} {version}")
    files = {name: {"sha256": "0" * 64, "bytes": 1} for name in names}
    manifests.write(target / "manifest.json", {"schema": SCENE_SCHEMA, "files": files}, settled=False)


NAMES = st.sampled_from(
    ["room.blend", "renders/a.png", "renders/deep/b.png", "maps/c.txt", ".hidden", "extra.usda", "extra.own.usda"]
)
STEPS = st.lists(st.one_of(st.tuples(st.just("put"), NAMES), st.sampled_from(["again", "killed", "more"])), max_size=12)


def texts(*folders):
    return [path.read_text() for folder in folders for path in folder.rglob("*") if path.is_file()]


@settings(max_examples=60, deadline=None)
@given(STEPS)
def test_nothing_is_lost_in_any_order(tmp_path_factory, steps):
    """Put files, publish, be killed after either rename, and publish names that the user took first."""
    target = tmp_path_factory.mktemp("s") / "scenes/room"
    published(target)
    mine, written = set(), list(WRITTEN)
    for version, step in enumerate(steps, 1):
        if isinstance(step, tuple):
            place = target / step[1]
            place.parent.mkdir(parents=True, exist_ok=True)
            if step[1] in written:
                continue
            mine.discard(place.read_text() if place.is_file() else "")  # what the user overwrites is the user's to lose
            place.write_text(f"mine {version}")
            mine.add(f"mine {version}")
        elif step == "more":
            written.append("extra.usda")
        else:
            temporary = target.with_name(".room.tmp")
            published(temporary, version, written)
            if step == "killed":  # between the two renames and what follows
                kept.carry(swap.set_aside(target), target)
                shutil.rmtree(swap.set_aside(target), ignore_errors=True)
                target.rename(swap.set_aside(target))
                temporary.rename(target)
            else:
                swap.replace(temporary, target)
        assert mine <= set(texts(target, swap.set_aside(target))), (step, mine)
    published(target.with_name(".room.tmp"), 99, written)
    swap.replace(target.with_name(".room.tmp"), target)
    assert mine <= set(texts(target)) and not swap.set_aside(target).exists()
    assert [(target / name).read_text() for name in written] == [f"{name} 99" for name in written]


def test_without_a_manifest_the_record_of_the_stage_tells_what_was_published(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    old, target = tmp_path / "scenes/.room.old", tmp_path / "scenes/room"
    published(old, names=[*WRITTEN, "dropped.json"])
    (old / "manifest.json").unlink()
    (old / "mine.txt").write_text("mine")
    published(target)
    (tmp_path / "results/room/publish").mkdir(parents=True)
    (tmp_path / "results/room/publish/published.json").write_text(json.dumps({"files": {"dropped.json": "0"}}))
    assert kept.carry(old, target) == ["mine.txt"]


def test_names_that_are_taken_are_counted(tmp_path):
    old, target = tmp_path / "old", tmp_path / "room"
    published(old)
    for name in ("extra.usda", "extra.own.usda"):
        (old / name).write_text(f"mine {name}")
    published(target, names=[*WRITTEN, "extra.usda"])
    assert kept.carry(old, target) == ["extra.own.usda", "extra.own2.usda"]
    assert (target / "extra.own.usda").read_text() == "mine extra.own.usda"
    assert (target / "extra.own2.usda").read_text() == "mine extra.usda"


@pytest.mark.parametrize(("mine", "new"), [("extra/a.txt", "extra"), ("extra", "extra/a.txt"), ("a/extra/b.txt", "a/extra")])
def test_a_folder_and_a_file_of_one_name_both_stay(tmp_path, mine, new):
    old, target = tmp_path / "old", tmp_path / "room"
    published(old)
    (old / mine).parent.mkdir(parents=True, exist_ok=True)
    (old / mine).write_text("mine")
    published(target, names=[*WRITTEN, new])
    assert kept.carry(old, target) == [mine.replace("extra", "extra.own")]
    assert (target / mine.replace("extra", "extra.own")).read_text() == "mine"
    assert (target / new).read_text() == f"{new} 0"


def test_what_snakemake_leaves_is_not_the_users(tmp_path):
    published(tmp_path / "old")
    published(tmp_path / "room")
    (tmp_path / "old/.snakemake_timestamp").touch()
    assert kept.carry(tmp_path / "old", tmp_path / "room") == []
    assert kept.carry(tmp_path / "none", tmp_path / "room") == []


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
