"""The batch table: what it makes of its lines, how it names mistakes, and what the summary says of each scene."""

import csv
import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tests.errors import missing, named, refused
from workflow import settings
from workflow.artifacts import StageWriter, sound, stamps
from workflow.artifacts.files import write_exr, write_json, write_parquet
from workflow.batch import causes, standing, summary
from workflow.batch import plan as batch_plan
from workflow.costs.model import Cost
from workflow.runtime import fingerprint as fp
from workflow.runtime.job_state import JobState, reasons
from workflow.scene.named import check_overrides
from workflow.settings import batch_table

HEADER = "name\tsource\tpath\tbase\toverrides\n"
BASE = "source: {kind: folder, path: data/tpl, unit: mm}\nprior: {kind: retinex, samples: 5}\nseed: 4\n"


@pytest.fixture
def project(tmp_path, monkeypatch):
    """A working directory with one scene file, `tpl`, and `write(table)`."""
    (tmp_path / "config/scenes").mkdir(parents=True)
    (tmp_path / "config/scenes/tpl.yaml").write_text(BASE)
    monkeypatch.chdir(tmp_path)
    caches = (fp.resolved, fp.fingerprint, batch_plan.plan, check_overrides)
    for cache in caches:
        cache.cache_clear()

    def write(table, header=HEADER):
        data = table if isinstance(table, bytes) else (header + table).encode()
        (tmp_path / "config/batch.tsv").write_bytes(data)
        for cache in caches:
            cache.cache_clear()
        return tmp_path

    yield write
    for cache in caches:
        cache.cache_clear()


# ---------------------------------------------------------------------------------------------------------------- table


def test_columns_may_come_in_any_order_and_cells_may_be_missing(project):
    project("# remark\n\n x \t data/with space \n0a5c\n", header="name\tpath\tsource\n")
    lines = batch_table.read_table()
    assert [(line.number, line.name, line.path, line.source, line.is_plain) for line in lines] == [
        (4, "x", "data/with space", "", False),
        (5, "0a5c", "", "", True),
    ]


def test_a_scene_of_the_table_can_be_benched(project):
    """At the sizes of the points, with what its line and the scene file of its column `base` set."""
    project("room\tscannetpp\tdata/room\ttpl\tseed=9\n")
    found = settings.load("room--bench-p01-s0")
    point = settings.load("tpl", "p01")
    assert (found.source.kind, str(found.source.path), found.seed) == ("scannetpp", "data/room", 9)
    assert found.prior.samples == 5 and found.capture.width == point.capture.width
    assert found.capture.test_every == 8


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"])
def test_what_spreadsheets_write_is_read(project, end, mark):
    project(mark + f"name\tbase{end}a\ttpl{end}b\ttpl{end}".encode())
    assert [(line.number, line.name, line.base) for line in batch_table.read_table()] == [(2, "a", "tpl"), (3, "b", "tpl")]


def test_without_a_table_every_scene_file_counts(project, tmp_path):
    (tmp_path / "config/scenes/other.yaml").write_text(BASE)
    assert [line.name for line in batch_table.read_table()] == ["other", "tpl"]


@pytest.mark.parametrize(
    ("table", "words"),
    [
        (HEADER, ["name <tab> source <tab> path <tab> base <tab> overrides"]),
        ("name source path\n", ["line 1", "'name source path'", "tabs", "spaces"]),
        ("# x\nname\tsuorce\n", ["line 2", "column 2", "'suorce'", "name, source, path, base, overrides"]),
        ("name\tpath\tpath\n", ["line 1", "column path"]),
        ("path\tbase\n", ["line 1", "column name", "name, source, path, base, overrides"]),
        (HEADER + "a b folder\n", ["line 2, column name", "'a b folder'", "tabs", "spaces"]),
        (HEADER + "a,folder,data/a\n", ["line 2, column name", "'a,folder,data/a'", "tabs", "commas"]),
        (HEADER + "a;folder;data/a\n", ["line 2, column name", "'a;folder;data/a'", "tabs", "semicolons"]),
        ("name,source\na,folder\n", ["line 1", "'name,source'", "tabs", "commas"]),
        (HEADER + "a\t\t\t\t\textra\n", ["line 2, column 6", "6 cells", "5 columns", "'extra'"]),
        (HEADER + "\tfolder\n", ["line 2, column name"]),
        (HEADER + "a/b\tfolder\n", ["line 2, column name", "'a/b'", "_", "-"]),
        (HEADER + "a--s0\tfolder\n", ["line 2, column name", "'a--s0'", "-"]),
        (HEADER + "studies\tfolder\n", ["line 2, column name", "'studies'", "results/"]),
        (HEADER + "a\n# c\na\tfolder\n", ["line 4, column name", "'a'", "line 2"]),
        (HEADER + "tpl\tfolder\n", ["line 2, column name", "config/scenes/tpl.yaml", "column base"]),
        (HEADER.encode("utf-16"), ["UTF-16", "UTF-8"]),
        (HEADER.encode() + b"a\t\xff\n", ["line 2", "UTF-8", "byte 34"]),
    ],
)
def test_mistakes_about_which_scenes_there_are(project, table, words):
    project(table if isinstance(table, bytes) else table.encode())
    with refused(*words) as caught:
        batch_table.read_table()
    assert str(caught.value).startswith("config/batch.tsv")


