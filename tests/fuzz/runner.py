"""Reads changed files as a run does, in forked processes with limits on time and memory for each case, and reports the outcomes.

`python -m tests.fuzz.runner --cases 100000 --seed 0 --jobs 2`, or `make fuzz`. Whatever a file holds, a reader must either accept
it or refuse it with one clear message (`InputError`). Everything else is a failure: another exception, a signal, more time or
memory than is allowed, a write outside of the folder, a message that nobody can read. A case is known by its seed, kind, number.
"""

from __future__ import annotations

import argparse
import contextlib
import faulthandler
import gc
import json
import os
import resource
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

import lab  # noqa: F401  registers its plug-in: its sources are read too
from iif_core.errors import InputError
from tests.fuzz import mutators
from tests.fuzz.corpora import TARGETS, Target

MEMORY = 1 << 30
"""Bytes of address space that a case may take over what the warm process has."""
CPU_SECONDS = 10
WALL_SECONDS = 60
LONGEST_MESSAGE = 4_000
ROW = Path("lab/notebook/data/reliability_fuzz.json")
PORTION = 5_000
"""Cases after which the counts are written down, so that a run that is stopped can go on (`--continue`)."""
TOGETHER = 10
"""Cases that one forked process reads, one after the other: to fork takes longer than to read most of them."""
GOOD = ("accepted", "refused")
BAD = ("traceback", "signal", "hang", "memory", "write outside", "unclear message")


@dataclass(frozen=True)
class Result:
    """What became of a case: one of `GOOD` or `BAD`, what was changed, and the message or the end of the traceback."""

    kind: str
    number: int
    seed: int
    verdict: str
    change: str = ""
    message: str = ""

    @property
    def line(self) -> str:
        return f"{self.seed}\t{self.kind}\t{self.number}\t{self.verdict}\t{self.change}\t{self.message[-300:]!r}"


def kinds_of(cases: int, targets: dict[str, Target]) -> list[tuple[str, int]]:
    """Return (kind, number) of every case, shares by weight; the first are the same however many there are."""
    total = sum(target.weight for target in targets.values())
    wanted = {name: max(1, round(cases * target.weight / total)) for name, target in targets.items()}
    return sorted(((name, i) for name, count in wanted.items() for i in range(count)), key=lambda case: (case[1], case[0]))


class Pristine:
    """The valid inputs, built once, as folders that are copied for each case."""

    def __init__(self, root: Path, targets: dict[str, Target]):
        self.root, self.targets = root, targets
        built: dict[Any, Path] = {}
        self.folders: dict[str, Path] = {}
        for name, target in targets.items():
            key = target.build if target.build.__name__ != "<lambda>" else name
            if key not in built:
                built[key] = root / f"{len(built)}"
                built[key].mkdir(parents=True)
                target.build(built[key])
            self.folders[name] = built[key]

    def copy(self, kind: str, place: Path) -> None:
        """Copy the input of a kind; files that are not changed are links to the same inode."""
        shutil.copytree(self.folders[kind], place, copy_function=os.link)
        for name in self.targets[kind].files:
            path = place / name
            data = path.read_bytes()
            path.unlink()
            path.write_bytes(data)


_allowed: list[str] = []  # folder in which the process of a case may write; empty in every other process
_outside: list[str] = []


