"""The stages of a finished scene, ended at calls to the file system: by an error of the disk, or by SIGKILL.

One process imports everything and then forks for every run, so that a run takes as long as its stage computes and no longer.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import random
import shutil
import signal
import sys
import time
from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import lab  # noqa: F401  for the rooms of the laboratory
from iif_core.errors import InputError
from tests.workflow.crash import FAULTS, Tally, Tree, Wrong, unflushed
from tests.workflow.faulty_disk import Disk, Fault, lay_out, tree
from workflow import __main__ as commands
from workflow.artifacts import StageReader
from workflow.artifacts.manifest import MANIFEST
from workflow.registry import STAGES
from workflow.runtime import native
from workflow.runtime.ending import CAUSES
from workflow.runtime.job import configure_logging

KILL = "kill"
LONGEST = 300.0
"""Seconds after which a run hangs."""


class Stage:
    """A finished stage of the scene in the working folder, which trials end and make again.

    Attributes:
        name: of the stage.
        steps: calls of an undisturbed run.
    """

    def __init__(self, scene: str, name: str):
        self.scene, self.name = scene, name
        self.folders = [Path("results") / scene / name, *([Path("scenes") / scene] if name == "publish" else [])]
        code, said, _ = self._run(None)  # what earlier trials changed elsewhere, such as the times of jobs, is in it
        if code:
            raise Wrong(f"{name} ends with {code}: {said[-2000:]}")
        self.start = self._found()
        self.steps = self._run(None)[2]
        if self._found() != self.start:
            raise Wrong(f"{name}: two undisturbed runs differ")

    def _found(self) -> list[Tree]:
        return [tree(folder) if folder.is_dir() else {} for folder in self.folders]

    def _run(self, fault: Fault | None) -> tuple[int, str, list[tuple[str, str]]]:
        """Run the stage in a fork; return how the process ended (-9 = by SIGKILL), what it said, and its calls."""
        said, told = Path(".trial.log").absolute(), Path(".trial.json").absolute()
        told.unlink(missing_ok=True)
        child = os.fork()
        if not child:
            self._in_the_fork(fault, said, told)
        end = time.monotonic() + LONGEST
        while True:
            pid, status = os.waitpid(child, os.WNOHANG)
            if pid:
                break
            if time.monotonic() > end:
                os.kill(child, signal.SIGKILL)
                os.waitpid(child, 0)
                raise Wrong(f"{self.name} hangs")
            time.sleep(0.005)
        steps = [(call, path) for call, path in json.loads(told.read_text())] if told.is_file() else []
        return os.waitstatus_to_exitcode(status), said.read_text(), steps

    def _in_the_fork(self, fault: Fault | None, said: Path, told: Path) -> None:
        code = 99
        try:
            log = os.open(said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(log, 1)
            os.dup2(log, 2)
            arguments = argparse.Namespace(
                command=self.name, scene=self.scene, quality="draft", threads=1, fingerprint=None, log=None
            )
            configure_logging(None)
            if self.name == "relit_scores":  # it writes how long pictures took, which no two runs agree about
                importlib.import_module(STAGES[self.name].module).time = SimpleNamespace(monotonic=lambda: 0.0)
            disk = Disk(Path("."), fault)
            with unflushed(), disk.watched():
                code = commands._stage(arguments)
            told.write_text(json.dumps(disk.steps))
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)

    def trial(self, kind: str, call: int, empty: bool, _: Path) -> str:
        """End a run at a call, look, run again; return `unharmed`, `kept` or `lost`.

        Raises:
            Wrong: what is there is taken for finished and is not as it should be, a second run ends with something else, or the
                message does not say in one sentence what is wrong.
        """
        self.begin_again(empty)
        code, said, calls = self._run(Fault(kind, call))
        if code and kind != KILL:
            lines = said.strip().splitlines()
            if "Traceback" in said or not any(lines[-1].endswith(words) for words in CAUSES.values()):
                raise Wrong(f"not told in one sentence: {said[-400:]}")
        ended_before = not code and len(calls) <= call  # a run that finds nothing has less to remove
        if (code == -signal.SIGKILL) != (kind == KILL) and not ended_before:
            raise Wrong(f"it ended with {code}: {said[-400:]}")
        found = self._judge()
        if not code and not found:
            raise Wrong("no error, and it is not finished")
        again, said, _calls = self._run(None)
        if again:
            raise Wrong(f"a second run fails: {said[-400:]}")
        if self._found() != self.start:
            raise Wrong("a second run does not end with what an undisturbed one writes")
        return "unharmed" if not code else "kept" if found else "lost"

    def _judge(self) -> bool:
        """Return whether the stage counts as finished; what counts must be as it was written."""
        stage, *published = self._found()
        for now, before in zip(published, self.start[1:], strict=True):
            if now and now != before:
                raise Wrong("the deliverable is damaged")
        try:
            reader = StageReader(self.folders[0], self.name, self.scene)
            for name in reader.names():
                reader.path(name)
        except InputError as error:
            if (self.folders[0] / MANIFEST).is_file():
                raise Wrong(f"a manifest is there, and files are not what it says: {error}") from None
            return False
        if {name: data for name, data in stage.items() if name in reader.names()} != {
            name: data for name, data in self.start[0].items() if name in reader.names()
        }:
            raise Wrong("it counts as finished, and files are not those of an undisturbed run")
        return True

    def begin_again(self, empty: bool) -> None:
        """Lay out what was there before a trial: the finished stage, or nothing of it."""
        for folder, content in zip(self.folders, self.start, strict=True):
            shutil.rmtree(folder, ignore_errors=True)
            if not empty:
                lay_out(folder, content)


def warm(more: Iterable[str] = ()) -> list[str]:
    """Import what stages import; return the names of those that a scene needs, in their order.

    Args:
        more: stages that are made on demand and are tried as well.
    """
    native.prepare()
    native.limit_threads(1)
    names = [stage.name for stage in STAGES.values() if not stage.on_demand]
    for name in [*names, *more]:
        importlib.import_module(STAGES[name].module)
    return names


def points(stage: Stage) -> list[tuple[str, int, bool]]:
    """Return (what happens, at which call, whether nothing of the stage is there before): for every call SIGKILL, and one of the
    errors in turn."""
    out = []
    for call, (name, _) in enumerate(stage.steps):
        errors = [kind for kind in FAULTS if name == "write" or kind not in ("short", "torn")]
        out += [(KILL, call, bool(call % 2)), (errors[call % len(errors)], call, bool(call % 2 == 0))]
    return out


def try_stages(folder: Path, scene: str, stages: Mapping[str, int], seed: int = 0) -> Iterator[dict[str, Any]]:
    """Try points of stages of a scene.

    Args:
        folder: with results/ and scenes/ of the finished scene; it is worked in.
        scene: which.
        stages: name -> number of trials, chosen by chance; 0 = all. `warm` has been called.
        seed: of the choice.

    Yields:
        For each, as soon as it is done: its name (`stage`), the counts, the calls of a run, and under `said` what went wrong.
    """
    os.chdir(folder)
    for name, most in stages.items():
        stage, tally = Stage(scene, name), Tally()
        every = points(stage)
        for kind, call, empty in random.Random(f"{name} {seed}").sample(every, most) if 0 < most < len(every) else every:
            what = f"{name}: {kind} at call {call} of {len(stage.steps)} ({' '.join(stage.steps[call])})"
            tally.tried(what, partial(stage.trial, kind, call, empty))
        stage.begin_again(empty=False)
        yield {"stage": name, **tally.row(), "calls": len(stage.steps), "of": len(every), "said": tally.wrong}


def main() -> int:
    """Print the counts, a line of JSON for each stage; the exit code is 1 if anything went wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("scene")
    parser.add_argument("stages", nargs="+", help="name=number of trials, or name for all")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    chosen = {name: int(most or 0) for name, _, most in (text.partition("=") for text in arguments.stages)}
    warm(chosen)
    wrong = 0
    for row in try_stages(arguments.folder, arguments.scene, chosen, arguments.seed):
        wrong += row["wrong"]
        print(json.dumps(row), flush=True)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
