"""`python -m lab.mutants`: does a unit test fail when a line that numbers pass through is wrong?

    python -m lab.mutants --count 300 --seed 0             # 300 lines of all modules; --resume leaves out what was tried
    python -m lab.mutants --count 20 --only fusion/gauge   # of files whose path contains this text

A mutant is the last commit with one operator, sign, constant or argument changed. It is killed if one of the unit tests closest
to its file fails, or if they compute four times as long as before. If it survives, it is equivalent, or a test is missing.

mutmut leaves out decorated functions, so every kernel of numba; cosmic-ray has one test command for all modules, and no samples.
"""

from __future__ import annotations

import argparse
import ast
import copy
import csv
import hashlib
import math
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import astuple, dataclass
from functools import partial
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
TABLE = REPOSITORY / "lab/notebook/data/mutants.csv"
COLUMNS = ("seed", "number", "file", "line", "operator", "before", "after", "verdict", "by", "seconds")
MODULES = (
    "iif_core/*/*.py", "iif_core/camera/calibration/*.py", "iif_core/light/emission/*.py",
    "workflow/priors/*.py", "workflow/scoring/*.py", "workflow/segmentations/*.py",
)  # fmt: skip
"""Files whose lines are drawn. Kernels of light transport are left out: compiling a changed one takes minutes."""
FEWEST_FILES, FARTHEST = 6, 3
"""Test files that are run for a file: all that import it, or this many that reach it by this many imports in a row."""
SOON, PATIENCE, IDLE = 60.0, 4.0, 30.0
"""Seconds of a processor, and times what the unchanged code takes, until a mutant counts as hung; other work on the machine makes
no difference. One that waits for something is ended after IDLE times these seconds."""
GUARD = 1e-6
"""Constants below this only keep a division from 0 / 0."""

_SWAPS: dict[str, dict[type, type]] = {
    "comparison": {ast.Lt: ast.Gt, ast.Gt: ast.Lt, ast.LtE: ast.GtE, ast.GtE: ast.LtE, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq},
    "edge": {ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt},
    "arithmetic": {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.Pow: ast.Mult},
    "logic": {ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd, ast.And: ast.Or, ast.Or: ast.And},
}
_PAIRS = (("min", "max"), ("minimum", "maximum"), ("argmin", "argmax"), ("floor", "ceil"), ("any", "all"))
_NAMES = dict([*_PAIRS, *(pair[::-1] for pair in _PAIRS)])
_SYMMETRIC = re.compile(r"(.*\.)?(minimum|maximum|min|max|hypot|isinstance|zip)")
_LATE = "time limit"
KERNELS = (b"numba", b"numerics.compiled")
"""What the source of compiled kernels imports; their cache may not be shared with other mutants."""
_SAID = re.compile(r".*\b(log|logging|warnings|notes|progress)\b(\.\w+)?")


@dataclass(frozen=True)
class Mutant:
    """A change of one file: `after` takes the place of `before`, which begins at byte `start`."""

    file: str
    line: int
    operator: str
    before: str
    after: str
    start: int

    def of(self, source: bytes) -> bytes:
        """Return the changed source."""
        return source[: self.start] + self.after.encode() + source[self.start + len(self.before.encode()) :]


def mutants_of(file: str, source: bytes) -> list[Mutant]:
    """Return every mutant of a file: of code in functions, without annotations, messages and raise statements."""
    begins, out = [0], []
    for text in source.splitlines(keepends=True):
        begins.append(begins[-1] + len(text))
    for node in _within(ast.parse(source), False):
        for operator, changed in _changes(node):
            start, end = begins[node.lineno - 1] + node.col_offset, begins[node.end_lineno - 1] + node.end_col_offset
            after = ast.unparse(changed) if isinstance(node, ast.AugAssign) else f"({ast.unparse(changed)})"
            out.append(Mutant(file, node.lineno, operator, source[start:end].decode(), after, start))
    return out


def _within(node: ast.AST, in_function: bool) -> Iterator[ast.AST]:
    """The nodes of code in functions that numbers pass through."""
    if isinstance(node, ast.Raise | ast.JoinedStr) or (isinstance(node, ast.Call) and _SAID.fullmatch(ast.unparse(node.func))):
        return
    if in_function:
        yield node
    inner = ast.iter_child_nodes(node)
    if isinstance(node, ast.FunctionDef):
        inner, in_function = iter(node.body), True
    for child in inner:
        if child is not getattr(node, "annotation", None):
            yield from _within(child, in_function)