def _watch(event: str, arguments: tuple[Any, ...]) -> None:
    """Note what Python itself writes outside of the folder of a case (an audit hook)."""
    if not _allowed:
        return
    if event == "open":
        path, mode, flags = arguments
        writes = isinstance(flags, int) and flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC)
        paths = [path] if writes and isinstance(path, str | bytes) else []
    elif event in ("os.mkdir", "os.remove", "os.rmdir", "os.truncate", "os.chmod"):
        paths = [arguments[0]]
    elif event in ("os.rename", "os.link", "os.symlink"):
        paths = list(arguments[:2])
    elif event in ("subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "socket.connect"):
        _outside.append(f"{event} {arguments[0]}")
        return
    else:
        return
    for path in paths:
        with contextlib.suppress(TypeError, ValueError):
            real = os.path.realpath(os.fsdecode(path))
            if not real.startswith(_allowed[0] + "/") and real not in (_allowed[0], "/dev/null"):
                _outside.append(f"{event} {real}")


def read_case(kind: str, number: int, seed: int, pristine: Pristine, place: Path) -> dict[str, str]:
    """Change the input of a case and read it, in this process; returns verdict, change and message."""
    target = pristine.targets[kind]
    pristine.copy(kind, place)
    change = ""
    if number >= 0:  # otherwise the valid input itself
        rng = np.random.default_rng([seed, zlib.crc32(kind.encode()), number])
        change = mutators.mutate(rng, place, target.files)
    os.chdir(place)
    _allowed[:], _outside[:] = [os.path.realpath(place)], []
    used = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for limit, value in (
        (resource.RLIMIT_AS, used + MEMORY),
        (resource.RLIMIT_CPU, int(time.process_time()) + CPU_SECONDS),
        (resource.RLIMIT_CORE, 0),
    ):
        resource.setrlimit(limit, (value, resource.getrlimit(limit)[1]))
    verdict, message = "accepted", ""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            target.read()
    except InputError as error:
        verdict, message = "refused", str(error)
        if "more memory than there is" in message:
            verdict = "memory"
        elif not message or len(message) > LONGEST_MESSAGE or any(not c.isprintable() and c != "\n" for c in message):
            verdict = "unclear message"
    except MemoryError:
        verdict, message = "memory", traceback.format_exc(limit=-4)
    except BaseException:
        verdict, message = "traceback", traceback.format_exc(limit=-4)
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - peak) << 10
    if grown > MEMORY // 2 and verdict in GOOD:
        verdict, message = "memory", f"{grown >> 20} MB; {message}"
    if _outside:
        verdict, message = "write outside", "; ".join(_outside[:3])
    _allowed.clear()
    return {"verdict": verdict, "change": change, "message": message[-3000:]}


def _strays(home: Path) -> list[Path]:
    """Return what lies in the folders above those of the cases, where nothing belongs."""
    chain = [home.parents[2], home.parents[1], home.parents[0], home]
    return [path for path in (p for folder in chain for p in folder.iterdir()) if path not in chain and path.parent != home]


def _child(cases: list[tuple[str, int]], seed: int, pristine: Pristine, home: Path, send: int) -> None:
    """Read cases one after the other and tell of each when it is done."""
    faulthandler.disable()
    quiet = os.open(os.devnull, os.O_WRONLY)
    os.dup2(quiet, 1), os.dup2(quiet, 2)
    for i, (kind, number) in enumerate(cases):
        try:
            found = read_case(kind, number, seed, pristine, home / f"case{i}")
        except BaseException:
            found = {"verdict": "traceback", "message": traceback.format_exc()[-3000:]}
        os.chdir(home)
        if strays := _strays(home):
            found |= {"verdict": "write outside", "message": "; ".join(map(str, strays[:3]))}
            for path in strays:
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        answer = json.dumps(found).encode() + b"\n"
        while answer:
            answer = answer[os.write(send, answer) :]
        if found["verdict"] == "memory":  # the peak of this process would hide the peak of the next case
            return


def _answers(cases: list[tuple[str, int]], seed: int, pristine: Pristine, scratch: Path) -> list[dict[str, str]]:
    """Run cases in one forked process as far as it lives; the last answer tells what killed it, or kept it."""
    home = scratch / "a/b/c"
    shutil.rmtree(scratch / "a", ignore_errors=True)
    home.mkdir(parents=True)
    receive, send = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            os.setsid()  # its own forks are of its group, and end with it
            os.close(receive)
            _child(cases, seed, pristine, home, send)
        finally:
            os._exit(0)
    os.close(send)
    said, deadline, late = b"", time.monotonic() + WALL_SECONDS, False
    while not late and said.count(b"\n") < len(cases):
        late = not select.select([receive], [], [], max(0, deadline - time.monotonic()))[0]
        part = b"" if late else os.read(receive, 1 << 16)
        if not part:
            break
        said += part
        if part.endswith(b"\n"):
            deadline = time.monotonic() + WALL_SECONDS
    with contextlib.suppress(ProcessLookupError):  # and what it started; if it has ended already, its status stays
        os.killpg(child, signal.SIGKILL)
    os.close(receive)
    _, status = os.waitpid(child, 0)
    answers = [json.loads(line) for line in said.split(b"\n")[: said.count(b"\n")]]
    ended = bool(answers) and answers[-1]["verdict"] == "memory"
    if len(answers) < len(cases) and not ended:
        number_of = os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0
        verdict = "hang" if late or number_of == signal.SIGXCPU else "signal"
        answers.append({"verdict": verdict, "message": signal.Signals(number_of).name if number_of else "no answer"})
    return answers


