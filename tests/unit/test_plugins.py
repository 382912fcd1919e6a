"""Plug-ins: what IIF_PLUGINS adds, and that nothing else changes (workflow/plugins.py)."""

import json
import os
import subprocess
import sys

import pytest

SCENE = "source: {kind: folder, path: photos}\n"
KITCHEN = "from workflow.runtime import fingerprint as fp; print({s: fp.fingerprint(s, 'kitchen', 'draft') for s in fp.NEEDED})"


@pytest.fixture
def python(repository):
    """`python(code, plugins)`: what a process prints that has these plug-ins; `error` is what it said if it failed."""

    def run(code: str, plugins: str = "", folder=None) -> subprocess.CompletedProcess:
        environment = {**os.environ, "IIF_PLUGINS": plugins, "PYTHONPATH": str(repository)}
        command = [sys.executable, "-c", code]
        return subprocess.run(command, cwd=folder or repository, env=environment, capture_output=True, text=True)

    return run


def good(done: subprocess.CompletedProcess) -> str:
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_a_plug_in_that_takes_no_part_changes_no_fingerprint(python):
    assert good(python(KITCHEN)) == good(python(KITCHEN, "tests.extra_names"))


def test_settings_that_became_constants_are_refused_with_what_became_of_them(python, tmp_path):
    """Without plug-ins, of which that of the laboratory has some of them still."""
    gone = {
        "kind: fipt, validation: none": ["source.validation", "held out"],
        "kind: fipt, ids: parts": ["source.ids", "IndexMA"],
        "kind: scannetpp, lists: train": ["source.lists", "held out"],
        "kind: scannetpp, drop_bad: false": ["source.drop_bad", "left out"],
        "kind: folder}\nreport: {views: 3": ["report.views", "6 of them"],
        "kind: folder}\nsegmentation: {colour: 0": ["segmentation.colour", "`scale`"],
        "kind: folder}\nsegmentation: {kind: masks, sam2: {confidence: 0.5}": ["segmentation.sam2.confidence", "same for all"],
    }
    (tmp_path / "config/scenes").mkdir(parents=True)
    for number, text in enumerate(gone):
        (tmp_path / f"config/scenes/s{number}.yaml").write_text(f"source: {{path: p, {text}}}\n")
    code = f"""
from iif_core.errors import InputError
from workflow import settings
for number in range({len(gone)}):
    try:
        settings.load(f"s{{number}}")
    except InputError as error:
        print(error)
"""
    said = good(python(code, folder=tmp_path)).splitlines()
    assert len(said) == len(gone)
    for line, (key, remedy) in zip(said, gone.values(), strict=True):
        assert f"`{key}`: unknown key." in line and remedy in line and "delete it" in line or "move the other" in line, line


@pytest.mark.parametrize("first", ["workflow.settings", "workflow.registry", "tests.extra.settings"])
def test_a_plug_in_adds_kinds_fields_and_stages(python, first):
    code = f"""
import {first}, json
from workflow import plugins, registry, settings
found = settings.SceneSettings.model_validate({{"source": {{"kind": "extra"}}, "base": {{"extra": "yes"}}, "weight": 2}})
document = settings.dump(found)
recorded = settings.recorded(document, ("base",))["base"]
unused = settings.recorded(settings.dump(settings.SceneSettings.model_validate({{"source": {{"kind": "extra"}}}})), ("base",))
print(json.dumps([document["source"], recorded["extra"], "extra" in unused["base"], document["weight"],
    plugins.implementation("source", "extra"), registry.STAGES["weigh"].module, registry.STAGES["weigh"].on_demand]))
"""
    source = {"kind": "extra", "count": 3}
    expected = [source, "yes", False, 2, "tests.extra.source", "tests.extra.weigh", True]
    assert json.loads(good(python(code, "tests.extra_names"))) == expected


def test_a_module_in_the_place_of_a_stage_counts_with_its_code_and_what_it_reads(python, tmp_path):
    (tmp_path / "config/scenes").mkdir(parents=True)
    (tmp_path / "config/scenes/ours.yaml").write_text(SCENE)
    (tmp_path / "config/scenes/theirs.yaml").write_text(SCENE + "base: {extra: 'yes'}\n")
    code = """
import json
from workflow.runtime import fingerprint as fp
fp.raw_inputs = lambda stage, document: []
out = []
for scene in ("ours", "theirs"):
    document = fp.parsed(fp.resolved(scene, "draft"))
    marks = {stage: fp.fingerprint(stage, scene, "draft") for stage in ("segmentation", "base", "emission")}
    modules = fp.stage_modules("base", document)
    out.append([fp.module_of("base", document), "tests.extra.source" in modules, "capture.dynamic_range" in
        fp.settings_of("base", document), marks])
print(json.dumps(out))
"""
    ours, theirs = json.loads(good(python(code, "tests.extra_names", tmp_path)))
    assert ours[:3] == ["workflow.stages.base", False, False]
    assert theirs[:3] == ["tests.extra.solver", True, True]
    assert [ours[3][stage] == theirs[3][stage] for stage in ours[3]] == [True, False, False]


def test_without_plug_ins_an_unknown_kind_is_refused_with_those_that_exist(python, tmp_path):
    (tmp_path / "config/scenes").mkdir(parents=True)
    (tmp_path / "config/scenes/room.yaml").write_text("source: {kind: extra}\n")
    said = python("from workflow.settings import load; load('room')", folder=tmp_path)
    assert said.returncode and "InputError: config/scenes/room.yaml: `source.kind`" in said.stderr
    assert "'extra'" in said.stderr and "folder, photographs, scannetpp, fipt" in said.stderr
    assert good(python("from workflow.settings import load; print(load('room').source.kind)", "tests.extra_names", tmp_path))


def test_a_name_of_no_module_is_refused(python):
    said = python("import workflow.settings", "tests.extra_names, nowhere.at_all")
    assert said.returncode and "InputError: IIF_PLUGINS" in said.stderr and "'nowhere.at_all'" in said.stderr


def test_the_schema_is_that_of_the_product_alone(python, repository):
    page = repository / "docs/site/settings_page.py"
    code = f"import json, runpy; print(json.dumps(runpy.run_path({str(page)!r})['written']()))"
    found = json.loads(good(python(code)))
    assert len(found) == 3 and found == {name: (repository / name).read_text() for name in found}
    refused = python(f"import runpy; runpy.run_path({str(page)!r}, run_name='__main__')", "tests.extra_names")
    assert refused.returncode and "IIF_PLUGINS" in refused.stderr
