"""Artefacts: what is written is read back; what changed on disk is found and named."""

import json
import logging
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.errors import named, refused
from workflow.artifacts import DamagedArtefact, StageReader, StageWriter, files, locks, scratch, sound, stamps
from workflow.artifacts import manifest as manifests
from workflow.artifacts.files import sha256_of, write_parquet
from workflow.artifacts.manifest import SCENE_SCHEMA
from workflow.artifacts.store import PARTS, ids_from_disk, ids_to_disk, rgb, split_rgb
from workflow.artifacts.verify import damaged
from workflow.intake.names import shown
from workflow.runtime.job import configure_logging

MARK = "0" * 16


def provenance():
    return {"scene": "s", "stage": "base", "fingerprint": MARK, "settings": {}, "inputs": {}, "versions": {}}


@pytest.fixture
def stage(tmp_path):
    folder = tmp_path / "results/s/base"
    writer = StageWriter(folder, provenance())
    rng = np.random.default_rng(0)
    channels = {
        **split_rgb(rng.random((5, 7, 3)), "albedo"),
        "half": rng.random((5, 7)).astype(np.float16),
        "object.id": ids_to_disk(np.array([[-1, 70000, 4] + [0] * 4] * 5, np.int32)),
    }
    writer.exr("maps/v.exr", channels)
    columns = {"cell_id": np.arange(3, dtype=np.int32), "T": np.arange(12.0).reshape(3, 4), "name": ["a", "b", "c"]}
    writer.table("cells.parquet", columns)
    writer.json("base.json", {"edge": 0.01})
    writer.finish()
    return folder, channels, columns


def test_round_trip(stage):
    folder, channels, columns = stage
    reader = StageReader(folder, "base", "s")
    got = reader.exr("maps/v.exr")
    assert set(got) == set(channels)
    for name in channels:
        assert got[name].dtype == channels[name].dtype
        np.testing.assert_array_equal(got[name], channels[name])
    assert ids_from_disk(got["object.id"])[0].tolist()[:3] == [-1, 70000, 4]
    assert rgb(got, "albedo").shape == (5, 7, 3)
    table = reader.table("cells.parquet")
    np.testing.assert_array_equal(table["T"], columns["T"])
    assert table["name"].tolist() == ["a", "b", "c"]
    assert reader.json("base.json") == {"edge": 0.01}