def _changes(node: ast.AST) -> Iterator[tuple[str, ast.AST]]:
    """The operators that apply to a node, with the changed node."""

    def having(**fields: object) -> ast.AST:
        return type(node)(**{**dict(ast.iter_fields(copy.deepcopy(node))), **fields})

    parts = list(ast.iter_child_nodes(node))  # text and lists are joined by +
    joined = any(isinstance(part, ast.JoinedStr | ast.List) or isinstance(getattr(part, "value", 0), str) for part in parts)
    for kind, swaps in _SWAPS.items():
        if isinstance(node, ast.BinOp | ast.BoolOp | ast.AugAssign) and type(node.op) in swaps and not joined:
            yield kind, having(op=swaps[type(node.op)]())
        if isinstance(node, ast.Compare) and type(node.ops[0]) in swaps:
            yield kind, having(ops=[swaps[type(node.ops[0])](), *node.ops[1:]])
    if isinstance(node, ast.UnaryOp):
        yield ("sign" if isinstance(node.op, ast.USub) else "not"), node.operand
    if isinstance(node, ast.Constant) and type(node.value) is int:
        yield from (("constant", having(value=node.value + step)) for step in (1, -1))
    if isinstance(node, ast.Constant) and type(node.value) is float and abs(node.value) > GUARD:
        yield from (("constant", having(value=node.value * factor)) for factor in (2.0, 0.5))
    for field in ("id", "attr"):
        if getattr(node, field, None) in _NAMES and isinstance(node.ctx, ast.Load):
            yield "extreme", having(**{field: _NAMES[getattr(node, field)]})
    if isinstance(node, ast.Call) and not _SYMMETRIC.fullmatch(ast.unparse(node.func)):
        for i, (a, b) in enumerate(zip(node.args, node.args[1:], strict=False)):
            if type(a) is type(b) and isinstance(a, ast.Name | ast.Attribute | ast.Subscript) and ast.dump(a) != ast.dump(b):
                yield "arguments", having(args=[*node.args[:i], b, a, *node.args[i + 2 :]])


def draw(root: Path, seed: int) -> list[Mutant]:
    """Return one mutant of every line that has any, in random order; operators of a line are equally likely."""
    lines: dict[tuple[str, int], dict[str, list[Mutant]]] = {}
    for path in sorted({path for pattern in MODULES for path in root.glob(pattern)}):
        for mutant in mutants_of(str(path.relative_to(root)), path.read_bytes()):
            lines.setdefault((mutant.file, mutant.line), {}).setdefault(mutant.operator, []).append(mutant)
    rng = random.Random(seed)
    drawn = [rng.choice(rng.choice(list(own.values()))) for own in lines.values()]
    rng.shuffle(drawn)
    return drawn


def tests_by_file(root: Path) -> dict[str, list[str]]:
    """Return the closest unit tests of each file: first those that import it, then those that import what imports it."""
    paths = sorted(path for folder in ("iif_core", "workflow", "lab", "tests") for path in (root / folder).rglob("*.py"))
    places = {".".join(path.relative_to(root).with_suffix("").parts): str(path.relative_to(root)) for path in paths}
    imports = {name: _imported(root / place) & places.keys() for name, place in places.items()}
    found: dict[str, list[tuple[int, int, str]]] = {}
    for name in places:
        reached, steps = {name}, 0
        while name.startswith(("tests.unit.test_", "tests.lab.test_")) and steps < FARTHEST:
            new, steps = set().union(*(imports[one] for one in reached)) - reached, steps + 1
            reached |= new
            for one in new:  # of tests as close, the one with fewer imports is about fewer modules
                found.setdefault(places[one], []).append((steps, len(imports[name]), places[name]))
    return {
        file: [test for place, (far, _, test) in enumerate(sorted(ranks)) if far == 1 or place < FEWEST_FILES]
        for file, ranks in found.items()
    }


def _imported(path: Path) -> set[str]:
    """What may be modules among the names that a file imports, also inside functions."""
    nodes = list(ast.walk(ast.parse(path.read_bytes())))
    names = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    for node in nodes:
        if isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return names


