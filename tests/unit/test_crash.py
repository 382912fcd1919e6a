"""A power cut, a failing disk or a kill at any call leaves the earlier result, the new one, or what is visibly unfinished."""

import errno
import json
import os
import random
import resource
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from iif_core.errors import InputError
from lab.published.state import keep_state
from tests.errors import missing, refused
from tests.workflow import crash
from tests.workflow.faulty_disk import Disk
from workflow.artifacts import StageReader, StageWriter, locks, swap
from workflow.artifacts import files as io
from workflow.runtime import ending
from workflow.stages import publish

REPOSITORY = Path(__file__).resolve().parents[2]


def some(number):
    return lambda every: random.Random(5).sample(every, min(number, len(every)))


@pytest.mark.parametrize("case", crash.CASES.values(), ids=lambda case: case.name)
def test_power_cuts_and_faults_leave_what_can_be_told_apart(case):
    cuts, faults = crash.try_power_cuts(case, 2, some(25)), crash.try_faults(case, some(15))
    assert cuts.wrong + faults.wrong == []
    assert cuts.counts.total() == 25 and faults.counts.total() >= 8


@pytest.mark.long
@pytest.mark.parametrize("case", crash.CASES.values(), ids=lambda case: case.name)
def test_every_power_cut_and_every_fault(case):
    assert crash.try_power_cuts(case, 4).wrong + crash.try_faults(case).wrong == []


MUTANTS = {
    "folders are not flushed": (io, "flush_folder", lambda folder: None, "stage", "a power cut took it back"),
    "content is not flushed": (io, "_flush", lambda path: None, "stage", "a manifest is there, and files are not what it says"),
    "the folder of a file is not flushed": (io, "flush_folder", lambda folder: None, "file", "a power cut took it back"),
    "a file is written in place": (
        io,
        "write_atomically",
        lambda path, write, *_: (path.parent.mkdir(parents=True, exist_ok=True), write(path)),
        "file over an earlier one",
        "neither the earlier one nor the new one",
    ),
    "the manifest is written before the names of files are flushed": (
        io,
        "flush_folders",
        lambda folder: None,
        "stage",
        "a manifest is there, and files are not what it says",
    ),
    "the removal of the earlier manifest is not flushed": (
        io,
        "remove",
        lambda path: path.unlink(missing_ok=True),
        "stage over an earlier one",
        "a manifest is there, and files are not what it says",
    ),
    "hashes are not compared": (io, "sha256_of", lambda path: "0", "stage over an earlier one", "a second run does not end"),
    "a deliverable is renamed before it is flushed": (
        publish,
        "flush_folders",
        lambda folder: None,
        "deliverable",
        "scenes/s of",
    ),
    "the earlier deliverable is removed first": (
        publish,
        "replace",
        lambda temporary, target: (publish.shutil.rmtree(target, ignore_errors=True), os.rename(temporary, target)),
        "deliverable over an earlier one",
        "scenes/s of",
    ),
}


@pytest.mark.parametrize("mutant", MUTANTS)
def test_the_trials_see_what_they_are_for(mutant, monkeypatch):
    """With a flush left out, or a step in another order, they find what is wrong."""
    module, name, replacement, case, said = MUTANTS[mutant]
    monkeypatch.setattr(module, name, replacement)
    tally = crash.try_power_cuts(crash.CASES[case], 1, lambda every: every[::-1], until=said)
    assert said in tally.wrong[-1]


def test_the_record_is_complete(tmp_path, monkeypatch):
    """A call that the record misses shows, because the record then leads elsewhere."""
    missed = os.replace

    def careless(mark):
        crash.note(mark)
        missed("plan/s/plan.json", "plan/s/other.json")

    with pytest.raises(crash.Wrong, match="a call was missed"):
        crash.prepare(crash.Case("careless", careless, crash.of_note, lambda *_: ""), tmp_path / "w")