def test_all_mistakes_of_a_table_come_at_once(project):
    project("a b c\nok\ttpl\nd/e\n" + "".join(f"x{i}/\n" for i in range(30)))
    with refused("line 2", "'a b c'", "line 4", "'d/e'", 12) as caught:
        batch_table.read_table()
    assert len(str(caught.value).splitlines()) == 32 - 12 + 1


# ------------------------------------------------------------------------------------------------------------ overrides


def test_a_job_needs_its_own_line_alone(project):
    """A table is saved unfinished while jobs run: those of other scenes go on, and the plan of the batch still refuses it."""
    project("a\t\t\ttpl\tseed=9\nmy room\t\t\ttpl\nb\t\t\ttpl\nb\t\t\ttpl\tseed=8\n")
    assert settings.load("a").seed == 9
    assert settings.loading.scene_origin("a") == "config/batch.tsv, line 2"
    with refused("line 5, column name", "'b'", "line 4"):
        settings.load("b")
    for ask in (batch_table.read_table, lambda: settings.load("c")):
        with refused("line 3, column name", "'my room'"):
            ask()


def test_overrides_are_yaml_values_under_dotted_keys():
    got = batch_table.parse_overrides("capture.views=24; prior.samples = 8;base.flag=true;a.b.c=[1, 2];seed=0;x.path=data/a=b;")
    assert got == {
        "capture": {"views": 24},
        "prior": {"samples": 8},
        "base": {"flag": True},
        "a": {"b": {"c": [1, 2]}},
        "seed": 0,
        "x": {"path": "data/a=b"},
    }


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("capture.views", ["'capture.views'", "key=value"]),
        ("capture.views=", ["'capture.views='", "key=value"]),
        ("capture..views=3", ["'capture..views=3'", "key=value"]),
        ("capture.views=3;capture.views=4", ["here: 'capture.views'"]),
        ("prior={kind: retinex};prior.samples=3", ["'prior'", "'prior.samples'"]),
        ("source.path=x", ["'source.path'", "path"]),
        ("source.kind=folder", ["'source.kind'", "source"]),
        ("seed=[1", ["'seed'", "'[1'", "YAML"]),
    ],
)
def test_mistakes_in_overrides(text, words):
    with refused(*words) as caught:
        batch_table.parse_overrides(text, "here")
    assert str(caught.value).startswith("here: ")


# ------------------------------------------------------------------------------------------------------------ one scene


def test_a_line_lies_over_its_base_and_the_quality_below(project, tmp_path):
    project("a\t\tdata/a\ttpl\tcapture.views=7;prior.samples=3\nb\tbuiltin\t\ttpl\tprior.kind=simulated;source.scene=tiny\n")
    (tmp_path / "config/quality").mkdir()
    (tmp_path / "config/quality/draft.yaml").write_text("capture: {views: 9, width: 99}\nprior: {samples: 9}\n")
    a, b = settings.load("a"), settings.load("b")
    assert (a.source.kind, a.source.path, a.source.unit) == ("folder", Path("data/a"), "mm")
    assert (a.capture.views, a.capture.width, a.prior.samples, a.seed) == (7, 99, 3, 4)
    assert (b.source.kind, b.source.scene, b.prior.kind, b.capture.views) == ("builtin", "tiny", "simulated", 9)
    assert settings.load("tpl").seed == 4


