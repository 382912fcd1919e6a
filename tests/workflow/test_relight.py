"""`snakemake relight/<scene>` and `relight/<scene>/<plan>`: pictures under other light, without touching what is published."""

import json

import pytest
from support import error_of, planned

from tests.errors import named
from workflow.artifacts.files import read_exr, read_parquet
from workflow.artifacts.store import rgb

RELIGHT = """
relight:
  - {name: dimmed, emitters: 0.5, samples: 8}
  - name: lamp
    emitters: off
    sphere: {center: [1.0, 1.0, 1.2], path_to: [1.2, 1.0, 1.2], radius: 0.1, radiance: [20, 20, 20]}
    camera: {frames: 2, width: 32, height: 24, views: ["000"]}
    samples: 8
    video: {codec: h264}
"""
PLAN = """
relight:
  - {name: half, emitters: 0.5, samples: 8, camera: &still {width: 32, height: 24}}
  - {name: painted, materials: {0: {albedo: [0.1, 0.6, 0.1]}}, samples: 8, camera: *still}
"""


def pictures(folder):
    """Files of a folder without what Snakemake leaves there."""
    return sorted(p.relative_to(folder).as_posix() for p in folder.rglob("[!.]*") if p.is_file())


def files_of(*frames, more=()):
    """What is delivered, with the pictures of these frames."""
    names = [name.format(of) for name in frames for of in ("frame", "before")]
    return sorted([*(f"{name}.{kind}" for name in names for kind in ("exr", "png")), "contact_sheet.png", "relight.json", *more])


def test_relighting_is_made_on_demand(workflow):
    path = workflow.folder / "config/scenes/tiny.yaml"
    path.write_text(path.read_text() + RELIGHT)
    assert planned(workflow.run("relight/tiny", "-n")) == {"lamp_images", "relight", "relit"}
    assert "Nothing to be done" in workflow.run("scenes/tiny").stderr
    result = workflow.run("relight/tiny")
    assert result.returncode == 0, result.stderr[-3000:]
    folder = workflow.folder / "relight/tiny"
    assert pictures(folder) == files_of("dimmed/{}_0000", "lamp/{}_0000", "lamp/{}_0001", more=["lamp/video.mp4"])
    assert read_exr(folder / "lamp/frame_0001.exr")["R"].shape == (24, 32)
    facts = json.loads((folder / "relight.json").read_text())["relightings"]
    assert [entry["frames"] for entry in facts] == [1, 2] and all(entry["exposure"] > 0 for entry in facts)
    assert [entry["method"] for entry in facts] == ["recombined", "path traced"]
    dimmed, before = (rgb(read_exr(folder / f"dimmed/{name}_0000.exr")) for name in ("frame", "before"))
    assert dimmed.sum() == pytest.approx(0.5 * before.sum(), rel=1e-3)

    # Another factor is another sum: the light of the lamps is not traced again, and no other frame is.
    def stamp(of):
        return (workflow.folder / of).stat().st_mtime_ns

    kept = "results/tiny/relight/lamp/frame_0000.exr", "results/tiny/lamp_images/manifest.json"
    stamps = [stamp(of) for of in kept]
    path.write_text(path.read_text().replace("emitters: 0.5", "emitters: 0.25"))
    assert planned(workflow.run("relight/tiny", "-n")) == {"relight", "relit"}
    result = workflow.run("relight/tiny")
    assert result.returncode == 0, result.stderr[-3000:]
    assert rgb(read_exr(folder / "dimmed/frame_0000.exr")).sum() == pytest.approx(0.25 * before.sum(), rel=1e-3)
    assert [stamp(of) for of in kept] == stamps


@pytest.mark.long
def test_plans_stand_beside_the_relightings_of_a_scene(workflow):
    """A plan, the example for scenes without relightings, a second scene, and what cannot be asked for."""
    plans = workflow.folder / "config/relight"
    plans.mkdir()
    (plans / "plan.yaml").write_text(PLAN)
    (plans / "example.yaml").write_text("relight: [{name: dimmed, emitters: 0.3, samples: 4}]\n")
    result = workflow.run("relight/tiny/plan")
    assert result.returncode == 0, result.stderr[-3000:]
    folder = workflow.folder / "relight/tiny"
    expected = files_of("half/{}_0000", "painted/{}_0000")
    assert pictures(folder / "plan") == expected
    assert "Nothing to be done" in workflow.run("scenes/tiny").stderr
    # The example of a scene without relightings. What its plans left stays there, and is made again if a picture is missing.
    result = workflow.run("relight/tiny")
    assert result.returncode == 0, result.stderr[-3000:]
    assert (folder / "dimmed/frame_0000.png").is_file() and pictures(folder / "plan") == expected
    assert "Nothing to be done" in workflow.run("relight/tiny/plan").stderr
    (folder / "plan/half/frame_0000.png").unlink()
    assert planned(workflow.run("relight/tiny/plan", "-n")) == {"relit_plan"}
    both = workflow.run("relight/tiny", "relight/tiny/plan", "-n")
    named(error_of(both), "`relight/tiny`")
    unknown = workflow.run("relight/tiny/plna", "-n")
    named(error_of(unknown), "config/relight/plna.yaml", "plan")
    workflow.write("small", (workflow.folder / "config/scenes/tiny.yaml").read_text())
    assert {"lamp_images", "relight", "relit_plan", "capture"} <= planned(
        workflow.run("relight/tiny/plan", "relight/small/plan", "-n")
    )


@pytest.mark.parametrize(
    "text, names",
    [
        ("{name: a, lamps: {chandelier: off}}", ["relight.lamps", "a", "'chandelier'"]),
        ("{name: a, insert: [{file: chair.glb, position: [0, 0, 0]}]}", ["relight.insert.file", "a", "'chair.glb'"]),
    ],
)
def test_mistakes_stop_before_any_job(workflow, text, names):
    path = workflow.folder / "config/scenes/tiny.yaml"
    path.write_text(path.read_text() + f"relight: [{text}]\n")
    result = workflow.run("relight/tiny")
    named(error_of(result), *names)
    assert "rule lamp_images" not in result.stderr


@pytest.mark.long
def test_a_correction_by_hand_reruns_the_fit_alone(workflow):
    path = workflow.folder / "config/scenes/tiny.yaml"
    text = path.read_text()
    path.write_text(text + "materials: {tabel: {metallic: 1}}\n")
    wrong = workflow.run("scenes/tiny", "-n")
    named(error_of(wrong), "materials", "'tabel'")
    path.write_text(text + "materials: {0: {metallic: 0, roughness: 0.6}}\n")
    assert planned(workflow.run("scenes/tiny", "-n")) == {"affines", "render", "metrics", "export", "room", "report", "publish"}
    result = workflow.run("results/tiny/affines/manifest.json")
    assert result.returncode == 0, result.stderr[-3000:]
    table = read_parquet(workflow.folder / "results/tiny/affines/objects.parquet")
    assert table["given"][0] == "roughness, metallic" and not any(table["given"][1:])
    assert table["T_roughness"][0].tolist() == [0, 0.6] and table["T_metallic"][0].tolist() == [0, 0]
    assert not table["std_roughness"][0].any() and not table["std_metallic"][0].any()
    plan = json.loads((workflow.folder / "results/tiny/affines/affines.json").read_text())["plan"]
    assert "given by hand" in next(item for item in plan if item["component"] == "given_materials")["reason"]