@pytest.fixture
def small_files():
    """The kernel refuses to let a file grow beyond a limit, as a full disk does, in whatever language it is written."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (soft if size is None else size, hard))
    resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    signal.signal(signal.SIGXFSZ, handler)


@pytest.mark.parametrize("kind", ["exr", "table", "json", "bytes", "state"])
def test_the_kernel_refuses_and_it_is_told(tmp_path, small_files, kind):
    """OpenEXR alone would tell nothing if the last part of a file could not be written."""
    values = np.random.default_rng(0).random((20, 20)).astype(np.float16)
    write = {
        "exr": lambda writer: writer.exr("a.exr", {"a": values}),
        "table": lambda writer: writer.table("a.parquet", {"a": values.ravel().astype(np.float32)}),
        "json": lambda writer: writer.json("a.json", values.tolist()),
        "bytes": lambda writer: writer.bytes("a.bin", values.tobytes()),
        "state": lambda writer: keep_state(writer, "a", {"a": values}, {}),
    }[kind]
    writer = StageWriter(tmp_path, {"scene": "s", "stage": "base", "fingerprint": "f"})
    write(writer)
    (path,) = (path for path in tmp_path.rglob("*") if path.is_file())
    data = path.read_bytes()
    for size in sorted({0, 1, *range(len(data) // 9, len(data), len(data) // 9), len(data) - 1}):
        small_files(size)
        with pytest.raises(OSError) as caught:
            write(writer)
        small_files(None)
        assert caught.value.errno == errno.EFBIG and ending.of_the_machine(caught.value).startswith(f"{path}: the file would be")
        assert path.read_bytes() == data and list(path.parent.iterdir()) == [path]


def test_an_error_of_the_disk_is_one_sentence(tmp_path, monkeypatch, caplog):
    """Also where the state of the job itself cannot be written."""
    monkeypatch.chdir(tmp_path)
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "results/s/logs/base.state.json")

    class Full:
        def started(self):
            raise full

        def failed(self, reason):
            raise full

    assert ending.guarded("base of s", lambda: None, Full()) == 1
    (record,) = caplog.records
    assert not record.exc_info
    assert record.getMessage().startswith("results/s/logs/base.state.json: the disk is full; make room")


def test_a_folder_that_cannot_be_flushed_is_left_to_its_disk(tmp_path, monkeypatch):
    def refuse(code):
        def fsync(handle):
            raise OSError(code, os.strerror(code))

        return fsync

    monkeypatch.setattr(os, "fsync", refuse(errno.EINVAL))
    io.flush_folder(tmp_path)
    monkeypatch.setattr(os, "fsync", refuse(errno.EIO))
    with pytest.raises(OSError) as caught:
        io.flush_folder(tmp_path)
    assert caught.value.filename == str(tmp_path)


def test_a_folder_is_flushed_once_and_not_for_each_file(tmp_path):
    def flushed(files):
        folder = tmp_path / str(files)
        folder.mkdir()
        with Disk(folder).watched() as disk:
            writer = StageWriter(folder / "base", {"scene": "s", "stage": "base", "fingerprint": "f"})
            for number in range(files):
                writer.json(f"maps/{number}.json", number)
            writer.finish()
        paths = [path for call, path in disk.steps if call == "fsync"]
        return sum("json" not in path for path in paths)

    assert flushed(3) == flushed(12)


def test_a_note_of_a_part_that_was_changed_is_not_taken_over(tmp_path):
    facts = {"scene": "s", "stage": "base", "fingerprint": "f"}
    writer = StageWriter(tmp_path, facts)
    writer.json("a.json", 1)
    writer.part_done("a", ["a.json"], {"mean": 0.25}, "digest")
    assert StageWriter(tmp_path, facts).part_kept("a", "digest") == {"mean": 0.25}
    note = tmp_path / "unfinished/a.json"
    whole = note.read_text()
    note.write_text(whole.replace("0.25", "0.26"))
    assert StageWriter(tmp_path, facts).part_kept("a", "digest") is None
    note.write_text(whole)
    writer.finish()
    parts = tmp_path / "parts.json"
    parts.write_text(parts.read_text().replace("0.25", "0.26"))
    assert StageWriter(tmp_path, facts).part_kept("a", "digest") is None


def test_a_deliverable_that_was_set_aside_comes_back(tmp_path, monkeypatch):
    """Killed between the two renames of a run by hand, and then the disk is full: the earlier one is there again."""
    monkeypatch.chdir(tmp_path)
    crash.make_upstream(crash.OLD)
    crash.deliver(crash.OLD)
    before = crash.tree(Path("scenes"))
    os.rename("scenes/s", "scenes/.s.old")
    monkeypatch.setattr(publish, "copy", lambda *_: (_ for _ in ()).throw(OSError(errno.ENOSPC, "full")))
    with pytest.raises(OSError, match="full"):
        crash.deliver(crash.OLD)
    assert crash.tree(Path("scenes")) == before
    os.rename("scenes/s", "scenes/.s.old")
    Path("scenes/.s.old/scene.glb").write_bytes(b"damaged")
    swap.bring_back(Path("scenes/s"))
    assert not Path("scenes/s").exists()


HOLDER = """
import sys, time
from pathlib import Path
from workflow.artifacts import locks
with locks.alone(Path("results"), "s", "base"):
    print("held", flush=True)
    time.sleep(600)
