"""The setting `names`: objects have other names where people see them, and nothing is fitted again."""

import json

import numpy as np
import pytest

from tests.errors import misset, refused
from workflow import settings
from workflow.decisions import materials
from workflow.registry import STAGES
from workflow.relighting import sheet
from workflow.relighting.inventory import Inventory, Lamp
from workflow.runtime import fingerprint as fp
from workflow.scene.named import renamed
from workflow.settings.by_hand import by_former_names

NAMES = ["white wall 1", "white wall 2", "brown piece", "white wall 3"]


def test_names_take_the_place_of_others():
    assert renamed(NAMES, {"white wall 2": "north wall", "2": "Sofa"}) == ["white wall 1", "north wall", "Sofa", "white wall 3"]
    assert renamed(NAMES, {"piece 0": "a", "1": "white wall 1"}) == ["a", "white wall 1", "brown piece", "white wall 3"]
    assert renamed(NAMES, {}) == NAMES
    with refused("`names`", "'brown pece'", "'brown piece'"):
        renamed(NAMES, {"brown pece": "a"})
    with refused("`names`", "'1'", "'white wall 2'"):
        renamed(NAMES, {"1": "a", "white wall 2": "b"})
    with refused("`names`", 2, "'brown piece'"):
        renamed(NAMES, {"1": "brown piece"})


def test_what_is_no_name_is_refused():
    for name in ("", " sofa", "so\nfa", "x" * 61, "24", "1.5"):
        with misset("names", "value_error", repr(name)[:70]):
            tree(names={"24": name})


def tree(**more):
    source = {"kind": "folder", "path": "data/a"}
    return settings.dump(settings.SceneSettings.model_validate({"source": source, **more}))


def test_what_names_an_object_by_its_new_name_is_kept_by_the_one_before():
    by_hand = {"Sofa": {"metallic": 0}, "brown piece": {"roughness": 0.3}}
    patch = {"scale": {"white_patch": {"object": "north wall", "albedo": 0.8}}}
    relight = [{"name": "a", "materials": {"Sofa": {"metallic": 1}}, "lamps": {"lamp over the table": "off"}}]
    names = {24: "Sofa", "white wall 1": "north wall", "lamp 1": "lamp over the table"}
    document = tree(names=names, materials=by_hand, affines=patch, relight=relight)
    assert set(document["materials"]) == {"24", "brown piece"}
    assert document["affines"]["scale"]["white_patch"]["object"] == "white wall 1"
    (entry,) = document["relight"]
    assert list(entry["materials"]) == ["24"] and list(entry["lamps"]) == ["lamp over the table"]  # ids of lamps are others
    with misset("", "value_error", "'Sofa'", "'24'"):
        tree(names=names, materials=by_hand | {24: {"metallic": 1}})
    assert by_former_names({"a": 1}, {}) == {"a": 1}


def test_one_name_for_several_objects_means_all_of_them():
    names = {"yellow top 1": "oak table", 7: "oak table", 24: "sofa"}
    relight = [{"name": "a", "materials": {"oak table": {"metallic": 1}}}]
    document = tree(names=names, materials={"oak table": {"roughness": 0.4}}, relight=relight)
    assert list(document["materials"]) == list(document["relight"][0]["materials"]) == ["yellow top 1", "7"]
    assert (
        sheet.described(document["relight"][0], Inventory([], []), {str(key): name for key, name in names.items()})
        == "oak table painted"
    )
    with misset("", "value_error", "'oak table'"):
        tree(names=names, affines={"scale": {"white_patch": {"object": "oak table", "albedo": 0.8}}})
    room = Inventory(["a", "b", "c"], [Lamp(0, (0,)), Lamp(1, (2,))], ["lamps", "b", "lamps"])
    assert room.lamps_called("lamps", "x") == [0, 1]


def test_the_plan_says_what_people_call_an_object():
    given = np.full((3, 2), np.nan)
    given[:2, 0] = 0.3
    item = materials.given_by_hand(["brown piece 1", "dark brown piece 1", "c"], given)
    told = materials.by_shown_names(item, {"brown piece 1": "sofa"})["reason"]
    assert told.endswith("sofa (roughness); dark brown piece 1 (roughness)")
    other = {"component": "specular", "reason": "brown piece 1 (x)"}
    assert materials.by_shown_names(other, {"brown piece 1": "sofa"}) == other


def test_a_lamp_is_called_by_either_name():
    names = ["wall", "lamp 1", "lamp 2"]
    room = Inventory(names, [Lamp(0, (1,)), Lamp(4, (2,))], renamed(names, {"lamp 1": "over the table"}))
    assert room.lamps_called("over the table", "x") == room.lamps_called("lamp 1", "x") == [0]
    assert room.lamps_called("lamp 2", "x") == [1] and room.name_of(room.lamps[0]) == "over the table"
    with refused("x", "'over the tabel'", "'over the table'"):
        room.lamps_called("over the tabel", "x")


@pytest.fixture
def marks(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "config/scenes").mkdir(parents=True)

    def of(more):
        text = json.dumps({"source": {"kind": "builtin", "scene": "tiny"}, **more})
        (tmp_path / "config/scenes/t.yaml").write_text(text)
        fp.resolved.cache_clear()
        fp.fingerprint.cache_clear()
        every = [stage for stage in STAGES if not STAGES[stage].on_demand or stage == "relight"]
        return {stage: fp.fingerprint(stage, "t", "draft") for stage in every}

    yield of
    fp.resolved.cache_clear()
    fp.fingerprint.cache_clear()


def test_a_name_changes_only_what_people_look_at(marks):
    by_hand = {"sofa": {"metallic": 0}}
    before, after = marks({"materials": by_hand}), marks({"materials": {"Sofa": {"metallic": 0}}, "names": {"sofa": "Sofa"}})
    changed = {stage for stage in before if before[stage] != after[stage]}
    assert changed == {"unwrap", "export", "room", "report", "publish", "relight"}
    assert np.all([before[stage] for stage in changed])
