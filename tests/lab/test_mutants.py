"""What `python -m lab.mutants` changes, and whom it takes for killed."""

from __future__ import annotations

import ast
import csv
import subprocess

import pytest

from lab import mutants

SOURCE = '''
"""Two docstrings: 1 < 2."""
LIMIT = 3


def of(a, b: list[1] = 5, *, log=None):
    """-1"""
    x: tuple[2] = min(a.low, b.low) if not a < 2 <= b else -a.max()
    x += 2.5 * f(a, b) / (a - b) ** 2
    log.info("%d", 7 + 8)
    if a & b or x == 1e-12:
        raise ValueError(7 - 8)
    return np.minimum(a, b), f"{a + b}", "y" + "z", np.ä(b[0], b[1])
'''.encode()


def test_every_operator_makes_another_program():
    found = mutants.mutants_of("a.py", SOURCE)
    plain = ast.dump(ast.parse(SOURCE))
    programs = [ast.dump(ast.parse(one.of(SOURCE))) for one in found]
    assert plain not in programs and len(set(programs)) == len(programs)
    assert {one.operator for one in found} == {*mutants._SWAPS, "sign", "not", "constant", "extreme", "arguments"}
    for one in found:
        assert SOURCE.splitlines()[one.line - 1].count(one.before.encode())


def test_what_no_number_passes_through_stays():
    changes = {(one.line, one.before, one.after) for one in mutants.mutants_of("a.py", SOURCE)}
    assert not {line for line, *_ in changes} & {2, 3, 6, 7, 10, 12}
    assert not {before for _, before, _ in changes} & {"tuple[2]", "1e-12", "np.minimum(a, b)", "a + b", '"y" + "z"'}
    line = [(before, after) for number, before, after in changes if number == 8]
    assert {("a < 2 <= b", "(a <= 2 <= b)"), ("not a < 2 <= b", "(a < 2 <= b)"), ("-a.max()", "(a.max())")} < set(line)
    assert (13, "np.ä(b[0], b[1])", "(np.ä(b[1], b[0]))") in changes


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """A module, one that passes its functions on, one that no test imports, and a test that says little of `twice`."""
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")  # they take most of the time
    files = {
        "iif_core/fusion/tiny.py": "def half(x):\n    return x / 2\n\n\ndef twice(x):\n    return x * 2\n\n\n"
        "def down(x):\n    while x > 0:\n        x -= 1\n    return x\n",
        "iif_core/fusion/passed.py": "from iif_core.fusion.tiny import down, half, twice  # noqa\n",
        "iif_core/fusion/alone.py": "def half(x):\n    return x / 2\n",
        "tests/unit/test_tiny.py": "from iif_core.fusion.passed import down, half, twice\n\n\ndef test_half():\n"
        "    assert half(4) == 2 and twice(0) == 0 and down(1) == 0\n",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    return tmp_path


def trial(checkout, line, file="iif_core/fusion/tiny.py", operator="arithmetic"):
    source = (checkout / file).read_bytes()
    (one,) = (one for one in mutants.mutants_of(file, source) if (one.line, one.operator) == (line, operator))
    found = mutants.Bench(checkout).verdict(one)[:2]
    assert (checkout / file).read_bytes() == source
    return found


def test_a_mutant_is_killed_where_a_test_fails_and_survives_where_none_does(checkout):
    assert trial(checkout, 2) == ("killed", "tests/unit/test_tiny.py::test_half")
    assert trial(checkout, 6) == ("survived", "")  # 0 * 2 and 0 / 2 are both 0
    assert trial(checkout, 2, "iif_core/fusion/alone.py")[0] == "survived"


def test_the_tests_of_a_file_are_all_that_import_it_and_else_the_closest(checkout):
    test = (checkout / "tests/unit/test_tiny.py").read_text()
    for number in range(9):
        (checkout / f"tests/unit/test_also{number}.py").write_text(test)
        (checkout / f"tests/unit/test_near{number}.py").write_text("from iif_core.fusion import tiny\n")
    found = mutants.tests_by_file(checkout)
    assert found["iif_core/fusion/tiny.py"] == [f"tests/unit/test_near{number}.py" for number in range(9)]
    assert len(found["iif_core/fusion/passed.py"]) == 10 and "iif_core/fusion/alone.py" not in found


@pytest.mark.parametrize(
    "limits",
    [
        pytest.param({"SOON": 1.0, "PATIENCE": 1.0}, id="computes"),
        pytest.param({"SOON": 100.0, "IDLE": 0.01}, id="waits", marks=pytest.mark.long),
    ],
)
def test_a_mutant_that_never_ends_is_killed(checkout, monkeypatch, limits):
    for name, value in limits.items():
        monkeypatch.setattr(mutants, name, value)
    assert trial(checkout, 11) == ("killed", "time limit")


def test_tests_that_fail_anyway_kill_nothing(checkout):
    test = checkout / "tests/unit/test_tiny.py"
    test.write_text(test.read_text().replace("== 2", "== 3"))
    with pytest.raises(SystemExit):
        trial(checkout, 2)


def test_the_draw_is_that_of_the_seed_and_goes_on_where_it_was(checkout, monkeypatch):
    for arguments in (["init", "-q"], ["add", "."], ["-c", "user.name=a", "-c", "user.email=a@b", "commit", "-qm", "a"]):
        subprocess.run(["git", *arguments], cwd=checkout, check=True)
    monkeypatch.setattr(mutants, "REPOSITORY", checkout)
    monkeypatch.setattr(mutants, "TABLE", checkout / "mutants.csv")
    monkeypatch.setattr(mutants.Bench, "verdict", lambda self, mutant: ("killed", "one", 1.0))

    def rows(*arguments):
        assert mutants.main(list(arguments)) == 0
        with mutants.TABLE.open(newline="") as file:
            return list(csv.DictReader(file))

    first = rows("--count", "2")
    whole = rows("--count", "5", "--resume")
    assert whole[:2] == first and len(whole) == 5 == len({(row["file"], row["line"]) for row in whole})
    assert rows("--count", "2") == whole + first
    assert {row["file"] for row in rows("--only", "alone")[7:]} == {"iif_core/fusion/alone.py"}
    assert mutants.draw(checkout, 0) != mutants.draw(checkout, 1)