def test_a_file_is_hashed_once_in_a_process_until_somebody_touches_it(stage, monkeypatch):
    folder, read = stage[0], []
    original = files.sha256_of
    monkeypatch.setattr(files, "sha256_of", lambda path: read.append(path.name) or original(path))
    for _ in range(3):
        StageReader(folder, "base", "s").exr("maps/v.exr")
    assert read == ["v.exr"]
    data = bytearray((folder / "maps/v.exr").read_bytes())
    data[len(data) // 2] ^= 1
    (folder / "maps/v.exr").write_bytes(data)
    with pytest.raises(DamagedArtefact, match="its content changed"):
        StageReader(folder, "base", "s").exr("maps/v.exr")


@pytest.mark.parametrize("name, reader", [("maps/v.exr", "read_exr"), ("cells.parquet", "read_parquet")])
def test_an_error_of_the_disk_is_not_called_damage(stage, monkeypatch, name, reader):
    """What a library says of the content of a file is damage."""

    def fails(error):
        def read(path, *_):
            raise error

        monkeypatch.setattr(files, reader, read)
        found = StageReader(stage[0], "base", "s")
        return found.exr if name.endswith(".exr") else found.table

    with pytest.raises(OSError, match="Input/output error"):
        fails(OSError(5, "Input/output error"))(name)
    with refused(name, "snakemake --cores 2 scenes/s --forcerun base", kind=DamagedArtefact):
        fails(OSError("no end"))(name)


def test_some_columns_of_a_table(stage):
    folder, _, columns = stage
    reader, some = StageReader(folder, "base", "s"), sorted(columns)[:2]
    found = reader.table("cells.parquet", some)
    assert sorted(found) == some and all(np.array_equal(found[name], reader.table("cells.parquet")[name]) for name in some)
    assert reader.table("cells.parquet", ("none of them",)) == {}


def test_same_content_same_bytes(stage, tmp_path):
    folder, channels, columns = stage
    other = tmp_path / "again"
    writer = StageWriter(other, provenance())
    writer.exr("maps/v.exr", channels)
    writer.table("cells.parquet", columns)
    writer.json("base.json", {"edge": 0.01})
    writer.finish()
    assert (other / "manifest.json").read_bytes() == (folder / "manifest.json").read_bytes()


@pytest.mark.parametrize("name", ["maps/v.exr", "cells.parquet", "base.json"])
@pytest.mark.parametrize("harm", ["flip", "truncate", "delete"])
def test_damage_is_found_and_named(stage, tmp_path, name, harm):
    folder = stage[0]
    path = folder / name
    data = bytearray(path.read_bytes())
    if harm == "flip":  # same length, so only the hash can tell
        data[len(data) // 2] ^= 1
        path.write_bytes(data)
    elif harm == "truncate":
        path.write_bytes(data[: len(data) // 2])
    else:
        path.unlink()
    with refused(name, "snakemake --cores 2 scenes/s --forcerun base", kind=DamagedArtefact):
        StageReader(folder, "base", "s").path(name)
    lines = list(damaged(tmp_path))
    assert len(lines) == 1 and name in lines[0]


def test_what_repairs_it_keeps_the_quality(tmp_path):
    writer = StageWriter(tmp_path / "results/s/base", {**provenance(), "quality": "paper"})
    writer.json("base.json", {"edge": 0.01})
    writer.finish()
    (tmp_path / "results/s/base/base.json").write_text("{}")
    (line,) = damaged(tmp_path)
    assert line.endswith("snakemake --cores 2 scenes/s --forcerun base --config quality=paper")


@pytest.mark.parametrize("text", ["{", "[]", "[1]", "3"])
def test_manifest_that_is_none_is_named(stage, tmp_path, text):
    folder, _, _ = stage
    (folder / "manifest.json").write_text(text)
    (line,) = damaged(tmp_path)
    assert "results/s/base/manifest.json: " in line and "--forcerun base" in line


def test_unknown_schema_is_refused(stage):
    manifest = stage[0] / "manifest.json"
    document = json.loads(manifest.read_text()) | {"schema": "iif.stage/99"}
    manifest.write_text(json.dumps(document))
    with refused("manifest.json", "iif.stage/99", "iif.stage/2", kind=DamagedArtefact):
        StageReader(stage[0], "base", "s")


def test_unfinished_stage_is_refused(tmp_path):
    writer = StageWriter(tmp_path / "results/s/base", provenance())
    writer.json("base.json", {})
    with refused("results/s/base/manifest.json", "snakemake --cores 2", kind=DamagedArtefact):
        StageReader(tmp_path / "results/s/base", "base", "s")


def test_stale_files_of_an_earlier_run_are_removed(stage):
    folder = stage[0]
    writer = StageWriter(folder, provenance())
    writer.json("base.json", {})
    writer.finish()
    assert sorted(p.name for p in folder.rglob("*") if p.is_file()) == ["base.json", "manifest.json"]


def test_parts_that_the_same_job_finished_are_kept(tmp_path):
    writer = StageWriter(tmp_path, provenance())
    for view in "abc":
        writer.json(f"{view}.json", view)
        writer.part_done(view, [f"{view}.json"], {"view": view})
    (tmp_path / "b.json").write_text("cut")
    (tmp_path / "unfinished/c.json").write_text("{")
    other = StageWriter(tmp_path, {**provenance(), "fingerprint": "other"})
    assert other.part_kept("a") is None and other.files == {}
    again = StageWriter(tmp_path, provenance())
    assert [again.part_kept(view) for view in "abcd"] == [{"view": "a"}, None, None, None]
    assert again.files == {"a.json": writer.files["a.json"]}
    again.finish()
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["a.json", "manifest.json"]


FORGED = (
    {},
    {"by": MARK, "files": [], "facts": {}},
    {"by": 7, "files": {}, "facts": {}},
    {"by": MARK, "files": {"a.json": {"bytes": 3}}, "facts": {}},
    {"by": MARK, "files": {"a.json": {"sha256": 5, "bytes": 3}}, "facts": {}},
    {"by": MARK, "files": {"a.json": {"sha256": "0", "bytes": 3, "shape": [-1]}}, "facts": {}},
    {"by": MARK, "files": {"../evil": {"sha256": "0", "bytes": 3}}, "facts": {}},
    {"by": MARK, "files": {}},
)
"""Notes of parts as no stage writes them, under a seal that fits."""


@pytest.mark.parametrize("note", FORGED)
def test_forged_notes_of_parts_are_made_again(tmp_path, note):
    """Somebody who can write there can seal what he writes: such a part is made again, and nothing is raised."""
    writer = StageWriter(tmp_path, provenance())
    manifests.write(tmp_path / "unfinished/a.json", note, settled=False)
    assert writer.part_kept("a") is None and writer.part_kept("a", MARK) is None and not writer.files
    manifests.write(tmp_path / PARTS, {"parts": {"a": note, "../b": note}}, settled=False)
    assert StageWriter(tmp_path, provenance()).part_kept("b") is None and not (tmp_path / "b.json").exists()
    for parts in (None, [], {"a": None}, {"../evil": {"by": MARK, "files": {}, "facts": {}}}):
        manifests.write(tmp_path / PARTS, {"parts": parts}, settled=False)
        StageWriter(tmp_path, provenance())
    assert not (tmp_path / "evil.json").exists() and not (tmp_path.parent / "evil.json").exists()


@pytest.mark.parametrize("name", ["../evil", "maps/../../evil", "/tmp/evil", "", "link/evil"])
def test_names_that_leave_the_folder_are_refused(tmp_path, name):
    """Whatever the kind of file: relative parts, absolute paths, and links that lead out."""
    folder, outside = tmp_path / "stage", tmp_path / "outside"
    outside.mkdir()
    writer = StageWriter(folder, provenance())
    (folder / "link").symlink_to(outside)
    before = sorted(path for path in tmp_path.rglob("*"))
    for write in (
        lambda: writer.exr(name, {"a": np.zeros((1, 1), np.float32)}),
        lambda: writer.table(name, {"a": np.zeros(1)}),
        lambda: writer.json(name, {}),
        lambda: writer.bytes(name, b"x"),
        lambda: writer.channels(name),
    ):
        with refused(tmp_path / "stage", repr(name)):
            write()
    for part in (lambda: writer.part_done("../../evil", [], {}), lambda: writer.part_kept("../../evil")):
        with refused(tmp_path / "stage", "'unfinished/../../evil.json'"):
            part()
    assert sorted(path for path in tmp_path.rglob("*")) == before and not Path("/tmp/evil").exists()


LINKS = (
    "results/s",
    *(f"results/s/{name}" for name in ("base", "logs", "locks", "stamps", "benchmarks", "parts")),
    "results/s/logs/base.log",
    "results/s/locks/base",
    "results/s/benchmarks/base.parts.json",
    "results/s/stamps/base.json",
    "scenes/s",
    "scenes/.s.tmp",
    "scenes/.s.old",
)


@pytest.mark.parametrize("link", LINKS)
def test_nothing_is_made_where_a_link_leads_out(tmp_path, monkeypatch, link):
    """The results come from a stranger: neither a plan nor a job continues, and what is behind the link stays as it is."""
    monkeypatch.chdir(tmp_path)
    outside = Path("own/notes.txt")
    outside.parent.mkdir()
    outside.write_text("mine")
    Path(link).parent.mkdir(parents=True, exist_ok=True)
    Path(link).symlink_to((outside if link.count("/") == 3 else outside.parent).absolute())
    results = Path("results")

    def stage():
        StageWriter(results / "s/base", provenance())

    def job():
        with locks.alone(results, "s", "base"):
            pass

    sound.forget()
    plans = (
        lambda: sound.stage_faults(results, "s", "base", "0" * 16),
        lambda: sound.deliverable_faults(Path("scenes/s"), results, "s", "0" * 16),
        lambda: sound.copy_faults(Path("relight/s"), results, "s", "relight"),
    )
    before = sorted(Path().rglob("*"))
    for begin in (*plans, job, *([stage] if link == "results/s/base" else [])):
        with refused(f"{link}: "):
            begin()
    assert sorted(Path().rglob("*")) == before and outside.read_text() == "mine"


def test_results_and_scenes_may_be_on_another_disk(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("results", "scenes"):
        Path("disk", name).mkdir(parents=True)
        Path(name).symlink_to(Path("disk", name))
    with locks.alone(Path("results"), "s", "base"):
        StageWriter(Path("results/s/base"), provenance()).finish()
    assert Path("disk/results/s/base/manifest.json").is_file()


def test_a_file_is_never_written_through_a_link(tmp_path, monkeypatch):
    """In the place of a log, a lock, a file of a stage, its temporary file; other links in a stage go with what was left."""
    outside = tmp_path / "own/notes.txt"
    outside.parent.mkdir()
    outside.write_text("mine")
    folder = tmp_path / "results/s/base"
    writer = StageWriter(folder, provenance())
    for name in ("a.json", f".a.{os.getpid()}.tmp.json"):
        (folder / name).symlink_to(outside)
    (folder / "left").symlink_to(outside.parent)
    writer.json("a.json", {})
    writer.finish()
    assert sorted(path.name for path in folder.iterdir()) == ["a.json", "manifest.json"] and (folder / "a.json").is_file()
    log = tmp_path / "base.log"
    log.symlink_to(outside)
    root = logging.getLogger()
    monkeypatch.setattr(root, "handlers", [])
    with refused(log):
        configure_logging(log)
    assert outside.read_text() == "mine"


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_non_finite_values_are_not_written(tmp_path, bad):
    writer = StageWriter(tmp_path, provenance())
    with refused("x.exr", "channel a", 1, kind=ValueError):
        writer.exr("x.exr", {"a": np.array([[bad]], np.float32)})
    with refused("x.parquet", "column a", kind=ValueError):
        writer.table("x.parquet", {"a": np.array([bad])})
    assert not list(tmp_path.glob("*.exr")) and not list(tmp_path.glob("*.parquet"))


def chain(root, *stages, scene="s", quality="draft", home="s", **upstream):
    """Finished stages without files, each made from those of scene `home` that `upstream` names."""
    for stage in stages:
        made_from = {name: root / "results" / home / name / "manifest.json" for name in upstream.get(stage, ())}
        inputs = {
            name: {"fingerprint": "0" * 16, "scene": home, "manifest_sha256": sha256_of(path)} for name, path in made_from.items()
        }
        facts = {"scene": scene, "stage": stage, "quality": quality, "inputs": inputs}
        StageWriter(root / "results" / scene / stage, provenance() | facts).finish()


def deliverable(root, scene="s"):
    folder = root / "scenes" / scene
    folder.mkdir(parents=True)
    document = {
        "schema": SCENE_SCHEMA,
        "scene": scene,
        "quality": "draft",
        "fingerprints": {"capture": "", "report": ""},
        "files": {},
    }
    manifests.write(folder / "manifest.json", document)
    return folder


@pytest.mark.parametrize("whole", [True, False])
def test_a_stage_from_which_others_were_made_must_be_there(tmp_path, whole):
    chain(tmp_path, "capture", "base", "report", quality="paper", base=["capture"], report=["capture", "base"])
    assert list(damaged(tmp_path)) == []
    gone = tmp_path / "results/s/base"
    shutil.rmtree(gone) if whole else (gone / "manifest.json").unlink()
    (line,) = damaged(tmp_path)
    named(line, gone / "manifest.json", tmp_path / "results/s/report")
    assert line.endswith("snakemake --cores 2 results/s/base/manifest.json --config quality=paper")


def test_results_from_which_something_was_published_must_be_there(tmp_path):
    chain(tmp_path, "capture", "report", "publish")
    deliverable(tmp_path)
    assert list(damaged(tmp_path)) == []
    shutil.rmtree(tmp_path / "results/s/publish")
    (line,) = damaged(tmp_path)
    assert "results/s/publish/manifest.json: " in line and line.endswith("scenes/s --forcerun publish")
    shutil.rmtree(tmp_path / "results/s")
    (line,) = damaged(tmp_path)
    assert "results/s: " in line and line.endswith("scenes/s --forcerun publish")


def test_what_was_published_must_be_there(tmp_path):
    chain(tmp_path, "publish")
    (line,) = damaged(tmp_path)
    assert "scenes/s: " in line and line.endswith("snakemake --cores 2 scenes/s --forcerun publish")
    assert list(damaged(tmp_path, ["other"])) == []
    (tmp_path / "scenes").mkdir()
    (tmp_path / "scenes/s").write_text("")
    (line,) = damaged(tmp_path)
    assert "scenes/s: " in line and "snakemake" not in line  # which would not help


def test_a_page_that_was_asked_for_alone_is_not_missed_in_scenes(tmp_path):
    chain(tmp_path, "capture", "report", report=["capture"])
    assert list(damaged(tmp_path)) == []


def test_variants_of_a_study_share_stages(tmp_path):
    chain(tmp_path, "capture", scene="room--s0")
    chain(tmp_path, "base", scene="room--fusion-mean-s0", home="room--s0", base=["capture"])
    assert list(damaged(tmp_path)) == []
    shutil.rmtree(tmp_path / "results/room--s0")
    (line,) = damaged(tmp_path)
    named(line, "results/room--s0/capture/manifest.json")


def replace_by_link(path, target):
    shutil.copy(path, target)
    path.unlink()
    path.symlink_to(target)


def test_verify_names_links_and_what_lies_hidden(tmp_path):
    chain(tmp_path, "capture", "report", "publish")
    writer = StageWriter(tmp_path / "results/s/base", provenance() | {"scene": "s"})
    writer.json("a.json", {})
    writer.finish()
    folder = deliverable(tmp_path)
    manifests.write(folder / "manifest.json", json.loads((folder / "manifest.json").read_text()) | {"fingerprints": {}})
    assert list(damaged(tmp_path)) == []
    replace_by_link(tmp_path / "results/s/base/a.json", tmp_path / "a.json")
    (line,) = damaged(tmp_path)
    assert line.startswith(f"{tmp_path}/results/s/base/a.json: a symbolic link in the place of a file; rebuild with:")
    (tmp_path / "results/s/base/maps").symlink_to(tmp_path)
    (tmp_path / "results/s/logs").symlink_to(tmp_path)
    replace_by_link(folder / "manifest.json", tmp_path / "m.json")
    for name in (".hidden", "room.blend", ".snakemake_timestamp"):  # the first two of the user, who may
        (folder / name).touch()
    assert [line.split(";")[0].removeprefix(f"{tmp_path}/") for line in damaged(tmp_path)] == [
        "results/s/base/a.json: a symbolic link in the place of a file",
        f"results/s/base/maps: not written by rule base (not in {tmp_path}/results/s/base/manifest.json)",
        f"results/s/logs: a symbolic link to {shown(str(tmp_path))}, and what is behind it would be overwritten or removed."
        " Remove the"
        " link, or put what it leads to in its place",
        "scenes/s/manifest.json: a symbolic link in the place of a file",
    ]


def test_verify_names_a_manifest_that_was_taken_from_its_files(tmp_path):
    """Nothing was made from the stage. One that a job left unfinished is no damage."""
    writer = StageWriter(tmp_path / "results/s/base", provenance() | {"scene": "s"})
    writer.json("a.json", {})
    writer.part_done("a", ["a.json"], {})
    chain(tmp_path, "capture")
    assert list(damaged(tmp_path)) == []  # a part of a stage is made
    writer.finish()
    writer.stamps.save(stamps.place(tmp_path / "results", "s", "base"))
    (tmp_path / "results/s/base/manifest.json").unlink()
    shutil.rmtree(tmp_path / "results/s/capture")  # it is looked for also where no manifest is left
    (line,) = damaged(tmp_path)
    assert line == (
        f"{tmp_path}/results/s/base/manifest.json: missing, although it was finished; rebuild with:"
        " snakemake --cores 2 results/s/base/manifest.json"
    )


@pytest.mark.parametrize("harm", ["none", "removed", "changed", "of another stage", "forged"])
def test_verify_reads_the_notes_of_parts(tmp_path, harm):
    writer = StageWriter(tmp_path / "results/s/base", provenance() | {"scene": "s"})
    writer.json("a.json", {})
    writer.part_done("a", ["a.json"], {}, by="digest")
    writer.finish()
    path = tmp_path / "results/s/base" / PARTS
    document = json.loads(path.read_text())
    if harm == "removed":  # costs time alone
        path.unlink()
    elif harm == "changed":
        path.write_bytes(path.read_bytes().replace(b"digest", b"dig3st"))
    elif harm == "of another stage":
        document["parts"]["a"]["files"]["a.json"]["sha256"] = "0" * 64
        manifests.write(path, document)
    elif harm == "forged":
        manifests.write(path, {"parts": {"a": {"by": 3}}})
    lines = list(damaged(tmp_path))
    assert len(lines) == (harm in ("changed", "of another stage", "forged"))
    assert all(line.startswith(f"{path}: ") and line.endswith("--forcerun base") for line in lines)


def test_a_deliverable_that_the_user_keeps_under_another_name_is_no_damage(tmp_path):
    chain(tmp_path, "capture", "publish")
    folder = deliverable(tmp_path)
    (folder / "report.html").write_text("a page")
    document = json.loads((folder / "manifest.json").read_text())
    facts = {"sha256": sha256_of(folder / "report.html"), "bytes": 6}
    manifests.write(folder / "manifest.json", document | {"fingerprints": {}, "files": {"report.html": facts}})
    kept = tmp_path / "scenes/before"
    shutil.copytree(folder, kept)
    (kept / "room.blend").write_text("of the user")
    assert not [line for line in damaged(tmp_path) if "before" in line]
    (kept / "report.html").write_text("a pane")
    (line,) = [line for line in damaged(tmp_path) if "before" in line]
    named(line, kept / "report.html", "scenes/s")
    assert "snakemake" not in line  # there is no scene of that name
    (tmp_path / "results/before/capture").mkdir(parents=True)  # there is, and this is another's
    (line, *_) = [line for line in damaged(tmp_path) if line.startswith(f"{kept}/manifest.json: ")]
    assert "snakemake --cores 2 scenes/before" in line


def test_verify_does_not_take_one_variant_for_another(tmp_path):
    chain(tmp_path, "capture", "base", scene="room--v2", home="room--v2", base=["capture"])
    chain(tmp_path, "capture", "base", scene="room--v1", home="room--v1", base=["capture"])
    folder = deliverable(tmp_path, "room--v1")
    document = json.loads((folder / "manifest.json").read_text()) | {"fingerprints": {"base": ""}}
    digest = sha256_of(tmp_path / "results/room--v1/base/manifest.json")
    manifests.write(folder / "manifest.json", document | {"manifests": {"base": digest}})
    chain(tmp_path, "publish", scene="room--v1")
    assert list(damaged(tmp_path)) == []
    shutil.rmtree(tmp_path / "results/room--v1/capture")
    (line,) = damaged(tmp_path)
    named(line, tmp_path / "results/room--v1/capture/manifest.json", tmp_path / "results/room--v1/base")


def test_verify_of_nothing_promises_nothing(tmp_path, monkeypatch, capsys):
    from workflow.__main__ import main

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["workflow", "verify"])
    assert main() == 0
    assert capsys.readouterr().out == "nothing to compare: no artefacts below results/ and scenes/\n"


def test_verify_of_an_unknown_scene_is_one_error(tmp_path, monkeypatch, capsys):
    from workflow.__main__ import main

    chain(tmp_path, "capture", scene="kitchen")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["workflow", "verify", "kichen"])
    assert main() == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: kichen: ")
    named(line, "results/kichen", "scenes/kichen", "kitchen")
    monkeypatch.setattr("sys.argv", ["workflow", "verify", "kitchen"])
    assert main() == 0


def test_scratch_keeps_many_arrays_in_few_mappings(tmp_path, monkeypatch):
    """Arrays of odd sizes and several types come back as they were, from one file without a name."""
    monkeypatch.setattr(scratch, "REGION", 4096)
    keep, rng = scratch.Scratch(tmp_path), np.random.default_rng(0)
    arrays = [rng.random((3, n)).astype(t) for n in (0, 1, 7, 333, 2000) for t in (np.float32, np.float16, bool)] * 20
    open_before = len(os.listdir("/proc/self/fd"))
    kept = [keep(array) for array in arrays]
    assert len(os.listdir("/proc/self/fd")) - open_before < len(arrays)
    assert not list(tmp_path.iterdir())
    for before, after in zip(arrays, kept, strict=True):
        assert after.dtype == before.dtype and after.flags.aligned
        np.testing.assert_array_equal(before, after)
    assert not kept[-1].flags.writeable


def test_arrays_are_joined_on_disk(tmp_path):
    rng = np.random.default_rng(0)
    parts = [rng.random((n, 2, 3)).astype(np.float32) for n in (5, 0, 400, 1)]
    joined = scratch.Joined(tmp_path)
    for part in parts:
        joined.add(part)
    for other in (parts[0].astype(np.float64), parts[0][:, :1]):
        with refused(f"{other.dtype} {other.shape[1:]}", f"{parts[0].dtype} (2, 3)", kind=ValueError):
            joined.add(other)
    whole = joined.array()
    np.testing.assert_array_equal(whole, np.concatenate(parts))
    np.testing.assert_array_equal(whole[np.array([404, 3])], np.concatenate(parts)[[404, 3]])
    assert not list(tmp_path.iterdir())
    assert not whole.flags.writeable
    with refused("rows", kind=ValueError):
        joined.add(parts[0])
    none = scratch.Joined(tmp_path)
    none.add(parts[1])
    assert none.array().shape == (0, 2, 3) and none.array().dtype == np.float32


TABLES = """
import sys
from pathlib import Path
import numpy as np
from workflow.artifacts.files import read_parquet, write_parquet

path = Path(sys.argv[1])
columns = {
    "whole": np.arange(21, dtype=np.int32),
    "single": np.linspace(0, 1, 21, dtype=np.float32),
    "half": np.full(21, 0.5, np.float16),
    "truth": np.arange(21) % 3 == 0,
    "words": np.array(["", "Küche", "a, b"] * 7, object),
    "lists": np.arange(63.0).reshape(21, 3),
    "key": np.arange(21, dtype=np.uint64) << 40,
}
for size in (21, 1, 0):
    write_parquet(path, {name: values[:size] for name, values in columns.items()}, {"iif.schema": "x"})
    found = read_parquet(path)
    for name, values in columns.items():
        assert found[name].dtype == values.dtype and found[name].shape == values[:size].shape, name
        assert np.array_equal(found[name], values[:size]), name
assert "pandas" not in sys.modules, "pandas was imported, a quarter of a second in every job"
"""


def test_tables_of_every_kind_come_back_and_need_no_pandas(tmp_path, repository):
    subprocess.run([sys.executable, "-c", TABLES, str(tmp_path / "t.parquet")], cwd=repository, check=True)


def test_floats_are_packed_byte_by_byte_and_all_else_with_a_dictionary(tmp_path):
    import pyarrow.parquet as pq

    columns = {
        "number": np.arange(5, dtype=np.int32),
        "single": np.linspace(0, 1, 5, dtype=np.float32),
        "double": np.linspace(0, 1, 5),
        "list": np.zeros((5, 3), np.float32),
        "ids": np.zeros((5, 2), np.int32),
    }
    write_parquet(tmp_path / "t.parquet", columns, {})
    row = pq.ParquetFile(tmp_path / "t.parquet").metadata.row_group(0)
    found = {row.column(i).path_in_schema.split(".")[0]: set(row.column(i).encodings) for i in range(row.num_columns)}
    for name, encodings in found.items():
        floats = columns[name].dtype.kind == "f"
        assert ("BYTE_STREAM_SPLIT" in encodings, "RLE_DICTIONARY" in encodings) == (floats, not floats), name


def test_tables_are_the_bytes_that_arrow_would_write(tmp_path):
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns = {"a": np.arange(5), "b": np.array([True, False, True, True, False]), "c": np.array(list("vwxyz"), object)}
    write_parquet(tmp_path / "ours.parquet", columns, {"k": "v"})
    table = pa.table({name: pa.array(values) for name, values in columns.items()}).replace_schema_metadata({"k": "v"})
    pq.write_table(table, tmp_path / "theirs.parquet", compression="zstd", row_group_size=1 << 20, use_dictionary=["a", "b", "c"])
    assert (tmp_path / "ours.parquet").read_bytes() == (tmp_path / "theirs.parquet").read_bytes()
