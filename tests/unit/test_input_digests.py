"""Input files in fingerprints: content decides, and a file that nobody touched is not read again."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.unit import own_scene as own
from workflow.artifacts import files as io
from workflow.artifacts.stamps import stamp_of, unsaved
from workflow.runtime import fingerprint, input_digests

REPOSITORY = Path(__file__).resolve().parents[2]


@pytest.fixture
def here(tmp_path, monkeypatch):
    """An empty working directory, and a list of the files whose content was read."""
    monkeypatch.chdir(tmp_path)
    read = []
    whole = io.sha256_of
    monkeypatch.setattr(io, "sha256_of", lambda path: read.append(path.name) or whole(path))
    forget()
    return tmp_path, read


def forget():
    """As a new process would find it."""
    input_digests._kept.cache_clear()


def write(path, data, time=None):
    path.write_bytes(data)
    if time:
        os.utime(path, ns=(time, time))
    return path


DATA = bytes(range(200))
EDITED = DATA[:50] + b"!" + DATA[51:]


def test_a_file_that_nobody_touched_is_read_once(here):
    folder, read = here
    paths = [write(folder / name, DATA) for name in "ba"]
    first = input_digests.digests(paths)
    assert [line.partition(":")[0] for line in first] == sorted(map(str, paths))
    forget()
    assert input_digests.digests(paths) == first and sorted(read) == ["a", "b"]


def test_touching_changes_nothing(here):
    folder, _ = here
    path = write(folder / "f", DATA)
    first = input_digests.digests([path])
    for time in (10**18, 2 * 10**18):
        os.utime(path, ns=(time, time))
        forget()
        assert input_digests.digests([path]) == first


def test_an_edit_is_noticed_every_time(here):
    folder, _ = here
    path = write(folder / "f", DATA)
    seen = input_digests.digests([path])
    for i in range(1, 4):  # planned again and again without a job in between
        write(path, DATA[:50] + bytes([i]) + DATA[51:], i * 10**18)
        forget()
        now = input_digests.digests([path])
        assert now[0] not in seen
        seen += now


def test_copies_elsewhere_have_the_same_digest(here, tmp_path, monkeypatch):
    digests = []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        monkeypatch.chdir(tmp_path / name)
        path = write(tmp_path / name / "f", DATA, len(digests) * 10**18 + 1)
        digests.append(input_digests.digests([path.relative_to(tmp_path / name)]))
    assert digests[0] == digests[1]


def test_a_batch_saves_once(here):
    folder, read = here
    a, b = (write(folder / name, DATA) for name in "ab")
    with input_digests.saved_once():
        input_digests.digests([a])
        input_digests.digests([b])
        assert not input_digests.CACHE.exists()
    forget()
    input_digests.digests([a, b])
    assert sorted(read) == ["a", "b"]


def test_who_only_looks_saves_nothing(here):
    folder, _ = here
    with unsaved():
        input_digests.digests([write(folder / "f", DATA)])
    assert not input_digests.CACHE.exists()


def test_a_damaged_file_of_digests_is_made_anew(here):
    folder, _ = here
    path = write(folder / "f", DATA)
    first = input_digests.digests([path])
    kept = input_digests.CACHE.read_text()
    digest = first[0].rpartition(":")[2]
    for text in ("rubbish", "[]", kept.replace(digest, "0" * 64), kept.replace(digest[:9], "0" * 9)):
        input_digests.CACHE.write_text(text)
        forget()
        assert input_digests.digests([path]) == first


def test_a_time_stamp_that_is_set_back_hides_nothing(here):
    folder, read = here
    path = write(folder / "f", DATA, 10**18)
    first = input_digests.digests([path])
    write(path, EDITED, 10**18)  # the same size and the same time
    forget()
    assert input_digests.digests([path]) != first
    replacement = write(folder / "g", DATA, 10**18)
    os.replace(replacement, path)  # another file of the same size and time in its place
    forget()
    assert input_digests.digests([path]) == first and read == ["f"] * 3


def test_a_file_that_is_replaced_while_it_is_read_is_read_again(here, monkeypatch):
    folder, _ = here
    path = write(folder / "f", DATA)
    whole = io.sha256_of
    with monkeypatch.context() as network:
        network.setattr(io, "sha256_of", lambda path: (whole(path), write(path, EDITED + b"more"))[0])
        input_digests.digests([path])
    forget()
    assert input_digests.digests([path]) == [f"{path}:{whole(path)}"] and path.read_bytes() == EDITED + b"more"


def test_a_changed_mesh_is_found_although_its_time_stamp_and_the_kept_digests_say_nothing(tmp_path):
    """Two disguises: the kept digests are gone, or hold the old digest under the stamp that the file has now."""
    path = own.project(tmp_path, {"registration": "off"}, {"width": 32, "height": 24})
    own.photographed(path, 3)
    own.run(tmp_path, "capture")
    mesh = path / "mesh.ply"
    with own.working_in(tmp_path):
        manifest = json.loads(Path("results/own/capture/manifest.json").read_text())
        assert manifest["raw"] == {name: io.sha256_of(Path(name)) for name in manifest["raw"]}
        named = {Path(name).name for name in manifest["raw"]}
        assert named == {"transforms.json", "mesh.ply", "000.png", "001.png", "002.png"}
        assert list(input_digests.changed(["own"], REPOSITORY)) == []
        before, old = mesh.stat(), io.sha256_of(mesh)
        vertex = mesh.read_bytes().index(b"5.0 ")
        data = mesh.read_bytes()
        mesh.write_bytes(data[:vertex] + b"5.1 " + data[vertex + 4 :])
        os.utime(mesh, ns=(before.st_atime_ns, before.st_mtime_ns))
        assert mesh.stat().st_size == before.st_size
        for disguise in ("gone", "stale"):
            forget()
            input_digests.CACHE.unlink(missing_ok=True)
            if disguise == "stale":
                kept = input_digests._kept(input_digests.CACHE.absolute())
                kept.note("data/own/mesh.ply", stamp_of("data/own/mesh.ply"), old)
                kept.save(flushed=True)
            fingerprint.fingerprint.cache_clear()
            assert (fingerprint.fingerprint("capture", "own", "draft") == manifest["fingerprint"]) == (disguise == "stale")
            (line,) = input_digests.changed(["own"], REPOSITORY)
            assert "mesh.ply" in line and "--forcerun capture" in line
            fingerprint.fingerprint.cache_clear()
            assert "capture" in fingerprint.missing_stages("own", "draft")
        done = subprocess.run(
            [sys.executable, "-m", "workflow", "verify"], env={**os.environ, "PYTHONPATH": str(REPOSITORY)}, capture_output=True
        )
        assert done.returncode == 1 and b"mesh.ply" in done.stdout
        mesh.unlink()
        assert list(input_digests.changed(["own"], REPOSITORY)) == []


ADDS = """
import sys
from pathlib import Path
from workflow.runtime import input_digests
name = sys.argv[1]
print("ready", flush=True)
sys.stdin.readline()
for number in range(20):
    input_digests.digests([Path(f"{name}{number}")])
"""


def test_two_processes_leave_what_can_be_read(here):
    """What one adds may be lost to the other; it is read again then."""
    folder, read = here
    paths = [write(folder / f"{name}{number}", DATA) for name in "ab" for number in range(20)]
    command = [sys.executable, "-c", ADDS]
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    both = [
        subprocess.Popen([*command, name], stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment, text=True)
        for name in "ab"
    ]
    for one in both:
        assert one.stdout.readline() == "ready\n"
    for one in both:
        one.stdin.write("\n")
        one.stdin.flush()
    for one in both:
        one.communicate()
        assert one.returncode == 0
    assert len({line.rpartition(":")[2] for line in input_digests.digests(paths)}) == 1
    assert len(read) <= 40
