"""Damage of every kind is found by `verify` and when Snakemake plans; an untouched artefact is not read."""

import json
import os
import shutil

import numpy as np
import pytest

from tests.errors import missing, named
from workflow.artifacts import StageWriter, sound, stamps
from workflow.artifacts import files as io
from workflow.artifacts import manifest as manifests
from workflow.artifacts.manifest import MANIFEST
from workflow.artifacts.verify import damaged

MARK = "0" * 16


def finish(root, scene, stage, inputs=(), mark=MARK, value=0.01):
    """A stage with two files, as a job leaves it."""
    made_from = {name: root / "results" / scene / name / MANIFEST for name in inputs}
    facts = {
        "scene": scene,
        "stage": stage,
        "quality": "draft",
        "fingerprint": mark,
        "inputs": {
            name: {"fingerprint": MARK, "scene": scene, "manifest_sha256": io.sha256_of(path)} for name, path in made_from.items()
        },
    }
    writer = StageWriter(root / "results" / scene / stage, facts)
    writer.json("facts.json", {"value": value})
    writer.table("cells.parquet", {"edge": np.full(3, value)})
    writer.finish()
    writer.stamps.save(stamps.place(root / "results", scene, stage))
    return root / "results" / scene / stage


def faults(root, scene="s", stage="base", mark=MARK):
    sound.forget()
    return sound.stage_faults(root / "results", scene, stage, mark)


@pytest.fixture
def room(tmp_path):
    finish(tmp_path, "s", "capture")
    return finish(tmp_path, "s", "base", ["capture"])


def test_every_bit_of_a_manifest_counts(room, tmp_path):
    path = room / MANIFEST
    data = path.read_bytes()
    assert list(damaged(tmp_path)) == [] and faults(tmp_path) == ()
    for bit in range(0, 8 * len(data), 5):
        changed = bytearray(data)
        changed[bit // 8] ^= 1 << bit % 8
        with pytest.raises(manifests.Broken):
            manifests.parse(bytes(changed), manifests.STAGE_SCHEMA)
    for text in (
        data + b"\n",
        data.replace(b"\n ", b"\n  ", 1),
        data.replace(b'{\n "', b'{\n "a": 1,\n "', 1),
        b"",
        b"{}",
        b"[" * 100000,
    ):
        with pytest.raises(manifests.Broken):
            manifests.parse(text, manifests.STAGE_SCHEMA)


def flip(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def in_secret(harm):
    """Damage with the time stamp set back."""

    def harmed(path):
        status = path.stat()
        harm(path)
        os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))

    return harmed


HARMS = {
    "flipped": flip,
    "flipped in secret": in_secret(flip),
    "emptied": lambda path: path.write_bytes(b""),
    "emptied in secret": in_secret(lambda path: path.write_bytes(b"")),
    "removed": lambda path: path.unlink(),
    "a folder": lambda path: (path.unlink(), path.mkdir()),
}


@pytest.mark.parametrize("name", ["facts.json", "cells.parquet", MANIFEST])
@pytest.mark.parametrize("harm", HARMS)
def test_damage_is_found_by_both(room, tmp_path, name, harm):
    HARMS[harm](room / name)
    found = faults(tmp_path)
    assert found and all(str(room / name) in line for line in found)
    finish(tmp_path, "s", "report", ["capture"])  # another finished stage, not made from this one
    lines = list(damaged(tmp_path))
    if not (name == MANIFEST and harm in ("removed", "a folder")):
        assert any(str(room / name) in line for line in lines)


def test_a_stage_that_is_gone_is_missed(room, tmp_path):
    shutil.rmtree(room)
    assert faults(tmp_path) == (f"{room}: missing, although it was finished",)
    stamps.place(tmp_path / "results", "s", "base").unlink()  # as if it had never been finished
    assert faults(tmp_path) == ()