def run_cases(cases: list[tuple[str, int]], seed: int, pristine: Pristine, scratch: Path) -> Iterator[Result]:
    """Run cases, some in each forked process; what kills a process, or keeps it, becomes the verdict of the case that it read."""
    done = 0
    while done < len(cases):
        part = cases[done : done + TOGETHER]
        for (kind, number), found in zip(part, _answers(part, seed, pristine, scratch), strict=False):
            done += 1
            yield Result(kind, number, seed, found["verdict"], found.get("change", ""), found.get("message", ""))


def warm() -> None:
    """Import everything that readers import, so that a forked process starts with it."""
    import mitsuba
    import OpenEXR  # noqa: F401
    import pyarrow.parquet  # noqa: F401
    import scipy.spatial.transform  # noqa: F401
    import trimesh  # noqa: F401
    from PIL import Image

    import lab.sources.mitsuba  # noqa: F401
    import workflow.comparison.maps  # noqa: F401
    import workflow.priors.files  # noqa: F401
    import workflow.relighting.world  # noqa: F401
    import workflow.segmentations.masks  # noqa: F401
    import workflow.sources.scannetpp  # noqa: F401

    Image.init()
    mitsuba.set_variant("scalar_rgb")  # of a single thread: others do not survive a fork
    sys.dont_write_bytecode = True
    sys.addaudithook(_watch)


Run = Callable[[list[tuple[str, int]], int], Iterator[Result]]


@contextlib.contextmanager
def ready(targets: dict[str, Target] = TARGETS) -> Iterator[Run]:
    """Build the valid inputs; gives a function (cases, seed) -> results in the same order."""
    with tempfile.TemporaryDirectory(prefix="iif-fuzz-") as folder:
        scratch = Path(folder).resolve()
        import mitsuba

        before = mitsuba.variant(), sys.dont_write_bytecode
        warm()
        pristine = Pristine(scratch / "pristine", targets)
        gc.collect()
        gc.freeze()

        def run(cases: list[tuple[str, int]], seed: int) -> Iterator[Result]:
            place = scratch / f"work{os.getpid()}"
            place.mkdir(exist_ok=True)
            yield from run_cases(cases, seed, pristine, place)

        yield run
        gc.unfreeze()
        sys.dont_write_bytecode = before[1]
        if before[0]:  # the variant of other tests in this process
            mitsuba.set_variant(before[0])


