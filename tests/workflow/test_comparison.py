"""`compare/<a>,<b>`, `score/<scene>` and scored relighting on the tiny scene."""

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from tests.errors import named, refused
from workflow.artifacts import StageReader
from workflow.artifacts import manifest as manifests
from workflow.artifacts.files import write_exr
from workflow.artifacts.store import rgb, split_rgb
from workflow.comparison.maps import find, read_map


def fails(workflow, *arguments: str) -> str:
    result = workflow.run(*arguments)
    assert result.returncode != 0 and "Traceback" not in result.stderr and "Select jobs" not in result.stderr
    return result.stderr


def hand_over(folder: Path, maps: Path) -> None:
    """Write our own maps as somebody else would deliver theirs."""
    fitted = StageReader(folder / "results/tiny/affines", "affines", "tiny")
    rendered = StageReader(folder / "results/tiny/render", "render", "tiny")
    for name in fitted.names("maps/"):
        view, channels = Path(name).stem, rendered.exr(name)
        own = fitted.exr(f"maps/{view}.exr")
        write_exr(maps / f"albedo/{view}.exr", split_rgb(rgb(own, "albedo")))
        for quantity in ("roughness", "metallic"):
            write_exr(maps / f"{quantity}/{view}.exr", {"Y": own[quantity].astype(np.float32)})
        write_exr(maps / f"emission/{view}.exr", split_rgb(rgb(channels, "emission")))
        write_exr(maps / f"rgb/{view}.exr", split_rgb(rgb(channels)))


@pytest.mark.long
def test_our_own_maps_score_as_stage_metrics_says(workflow):
    hand_over(workflow.folder, workflow.folder / "mine")
    result = workflow.run("score/tiny", "--config", "maps=mine")
    assert result.returncode == 0, result.stderr[-3000:]
    keys = ["view", "quantity", "metric", "protocol"]
    ours = pd.read_parquet(workflow.folder / "results/tiny/metrics/metrics.parquet").set_index(keys)["value"]
    found = pd.read_parquet(workflow.folder / "score/tiny/scores.parquet").set_index(keys)["value"]
    of_images = ours[(ours.index.get_level_values("view") != "all")]
    of_images = of_images.drop([key for key in of_images.index if key[1] == "rgb" and key[2] == "log_l2"])
    assert set(found.index) == set(of_images.index) and len(found) > 100
    materials = [key for key in found.index if key[1] != "rgb"]
    assert (found[materials] == of_images[materials]).all()
    rest = [key for key in found.index if key[1] == "rgb"]
    assert np.allclose(found[rest], of_images[rest], rtol=1e-4)
    page = (workflow.folder / "score/tiny/score.html").read_text()
    assert "albedo: 4 of 4 views" in page and "http" not in page.partition("<body>")[2]
    assert "Nothing to be done" in workflow.run("score/tiny", "--config", "maps=mine").stderr


def test_the_maps_of_a_finished_scene_are_maps(workflow):
    """The layers of maps/ are the quantities, and say the same as a folder for each quantity."""
    hand_over(workflow.folder, workflow.folder / "mine")
    views = [path.stem for path in sorted((workflow.folder / "mine/albedo").iterdir())]
    layered, apart = (find(workflow.folder / of, "auto", views) for of in ("scenes/tiny/maps", "mine"))
    assert set(layered.files) == {"albedo", "roughness", "metallic", "emission"}
    for name in views:
        view = SimpleNamespace(name=name, width=48, height=48)
        dark = read_map(layered, "emission", view).sum(-1) == 0  # emitters are black in the maps that are delivered
        for quantity, files in layered.files.items():
            assert list(files) == views
            found, wanted = (read_map(of, quantity, view)[dark] for of in (layered, apart))
            assert dark.mean() > 0.5 and np.allclose(found, wanted, rtol=2e-3, atol=2e-3), (quantity, name)
    with refused("view 003", "000, 001, 002"):
        find(workflow.folder / "scenes/tiny/maps", "auto", views[:-1])


@pytest.mark.long
def test_maps_that_are_not_there_stop_before_any_job(workflow):
    named(fails(workflow, "score/tiny"), "score/tiny", "--config maps=<folder>")
    named(fails(workflow, "score/tiny", "--config", "maps=nowhere"), "--config maps=nowhere")