class Bench:
    """A copy of a checkout in which mutants are tried; every file is put back after its trial."""

    def __init__(self, root: Path):
        self.root, self.tests, self.passed, self._clock = root, tests_by_file(root), set(), 1_000_000_000

    def verdict(self, mutant: Mutant) -> tuple[str, str, float]:
        """Return `killed` or `survived`, by which test, and the seconds of a processor that took.

        Raises:
            SystemExit: the tests fail without any change.
        """
        files, path = tuple(self.tests.get(mutant.file, ())), self.root / mutant.file
        if not files:
            return "survived", "no unit test imports it", 0.0
        source = path.read_bytes()
        changed, kernels = mutant.of(source), any(word in source for word in KERNELS)
        try:
            failed, seconds = self._run(path, changed, files, kernels, SOON)
            if failed == _LATE:  # only then it matters what the tests take without it
                usual, taken = self._run(path, source, files, kernels, None)
                failed, seconds = self._run(path, changed, files, kernels, max(PATIENCE * taken, SOON))
            elif failed and failed not in self.passed:
                usual, _ = self._run(path, source, (failed,) if failed.startswith("tests/") else files, False, None)
                self.passed.add(failed)
            else:
                usual = ""
        finally:
            self._write(path, source)
        if usual:
            raise SystemExit(f"{usual}: fails without a mutant")
        return "killed" if failed else "survived", failed, seconds

    def _run(self, path: Path, source: bytes, tests: tuple[str, ...], fresh: bool, limit: float | None) -> tuple[str, float]:
        """What fails first with this source (empty: nothing), and the seconds of a processor that took.

        Compiled callers in other files do not notice that a kernel changed, so with `fresh` nothing that was compiled is reused.
        """
        self._write(path, source)
        cache = self.root / ".numba" / (hashlib.sha256(source).hexdigest() if fresh else "shared")
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-m", "not long", "--tb=no", "-p", "no:cacheprovider", *tests]
        options = {"cwd": self.root, "env": {**os.environ, "NUMBA_CACHE_DIR": str(cache)}, "start_new_session": True}
        begin = _computed()
        if limit is not None:
            options["preexec_fn"] = partial(_confine, limit)
        with subprocess.Popen(command, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, **options) as run:
            try:
                said, _ = run.communicate(timeout=limit and IDLE * limit)
            except subprocess.TimeoutExpired:
                said = _LATE
            finally:
                if run.poll() is None:
                    os.killpg(run.pid, signal.SIGKILL)
                if fresh:
                    shutil.rmtree(cache, ignore_errors=True)
        first = re.search(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", said, re.MULTILINE)
        failed = "" if run.returncode == 0 else first[1] if first else f"pytest ended with {run.returncode}"
        return _LATE if said == _LATE or run.returncode == -signal.SIGXCPU else failed, _computed() - begin

    def _write(self, path: Path, source: bytes) -> None:
        path.write_bytes(source)
        self._clock += 1  # Python takes byte code of the same second and size for current
        os.utime(path, (self._clock, self._clock))


def _computed() -> float:
    """Seconds of a processor that all trials took that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _confine(seconds: float) -> None:
    """Limit the processor time of a trial; where memory is short, the trial is what the system ends first."""
    resource.setrlimit(resource.RLIMIT_CPU, (math.ceil(seconds), math.ceil(seconds) + 5))
    Path("/proc/self/oom_score_adj").write_text("1000")


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m lab.mutants", description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="files whose path contains this text")
    parser.add_argument("--resume", action="store_true", help="leave out what the table holds of this seed")
    options = parser.parse_args(arguments)
    rows = list(csv.reader(TABLE.read_text().splitlines(True))) if TABLE.exists() else []
    done, verdicts = {(row[0], *row[2:7]) for row in rows if options.resume}, []
    with tempfile.TemporaryDirectory() as scratch, TABLE.open("a", newline="") as file:
        subprocess.run(["git", "clone", "-q", "--shared", str(REPOSITORY), f"{scratch}/copy"], check=True)
        table, bench = csv.writer(file, lineterminator="\n"), Bench(Path(scratch) / "copy")
        table.writerows([] if rows else [COLUMNS])
        drawn = [(number, one) for number, one in enumerate(draw(bench.root, options.seed)) if options.only in one.file]
        for number, mutant in drawn[: options.count]:
            if tuple(map(str, (options.seed, *astuple(mutant)[:5]))) not in done:
                verdict, by, seconds = bench.verdict(mutant)
                verdicts.append(verdict)
                table.writerow([options.seed, number, *astuple(mutant)[:5], verdict, by, f"{seconds:.1f}"])
                file.flush()
                where = f"{mutant.file}:{mutant.line}: {mutant.before} -> {mutant.after}"
                print(f"{number} {verdict} {where} {by} ({seconds:.0f} s)", flush=True)
    print(f"{verdicts.count('killed')} of {len(verdicts)} mutants are killed")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