"""


@pytest.fixture
def holder(tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
    )
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.communicate()


def test_a_stage_is_made_by_one_process_at_a_time(tmp_path, holder, monkeypatch):
    monkeypatch.chdir(tmp_path)
    results = Path("results")
    with locks.alone(results, "s", "shading"), locks.alone(results, "other", "base"):
        pass
    with refused("results/s/locks/base", "stage base of s", holder.pid, os.uname().nodename), locks.alone(results, "s", "base"):
        pass
    holder.kill()  # as an orphan that the memory killer ends: the kernel gives its lock back
    holder.wait()
    with locks.alone(results, "s", "base"):
        assert json.loads(locks.place(results, "s", "base").read_text())["pid"] == os.getpid()
    assert locks.place(results, "s", "base").read_text() == ""


def test_the_second_of_two_runs_ends_at_once_and_disturbs_nothing(tmp_path, holder):
    (tmp_path / "config/scenes").mkdir(parents=True)
    (tmp_path / "config/scenes/s.yaml").write_text("source: {kind: builtin, scene: tiny}\n")
    log = tmp_path / "results/s/logs/base.log"
    log.parent.mkdir(parents=True)
    state = log.with_name("base.state.json")
    for file in (log, state):
        file.write_text("of the first\n")
    second = subprocess.run(
        [sys.executable, "-m", "workflow", "base", "s", "--log", str(log)],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
    )
    assert second.returncode == 1 and holder.poll() is None  # it did not wait
    (line,) = second.stderr.strip().splitlines()
    assert line.startswith("error: results/s/locks/base: ") and not missing(line, "stage base of s", holder.pid)
    assert log.read_text() == "of the first\n" and not (tmp_path / "results/s/base").exists()
    assert state.read_text() == "of the first\n"


def test_a_disk_without_locks_is_named_and_work_goes_on(tmp_path, monkeypatch, caplog):
    def unsupported(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(locks.fcntl, "flock", unsupported)
    with locks.alone(tmp_path, "s", "base"):
        done = True
    assert done and not missing(caplog.text, "(No locks available)")
    monkeypatch.setattr(locks.fcntl, "flock", lambda *_: (_ for _ in ()).throw(OSError(errno.EIO, "bad")))
    with pytest.raises(OSError, match="bad"), locks.alone(tmp_path, "s", "base"):
        pass


def test_a_reader_of_a_torn_stage_is_refused(tmp_path, monkeypatch):
    """The check of the trials themselves: a file that is not what the manifest says is never read."""
    monkeypatch.chdir(tmp_path)
    crash.perform(crash.NEW)
    whole = {crash.NEW: crash.of_stage(crash.tree(tmp_path))}
    assert crash.stage_is_sound(whole, crash.NEW) == crash.NEW
    Path("results/s/base/page.html").write_bytes(b"torn")
    with pytest.raises(crash.Wrong, match="a manifest is there"):
        crash.stage_is_sound(whole, crash.NEW)
    with pytest.raises(InputError):
        StageReader(Path("results/s/base"), "base", "s").path("page.html")