def test_a_base_may_lack_what_the_line_gives(project, tmp_path):
    (tmp_path / "config/scenes/tpl.yaml").write_text("source: {kind: folder}\nprior: {kind: retinex}\n")
    project("a\t\tdata/a\tconfig/scenes/tpl.yaml\t\n")
    assert settings.load("a").source.path == Path("data/a")


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("a\t\t\ttpl\tcapture.veiws=3", ["line 2, column overrides", "capture.veiws", "views"]),
        ("a\t\t\ttpl\tcapture.views=0", ["line 2, column overrides", "capture.views", 0, 1]),
        ("a\t\t\ttpl\tcapture=3", ["line 2, column overrides", "capture", 3, "key: value"]),
        ("a\tfoldr\tx\t\tprior.kind=retinex", ["line 2, column source", "source.kind", "'foldr'", "drawn, mitsuba"]),
        ("a\tfolder\t\t\tprior.kind=retinex", ["line 2, column path", "source.path", "config/scenes/kitchen.yaml"]),
        ("a\tfolder\tx\t\tprior.kind=retinx", ["line 2, column overrides", "prior.kind", "'retinx'", "retinex"]),
        ("a\tbuiltin\tx\ttpl\tprior.kind=simulated", ["line 2, column path", "source.path", "kind, quarterings, scene"]),
        ("a\t\t\ttlp\t", ["line 2, column base", "config/scenes/tlp.yaml", "tpl"]),
        ("a\t\t\ttpl\tviews", ["line 2, column overrides", "'views'", "key=value"]),
        ("a\t\t\tbad\t", ["config/scenes/bad.yaml", "config/batch.tsv, line 2", "seed", "'x'"]),
    ],
)
def test_a_mistake_in_a_scene_names_line_column_and_key(project, tmp_path, line, words):
    (tmp_path / "config/scenes/bad.yaml").write_text(BASE.replace("seed: 4", "seed: x"))
    project(line + "\n")
    with refused(*words):
        settings.load("a")


def test_an_unknown_scene_is_looked_for_in_the_table_too(project):
    project("office\t\tdata/a\ttpl\t\n")
    with refused("config/scenes/ofice.yaml", "scenes/office", "tpl and 1 of config/batch.tsv"):
        settings.load("ofice")


def test_a_line_with_a_name_alone_is_not_told_to_be_itself(project):
    project("tpl2\n")
    with refused("config/scenes/tpl2.yaml", "scenes/tpl"):
        settings.load("tpl2")


# ----------------------------------------------------------------------------------------------------------- all scenes


def test_every_scene_is_refused_by_itself(project, monkeypatch):
    project(
        "good\tbuiltin\t\t\tsource.scene=tiny;prior.kind=simulated\n"
        "key\t\t\ttpl\tcapture.veiws=3\n"
        "data\tfolder\tno/where\t\tprior.kind=retinex\n"
        "gone\n"
        "disk\tmitsuba\tx.xml\t\tprior.kind=simulated\n"
    )
    from lab.sources import mitsuba

    monkeypatch.setattr(mitsuba, "raw_inputs", lambda document: 1 / 0)
    plan = batch_plan.plan("draft")
    assert list(plan.ready) == ["good"] and list(plan.refused) == ["key", "data", "gone", "disk"]
    assert "line 3, column overrides" in plan.refused["key"]
    named(plan.refused["data"], "config/batch.tsv, line 4", "no/where", "source.path")
    named(plan.refused["gone"], "line 5", "config/scenes/gone.yaml")
    named(plan.refused["disk"], "line 6", "ZeroDivisionError")
    assert plan.ready["good"] == fp.fingerprint("publish", "good", "draft")


SMALL = "builtin\t\t\tsource.scene=tiny;prior.kind=simulated"
WRONG_NAME = SMALL + ";materials={nosuchthing: {metallic: 0}}"


def segmented(scene):
    """A finished segmentation with one object, `floor`, and its table."""
    facts = {"scene": scene, "stage": "segmentation", "quality": "draft", "inputs": {}}
    facts["fingerprint"] = fp.fingerprint("segmentation", scene, "draft")
    writer = StageWriter(Path("results") / scene / "segmentation", facts)
    writer.table("objects.parquet", {"object_id": np.arange(1), "name": ["floor"]})
    writer.finish()
    writer.stamps.save(stamps.place(Path("results"), scene, "segmentation"))
    sound.forget()
    return Path("results") / scene / "segmentation"