def test_a_stage_of_another_scene_is_not_taken(room, tmp_path):
    other = finish(tmp_path, "other", "base", mark="1" * 16, value=0.02)
    shutil.rmtree(room)
    shutil.copytree(other, room)
    (line,) = faults(tmp_path)
    named(line, room / MANIFEST, "stage base", "scene other")
    assert any(not missing(line, "stage base", "scene other") for line in damaged(tmp_path))


def test_a_stage_of_other_settings_is_not_taken(room, tmp_path):
    other = finish(tmp_path / "elsewhere", "s", "base", mark="1" * 16, value=0.02)
    shutil.rmtree(room)
    shutil.copytree(other, room)
    assert faults(tmp_path) == ("",)
    assert faults(tmp_path, mark="1" * 16) == ()


def test_other_settings_are_nothing_to_tell(room, tmp_path):
    assert faults(tmp_path, mark="2" * 16) == ("",) and sound.told(("",), "again") == ""


def test_the_chain_is_closed(room, tmp_path):
    """The stage from which another was made is replaced by one that is sound in itself."""
    finish(tmp_path, "s", "capture", value=0.5)
    (line,) = faults(tmp_path)
    named(line, room, tmp_path / "results/s/capture")
    (line,) = damaged(tmp_path)
    assert line.endswith("scenes/s --forcerun base") and not missing(line, tmp_path / "results/s/capture")


@pytest.mark.parametrize("name", ["extra.json", "maps/extra.exr", "link"])
def test_files_that_no_stage_wrote_are_named(room, tmp_path, name):
    (room / name).parent.mkdir(exist_ok=True)
    (room / name).symlink_to("nowhere") if name == "link" else (room / name).write_text("")
    (line,) = damaged(tmp_path)
    assert line.startswith(f"{room / name}: not written by rule base")


def test_what_nobody_touched_is_not_read(room, tmp_path, monkeypatch):
    def read(path):
        raise AssertionError(f"{path} was read")

    with monkeypatch.context() as untouched:
        untouched.setattr(io, "sha256_of", read)
        assert faults(tmp_path) == ()
    os.utime(room / "facts.json")
    seen = []
    with monkeypatch.context() as watched:
        original = io.sha256_of
        watched.setattr(io, "sha256_of", lambda path: seen.append(path.name) or original(path))
        assert faults(tmp_path) == ()  # the same content: nothing to do, and the new time stamp is noted
    assert "facts.json" in seen and "cells.parquet" not in seen
    monkeypatch.setattr(io, "sha256_of", read)
    assert faults(tmp_path) == ()


def test_a_stage_whose_job_was_killed_while_it_made_it_again_is_made_again(room, tmp_path):
    """Also where what was made from the earlier one is there: its stamps stay until the new one has its own."""
    finish(tmp_path, "s", "render", ["base"])
    facts = {"scene": "s", "stage": "base", "fingerprint": MARK, "inputs": {}}
    StageWriter(room, facts).json("facts.json", {})  # and then it is killed
    assert faults(tmp_path) == (f"{room / MANIFEST}: missing, although it was finished",)


def test_a_folder_in_the_place_of_a_manifest_is_told(room, tmp_path):
    (room / MANIFEST).unlink()
    (room / MANIFEST).mkdir()
    finish(tmp_path, "s", "render")
    (line,) = faults(tmp_path)
    assert line.startswith(f"{room / MANIFEST}: ")
    assert sound._digest_of(tmp_path / "results", "s", "base") is None


def test_a_manifest_that_was_touched_has_no_content_read_but_its_own(room, tmp_path, monkeypatch):
    """Snakemake touches it when a job has ended. A file that was touched as well is read, and a harm of it is found."""
    read = []
    original = io.sha256_of
    monkeypatch.setattr(io, "sha256_of", lambda path: read.append(path.name) or original(path))
    os.utime(room / MANIFEST)
    assert faults(tmp_path) == () and read == []
    os.utime(room / MANIFEST)
    in_secret(flip)(room / "facts.json")
    (line,) = faults(tmp_path)
    assert line.startswith(f"{room / 'facts.json'}: its content changed") and read == ["facts.json"]