@contextlib.contextmanager
def apart() -> Iterator[Run]:
    """As `ready` with all kinds, in a process that has no threads yet: what a thread held when its process forked, the fork waits
    for in vain."""
    command = [sys.executable, "-m", "tests.fuzz.runner", "--serve"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdin and process.stdout
        asked, told = process.stdin, process.stdout

        def run(cases: list[tuple[str, int]], seed: int) -> Iterator[Result]:
            asked.write(json.dumps([cases, seed]) + "\n")
            asked.flush()
            for _ in cases:
                yield Result(**json.loads(told.readline()))

        yield run


def _serve() -> None:
    """Run what each line of the standard input asks for, and write a result a line."""
    with ready() as run:
        for line in sys.stdin:
            cases, seed = json.loads(line)
            for result in run([(kind, number) for kind, number in cases], seed):
                print(json.dumps(asdict(result)), flush=True)


def _worker(cases: list[tuple[str, int]], seed: int, run: Run, out: Path) -> None:
    with out.open("w") as file:
        for result in run(cases, seed):
            file.write(json.dumps(asdict(result)) + "\n")
            file.flush()


def fuzz(cases: list[tuple[str, int]], seed: int, jobs: int, tell: float = 60.0) -> list[Result]:
    """Run cases in `jobs` parallel processes."""
    with ready() as run, tempfile.TemporaryDirectory(prefix="iif-fuzz-results-") as folder:
        places = [Path(folder) / f"{i}.jsonl" for i in range(jobs)]
        children = []
        for i, place in enumerate(places):
            child = os.fork()
            if child == 0:
                code = 1
                try:
                    _worker(cases[i::jobs], seed, run, place)
                    code = 0
                finally:
                    os._exit(code)
            children.append(child)
        told, failed = time.monotonic(), 0
        while children:
            ended, status = os.waitpid(-1, os.WNOHANG)
            if ended in children:
                children.remove(ended)
                failed += status != 0
            elif not ended:
                time.sleep(0.2)
            if time.monotonic() - told > tell:
                told = time.monotonic()
                done = sum(place.read_bytes().count(b"\n") for place in places if place.is_file())
                print(f"{done} of {len(cases)} cases", file=sys.stderr, flush=True)
        results = [Result(**json.loads(line)) for place in places for line in place.read_text().splitlines()]
    if failed or len(results) != len(cases):
        raise SystemExit(f"{failed} workers stopped; {len(results)} of {len(cases)} cases were run")
    return results


def table(results: list[Result], seed: int) -> dict[str, Any]:
    """Return the counts that the notebook shows: of each verdict, by kind of file and in all."""
    kinds = {kind: Counter(r.verdict for r in results if r.kind == kind) for kind in sorted({r.kind for r in results})}
    rows = {kind: {"cases": sum(found.values()), **{v: found[v] for v in (*GOOD, *BAD)}} for kind, found in kinds.items()}
    total = {key: sum(row[key] for row in rows.values()) for key in ("cases", *GOOD, *BAD)}
    limits = {"memory_mb": MEMORY >> 20, "cpu_seconds": CPU_SECONDS, "wall_seconds": WALL_SECONDS}
    return {"seed": seed, "limits": limits, "kinds": rows, "all": total}


def added(earlier: dict[str, Any], later: dict[str, Any]) -> dict[str, Any]:
    """Return the counts of two parts of one run together.

    Raises:
        SystemExit: they are of different seeds or limits.
    """
    if any(earlier[key] != later[key] for key in ("seed", "limits")):
        raise SystemExit("the counts that are kept are of another seed or other limits; leave out --continue")

    def sums(one: dict[str, int], other: dict[str, int]) -> dict[str, int]:
        return {key: one.get(key, 0) + other.get(key, 0) for key in {**one, **other}}

    kinds = {
        kind: sums(earlier["kinds"].get(kind, {}), later["kinds"].get(kind, {}))
        for kind in {**earlier["kinds"], **later["kinds"]}
    }
    return {**later, "kinds": dict(sorted(kinds.items())), "all": sums(earlier["all"], later["all"])}


def shown(document: dict[str, Any]) -> str:
    """Return the table as text."""
    head = ("cases", *GOOD, *BAD)
    lines = [f"{'':24s}" + "".join(f"{name:>16s}" for name in head)]
    for kind, row in (*document["kinds"].items(), ("all", document["all"])):
        lines.append(f"{kind:24s}" + "".join(f"{row[name]:16d}" for name in head))
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--cases", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument(
        "--continue", action="store_true", dest="go_on", help="leave out the cases that --keep has counted already"
    )
    parser.add_argument("--kinds", default="", help="kinds of files, parted by commas; default: all")
    parser.add_argument("--case", type=int, help="run this case of one kind, and show what became of it")
    parser.add_argument("--keep", type=Path, default=ROW, help="JSON file of the counts")
    parser.add_argument("--serve", action="store_true", help="run the cases that lines of the standard input name, as tests do")
    parser.add_argument("--failures", type=Path, help="file to which failures are added, a line each")
    arguments = parser.parse_args()
    if arguments.serve:
        _serve()
        return 0
    targets = {name: TARGETS[name] for name in arguments.kinds.split(",")} if arguments.kinds else TARGETS
    if arguments.case is not None:
        with ready({arguments.kinds: TARGETS[arguments.kinds]}) as run:
            (result,) = run([(arguments.kinds, arguments.case)], arguments.seed)
        print(f"{result.verdict}: {result.change}\n{result.message}")
        return int(result.verdict not in GOOD)
    started, failed = time.monotonic(), 0
    document = json.loads(arguments.keep.read_text()) if arguments.go_on and arguments.keep.is_file() else None
    cases = kinds_of(arguments.cases, targets)
    todo = cases[document["all"]["cases"] if document else 0 :]
    for first in range(0, len(todo), PORTION):
        results = fuzz(todo[first : first + PORTION], arguments.seed, arguments.jobs)
        part = table(results, arguments.seed)
        document = added(document, part) if document else part
        bad = [result for result in results if result.verdict in BAD]
        failed += len(bad)
        for result in bad[:50]:
            print(result.line, flush=True)
        if arguments.failures:
            with arguments.failures.open("a") as file:
                file.writelines(result.line + "\n" for result in bad)
        if not arguments.kinds:
            arguments.keep.write_text(json.dumps(document, indent=1) + "\n")
    if document:
        print(shown(document))
    print(f"{len(todo)} cases in {time.monotonic() - started:.0f} s")
    return int(bool(failed))


if __name__ == "__main__":
    raise SystemExit(main())