def test_what_lies_in_the_folders_of_a_scene_refuses_that_scene_alone(project):
    project("".join(f"{name}\t{SMALL}\n" for name in ("good", "file", "stage", "logs", "link")) + f"name\t{WRONG_NAME}\n")
    for path in ("scenes/file", "results/stage/render", "results/logs/logs"):
        Path(path).parent.mkdir(parents=True)
        Path(path).touch()
    Path("scenes/link").symlink_to("../config")
    segmented("name")
    plan = batch_plan.plan("draft")
    assert list(plan.ready) == ["good"]
    for name, names in {
        "file": ["scenes/file"],
        "stage": ["results/stage/render"],
        "logs": ["results/logs/logs"],
        "name": ["materials", "'nosuchthing'"],
        "link": ["scenes/link"],
    }.items():
        named(plan.refused[name], *names)


def test_a_damaged_segmentation_is_made_again_whatever_overrides_name(project):
    project(f"a\t{WRONG_NAME}\n")
    path = segmented("a") / "objects.parquet"
    path.write_bytes(path.read_bytes()[:-1] + b"x")
    assert list(batch_plan.plan("draft").ready) == ["a"]
    (fault,) = batch_plan.check_stage("segmentation", "a", "draft")
    assert "objects.parquet: its content changed" in fault


def test_the_summary_is_made_again_when_a_scene_or_a_reason_changes(project):
    marks = []
    for overrides in ("seed=1", "seed=2", "seeds=2", "seedz=2"):
        project(f"a\tbuiltin\t\t\tsource.scene=tiny;prior.kind=simulated;{overrides}\n")
        marks.append(batch_plan.fingerprint("draft"))
    assert len(set(marks)) == 4


# -------------------------------------------------------------------------------------------------------------- summary


def gone(state):
    """Give the process of a state another time of start, as after its number was given again."""
    document = json.loads(state.path.read_text())
    write_json(state.path, document | {"start": document["start"] - 9})


@pytest.fixture
def five(project, monkeypatch):
    """Five scenes that ended differently, without running them."""
    names = ("done", "refused", "failed", "killed", "idle")
    lines = tuple(batch_table.Line(i + 2, name, "builtin") for i, name in enumerate(names))
    monkeypatch.setattr(fp, "fingerprint", lambda stage, scene, quality: f"{stage} of {scene}")
    monkeypatch.setattr(fp, "resolved", lambda scene, quality: json.dumps({"source": {"kind": "builtin"}}))
    reason = "config/batch.tsv, line 3: <script>bad\tdata</script>\nsecond line"
    plan = batch_plan.Plan(lines, {n: f"publish of {n}" for n in names if n != "refused"}, {"refused": reason})
    monkeypatch.setattr(batch_plan, "plan", lambda quality: plan)
    monkeypatch.setattr(standing, "check", lambda scene, quality: ())
    monkeypatch.setattr(standing.forecast, "job_cost", lambda *job: Cost(None, None, None, None))

    write_json(Path("scenes/done/manifest.json"), {"fingerprint": "publish of done"})
    write_json(
        Path("scenes/done/verdict.json"), {"verdict": "doubtful", "sentence": "Usable with care: 0 lamps\tfound.", "lights": {}}
    )
    view = ["000", "001", "000", "000"]
    columns = {"view": view, "quantity": ["rgb", "rgb_held_out", "albedo", "rgb"], "metric": ["psnr", "psnr", "psnr", "l2"]}
    columns |= {"protocol": ["raw"] * 4, "value": np.array([30.0, 20.0, 25.0, 9.0])}
    write_parquet(Path("scenes/done/metrics.parquet"), columns, {})
    for name in ("000", "001"):
        path = Path(f"scenes/done/maps/{name}.exr")
        path.parent.mkdir(exist_ok=True)
        path.touch()
    benchmarks = Path("results/done/benchmarks")
    benchmarks.mkdir(parents=True)
    write_json(benchmarks / "capture.parts.json", {"job": {"seconds": 3.0, "cpu_seconds": 4.0, "max_rss_mb": 100.0}})
    write_json(benchmarks / "base.parts.json", {"job": {"seconds": 5.0, "cpu_seconds": 7.0, "max_rss_mb": 120.0}})

    write_json(Path("scenes/idle/manifest.json"), {"fingerprint": "publish of other settings"})
    write_json(Path("results/idle/capture/manifest.json"), {"fingerprint": "capture of idle"})
    JobState("idle", "prior", "prior of other settings").failed("long ago")
    killed, cancelled = JobState("killed", "capture", "capture of killed"), JobState("failed", "prior", "prior of failed")
    killed.started()
    gone(killed)
    JobState("failed", "capture", "capture of failed").started()
    JobState("failed", "capture", "capture of failed").done()
    write_json(Path("results/failed/capture/manifest.json"), {"fingerprint": "capture of failed"})
    cancelled.started()  # both were running when one failed
    gone(cancelled)
    JobState("failed", "segmentation", "segmentation of failed").failed("mesh: no faces")
    return plan