def test_another_manifest_has_all_contents_compared(room, tmp_path):
    """One that is sealed, lists the same files, and came into the place of the one that is noted."""
    document = manifests.read(room / MANIFEST)
    document["files"]["facts.json"]["sha256"] = "0" * 64
    manifests.write(room / MANIFEST, document)
    (line,) = faults(tmp_path)
    assert line.startswith(f"{room / 'facts.json'}: its content changed")


@pytest.mark.parametrize("noted", [True, False])
@pytest.mark.parametrize("name", ["facts.json", MANIFEST])
def test_what_changes_while_it_is_compared_is_found_by_the_next_plan(room, tmp_path, monkeypatch, name, noted):
    """Once a file has been read, and before its time stamps are noted, it changes."""
    os.utime(room / "facts.json")
    if not noted:
        stamps.place(tmp_path / "results", "s", "base").unlink()
    original, before = sound.wrong_files, (room / name).read_bytes()

    def disturbed(*arguments):
        yield from original(*arguments)
        flip(room / name)

    with monkeypatch.context() as other:
        other.setattr(sound, "wrong_files", disturbed)
        faults(tmp_path)
    assert (room / name).read_bytes() != before
    (line,) = faults(tmp_path)
    assert line.startswith(f"{room / name}: its content changed")


def test_what_changes_before_the_end_of_its_job_is_found_by_the_next_plan(tmp_path, monkeypatch):
    monkeypatch.setattr(
        StageWriter, "finish", lambda writer, end=StageWriter.finish: (flip(writer.directory / "facts.json"), end(writer))
    )
    room = finish(tmp_path, "s", "capture")
    (line,) = faults(tmp_path, stage="capture")
    named(line, room / "facts.json", "sha256")


@pytest.mark.parametrize(
    "text", ["", "{", "[]", '{"files": 3}', '{"files": {"a": [1]}}', '{"files": {"PATH": [[1e999], "0"]}}', "null", "changed"]
)
def test_stamps_that_cannot_be_read_are_noted_again(room, tmp_path, text):
    path, file = stamps.place(tmp_path / "results", "s", "base"), room / "facts.json"
    whole = path.read_text()
    if text == "changed":
        text = whole.replace(stamps.Stamps(path).known(file), "0" * 64)
    elif text.startswith("{"):  # sealed by whoever forges it
        text = text.replace("PATH", str(file)).replace("1e999", "1")
        try:
            text = manifests.text_of(json.loads(text))
        except ValueError:
            pass
    path.write_text(text)
    assert stamps.Stamps(path).known(file) is None and faults(tmp_path) == ()
    assert stamps.Stamps(path).known(file) == io.sha256_of(file)
    flip(file)
    path.write_text(text)
    assert len(faults(tmp_path)) == 1


def test_a_deliverable_of_other_settings_is_published_again(tmp_path):
    """The earlier one is copied back over one that was published since."""
    folder = tmp_path / "scenes/s"

    def publish(mark):
        shutil.rmtree(folder, ignore_errors=True)
        document = {"schema": manifests.SCENE_SCHEMA, "scene": "s", "fingerprint": mark, "files": {}}
        manifests.write(folder / MANIFEST, document)

    def found(mark):
        sound.forget()
        return sound.deliverable_faults(folder, tmp_path / "results", "s", mark)

    first, second = "1" * 16, "2" * 16
    assert found(first) == ()
    publish(first)
    assert found(first) == () and found(second) == ("",)  # settings changed: there is nothing to tell
    earlier = tmp_path / "earlier"
    shutil.copytree(folder, earlier)
    publish(second)
    shutil.rmtree(folder)
    shutil.copytree(earlier, folder)
    assert found(second) == ("",)
    assert found(first) == ()  # back to the settings of the first, it is what is wanted
    shutil.rmtree(folder)
    manifests.write(folder / MANIFEST, {"schema": manifests.SCENE_SCHEMA, "scene": "other", "fingerprint": first, "files": {}})
    (line,) = found(first)
    named(line, folder / MANIFEST, "scene other")
