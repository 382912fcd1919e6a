"""A batch of a thousand scenes, some of them faulty: `python lab/benchmarks/batch.py [--real 100 --prepared 900]`.

Makes a folder with real scenes (the builtin `tiny`, each with its own seed, a few with other settings) and prepared ones, which
count as finished (tests/workflow/prepared.py). `--faults` of them, by default 3 % of the real ones and at least one of each
kind, cannot be finished as they are, or are killed. It then runs `snakemake --cores 2 scenes` to its end, cures the faults, runs
again, and once more, and judges: every run ends by itself, every scene but the faulty ones is delivered, each fault is named in
summary.tsv with its cause, the second run delivers the rest, and the third has nothing to do.

It may be killed; the same command then continues, and `--fresh` begins anew. The folder is /tmp/iif-batch, or `--folder`. With
`--keep` it writes one row in lab/notebook/data/reliability_batch.json; `python lab/benchmarks/reliability.py` makes the page.
A full disk (a small tmpfs) needs root; without it that fault is left out.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import lab  # noqa: F401  for the sources of the laboratory
from tests.unit import own_scene as own
from tests.workflow.prepared import prepare
from tests.workflow.support import TINY

ROOT = Path(__file__).resolve().parents[2]
ROWS = ROOT / "lab/notebook/data/reliability_batch.json"
HEADER = "name\tsource\tpath\tbase\toverrides\n"
SMALL = (
    "prior.kind=retinex;segmentation.kind=geometry;capture.width=48;capture.height=48;capture.views=4;emission.rows=2000;"
    "emission.samples=8;shading.samples=8;shading.levels=6;affines.pixels=8000;affines.iterations=5;render.samples=8;"
    "room.lightmap_size=128;room.samples=256"
)
"""Of scenes from a folder, as small as the tiny one."""
OTHERS = ("capture.views=5", "capture.dynamic_range=ldr", "emission.samples=16", "shading.levels=5", "prior.samples=2")
"""Settings of every tenth real scene, one after the other."""
DISK = "400k"
"""Of the full disk: enough for the first files of a scene."""
MEMORY = 700 << 20
"""Address space, in bytes, that a job without memory is left with."""
LIMITS = {"plan_seconds": 60.0, "plan_mb": 2048.0}


@dataclass(frozen=True)
class Fault:
    """One kind of fault.

    Attributes:
        words: what is done, for the page.
        line: of the batch table, after the name.
        cured: the line after the repair.
        status: what the summary may say.
        cause: pattern that the reason must match.
        prepare: called with the scene before the first run.
        watch: called with the scene again and again while the first run lasts; returns whether it did something.
        cure: called with the scene after the first run.
    """

    words: str
    line: str
    cured: str
    status: tuple[str, ...]
    cause: str
    stage: str = ""
    prepare: Callable[[str], object] = len
    watch: Callable[[str], bool] = lambda scene: False
    cure: Callable[[str], object] = len


# ---------------------------------------------------------------------------------------------------------------- faults


def _folder(scene: str, scale: float = 1.0) -> None:
    """Write data/<scene>: a photographed room, whose mesh may be in another unit than its cameras."""
    folder = Path("data") / scene
    if not (folder / "transforms.json").is_file():
        own.photographed(folder)
        vertices, faces, _ = own.room_mesh()
        own.save_mesh(folder / "mesh.ply", scale * vertices, faces)


def _cut(scene: str) -> None:
    _folder(scene)
    path = Path("data") / scene / "images/001.png"
    data = path.read_bytes()
    if not path.with_suffix(".whole").is_file():
        path.with_suffix(".whole").write_bytes(data)
        path.write_bytes(data[: len(data) // 2])


def _whole(scene: str) -> None:
    path = Path("data") / scene / "images/001.png"
    path.write_bytes(path.with_suffix(".whole").read_bytes())


def _photographs(scene: str) -> None:
    folder = Path("data") / scene
    shutil.copytree(folder.with_name(f"{scene}.later"), folder, dirs_exist_ok=True)


def _later(scene: str) -> None:
    _folder(f"{scene}.later")


def _jobs(scene: str, stage: str) -> Iterator[int]:
    """Yield the processes that compute a stage of a scene now, if they have begun their work."""
    if not Path(f"results/{scene}/logs/{stage}.state.json").is_file():
        return
    wanted = f"-m\0workflow\0{stage}\0{scene}\0".encode()
    for path in Path("/proc").glob("[0-9]*"):
        try:
            if wanted in (path / "cmdline").read_bytes() and b"python" in os.readlink(path / "exe").encode():
                yield int(path.name)
        except OSError:
            continue


def _kill(stage: str) -> Callable[[str], bool]:
    def watch(scene: str) -> bool:
        for process in _jobs(scene, stage):
            os.kill(process, signal.SIGKILL)
            return True
        return False

    return watch


def _starve(stage: str) -> Callable[[str], bool]:
    def watch(scene: str) -> bool:
        for process in _jobs(scene, stage):
            if resource.prlimit(process, resource.RLIMIT_AS)[0] != MEMORY:
                resource.prlimit(process, resource.RLIMIT_AS, (MEMORY, MEMORY))
                return True
        return False

    return watch


def _spoil(name: str) -> Callable[[str], bool]:
    """Change one bit of a file as soon as its stage is finished, and again if it is made again."""

    def watch(scene: str) -> bool:
        path, note = Path("results") / scene / name, Path(f"spoilt.{scene}")
        if not (Path("results") / scene / Path(name).parts[0] / "manifest.json").is_file():
            return False
        stamp = str(path.stat().st_ino)
        if note.is_file() and note.read_text() == stamp:
            return False
        data = bytearray(path.read_bytes())
        data[len(data) // 2] ^= 1
        path.write_bytes(data)
        note.write_text(stamp)
        return True

    return watch


def _fill(scene: str) -> None:
    folder = Path("results") / scene
    folder.mkdir(parents=True, exist_ok=True)
    if not os.path.ismount(folder):
        subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={DISK}", "tmpfs", str(folder)], check=True)


def _empty(scene: str) -> None:
    folder = Path("results") / scene
    if os.path.ismount(folder):
        subprocess.run(["umount", str(folder)], check=True)


FAULTS = {
    "key": Fault(
        "unknown key in the table", "\t\ttiny\tseed=1;capture.veiws=3", "\t\ttiny\tseed=1", ("refused",), "`capture.veiws`"
    ),
    "missing": Fault(
        "photographs that are not there",
        f"folder\tdata/NAME\t\t{SMALL}",
        f"folder\tdata/NAME\t\t{SMALL}",
        ("refused",),
        r"data/\S+.*not found",
        prepare=_later,
        cure=_photographs,
    ),
    "unit": Fault(
        "mesh in another unit than the cameras",
        f"folder\tdata/NAME\t\t{SMALL}",
        f"folder\tdata/NAME\t\t{SMALL}",
        ("failed",),
        r"\d m across",
        "capture",
        prepare=lambda scene: _folder(scene, 1000.0),
        cure=lambda scene: (shutil.rmtree(f"data/{scene}"), _folder(scene)),
    ),
    "photograph": Fault(
        "photograph that ends in the middle",
        f"folder\tdata/NAME\t\t{SMALL}",
        f"folder\tdata/NAME\t\t{SMALL}",
        ("refused",),
        r"001\.png: cut short",
        prepare=_cut,
        cure=_whole,
    ),
    "killed": Fault("job killed in the middle", "", "", ("killed",), "^it was killed", "emission", watch=_kill("emission")),
    "memory": Fault(
        "job that gets no memory",
        "",
        "",
        ("failed", "killed"),
        "not enough memory|^it was killed",
        "shading",
        watch=_starve("shading"),
    ),
    "damaged": Fault(
        "bit of a finished stage changed while the next one waits",
        "",
        "",
        ("failed",),
        r"results/\S+/prior/\S+: its content changed",
        "base",
        watch=_spoil("prior/maps/000.exr"),
    ),
    "disk": Fault("full disk", "", "", ("failed", "killed"), "disk is full", prepare=_fill, cure=_empty),
}


# ---------------------------------------------------------------------------------------------------------------- folder


@dataclass(frozen=True)
class Plan:
    """Which scenes there are: name -> line of the table; name -> fault; which prepared scenes are damaged before the run."""

    real: dict[str, str]
    faulty: dict[str, str]
    prepared: dict[str, str]
    damaged: tuple[str, ...]

    def table(self, cured: bool) -> str:
        lines = []
        for name, line in {**self.real, **self.prepared}.items():
            fault = FAULTS.get(self.faulty.get(name, ""))
            changed = (fault.cured if cured else fault.line) if fault else ""
            lines.append(f"{name}\t{changed.replace('NAME', name) or line}\n")
        return HEADER + "".join(lines)


def plan_of(real: int, prepared: int, faults: int | None, kinds: list[str]) -> Plan:
    """Return the scenes; faults are spread evenly over the real ones."""
    lines = {}
    for i in range(real):
        other = f";{OTHERS[i // 10 % len(OTHERS)]}" if i % 10 == 9 else ""
        lines[f"real-{i + 1:04d}"] = f"\t\ttiny\tseed={i + 1}{other}"
    count = max(-(-3 * real // 100), len(kinds)) if faults is None else faults
    count = min(count, real)
    names = list(lines)
    faulty = {names[(2 * i + 1) * real // (2 * count)]: kinds[i % len(kinds)] for i in range(count)}
    finished = {f"done-{i + 1:04d}": f"\t\ttiny\tseed={100_000 + i}" for i in range(prepared)}
    return Plan(lines, faulty, finished, tuple(list(finished)[:: max(1, prepared // 2)][:2]) if real else ())


def build(plan: Plan) -> None:
    """Make the folder as it is before the first run, as far as it is not there."""
    Path("config/scenes").mkdir(parents=True, exist_ok=True)
    Path("config/scenes/tiny.yaml").write_text(TINY)
    _write_table(plan.table(cured=False))
    if plan.prepared:
        if not Path("scenes/tiny/manifest.json").is_file():
            say("the scene that is copied")
            result = snakemake("scenes/tiny")
            assert result.code == 0, result.text[-3000:]
        prepare(list(plan.prepared), "tiny", said=say)
    for name, kind in plan.faulty.items():
        FAULTS[kind].prepare(name)
    for name in plan.damaged:
        path = Path(f"results/{name}/render/maps") / sorted(os.listdir(f"results/{name}/render/maps"))[0]
        data = bytearray(path.read_bytes())
        data[len(data) // 2] ^= 1
        path.unlink()  # it is a link to a file of all prepared scenes
        path.write_bytes(data)


def _write_table(text: str) -> None:
    path = Path("config/batch.tsv")
    if not path.is_file() or path.read_text() != text:
        path.write_text(text)


# ------------------------------------------------------------------------------------------------------------------ runs


@dataclass(frozen=True)
class Run:
    """What a command took: exit code, what it said, wall and CPU seconds, and the memory of its largest process in MB."""

    code: int
    text: str
    seconds: float
    cpu: float
    mb: float


def measured(command: list[str], watch: Callable[[], None] | None = None, said: str = "said.txt") -> Run:
    """Run a command to its end; `watch` is called every 20 ms meanwhile. What it says is added to a file."""
    _end_earlier()
    start = time.monotonic()
    with open(said, "ab") as file:
        process = subprocess.Popen(command, stdout=file, stderr=subprocess.STDOUT)
        RUNNING.write_text(str(process.pid))
        try:
            while True:
                ended, status, usage = os.wait4(process.pid, os.WNOHANG if watch else 0)
                if ended:
                    break
                if watch:
                    watch()
                time.sleep(0.02)
        except BaseException:
            _end_earlier()
            raise
    RUNNING.unlink()
    process.returncode = os.waitstatus_to_exitcode(status)
    text = Path(said).read_text(errors="replace")
    seconds, cpu = time.monotonic() - start, usage.ru_utime + usage.ru_stime
    return Run(process.returncode, text, seconds, cpu, usage.ru_maxrss / 1024)


RUNNING = Path("running.pid")
"""Names the Snakemake that this script started; it outlives a script that is killed."""


def _end_earlier() -> None:
    """Interrupt what an earlier call has left running, wait for its end, and remove the lock of a folder that nothing uses."""
    if not RUNNING.is_file():
        return
    process = RUNNING.read_text()
    while "snakemake" in _command(process):
        os.kill(int(process), signal.SIGINT)
        time.sleep(2)
    shutil.rmtree(".snakemake/locks", ignore_errors=True)
    RUNNING.unlink()


def _command(process: str) -> str:
    try:
        state = Path(f"/proc/{process}/status").read_text()
        return "" if "State:\tZ" in state else Path(f"/proc/{process}/cmdline").read_text()
    except OSError:
        return ""


def snakemake(*arguments: str, watch: Callable[[], None] | None = None, said: str = "said.txt") -> Run:
    program = str(Path(sys.executable).with_name("snakemake"))
    return measured([program, "-s", str(ROOT / "Snakefile"), "-d", ".", "--cores", "2", *arguments], watch, said)


def summary() -> dict[str, dict[str, str]]:
    with open("results/batch/summary.tsv", newline="") as file:
        return {row["scene"]: row for row in csv.DictReader(file, delimiter="\t")}


def watcher(plan: Plan) -> Callable[[], None]:
    """Return what is done while the first run lasts: faults that strike a running job, and a line of progress a minute."""
    names = list(plan.real)
    told = time.monotonic()

    def watch() -> None:
        nonlocal told
        for name, kind in plan.faulty.items():
            if FAULTS[kind].watch(name):
                say(f"{name}: {FAULTS[kind].words}")
        if time.monotonic() > told + 60:
            told = time.monotonic()
            say(f"{sum(Path(f'scenes/{name}/manifest.json').is_file() for name in names)} of {len(names)} real scenes delivered")

    return watch


_STARTED = time.monotonic()


def say(text: str) -> None:
    print(f"[{time.monotonic() - _STARTED:6.0f} s] {text}", flush=True)


# ----------------------------------------------------------------------------------------------------------------- judge


def judge_first(plan: Plan, run: Run) -> list[str]:
    """Return what is wrong after the run with faults."""
    rows, wrong = summary(), []
    for name in [*plan.real, *plan.prepared]:
        row = rows.get(name)
        if row is None:
            wrong.append(f"{name}: no row")
            continue
        fault = FAULTS.get(plan.faulty.get(name, ""))
        if fault is None:
            if row["status"] != "done":
                wrong.append(f"{name}: {row['status']} in {row['stage']}: {row['reason']}, although nothing is wrong with it")
        elif row["status"] not in fault.status or not re.search(fault.cause, row["reason"], re.I):
            wrong.append(f"{name} ({fault.words}): {row['status']} in {row['stage']}: {row['reason']}")
        elif fault.stage and row["stage"] != fault.stage:
            wrong.append(f"{name} ({fault.words}): in stage {row['stage']}, not {fault.stage}")
    for name in plan.damaged:
        if not re.search(rf"results/{name}/render/\S+: (?:its content changed|\d+ bytes on disk)", run.text):
            wrong.append(f"{name}: its damage is not named")
    expected = 1 if plan.faulty else 0
    if run.code != expected:
        wrong.append(f"exit code {run.code}, not {expected}")
    if "Traceback (most recent call last)" in run.text.replace("(a bug", ""):
        wrong.append("a traceback")
    return wrong


def judge_second(plan: Plan, run: Run) -> list[str]:
    wrong = [f"{name}: {row['status']}: {row['reason']}" for name, row in summary().items() if row["status"] != "done"]
    return wrong + ([f"exit code {run.code}, not 0"] if run.code else [])


@contextmanager
def stage(state: dict[str, Any], name: str) -> Iterator[bool]:
    """Yield whether a part is still to be done; what it adds to `state` is kept when it ends."""
    missing = name not in state["done"]
    yield missing
    if missing:
        state["done"].append(name)
        Path("state.json").write_text(json.dumps(state, indent=1))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--real", type=int, default=100)
    parser.add_argument("--prepared", type=int, default=900)
    parser.add_argument("--faults", type=int, help="scenes with a fault")
    parser.add_argument("--kinds", nargs="+", choices=FAULTS, default=list(FAULTS))
    parser.add_argument("--folder", type=Path, default=Path("/tmp/iif-batch"))
    parser.add_argument("--fresh", action="store_true", help="begin anew")
    parser.add_argument("--keep", action="store_true", help="keep the row in lab/notebook/data/")
    arguments = parser.parse_args()
    kinds = [kind for kind in arguments.kinds if kind != "disk" or os.geteuid() == 0]
    plan = plan_of(arguments.real, arguments.prepared, arguments.faults, kinds)
    folder = arguments.folder.resolve()
    if arguments.fresh and folder.is_dir():
        for mounted in (path for path in (folder / "results").glob("*") if path.is_mount()):
            subprocess.run(["umount", str(mounted)], check=True)
        shutil.rmtree(folder)
    folder.mkdir(parents=True, exist_ok=True)
    os.chdir(folder)
    asked = [arguments.real, arguments.prepared, plan.faulty]
    state = json.loads(Path("state.json").read_text()) if Path("state.json").is_file() else {"asked": asked, "done": []}
    if state["asked"] != asked:
        print(f"{folder} has another batch; --fresh begins anew", file=sys.stderr)
        return 2
    return run(plan, state, arguments.keep)


def run(plan: Plan, state: dict[str, Any], keep: bool) -> int:
    """Go through the parts that are not done yet, and return the exit code."""
    with stage(state, "build") as missing:
        if missing:
            build(plan)
            say(f"{len(plan.real)} real and {len(plan.prepared)} prepared scenes, {len(plan.faulty)} with faults")
    with stage(state, "plan") as missing:
        if missing:
            once = snakemake("scenes", "-n")  # the first hashes what was damaged, and reads every file once
            again = snakemake("scenes", "-n")
            state["plan"] = {"seconds": again.seconds, "cpu": again.cpu, "mb": max(once.mb, again.mb), "first": once.seconds}
            say(f"planned in {again.seconds:.1f} s ({again.cpu:.1f} CPU s, {state['plan']['mb']:.0f} MB)")
    with stage(state, "first") as missing:
        if missing:
            finished = sum(Path(f"scenes/{name}/manifest.json").is_file() for name in plan.real)
            first = snakemake("scenes", watch=watcher(plan), said="first.txt")
            rows = summary()
            state["wrong"] = judge_first(plan, first)
            state["first"] = {"seconds": first.seconds, "mb": first.mb, "code": first.code}
            state["delivered"] = sum(rows[name]["status"] == "done" for name in plan.real) - finished
            state["reasons"] = {kind: _row_of(rows[name]) for name, kind in plan.faulty.items()}
            say(f"first run: exit code {first.code}, {state['delivered']} real scenes in {first.seconds / 60:.1f} min")
    with stage(state, "cure") as missing:
        if missing:
            _write_table(plan.table(cured=True))
            for name, kind in plan.faulty.items():
                FAULTS[kind].cure(name)
    with stage(state, "second") as missing:
        if missing:
            second = snakemake("scenes", said="second.txt")
            state["wrong"] += [f"second run: {line}" for line in judge_second(plan, second)]
            say(f"second run: exit code {second.code}")
    with stage(state, "third") as missing:
        if missing:
            Path("third.txt").unlink(missing_ok=True)  # of an attempt before
            third = snakemake("scenes", said="third.txt")
            if third.code or "Nothing to be done" not in third.text:
                state["wrong"].append(f"third run: exit code {third.code}, something was done")
            say("third run: " + ("nothing to be done" if "Nothing to be done" in third.text else third.text[-500:]))
    with stage(state, "page") as missing:
        if missing:
            command = [sys.executable, "-m", "workflow", "batch"]
            os.environ["PYTHONPATH"] = str(ROOT)
            shutil.rmtree("results/batch/pictures", ignore_errors=True)
            cold, warm = measured(command), measured(command)
            pictures = list(Path("results/batch/pictures").iterdir())
            state["page"] = {
                "seconds": warm.cpu,
                "first_seconds": cold.cpu,
                "mb": Path("results/batch/report.html").stat().st_size / 1e6,
                "pictures_mb": sum(path.stat().st_size for path in pictures) / 1e6,
            }
    row = row_of(plan, state)
    print(json.dumps(row, indent=1, ensure_ascii=False))
    wrong = state["wrong"] + [f"{key}: {row[key]}, at most {most}" for key, most in LIMITS.items() if row[key] > most]
    print("\n".join(wrong) or "nothing is wrong")
    if keep:
        ROWS.write_text(json.dumps({**row, "wrong": wrong}, indent=1, ensure_ascii=False) + "\n")
    return 1 if wrong else 0


def _row_of(row: dict[str, str]) -> list[str]:
    return [row["status"], row["stage"], row["reason"]]


def row_of(plan: Plan, state: dict[str, Any]) -> dict[str, Any]:
    """Return what is kept of the measurements."""
    first, hours = state["first"], state["first"]["seconds"] / 3600
    return {
        "real": len(plan.real),
        "prepared": len(plan.prepared),
        "faulty": len(plan.faulty),
        "damaged": len(plan.damaged),
        "plan_seconds": round(state["plan"]["seconds"], 1),
        "plan_cpu": round(state["plan"]["cpu"], 1),
        "plan_mb": round(max(state["plan"]["mb"], 0.0)),
        "run_minutes": round(first["seconds"] / 60, 1),
        "scenes_an_hour": round(state["delivered"] / hours) if state["delivered"] else None,
        "page_cpu_first": round(state["page"]["first_seconds"], 1),
        "page_cpu": round(state["page"]["seconds"], 1),
        "page_mb": round(state["page"]["mb"], 2),
        "pictures_mb": round(state["page"]["pictures_mb"], 2),
        "faults": {FAULTS[kind].words: reason for kind, reason in state["reasons"].items()},
    }


if __name__ == "__main__":
    sys.exit(main())