def test_every_scene_has_a_row_that_says_how_it_ended(five):
    summary.write_summary("draft")
    with open("results/batch/summary.tsv", newline="") as file:
        rows = {row["scene"]: row for row in csv.DictReader(file, delimiter="\t")}
    assert {name: row["status"] for name, row in rows.items()} == {
        "done": "done",
        "refused": "refused",
        "failed": "failed",
        "killed": "killed",
        "idle": "stale",
    }
    done = rows["done"]
    assert (done["rgb_psnr"], done["rgb_psnr_held_out"], done["albedo_psnr"], done["roughness_l2"]) == ("30", "20", "25", "")
    assert (done["seconds"], done["cpu_seconds"], done["max_rss_mb"], done["slowest"]) == ("8", "11", "120", "base 5 s")
    assert (done["verdict"], done["doubt"]) == ("doubtful", "Usable with care: 0 lamps found.")
    assert {rows[name]["verdict"] for name in ("refused", "failed", "killed", "idle")} == {""}
    assert rows["refused"]["reason"].endswith("<script>bad data</script> | second line")
    assert (rows["failed"]["stage"], rows["failed"]["reason"]) == ("segmentation", "mesh: no faces")
    assert rows["failed"]["log"] == "results/failed/logs/segmentation.log"
    assert (rows["killed"]["stage"], rows["idle"]["stage"]) == ("capture", "plan")
    import pyarrow.parquet as pq

    table = pq.read_table("results/batch/summary.parquet")
    assert table.column_names == list(summary.COLUMNS)
    assert table["rgb_psnr"].to_pylist() == [30.0, None, None, None, None]


@pytest.mark.parametrize("between", ["\n", "\r", "\r\n", "\x0b", "\x85", "\u2028"])
def test_a_reason_is_one_cell_of_the_table(five, monkeypatch, between):
    monkeypatch.setitem(five.refused, "refused", f"one\t\x1btwo{between}three")
    summary.write_summary("draft")
    text = Path("results/batch/summary.tsv").read_bytes().decode()
    assert "\tone \\x1btwo | three\t" in text and len(text.splitlines()) == 6


def test_a_job_that_runs_is_told_from_a_killed_one(five):
    JobState("idle", "prior", "prior of idle").started()  # by this process
    summary.write_summary("draft")
    assert "\trunning\tprior\t" in Path("results/batch/summary.tsv").read_text()
    assert "a job of it runs" in Path("results/batch/report.html").read_text()


class _Addresses(HTMLParser):
    def __init__(self, text):
        super().__init__()
        self.found, self.tags = [], set()
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        self.found += [value for name, value in attrs if name in ("src", "href")]


def test_the_page_links_to_what_is_here_and_escapes_what_it_is_told(five):
    summary.write_summary("draft")
    text = Path("results/batch/report.html").read_text()
    page = _Addresses(text)
    assert "<script>bad" not in text and "&lt;script&gt;bad" in text
    assert set(page.found) == {
        "#scenes",
        "#verdict=doubtful",
        *(f"#status={status}" for status in ("done", "refused", "failed", "killed", "stale")),
        "../../scenes/done/report.html",
        "../../results/failed/logs/segmentation.log",
        "../../results/killed/logs/capture.log",
    }
    for words in ("<b>1</b>", "mesh: no faces", "held-out PSNR"):
        assert words in text
    assert "roughness L2" not in text  # no scene has it


def test_a_deliverable_that_was_changed_is_not_done(five, monkeypatch):
    """Scores and verdict are read from its files, so the table reports none of them."""
    lines = ("scenes/done/verdict.json: its content changed", "scenes/done/scene.glb: missing")
    monkeypatch.setattr(standing, "check", lambda scene, quality: lines if scene == "done" else ())
    summary.write_summary("draft")
    with open("results/batch/summary.tsv", newline="") as file:
        row = next(row for row in csv.DictReader(file, delimiter="\t") if row["scene"] == "done")
    assert (row["status"], row["verdict"], row["rgb_psnr"]) == ("stale", "", "")
    assert row["reason"] == f"{lines[0]}, and 1 more"