def test_a_result_beside_itself_and_beside_another(workflow):
    folder = workflow.folder
    assert workflow.run("compare/tiny,tiny").returncode == 0
    same = pd.read_parquet(folder / "compare/tiny,tiny/compare.parquet")
    assert same["same"].all() and set(same["part"]) == {"settings", "code", "versions", "plan", "scores", "objects", "pictures"}
    numbers = same[same["part"].isin(["scores", "objects", "pictures"])]
    assert len(numbers) > 50 and (numbers["difference"] == 0).all()
    assert "No difference." in (folder / "compare/tiny,tiny/compare.html").read_text()

    # Another result, planted: the albedo of every cell is halved, and one setting is another.
    shutil.copytree(folder / "results/tiny", folder / "results/other")
    manifest = folder / "results/other/affines/manifest.json"
    document = json.loads(manifest.read_text())
    document["settings"]["affines"]["pixels"] += 1
    cells = pd.read_parquet(manifest.with_name("cells.parquet"))
    cells[[f"albedo_{c}" for c in "rgb"]] *= np.float32(0.5)
    cells.to_parquet(manifest.with_name("cells.parquet"))
    path = manifest.with_name("cells.parquet")
    from workflow.artifacts.files import sha256_of

    document["files"]["cells.parquet"] |= {"sha256": sha256_of(path), "bytes": path.stat().st_size}
    manifests.write(manifest, document)
    result = workflow.run("compare/tiny,other")
    assert result.returncode == 0, result.stderr[-2000:]
    rows = pd.read_parquet(folder / "compare/tiny,other/compare.parquet")
    differing = rows[~rows["same"]]
    assert differing[differing["part"] == "settings"]["name"].tolist() == ["affines.pixels"]
    objects = differing[differing["part"] == "objects"]
    assert objects["name"].str.contains("/albedo_").all() and len(objects) >= 3
    assert np.allclose(objects["b"].astype(float) / objects["a"].astype(float), 0.5, rtol=1e-3)
    assert set(differing["part"]) == {"settings", "objects"}


@pytest.mark.long
def test_results_that_are_not_there_stop_before_any_job(workflow):
    named(fails(workflow, "compare/tiny,tinny"), "config/scenes/tinny.yaml", "tiny")
    shutil.rmtree(workflow.folder / "results/tiny/affines")
    named(fails(workflow, "compare/tiny,tiny"), "results/tiny", "affines")


@pytest.mark.long
def test_the_tiny_room_under_new_light(workflow):
    path = workflow.folder / "config/scenes/tiny.yaml"
    path.write_text(path.read_text() + "relit: {views: 1, lamps: 1, spheres: 1, samples: 64}\n")
    laboratory = str(workflow.repository / "lab/Snakefile")
    result = workflow.run("-s", laboratory, "results/tiny/relit_scores/manifest.json")
    assert result.returncode == 0, result.stderr[-3000:]
    folder = workflow.folder / "results/tiny"
    lights = json.loads((folder / "relit_truth/lights.json").read_text())
    assert [light["kind"] for light in lights["lights"]] == ["lamp", "moved", "sphere"]
    reasons = {gone["light"]: gone["reason"] for gone in lights["left_out"]}
    assert "no opening" in reasons.pop("environment") and list(reasons.values()) == ["only the 1 strongest shine alone"]
    table = pd.read_parquet(folder / "relit_scores/scores.parquet")
    assert set(table["quantity"]) == {"relit_lamp", "relit_moved", "relit_sphere"} and table["found"].all()
    psnr = table[table["metric"] == "psnr"].set_index(["variant", "light", "protocol"])["value"]
    for light in psnr["result"].index.unique("light"):
        assert psnr["result", light, "raw"] > 22 and psnr["noise", light, "raw"] > psnr["result", light, "raw"] - 3
    lamps = json.loads((folder / "relit_scores/scores.json").read_text())["lamps"]
    assert [lamp["found"] for lamp in lamps] == [True, True]
    assert all(0.7 < lamp["power_ratio"] < 1.4 and lamp["overlap"] > 0.9 for lamp in lamps)
