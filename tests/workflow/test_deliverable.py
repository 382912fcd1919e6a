"""The deliverable of the tiny scene: the files and columns that users rely on."""

import json
import shutil

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
import yaml
from support import planned

from workflow.artifacts import swap

FILES = """scene.glb mitsuba/scene.xml mitsuba/render.py objects.parquet objects.csv emitters.parquet plan.yaml verdict.json
metrics.parquet timings.parquet report.html room.html scene_unlit.glb scene.usdc manifest.json""".split()


@pytest.fixture(scope="module")
def scene(finished):
    return finished.folder / "scenes/tiny"


def test_contract_files_exist_and_are_listed(scene):
    listed = json.loads((scene / "manifest.json").read_text())["files"]
    for name in FILES:
        assert (scene / name).is_file(), name
        assert name == "manifest.json" or name in listed
    assert len(list((scene / "maps").glob("*.exr"))) == 4


def test_contract_columns(scene):
    columns = {p.stem: pq.read_schema(p).names for p in scene.glob("*.parquet")}
    assert columns["metrics"] == ["scene", "view", "quantity", "metric", "protocol", "value"]
    assert columns["timings"][:6] == ["rule", "wildcards", "seconds", "cpu_seconds", "max_rss_mb", "threads"]
    assert {"object_id", "pixels", "T_albedo", "T_roughness", "T_metallic", "residual"} <= set(columns["objects"])
    assert {"emitter_id", "faces", "area_m2", "radiance_r"} <= set(columns["emitters"])


def test_metrics_cover_quantities_and_protocols(scene):
    table = pq.read_table(scene / "metrics.parquet").to_pandas()
    assert {"albedo", "roughness", "metallic", "emission", "rgb"} <= set(table["quantity"])
    assert {"raw", "scaled", "oracle_affine"} <= set(table["protocol"])
    assert np.isfinite(table["value"]).all()


def test_plan_gives_reasons(scene):
    plan = yaml.safe_load((scene / "plan.yaml").read_text())
    items = plan["components"] if isinstance(plan, dict) and "components" in plan else plan
    assert len(items) >= 4
    for item in items:
        assert {"component", "included", "reason"} <= set(item)


def test_report_is_self_contained(scene):
    page = (scene / "report.html").read_text()
    for word in ('src="http', "src='http", 'href="http', "url(http"):
        assert word not in page
    assert page.count("data:image/") >= 10


def test_timings_name_every_job(scene):
    table = pq.read_table(scene / "timings.parquet").to_pandas()
    assert {"capture", "prior", "base", "emission", "shading", "affines", "render"} <= set(table["rule"])
    assert (table["seconds"] > 0).all() and (table["threads"] > 0).all()


def test_the_last_line_says_where_to_look(workflow):
    result = workflow.run("scenes/tiny", "--forcerun", "publish")
    assert result.returncode == 0, result.stderr[-4000:]
    pages = [workflow.folder.resolve() / f"scenes/tiny/{name}.html" for name in ("report", "room")]
    assert result.stderr.rstrip().endswith(f"Open: {pages[0]}\n      {pages[1]}")


OWN = {"room.blend": b"a scene of Blender", "renders/night.png": b"a picture", "maps/notes.txt": b"beside files of the workflow"}


def put(folder, names=OWN):
    for name, data in names.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    (folder / "latest").symlink_to("renders")


def has_own(folder):
    return all((folder / name).read_bytes() == data for name, data in OWN.items()) and (folder / "latest").is_symlink()


def test_files_of_the_user_outlive_a_new_deliverable(workflow):
    scene = workflow.folder / "scenes/tiny"
    put(scene)
    before = json.loads((scene / "manifest.json").read_text())["files"]
    result = workflow.run("scenes/tiny", "--forcerun", "publish")
    assert result.returncode == 0, result.stderr[-4000:]
    assert has_own(scene) and not list(scene.parent.glob(".*"))
    assert json.loads((scene / "manifest.json").read_text())["files"].keys() == before.keys()
    assert workflow.run("scenes/tiny").returncode == 0  # they are no damage
    assert has_own(scene)


def test_files_of_the_user_outlive_a_run_that_was_killed(workflow):
    scene, snakemake = workflow.folder / "scenes/tiny", workflow.folder / ".snakemake"
    put(scene)
    shutil.copytree(scene, snakemake / "backups/scenes/tiny", symlinks=True)  # as Snakemake leaves it
    scene.rename(swap.set_aside(scene))  # between the two renames
    result = workflow.run("scenes/tiny")
    assert result.returncode == 0, result.stderr[-4000:]
    assert has_own(scene) and (scene / "report.html").is_file()
    assert not list(scene.parent.glob(".*")) and not (snakemake / "backups/scenes/tiny").exists()


def test_files_of_the_user_outlive_a_job_that_fails(workflow):
    scene = workflow.folder / "scenes/tiny"
    put(scene)
    record = workflow.folder / "results/tiny/publish"
    shutil.rmtree(record)
    record.write_text("a file where the stage writes its folder")
    result = workflow.run("scenes/tiny", "--forcerun", "publish")
    assert result.returncode != 0
    assert has_own(scene) and (scene / "report.html").is_file()


def test_a_name_is_shown_without_a_new_fit_and_files_that_are_put_there_meanwhile_are_kept(workflow):
    """The files come long after Snakemake has planned: here the stages from `unwrap` on run, for a new name of an object."""
    scene = workflow.folder / "scenes/tiny"
    before = pd.read_csv(scene / "objects.csv").set_index("object_id")["name"]
    assert "north wall" not in before.tolist()
    (workflow.folder / "config/scenes/tiny.yaml").open("a").write("names: {0: north wall}\nreport: {credit: someone}\n")
    put(scene)
    result = workflow.run("scenes/tiny")
    assert result.returncode == 0, result.stderr[-4000:]
    assert planned(result) == {"unwrap", "export", "room", "report", "publish"}
    assert has_own(scene) and "someone" in (scene / "report.html").read_text()
    after = pd.read_csv(scene / "objects.csv").set_index("object_id")["name"]
    assert after[0] == "north wall" and after.drop(0).equals(before.drop(0))
    assert "north wall" in (scene / "room.html").read_text() and b"north wall" in (scene / "scene.glb").read_bytes()
