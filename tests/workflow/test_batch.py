"""`snakemake scenes`: bad scenes are named and do not stop the others, and what is done is not done again."""

import csv
import json

import pytest
from support import error_of, planned

from tests.errors import named
from tests.unit import own_scene as own
from tests.workflow.prepared import prepare

HEADER = "name\tsource\tpath\tbase\toverrides\n"
SMALL = "prior.kind=retinex;segmentation.kind=geometry;capture.width=64;capture.height=48"


@pytest.fixture(scope="module")
def ended(finished, tmp_path_factory):
    """A batch of a scene that lacks its last two jobs, one with a misspelt key, one without data, one whose first job fails, and
    one with a file in the place of its folder."""
    workflow = finished.copy(tmp_path_factory.mktemp("batch") / "run")
    for path in ("results/tiny/report/manifest.json", "scenes/tiny/manifest.json"):
        (workflow.folder / path).unlink()
    own.bare(workflow.folder / "data/mm")
    vertices, faces, _ = own.room_mesh()
    own.save_mesh(workflow.folder / "data/mm/mesh.ply", 1000 * vertices, faces)
    workflow.table = workflow.folder / "config/batch.tsv"
    lines = ["tiny", "key\t\t\ttiny\tcapture.veiws=3", f"data\tfolder\tno/where\t\t{SMALL}", f"mm\tfolder\tdata/mm\t\t{SMALL}"]
    lines.append("way\t\t\ttiny\tseed=7")
    (workflow.folder / "scenes/way").touch()
    workflow.table.write_text(HEADER + "".join(f"{line}\n" for line in lines))
    first = "results/mm/capture/manifest.json"
    workflow.said = workflow.run("scenes", "--prioritize", first, "--forcerun", "report")  # so that the failure comes first
    return workflow


def summary(workflow):
    with open(workflow.folder / "results/batch/summary.tsv", newline="") as file:
        return {row["scene"]: row for row in csv.DictReader(file, delimiter="\t")}


def test_the_good_scene_is_done_and_the_bad_ones_are_named(ended):
    assert ended.said.returncode == 1
    rows = summary(ended)
    assert {name: row["status"] for name, row in rows.items()} == {
        "tiny": "done",
        "key": "refused",
        "data": "refused",
        "mm": "failed",
        "way": "refused",
    }
    assert float(rows["tiny"]["rgb_psnr"]) > 10 and float(rows["tiny"]["max_rss_mb"]) > 50
    named(rows["key"]["reason"], "line 3, column overrides", "capture.veiws", "`views`")
    named(rows["data"]["reason"], "line 4", "no/where")
    named(rows["way"]["reason"], "scenes/way")
    assert rows["mm"]["stage"] == "capture" and "5590 m" in rows["mm"]["reason"]
    said = ended.said.stderr
    assert said.index("5590 m") < said.index("publishing scenes/tiny"), "the failure was to come first"
    assert "1 of 5 scenes done" in said and "Traceback" not in said
    page = (ended.folder / "results/batch/report.html").read_text()
    assert page.count('src="pictures/tiny.') == 1 and '"../../scenes/tiny/report.html"' in page


@pytest.mark.long
def test_what_is_left_runs_when_the_table_is_mended_and_then_nothing_does(ended):
    ended.table.write_text(HEADER + "tiny\nmm\t\t\tother\tseed=1\n")
    (ended.folder / "config/scenes/other.yaml").write_text((ended.folder / "config/scenes/tiny.yaml").read_text())
    assert planned(ended.run("scenes", "-n")) >= {"capture", "publish", "batch"}  # mm is another scene now
    ended.table.write_text(HEADER + "tiny\n")
    # `scenes` is what plain `snakemake` makes; the summary that the failed run left is not taken for the one wanted
    assert planned(ended.run("-n")) == {"batch"}
    mended = ended.run("scenes")
    assert mended.returncode == 0 and "1 of 1 scenes done" in mended.stderr, mended.stderr[-2000:]
    assert list(summary(ended)) == ["tiny"]
    assert "Nothing to be done" in ended.run("scenes").stderr


def test_a_table_that_cannot_be_read_stops_at_once(workflow):
    (workflow.folder / "config/batch.tsv").write_text(HEADER + "tiny\ntiny\n")
    result = workflow.run("scenes")
    named(error_of(result), "config/batch.tsv, line 3, column name", "'tiny'", "line 2")
    assert not (workflow.folder / "results/batch").exists()


def test_a_named_scene_of_the_table_stops_with_its_mistake(workflow):
    (workflow.folder / "config/batch.tsv").write_text(HEADER + "tiny\nkey\t\t\ttiny\tcapture.veiws=3\n")
    result = workflow.run("scenes/tiny", "scenes/key")
    named(error_of(result), "config/batch.tsv, line 3, column overrides", "capture.veiws")
    assert not (workflow.folder / "results/key").exists()


@pytest.fixture(scope="module")
def copied(finished, tmp_path_factory):
    """The finished scene, and two that were prepared from it, in a table."""
    workflow = finished.copy(tmp_path_factory.mktemp("prepared") / "run")
    (workflow.folder / "config/batch.tsv").write_text(HEADER + "tiny\na\t\t\ttiny\tseed=5\nb\t\t\ttiny\tseed=6\n")
    with own.working_in(workflow.folder):
        prepare(["a", "b"], "tiny")
    return workflow


@pytest.mark.long
def test_prepared_scenes_are_sound_and_finished(copied):
    """What benchmarks of large batches rest on: such a scene is to everybody what a computed one would be."""
    verified = copied.run("verify")
    assert verified.returncode == 0 and "all artefacts are as they were written" in verified.stdout, verified.stdout
    assert planned(copied.run("scenes", "-n")) == {"batch"}  # nothing but the summary
    assert "Nothing to be done" in copied.run("scenes/a", "scenes/b", "scenes/tiny", "-n").stdout
    found = (copied.folder / f"scenes/{name}/manifest.json" for name in ("a", "b", "tiny"))
    marks = {json.loads(path.read_text())["fingerprint"] for path in found}
    assert len(marks) == 3


@pytest.mark.long
def test_one_scene_is_delivered_before_the_next_goes_on(copied):
    """So that a batch that is stopped has delivered what it could."""
    made = {name: [copied.folder / f"results/{name}/{stage}/manifest.json" for stage in ("metrics", "report")] for name in "ab"}
    for name, paths in made.items():
        paths.append(copied.folder / f"scenes/{name}/manifest.json")
        for path in paths:
            path.unlink()
    result = copied.run("scenes/a", "scenes/b", "--cores", "1")
    assert result.returncode == 0, result.stderr[-2000:]
    first, second = sorted([path.stat().st_mtime_ns for path in paths] for paths in made.values())
    assert first[0] < first[1] < first[2] < second[0] < second[1] < second[2]


@pytest.mark.long
def test_a_prepared_scene_is_made_again_where_it_is_edited_or_damaged(copied):
    table = copied.folder / "config/batch.tsv"
    kept = table.read_text()
    table.write_text(kept.replace("seed=5", "seed=5;render.samples=9"))
    assert planned(copied.run("scenes", "-n")) == {"render", "metrics", "report", "publish", "batch"}
    table.write_text(kept)
    path = copied.folder / "results/b/metrics/metrics.parquet"
    data = bytearray(path.read_bytes())
    path.unlink()  # a link to the file of all
    path.write_bytes(data[:-1] + b"x")
    result = copied.run("scenes", "-n")
    assert planned(result) == {"metrics", "report", "publish", "batch"}
    assert "results/b/metrics/metrics.parquet: " in result.stderr
