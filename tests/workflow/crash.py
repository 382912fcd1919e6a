"""What is left after a power cut, an error of the disk or a kill at every call of the artefact layer and of the stages.

A trial ends a run at one point, looks at what is there, and runs again. What is there must be the earlier result, the new one, or
visibly unfinished; the second run must end with the bytes of an undisturbed one.

`python -m tests.workflow.crash --all` tries every point of the layer and writes lab/notebook/data/reliability_crash.json;
`--stages <file>` adds what `python -m tests.workflow.crash_stages` printed of the stages of a scene.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import sys
import tempfile
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from iif_core.errors import InputError
from lab.published.state import keep_state, kept_state
from tests.workflow.faulty_disk import HOSTILE, Disk, Fault, lay_out, tree
from workflow.artifacts import StageReader, StageWriter, sound, stamps, swap
from workflow.artifacts import files as io
from workflow.artifacts import manifest as manifests
from workflow.artifacts.manifest import MANIFEST, SCENE_SCHEMA
from workflow.registry import STAGES
from workflow.runtime.ending import CAUSES, of_the_machine
from workflow.runtime.timings import read_timings
from workflow.stages import publish

REPOSITORY = Path(__file__).resolve().parents[2]
PLACE = REPOSITORY / "lab/notebook/data/reliability_crash.json"
FAULTS = ("ENOSPC", "EIO", "EINTR", "short", "torn", "full")
VIEWS = ("000", "001")

Tree = dict[str, bytes | None]


class Wrong(AssertionError):
    """A trial left what it must not."""


# -- a stage that writes what stages write ------------------------------------------------------------------------------------


def perform(mark: str) -> None:
    """Make the stage `base` of the scene `s` in the working folder: rasters as parts, a state that is kept, a table, two more.

    Args:
        mark: its fingerprint, from which all of its values follow but those of a part that is taken over from earlier settings.
    """
    results = Path("results")
    facts = {"scene": "s", "stage": "base", "quality": "draft", "fingerprint": mark, "inputs": {}}
    writer = StageWriter(results / "s/base", facts)
    number = int(mark, 16)
    said = {}
    for view in VIEWS:
        kept = writer.part_kept(view)
        if kept is None:
            raster = np.random.default_rng([number, int(view)]).random((9, 7)).astype(np.float32)
            writer.exr(f"maps/{view}.exr", {"a": raster, "b": raster > 0.5})
            kept = {"mean": float(raster.mean())}
            writer.part_done(view, [f"maps/{view}.exr"], kept)
        said[view] = kept["mean"]
    if writer.part_kept("lamp", "digest") is None:
        writer.json("lamps/lamp.json", [1, 2])
        writer.part_done("lamp", ["lamps/lamp.json"], {}, "digest")
    state = kept_state(writer, "descent")
    value, step = (state[0]["value"], state[1]["step"]) if state else (np.full(3, number % 97, np.float64), 0)
    for done in range(step, 2):
        value = value * 1.25 + 1
        keep_state(writer, "descent", {"value": value}, {"step": done + 1})
    writer.table("cells.parquet", {"value": value, "k": np.arange(3)})
    writer.json("facts.json", said)
    writer.bytes("page.html", b"<p>" + bytes(mark, "ascii"))
    writer.finish()
    writer.stamps.save(stamps.place(results, "s", "base"), flushed=True)


def of_stage(content: Tree) -> Tree:
    """Return what counts of a tree: the folder of the stage."""
    return {name: data for name, data in content.items() if name.startswith("results/s/base/")}


def stage_is_sound(wanted: dict[str, Tree], mark: str) -> str:
    """Return the fingerprint of the stage that is finished in the working folder, or "".

    Args:
        wanted: fingerprint -> tree of an undisturbed run.
        mark: fingerprint for which a plan would look.

    Raises:
        Wrong: what is taken for finished is not what was to be written.
    """
    found = ""
    try:
        reader = StageReader(Path("results/s/base"), "base", "s")
        content = {f"results/s/base/{name}": reader.path(name).read_bytes() for name in reader.names()}
        found = reader.fingerprint
    except InputError as error:
        content = {}
        if Path("results/s/base", MANIFEST).is_file():
            raise Wrong(f"a manifest is there, and files are not what it says: {error}") from None
    sound.forget()
    planned = Path("results/s/base", MANIFEST).is_file() and sound.stage_faults(Path("results"), "s", "base", mark) == ()
    if planned and found != mark:
        raise Wrong(f"a plan takes the stage for finished, and it has {found!r}")
    if found:
        right = {name: data for name, data in of_stage(wanted[found]).items() if data is not None}
        apart = {f"results/s/base/{name}" for name in (MANIFEST, "parts.json")}
        if content != {name: data for name, data in right.items() if name not in apart}:
            raise Wrong(f"finished under {found}, and files are not those of an undisturbed run")
    return found


# -- a deliverable ------------------------------------------------------------------------------------------------------------


def _facts(stage: str, mark: str) -> dict[str, Any]:
    return {"scene": "s", "stage": stage, "quality": "draft", "fingerprint": mark, "inputs": {}}


def make_upstream(mark: str) -> None:
    """Write the stages from which the deliverable is copied."""
    chosen = {
        "export": ["scene.glb", "export.json", "textures/base_color.png"],
        "render": ["maps/000.exr"],
        "report": ["report.html", "verdict.json", "plan.yaml"],
        "room": ["room.html", "scene_unlit.glb"],
        "metrics": ["metrics.parquet"],
        "affines": ["objects.parquet"],
    }
    for stage in STAGES["publish"].upstream:
        writer = StageWriter(Path("results/s") / stage, _facts(stage, mark))
        for name in chosen.get(stage, ["facts.json"]):
            writer.bytes(name, f"{stage} {name} {mark}".encode() * 40)
        writer.finish()


def deliver(mark: str) -> None:
    """Publish the scene `s` of the working folder, as stage publish does it."""
    readers = {stage: StageReader(Path("results/s") / stage, stage, "s") for stage in STAGES["publish"].upstream}
    writer = StageWriter(Path("results/s/publish"), _facts("publish", mark))
    facts = {"scene": "s", "quality": "draft", "fingerprint": mark, "settings": {"seed": int(mark, 16) % 97}}
    writer.json("published.json", publish.deliver(readers, facts, read_timings("s"))[0])
    writer.finish()


def of_deliverable(content: Tree) -> Tree:
    """Return what counts of a tree: scenes/, and the stage that says what was published."""
    return {name: data for name, data in content.items() if name.startswith(("scenes/", "results/s/publish/"))}


def deliverable_is_sound(wanted: dict[str, Tree], mark: str) -> str:
    """As `stage_is_sound`, of scenes/s; if it is absent, one that is whole must wait to be brought back, where there was one."""
    del mark
    folder = Path("scenes/s")
    if not folder.is_dir():
        old = swap.set_aside(folder)
        if len(wanted) > 1 and not (
            old.is_dir() and not list(sound.wrong_files(old, manifests.read(old / MANIFEST, SCENE_SCHEMA)))
        ):
            raise Wrong("scenes/s is absent, and nothing is there to be brought back")
        return ""
    document = manifests.read(folder / MANIFEST, SCENE_SCHEMA)
    found = document["fingerprint"]
    right = {name: data for name, data in wanted[found].items() if name.startswith("scenes/")}
    if {f"scenes/s/{name}": data for name, data in tree(folder).items()} != {k: v for k, v in right.items() if k != "scenes/s"}:
        raise Wrong(f"scenes/s of {found} is neither the earlier one nor the new one")
    return str(found)


# -- a single file ------------------------------------------------------------------------------------------------------------


def note(mark: str) -> None:
    """Write a document as plans, tables of studies, summaries and digests are written."""
    io.write_json(Path("plan/s/plan.json"), {"mark": mark, "text": "x" * 50})


def of_note(content: Tree) -> Tree:
    return {name: data for name, data in content.items() if name.startswith("plan/") and "/." not in name}


def note_is_sound(wanted: dict[str, Tree], mark: str) -> str:
    del mark
    path = Path("plan/s/plan.json")
    if not path.is_file():
        if len(wanted) > 1:
            raise Wrong("the earlier file is gone")
        return ""
    for mark, content in wanted.items():
        if content["plan/s/plan.json"] == path.read_bytes():
            return mark
    raise Wrong("the file is neither the earlier one nor the new one")


# -- trials -------------------------------------------------------------------------------------------------------------------

OLD, NEW = "00000000000000a1", "00000000000000b2"


@dataclass(frozen=True)
class Case:
    """Something that is made, and how it is judged.

    Attributes:
        make: makes it in the working folder, under a fingerprint.
        counts: the part of a tree that must equal the same part of an undisturbed run.
        judge: returns under which fingerprint it is finished; raises `Wrong`.
        before: makes what is there at first; returns the fingerprints that may be found besides the new one.
    """

    name: str
    make: Callable[[str], None]
    counts: Callable[[Tree], Tree]
    judge: Callable[[dict[str, Tree], str], str]
    before: Callable[[], tuple[str, ...]] = tuple


def _earlier(make: Callable[[str], None]) -> Callable[[], tuple[str, ...]]:
    def before() -> tuple[str, ...]:
        make(OLD)
        return (OLD,)

    return before


def _upstream(*earlier: str) -> Callable[[], tuple[str, ...]]:
    def before() -> tuple[str, ...]:
        for mark in earlier:
            make_upstream(mark)
            deliver(mark)
        make_upstream(NEW)
        return earlier

    return before


def _killed() -> tuple[str, ...]:
    """A run that wrote all parts and was killed before it ended."""

    class Killed(Exception):
        pass

    def stop(*_: Any) -> None:
        raise Killed

    finish, StageWriter.finish = StageWriter.finish, stop  # type: ignore[method-assign]
    try:
        perform(NEW)
    except Killed:
        pass
    finally:
        StageWriter.finish = finish  # type: ignore[method-assign]
    return ()


CASES = {
    case.name: case
    for case in (
        Case("stage", perform, of_stage, stage_is_sound),
        Case("stage over an earlier one", perform, of_stage, stage_is_sound, _earlier(perform)),
        Case("stage after a kill", perform, of_stage, stage_is_sound, _killed),
        Case("deliverable", deliver, of_deliverable, deliverable_is_sound, _upstream()),
        Case("deliverable over an earlier one", deliver, of_deliverable, deliverable_is_sound, _upstream(OLD)),
        Case("file", note, of_note, note_is_sound),
        Case("file over an earlier one", note, of_note, note_is_sound, _earlier(note)),
    )
}


@contextmanager
def working_in(folder: Path) -> Iterator[None]:
    before = os.getcwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


@contextmanager
def unflushed() -> Iterator[None]:
    """Runs whose power is not cut need not wait for the disk."""
    real, os.fsync = os.fsync, lambda handle: None
    try:
        yield
    finally:
        os.fsync = real


@dataclass
class Prepared:
    """A case with what is there before, what may be there afterwards, and the record of a run."""

    case: Case
    start: Tree
    wanted: dict[str, Tree]
    disk: Disk


def prepare(case: Case, folder: Path) -> Prepared:
    """Make what is there before a run, record one, and check that the record has all that happened."""
    folder.mkdir(parents=True)
    with working_in(folder), unflushed():
        earlier = case.before()
        start = tree(folder)
        wanted = {mark: case.counts(start) for mark in earlier}
        real, os.getpid = os.getpid, lambda: 1  # another process than the one that will make it again
        try:
            with Disk(folder).watched() as disk:
                case.make(NEW)
        finally:
            os.getpid = real
        end = tree(folder)
    wanted[NEW] = case.counts(end)
    if {name: data for name, data in disk.after(len(disk.steps), "all").items() if "/stamps/" not in name} != {
        name: data for name, data in end.items() if "/stamps/" not in name
    }:
        raise Wrong("the record does not lead to what is on disk: a call was missed")
    return Prepared(case, start, wanted, disk)


def power_cut(ready: Prepared, call: int, choice: str | random.Random, folder: Path) -> str:
    """Cut power before a call, look, run again; return `kept` (finished, as it was or as it should be) or `lost`.

    Raises:
        Wrong: anything else.
    """
    lay_out(folder, ready.disk.after(call, choice))
    case, ended = ready.case, call >= len(ready.disk.steps)
    with working_in(folder), unflushed():
        found = case.judge(ready.wanted, NEW)
        if ended and found != NEW:
            raise Wrong("it was finished, and a power cut took it back")
        case.make(NEW)
        if case.counts(tree(folder)) != ready.wanted[NEW] or case.judge(ready.wanted, NEW) != NEW:
            raise Wrong("a second run does not end with what an undisturbed one writes")
    return "kept" if found else "lost"


def fault(ready: Prepared, kind: str, call: int, folder: Path) -> str:
    """Let a call fail, look, run again; return `unharmed` (it ended well nevertheless), `kept` or `lost`.

    Raises:
        Wrong: anything else, or the error does not tell a person which file it is and what to do.
    """
    lay_out(folder, ready.start)
    case, error = ready.case, None
    with working_in(folder), unflushed():
        try:
            with Disk(folder, Fault(kind, call)).watched():
                case.make(NEW)
        except OSError as found:
            error = found
            said = of_the_machine(found)
            if not found.filename or CAUSES.get(found.errno or 0) is None or not said.endswith(CAUSES[found.errno or 0]):
                raise Wrong(f"the error does not say which file and what to do: {said}") from None
        finished = case.judge(ready.wanted, NEW)
        if error is None and finished != NEW:
            raise Wrong("no error, and it is not finished")
        if error is None and _seen(case.counts(tree(folder))) != _seen(ready.wanted[NEW]):
            raise Wrong("no error, and it is not what an undisturbed run writes")
        case.make(NEW)
        if case.counts(tree(folder)) != ready.wanted[NEW] or case.judge(ready.wanted, NEW) != NEW:
            raise Wrong("a second run does not end with what an undisturbed one writes")
    return "unharmed" if error is None else "kept" if finished else "lost"


def _seen(content: Tree) -> Tree:
    """Return a tree without hidden files, which the next run removes."""
    return {name: data for name, data in content.items() if "/." not in name}


@dataclass
class Tally:
    """Counts of trials by how they ended, and the first that went wrong."""

    counts: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)

    def tried(self, what: str, trial: Callable[[Path], str]) -> None:
        with tempfile.TemporaryDirectory(dir=_memory()) as folder:
            try:
                self.counts[trial(Path(folder) / "w")] += 1
            except Exception as error:
                self.counts["wrong"] += 1
                where = "" if isinstance(error, Wrong) else f" {traceback.format_exc(limit=-2)}"
                self.wrong.append(f"{what}: {type(error).__name__}: {error}{where}")

    def row(self) -> dict[str, Any]:
        return {"points": self.counts.total(), **{k: self.counts[k] for k in ("unharmed", "kept", "lost", "wrong")}}


def _memory() -> str | None:
    return "/dev/shm" if os.access("/dev/shm", os.W_OK) else None


def choices(call: int, seeds: int) -> list[tuple[str, str | random.Random]]:
    """Return (name, choice) of what is kept at a power cut: the extremes, then by chance."""
    return [(name, name) for name in HOSTILE] + [(f"seed {seed}", random.Random(f"{call} {seed}")) for seed in range(seeds)]


def try_power_cuts(
    case: Case, seeds: int, some: Callable[[list[Any]], Iterable[Any]] = lambda every: every, until: str | None = None
) -> Tally:
    """Cut power before every call, or `some` of them, with every choice; `until` something goes wrong that is called so."""
    tally = Tally()
    with tempfile.TemporaryDirectory(dir=_memory()) as folder:
        ready = prepare(case, Path(folder) / "w")
        every = [(call, *named) for call in range(len(ready.disk.steps) + 1) for named in choices(call, seeds)]
        for call, name, choice in some(every):
            tally.tried(f"{case.name}: {_where(ready, call)}, {name}", partial(power_cut, ready, call, choice))
            if until is not None and tally.wrong and until in tally.wrong[-1]:
                break
    return tally


def try_faults(case: Case, some: Callable[[list[Any]], Iterable[Any]] = lambda every: every) -> Tally:
    """Let every call, or some of them, fail in every way."""
    tally = Tally()
    with tempfile.TemporaryDirectory(dir=_memory()) as folder:
        ready = prepare(case, Path(folder) / "w")
        writes = ("short", "torn")
        every = [
            (kind, call)
            for call, (name, _) in enumerate(ready.disk.steps)
            for kind in FAULTS
            if kind not in writes or name == "write"
        ]
        for kind, call in some(every):
            tally.tried(f"{case.name}: {kind} at {_where(ready, call)}", partial(fault, ready, kind, call))
    return tally


def _where(ready: Prepared, call: int) -> str:
    steps = ready.disk.steps
    return f"call {call} of {len(steps)} ({' '.join(steps[call])})" if call < len(steps) else "the end"


# -- the command ----------------------------------------------------------------------------------------------------------------


def main() -> int:
    """Try every point of the layer and points of stages, and write what was found; the exit code is 1 if anything is wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--all", action="store_true", help="the layer, at every call")
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES), help="of the layer")
    parser.add_argument("--seeds", type=int, default=4, help="of choices by chance at each power cut")
    parser.add_argument("--stages", type=Path, help="what `python -m tests.workflow.crash_stages` printed, to be added")
    arguments = parser.parse_args()
    document = json.loads(PLACE.read_text()) if PLACE.is_file() else {}
    wrong = []
    if arguments.all:
        for name in arguments.cases:
            case = CASES[name]
            for kind, tally in (("power_cuts", try_power_cuts(case, arguments.seeds)), ("faults", try_faults(case))):
                document.setdefault(kind, {})[name] = tally.row()
                wrong += tally.wrong
                print(kind, name, tally.row(), *tally.wrong[:3], flush=True)
    if arguments.stages:
        for line in arguments.stages.read_text().splitlines():
            row = json.loads(line)
            wrong += row.pop("said")
            document.setdefault("stages", {})[row.pop("stage")] = row
    io.write_json(PLACE, document)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
