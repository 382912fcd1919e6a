"""Files from strangers: changed at random, and those that once did harm."""

import os
import signal
import tempfile
import time
from pathlib import Path

import pytest

from iif_core.errors import InputError
from tests.fuzz import runner
from tests.fuzz.corpora import TARGETS, Target

CASES = 200
FAR_AWAY = Path(tempfile.gettempdir()) / f"harm-{os.getpid()}"
REGRESSIONS = Path(__file__).with_name("regressions.tsv")
"""Seed, kind and number of cases that failed once, and how."""


@pytest.fixture(scope="module")
def run():
    with runner.apart() as run:
        yield run


def test_whatever_a_file_holds_it_is_read_or_refused_with_a_message(run):
    results = []
    for result in run(runner.kinds_of(CASES, TARGETS), 0):
        results.append(result)
        assert result.verdict in runner.GOOD, result.line  # at once: a minute is waited for each that hangs
    assert len(results) >= 0.95 * CASES and {result.kind for result in results} == set(TARGETS)
    # Nearly all changes hurt, and some do not: a reader that refuses everything, or accepts everything, tests nothing.
    refused = sum(result.verdict == "refused" for result in results)
    assert 0.5 * len(results) < refused < 0.98 * len(results)


def test_what_is_valid_is_accepted(run):
    for result in run([(kind, -1) for kind in TARGETS], 0):
        assert result.verdict == "accepted", f"{result.kind}: {result.message}"


def test_what_once_did_harm_does_no_more(run):
    lines = [line.split("\t", 3) for line in REGRESSIONS.read_text().splitlines() if line and line[0] != "#"]
    assert lines
    for seed, kind, number, _ in lines:
        (result,) = run([(kind, int(number))], int(seed))
        assert result.verdict in runner.GOOD, result.line


# -------------------------------------------------------------------------------------------- the fuzz itself can fail


def _value_error():
    raise ValueError("a bug")


def _killed():
    os.kill(os.getpid(), signal.SIGSEGV)


def _greedy():
    bytearray(2 << 30)


def _hungry():
    bytearray(b"x") * (700 << 20)  # below the limit of its process, and far too much for a small file


def _swallowed():
    from workflow.intake.documents import reading

    with reading(Path("f"), "cannot be read"):
        bytearray(2 << 30)


def _escaping():
    Path("../../evil").write_text("x")


def _far_away():
    FAR_AWAY.write_text("x")


def _beside_python():
    os.system("true")


def _unclear():
    raise InputError("x " * 5_000)


HARM = {
    "ValueError": (_value_error, "traceback"),
    "SystemExit": (lambda: exit(0), "traceback"),
    "signal": (_killed, "signal"),
    "allocation": (_greedy, "memory"),
    "large": (_hungry, "memory"),
    "hidden allocation": (_swallowed, "memory"),
    "beside its folder": (_escaping, "write outside"),
    "far away": (_far_away, "write outside"),
    "a command": (_beside_python, "write outside"),
    "long message": (_unclear, "unclear message"),
    "sleep": (lambda: time.sleep(30), "hang"),
    "message": (lambda: (_ for _ in ()).throw(InputError("f: found x, allowed y")), "refused"),
    "nothing": (lambda: None, "accepted"),
}


@pytest.mark.long
@pytest.mark.parametrize("harm", HARM)
def test_a_reader_that_does_harm_is_found(monkeypatch, harm):
    if harm == "sleep":
        monkeypatch.setattr(runner, "WALL_SECONDS", 2)
    read, verdict = HARM[harm]
    targets = {"x": Target(("f",), lambda home: (home / "f").write_text("a: 1\n"), read)}
    with runner.ready(targets) as run:
        results = list(run([("x", 0), ("x", 1)], 0))
    FAR_AWAY.unlink(missing_ok=True)
    assert [result.verdict for result in results] == [verdict] * 2, results


@pytest.mark.long
def test_a_loop_is_found_by_its_time(monkeypatch):
    monkeypatch.setattr(runner, "CPU_SECONDS", 1)

    def forever():
        while True:
            pass

    targets = {"x": Target(("f",), lambda home: (home / "f").write_text("a: 1\n"), forever)}
    with runner.ready(targets) as run:
        assert [result.verdict for result in run([("x", 0), ("x", 1)], 0)] == ["hang"] * 2


@pytest.mark.long
def test_what_a_reader_started_ends_with_it():
    """Or it would keep the pipes of the process of the tests open, and whoever waits for their end waits for ever."""

    def forking():
        child = os.fork()
        if child == 0:
            time.sleep(300)
        raise InputError(str(child))

    with runner.ready({"x": Target(("f",), lambda home: (home / "f").write_text("a: 1\n"), forking)}) as run:
        (result,) = run([("x", 0)], 0)
    state, end = Path(f"/proc/{result.message}/stat"), time.monotonic() + 10
    while state.exists() and state.read_text().rpartition(")")[2].split()[0] != "Z":
        assert time.monotonic() < end
        time.sleep(0.01)


def test_cases_are_the_same_each_time_and_counted():
    a, b = runner.kinds_of(100, TARGETS), runner.kinds_of(1000, TARGETS)
    assert set(a) <= set(b)
    results = [
        runner.Result("PNG", 0, 0, "refused"),
        runner.Result("PNG", 1, 0, "signal"),
        runner.Result("OBJ", 0, 0, "accepted"),
    ]
    table = runner.table(results, 0)
    assert table["all"]["cases"] == 3 and table["all"]["signal"] == 1 and table["kinds"]["PNG"]["refused"] == 1
    assert "signal" in runner.shown(table)