def test_a_damaged_deliverable_is_a_row_and_not_the_end(five):
    Path("scenes/done/metrics.parquet").write_bytes(b"PAR1 rubbish")
    summary.write_summary("draft")
    assert "its files cannot be read" in Path("results/batch/summary.tsv").read_text()


@pytest.mark.parametrize(
    "content", ["[1]", '{"job": 3}', '{"job": {"seconds": 1e999, "cpu_seconds": [], "threads": "x"}}', "[" * 9999]
)
def test_records_of_jobs_may_hold_anything(five, content):
    Path("results/done/benchmarks/base.parts.json").write_text(content)
    summary.write_summary("draft")
    assert "\tdone\tdone\t" in Path("results/batch/summary.tsv").read_text()


@pytest.mark.parametrize(("dynamic_range", "photograph", "rendered"), [("ldr", 102, 51), ("hdr", 188, 124)])
def test_pictures_show_what_the_report_shows(project, dynamic_range, photograph, rendered):
    """sRGB code of 0.4 and 0.2 as they are (LDR), of linear 0.4 x exposure 1.25 = 0.5 and linear 0.2 (HDR); albedo linear 0.5."""
    from PIL import Image

    from workflow.batch.page import GAP, write_pictures

    flat = {c: np.full((4, 300), 0.4, np.float32) for c in "RGB"}
    channels = {f"ldr.{c}": np.full((4, 300), 0.2, np.float32) for c in "RGB"}
    channels |= {f"albedo.{c}": np.full((4, 300), 0.5, np.float32) for c in "RGB"}
    for name in ("000", "001", "002"):
        write_exr(Path(f"scenes/a/maps/{name}.exr"), channels)
        write_exr(Path(f"results/a/capture/photos/{name}.exr"), flat)
    write_json(Path("results/a/capture/capture.json"), {"dynamic_range": dynamic_range})
    cameras = {"name": ["000", "001", "002"], "exposure": np.array([9.0, 1.25, 9.0])}
    write_parquet(Path("results/a/capture/cameras.parquet"), cameras, {})
    write_json(Path("scenes/a/manifest.json"), {"fingerprint": "first"})
    folder = Path("results/batch")
    (first,) = write_pictures(["a"], folder).values()
    picture = np.array(Image.open(folder / first)).astype(int)
    assert picture.shape == (1, 3 * 100 + 2 * GAP, 3)
    for i, value in enumerate((photograph, rendered, 188)):
        assert np.abs(picture[:, i * (100 + GAP) :][:, 8:92] - value).max() <= 3
    write_exr(Path("scenes/a/maps/001.exr"), {**channels, "ldr.R": np.full((4, 300), 0.9, np.float32)})
    assert write_pictures(["a"], folder) == {"a": first}  # the picture of the same result is not made again
    write_json(Path("scenes/a/manifest.json"), {"fingerprint": "second"})
    (second,) = write_pictures(["a"], folder).values()
    assert [path.name for path in (folder / "pictures").iterdir()] == [Path(second).name] and second != first
    write_json(Path("scenes/a/manifest.json"), {"fingerprint": "third"})
    Path("scenes/a/maps/001.exr").write_bytes(b"rubbish")
    assert write_pictures(["a"], folder) == {} and not list((folder / "pictures").iterdir())


def test_a_published_scene_whose_last_job_failed_says_so(five):
    """As where a damaged stage was to be made again; the deliverable is there, so the scene is done."""
    JobState("done", "render", "render of done").failed("results/done/render/maps: a file is in the place of a folder")
    JobState("done", "room", "room of other settings").failed("long ago")
    summary.write_summary("draft")
    with open("results/batch/summary.tsv", newline="") as file:
        row = next(row for row in csv.DictReader(file, delimiter="\t") if row["scene"] == "done")
    reason = "it is published, but its last job of render failed: results/done/render/maps: a file is in the place of a folder"
    assert (row["status"], row["reason"], row["log"]) == ("done", reason, "results/done/logs/render.log")
    plan = five
    closing = summary.closing([summary.row_of(line, plan, "draft") for line in plan.lines]).splitlines()
    assert closing[0].startswith("1 of 5 scenes done") and f"done: done: {reason}" in closing
    page = Path("results/batch/report.html").read_text()
    assert "1 scene done</b>, done: it is published" in page and '"../../results/done/logs/render.log"' in page


