"""Input files in fingerprints: content decides, and large files are not read while Snakemake plans."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from workflow.runtime import input_digests

REPOSITORY = Path(__file__).resolve().parents[2]


@pytest.fixture
def here(tmp_path, monkeypatch):
    """An empty working directory, small limits, and a list of the files whose whole content was read."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(input_digests, "WHOLE", 64)
    monkeypatch.setattr(input_digests, "SAMPLE", 8)
    read = []
    whole = input_digests.sha256_of
    monkeypatch.setattr(input_digests, "sha256_of", lambda path: read.append(path.name) or whole(path))
    forget()
    return tmp_path, read


def forget():
    """As a new process would find it."""
    input_digests._read_at = None
    input_digests._new.clear()


def write(path, data, time=None):
    path.write_bytes(data)
    if time:
        os.utime(path, ns=(time, time))
    return path


LARGE = bytes(range(200))
EDITED = LARGE[:50] + b"!" + LARGE[51:]  # between the samples


def test_a_large_file_is_not_read_until_a_job_has_read_it(here):
    folder, read = here
    path = write(folder / "large", LARGE)
    first = input_digests.digests([path])
    assert read == []
    input_digests.remember([path])
    forget()
    assert input_digests.digests([path]) == first and read == ["large"]


@pytest.mark.parametrize("size", [20, 200])
def test_touching_changes_nothing(here, size):
    folder, _ = here
    path = write(folder / "f", LARGE[:size])
    first = input_digests.digests([path])
    input_digests.remember([path])
    for time in (10**18, 2 * 10**18):
        os.utime(path, ns=(time, time))
        forget()
        assert input_digests.digests([path]) == first


def test_an_edit_that_keeps_size_and_samples_is_noticed_every_time(here):
    folder, _ = here
    path = write(folder / "f", LARGE)
    seen = input_digests.digests([path])
    input_digests.remember([path])
    for i in range(1, 4):  # planned again and again without a job in between
        write(path, LARGE[:50] + bytes([i]) + LARGE[51:], i * 10**18)
        forget()
        now = input_digests.digests([path])
        assert now[0] not in seen
        seen += now


@pytest.mark.parametrize("at", [0, 99, 199])
def test_an_edit_within_the_samples_or_of_the_size_is_noticed_without_reading_all(here, at):
    folder, read = here
    path = write(folder / "f", LARGE)
    first = input_digests.digests([path])
    edited = bytearray(LARGE)
    edited[at] ^= 1
    write(path, bytes(edited), 10**18)
    second = input_digests.digests([path])
    write(path, LARGE + b"x", 2 * 10**18)
    assert len({*first, *second, *input_digests.digests([path])}) == 3 and read == []


def test_copies_elsewhere_have_the_same_digest(here, tmp_path, monkeypatch):
    digests = []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        monkeypatch.chdir(tmp_path / name)
        path = write(tmp_path / name / "f", LARGE, len(digests) * 10**18 + 1)
        digests.append(input_digests.digests([path.relative_to(tmp_path / name)]))
    assert digests[0] == digests[1]


def test_what_changed_while_the_job_ran_is_not_taken_for_what_it_read(here):
    folder, read = here
    path = write(folder / "f", LARGE)
    input_digests.digests([path])
    write(path, EDITED, 10**18)
    input_digests.remember([path])
    assert read == []


def test_what_other_processes_noted_is_kept_and_a_batch_saves_once(here, monkeypatch):
    folder, _ = here
    a, b, c = (write(folder / name, LARGE) for name in "abc")
    input_digests.digests([a])
    stored = json.loads(input_digests.CACHE.read_text())
    saves = []
    save = input_digests.write_atomically
    monkeypatch.setattr(input_digests, "write_atomically", lambda *args: saves.append(1) or save(*args))
    with input_digests.saved_once():
        input_digests.digests([b])
        input_digests.CACHE.write_text(json.dumps({**stored, "elsewhere": [1, 2, "3", "4"]}))
        input_digests.digests([c])
    assert len(saves) == 1
    assert set(json.loads(input_digests.CACHE.read_text())) == {str(a), str(b), str(c), "elsewhere"}


