"""The scenes of the paper as lines of a batch, with miniatures in the place of what a person downloads."""

import csv
import json
import shutil

import pytest

from tests.unit import scannetpp_scene as mini
from workflow.settings.batch_table import read_table

SMALL = (
    "capture.width=48;capture.height=48;prior.samples=3;emission.rows=2000;emission.samples=8;shading.samples=8;"
    "shading.levels=6;affines.pixels=8000;render.samples=8;report.views=2;room.lightmap_size=128;room.samples=64"
)


@pytest.fixture
def table(repository):
    return (repository / "config/paper-scenes.tsv").read_text()


def test_nine_scenes_lack_nothing_but_their_data(workflow, table):
    (workflow.folder / "config/batch.tsv").write_text(table)
    lines = read_table(workflow.folder)
    assert len(lines) == 9
    said = workflow.run("scenes", "-n").stderr
    for line in lines:
        assert f"line {line.number}: {line.path}: not found" in said, said


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

    assert workflow.run("scenes").returncode == 1
    with (workflow.folder / "results/batch/summary.tsv").open(newline="") as file:
        rows = {row["scene"].removeprefix("scannetpp-"): row for row in csv.DictReader(file, delimiter="\t")}
    assert [rows[path.name]["status"] for path in (whole, meshless, unmasked)] == ["done", "refused", "refused"]
    assert "mesh_aligned_0.05.ply: not found; download the scene's `scans` too" in rows[meshless.name]["reason"]
    assert "1 mask(s) not found" in rows[unmasked.name]["reason"] and hidden in rows[unmasked.name]["reason"]
    capture = json.loads((workflow.folder / f"results/scannetpp-{whole.name}/capture/capture.json").read_text())
    assert "1 photographs that the release marks as bad are left out" in capture["notes"]
    assert rows[whole.name]["views"] == "5" and float(rows[whole.name]["rgb_psnr_held_out"]) > 10
    assert (workflow.folder / f"scenes/scannetpp-{whole.name}/report.html").is_file()


def _names(table):
    return [line.split("\t")[0].removeprefix("scannetpp-") for line in table.splitlines() if line.startswith("scannetpp")]