def test_a_part_of_the_prior_that_failed_is_the_reason(five):
    JobState("idle", "prior.3-of-8", "prior of idle").failed("no weights")
    found = standing.standing("idle", lambda _: "draft")
    assert (found.state, found.stage, found.reason) == ("failed", "prior", "no weights")
    assert found.log == "results/idle/logs/prior.3-of-8.log"


def test_only_a_finished_plan_counts_as_complete(five, monkeypatch):
    with refused("failed", 2):
        summary.write_summary("draft", "mark")
    assert not Path("results/batch/complete").exists() and Path("results/batch/report.html").is_file()
    lines = tuple(line for line in five.lines if line.name in ("done", "refused"))
    monkeypatch.setattr(batch_plan, "plan", lambda quality: replace(five, lines=lines))
    summary.write_summary("draft", "mark")
    assert Path("results/batch/complete").read_text().splitlines()[0] == "mark"
    assert batch_plan.faults_of_the_summary() == ()
    page, table = Path("results/batch/report.html"), Path("results/batch/summary.tsv")
    page.write_text("")
    table.unlink()
    faults = batch_plan.faults_of_the_summary()
    assert [fault.split(": ")[0] for fault in faults] == [str(table), str(page)]
    summary.write_summary("draft")
    assert not Path("results/batch/complete").exists() and batch_plan.faults_of_the_summary() == ()


def test_a_scene_whose_results_were_removed_is_done(five):
    """What is published has everything that the table tells."""
    shutil.rmtree("results/done")
    plan = batch_plan.plan("draft")
    row = summary.row_of(plan.lines[0], plan, "draft")
    assert (row["status"], row["views"], row["rgb_psnr"], row["verdict"]) == ("done", 2, 30.0, "doubtful")


def test_refusing_names_every_scene(five):
    with refused("config/batch.tsv, line 3", "<script>bad\\tdata</script>\nsecond line"):
        summary.refuse("draft")


# --------------------------------------------------------------------------------------------------------------- causes


def _failures(reasons_by_scene, status="failed", stage="capture"):
    return [{"scene": name, "status": status, "stage": stage, "reason": why} for name, why in reasons_by_scene.items()]


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("view DSC012, DSC4: pictures of different sizes 640 x 480 and 32 x 24", "view f_7: pictures of different sizes 1 x 2"),
        ("data/NAME/mesh.ply: 5590.5 m across, `source.unit: m`", "/abs/NAME/b.ply: 1e-3 m across, `source.unit: m`"),
        (
            "results/NAME/base/a.exr: changed. Run: snakemake scenes/NAME",
            "results/NAME/b/b.exr: changed. Run: snakemake scenes/NAME",
        ),
        ("config/batch.tsv, line 3: no mesh in scene NAME", "config/batch.tsv, line 12: no mesh in scene NAME"),
        ("no faces\nsecond line 1", "no faces\nanother line"),
        (
            "results/NAME/locks/base: stage base of NAME is being made by process 12 on vm since 2026-01-01 00:00:00. Wait",
            "results/NAME/locks/base: stage base of NAME is being made by process 345 on vm since 2026-02-03 04:05:06. Wait",
        ),
        ("it was killed (out of memory? It had 1,200 MB when last seen)", "it was killed (out of memory?)"),
        ("was killed for its memory: this process had 90 MB when last seen", "was killed for its memory"),
    ],
)
@pytest.mark.parametrize("names", [("a-1", "office"), ("kitchen", "bedroom")])
def test_one_cause_has_one_group(one, other, names):
    rows = _failures({name: text.replace("NAME", name) for name, text in zip(names, (one, other), strict=True)})
    (group,) = causes.groups(rows)
    assert [row["scene"] for row in group.rows] == list(names) and group.heading == "2 scenes failed in capture"


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("`capture.veiws`: unknown key", "`capture.widht`: unknown key"),
        ("no mesh", "no photographs"),
        ("mesh: no faces", "mesh: no vertices"),
        ("CUDA error 2: out of memory", "CUDA error 700: illegal address"),
        ("the device fails with CUDA error 2", "the device fails with CUDA error 700"),
    ],
)
def test_different_causes_stay_apart(one, other):
    assert len(causes.groups(_failures({"mesh": one, "b": other}))) == 2


def test_the_same_words_of_another_stage_or_status_are_another_cause():
    rows = [*_failures({"a": "no"}), *_failures({"b": "no"}, stage="base"), *_failures({"c": "no"}, status="killed")]
    assert [group.heading for group in causes.groups(rows)] == [
        "1 scene failed in capture",
        "1 scene failed in base",
        "1 scene killed in capture",
    ]