def test_a_damaged_or_older_file_of_digests_is_made_anew(here):
    folder, _ = here
    path = write(folder / "f", LARGE)
    first = input_digests.digests([path])
    for text in ("rubbish", "[]", json.dumps({str(path): [1, 2, "of an older version"]})):
        input_digests.CACHE.write_text(text)
        forget()
        assert input_digests.digests([path]) == first


def test_a_time_stamp_that_is_set_back_hides_nothing(here):
    folder, read = here
    path = write(folder / "f", LARGE, 10**18)
    first = input_digests.digests([path])
    input_digests.remember([path])
    write(path, EDITED, 10**18)  # the same size and the same time
    forget()
    assert input_digests.digests([path]) != first
    replacement = write(folder / "g", LARGE, 10**18)
    os.replace(replacement, path)  # another file of the same size and time in its place
    forget()
    assert input_digests.digests([path]) not in (first, []) and read[-1] == "f"


def test_a_file_that_is_replaced_while_it_is_read_is_another_file(here, monkeypatch):
    folder, _ = here
    path = write(folder / "f", LARGE)
    first = input_digests.digests([path])
    whole = input_digests.sha256_of
    with monkeypatch.context() as network:
        network.setattr(input_digests, "sha256_of", lambda path: whole(write(path, EDITED + b"more")))
        input_digests.remember([path])
    forget()
    assert input_digests.digests([path]) != first


def test_all_is_read_again_on_demand(here, monkeypatch):
    """Also where `stat` says nothing, as on a disk that has lost a bit."""
    folder, read = here
    paths = [write(folder / name, LARGE) for name in ("a", "b")]
    first = input_digests.digests(paths)
    input_digests.remember(paths[:1])
    forget()
    read.clear()
    assert input_digests.rehash() == [] and sorted(set(read)) == ["a", "b"] and input_digests.digests(paths) == first
    stamps = {path: input_digests._stamp(path) for path in paths}
    write(paths[0], EDITED)
    monkeypatch.setattr(input_digests, "_stamp", stamps.get)
    forget()
    assert input_digests.digests(paths) == first  # nothing is seen
    assert input_digests.rehash() == [paths[0]] and input_digests.digests(paths) != first


ADDS = """
import sys
from pathlib import Path
from workflow.runtime import input_digests
name = sys.argv[1]
input_digests.WHOLE, input_digests.SAMPLE = 64, 8
print("ready", flush=True)
sys.stdin.readline()
for number in range(20):
    path = Path(f"{name}{number}")
    input_digests.digests([path])
    input_digests.remember([path])
"""


def test_two_processes_lose_nothing_of_one_another(here):
    """What one adds is kept while the other reads the file, adds to it and writes it."""
    folder, _ = here
    for name in "ab":
        for number in range(20):
            write(folder / f"{name}{number}", LARGE)
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
    forget()
    input_digests._recall()
    known = input_digests._known
    assert sorted(known) == sorted(f"{name}{number}" for name in "ab" for number in range(20))
    assert all(entry.whole for entry in known.values())


def test_who_has_read_less_of_a_file_does_not_overwrite_who_has_read_all_of_it(here):
    folder, _ = here
    path = write(folder / "large", LARGE)
    with input_digests.unsaved():
        first = input_digests.digests([path])  # as a long plan, which saves at its end
    less = dict(input_digests._new)
    input_digests.digests([path])
    input_digests.remember([path])  # a job meanwhile
    input_digests._new.update(less)
    input_digests._save()
    status = path.stat()
    write(path, EDITED, status.st_mtime_ns)
    forget()
    assert input_digests.digests([path]) != first
