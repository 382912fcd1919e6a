"""The plan of a scene through the real workflow: what runs for it, what is left out because of it, how it is overridden."""

import json

import pytest
import yaml
from support import planned

OFF = "components: {specular: off, denoiser: off}\n"


def test_the_plan_needs_capture_alone_and_is_shown(workflow):
    assert planned(workflow.run("-n", "plan/tiny")) == {"planned"}  # the tiny scene is finished
    (workflow.folder / "results/tiny/plan/plan.yaml").unlink()
    result = workflow.run("plan/tiny", "--forcerun", "plan")
    assert result.returncode == 0, result.stderr[-4000:]
    shown = yaml.safe_load((workflow.folder / "plan/tiny/plan.yaml").read_text())
    said = result.stdout + result.stderr
    assert "environment: left out: " in said and "what was read:\n  4 photographs" in said and "component:" not in said
    of = {item["component"]: item for item in shown["components"]}
    assert of["environment"]["status"] == "settled" and "closed" in of["environment"]["reason"]
    assert of["camera_response"]["included"] is False  # linear photographs
    assert of["metallic"]["status"] == "provisional" and of["metallic"]["override"].startswith("components: {")
    expected = of["radiance_cache"]["expected"]
    assert expected["rooms"] >= 3 and "cpu_seconds" in expected and len(expected["held_out_db_range"]) == 2
    assert not planned(workflow.run("-n", "plan/tiny"))
    (workflow.folder / "plan/tiny/plan.yaml").unlink()
    assert planned(workflow.run("-n", "plan/tiny")) == {"planned"}
    # The plan is cheap, and says what it looked at.
    probes = json.loads((workflow.folder / "results/tiny/plan/plan.json").read_text())["probes"]
    assert 0 < probes["points"] <= 2000 and probes["escape_share"] == {"primary": 0.0, "secondary": 0.0}


@pytest.mark.long
def test_what_is_left_out_is_not_done_and_its_reruns_are_the_least(workflow):
    path = workflow.folder / "config/scenes/tiny.yaml"
    text = path.read_text()
    path.write_text(text + "components: {metallic: off}\n")
    again = planned(workflow.run("-n", "scenes/tiny"))
    assert "affines" in again and not again & {"capture", "plan", "base", "emission", "shading"}
    path.write_text(text + OFF)
    result = workflow.run("scenes/tiny")
    assert result.returncode == 0, result.stderr[-4000:]
    folder = workflow.folder / "results/tiny"
    assert json.loads((folder / "shading/shading.json").read_text())["specular"]["pixels"] == 0
    assert "end where radiance was photographed" in json.loads((folder / "render/render.json").read_text())["paths"]
    plan = yaml.safe_load((workflow.folder / "scenes/tiny/plan.yaml").read_text())["components"]
    of = {item["component"]: (item["included"], item["status"]) for item in plan}
    assert of["specular"] == of["denoiser"] == (False, "forced")
    assert "provisional" not in {status for _, status in of.values()}
    page = (workflow.folder / "scenes/tiny/report.html").read_text()
    assert "forced off" in page