def test_few_failures_have_a_line_each_and_many_a_line_a_cause():
    few = _failures({f"s{i}": f"data/s{i}: no mesh" for i in range(causes.FEW)})
    assert summary.closing(few).splitlines()[1:] == [f"s{i}: failed in capture: data/s{i}: no mesh" for i in range(causes.FEW)]
    many = [*few, *_failures({f"t{i}": f"line {i}: bad key" for i in range(19)}, "refused", None), *_failures({"u": "alone"})]
    assert summary.closing([*many, {"scene": "v", "status": "done", "reason": None, "verdict": "poor"}]).splitlines() == [
        "1 of 31 scenes done (1 poor, by their reports); results/batch/report.html, results/batch/summary.tsv",
        "19 scenes refused, such as t0: line 0: bad key",
        "10 scenes failed in capture, such as s0: data/s0: no mesh",
        "u: failed in capture: alone",
    ]
    words = "abcdefghijklmnop"
    told = causes.lines(_failures({f"s{i}": f"cause {word}" for i, word in enumerate(words)}))
    assert len(told) == causes.FEW + 1 and told[-1] == "and 6 scenes for 6 other causes"
    assert causes.refusals({f"s{i}": f"line {i}: bad" for i in range(30)}) == ["30 scenes refused, such as s0: line 0: bad"]
    assert causes.refusals({"a": "line 2: bad"}) == ["line 2: bad"]


def test_messages_do_not_steer_a_terminal(project, monkeypatch, capsys):
    """Whatever a state file, a name of a file or an error brings: control characters are written out (SECURITY.md)."""
    from workflow import __main__ as commands
    from workflow.artifacts import verify
    from workflow.runtime import ending

    steering, shown = "\x1b]0;x\x07\u202e\x9b2J", r"\x1b]0;x\x07\u202e\x9b2J"
    assert ending.of_the_machine(OSError(28, "No space left on device", steering)).startswith(f"{shown}: the disk is full")
    JobState("a", "base").failed(f"{steering}\nsecond line")
    (line,) = reasons(0.0)
    assert line.endswith(f": {shown}\nsecond line")
    assert summary.closing(_failures({"a": steering})).endswith(f"a: failed in capture: {shown}")
    monkeypatch.setattr(verify, "damaged", lambda root, scenes: [f"{steering}: missing"])
    assert commands._verify(SimpleNamespace(scenes=[])) == 1 and capsys.readouterr().out.splitlines()[0] == f"{shown}: missing"


def test_the_shipped_table_can_be_read(repository):
    lines = batch_table.read_table(repository)
    assert [line.name for line in lines if line.is_plain] and all(
        settings.load(line.name, quality, repository) for line in lines for quality in settings.QUALITIES
    )


def test_an_interrupted_job_does_not_look_like_one_without_memory(tmp_path, monkeypatch):
    from workflow.runtime.ending import guarded

    def interrupted():
        raise KeyboardInterrupt

    monkeypatch.chdir(tmp_path)
    assert guarded("base of x", interrupted, JobState("x", "base")) == 130
    assert [message.endswith("it was interrupted; the same command continues") for message in reasons(0.0)] == [True]


def test_a_job_without_memory_says_so(tmp_path, monkeypatch, caplog):
    from workflow.runtime.ending import guarded

    def greedy():
        raise MemoryError("Unable to allocate 9 TiB")

    monkeypatch.chdir(tmp_path)
    assert guarded("base of x", greedy, JobState("x", "base")) == 1
    (reason,) = reasons(0.0)
    assert "base of x: not enough memory; " in reason and reason.endswith("(Unable to allocate 9 TiB)")
    assert "Traceback" not in caplog.text and "bug" not in caplog.text


def test_an_unknown_quality_is_refused_and_the_summary_stays(project, repository):
    folder = project("tpl\n")
    kept = folder / "results/batch/summary.tsv"
    kept.parent.mkdir(parents=True)
    kept.write_text("as it was")
    for command in ("batch", "status"):
        said = subprocess.run(
            [sys.executable, "-m", "workflow", command, "--quality", "standrad"],
            cwd=folder,
            env={**os.environ, "PYTHONPATH": str(repository)},
            capture_output=True,
            text=True,
        )
        assert said.returncode == 1 and not missing(said.stderr, "standrad", "standard") and not said.stdout
    assert kept.read_text() == "as it was" and [path.name for path in kept.parent.iterdir()] == ["summary.tsv"]
