"""The scenes of the paper as lines of a batch, with miniatures in the place of what a person downloads."""

import shutil

import pytest

from tests.unit import scannetpp_scene as mini
from workflow.artifacts.files import read_parquet
from workflow.settings.batch_table import read_table

SMALL = (
    "capture.width=48;capture.height=48;prior.samples=3;emission.rows=2000;emission.samples=8;shading.samples=8;"
    "shading.levels=6;affines.pixels=8000;render.samples=8"
)


@pytest.fixture
def table(repository):
    return (repository / "config/paper-scenes.tsv").read_text()


@pytest.mark.long
def test_nine_scenes_lack_nothing_but_their_data(workflow, table):
    (workflow.folder / "config/batch.tsv").write_text(table)
    lines = read_table(workflow.folder)
    assert len(lines) == 9
    said = workflow.run("scenes", "-n").stderr
    for line in lines:
        assert f"line {line.number}: {line.path}: " in said, said


@pytest.mark.long
def test_first_contact_with_scannetpp(workflow, table):
    """Masks, bad and test photographs, a scene without its mesh, one without a mask: what can be made is, the rest is named."""
    room = mini.room()
    whole, meshless, unmasked = (workflow.folder / "data/scannetpp/data" / name for name in _names(table))
    mini.release(whole, room, mini.traced(room, 6, 64))
    for copy in (meshless, unmasked):
        shutil.copytree(whole, copy)
    (meshless / "scans/mesh_aligned_0.05.ply").unlink()
    hidden = f"dslr/resized_anon_masks/{mini.name(mini.MASKED[1]).replace('JPG', 'png')}"
    (unmasked / hidden).unlink()
    lines = [line for line in table.splitlines() if line.startswith(("name", "scannetpp"))]
    (workflow.folder / "config/batch.tsv").write_text("\n".join([lines[0], *(f"{line};{SMALL}" for line in lines[1:])]) + "\n")

    planned = workflow.run("scenes", "-n").stderr
    assert f"{meshless.relative_to(workflow.folder)}/scans/mesh_aligned_0.05.ply: " in planned
    assert f"{unmasked.name}/{hidden}" in planned

    scene = workflow.folder / f"results/scannetpp-{whole.name}"
    result = workflow.run(f"results/{scene.name}/metrics/manifest.json")
    assert result.returncode == 0, result.stderr[-3000:]
    assert "1 photographs that the release marks as bad are left out" in (scene / "capture/capture.json").read_text()
    scores = read_parquet(scene / "metrics/metrics.parquet")
    psnr = {key: scores["value"][(scores["quantity"] == key) & (scores["metric"] == "psnr")] for key in ("rgb", "rgb_held_out")}
    assert [len(values) for values in psnr.values()] == [3, 2] and all((values > 10).all() for values in psnr.values()), psnr


def _names(table):
    return [line.split("\t")[0].removeprefix("scannetpp-") for line in table.splitlines() if line.startswith("scannetpp")]
