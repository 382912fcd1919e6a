"""What people have put into `scenes/<scene>/` after commands in any order: none of it is lost, and the scene can be made again.

    python -m tests.workflow.sequences FOLDER [--count 200] [--seed 0] [--jobs 1]

Makes the tiny scene in FOLDER, and from copies of it runs sequences of commands drawn at random: another quality, refused or by
`replace=yes`, publishing again, runs that are killed or interrupted at any moment or while the deliverable is put in its place,
two runs at once, a deliverable that is renamed, records that are deleted; files of the user come between. After each command
every file of the user must lie somewhere, with its bytes; at the end the scene must be made, and `verify` must find it whole.
A line of JSON for each sequence is added to lab/notebook/data/reliability_sequences.jsonl; sequences that it has are left out.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import yaml

sys.path.insert(0, str(Path(__file__).resolve().parent))

from support import TINY, Workflow

import lab  # noqa: F401  for the tiny room, which jobs learn of by the environment

REPOSITORY = Path(__file__).resolve().parents[2]
PLACE = REPOSITORY / "lab/notebook/data/reliability_sequences.jsonl"
COMMANDS = 5
SCENE = TINY.replace("samples: 3, ", "")  # a quality says how many
QUALITIES = {"fine": {"report": {"credit": "fine"}}, "coarse": {"report": {"credit": "coarse"}, "prior": {"samples": 2}}}
NAMES = (
    "room.blend",
    "renders/night.png",
    "maps/notes.txt",
    "textures/wood/oak.jpg",
    "report.own.html",
    ".hidden/state",
    "ü ñ.txt",
)


class Room:
    """The tiny scene in a folder of its own, and what the user has put into its deliverable."""

    def __init__(self, workflow: Workflow, rng: random.Random):
        self.workflow, self.rng, self.scenes = workflow, rng, workflow.folder / "scenes"
        self.own: list[bytes] = []

    def lost(self) -> list[str]:
        """Return what the user has put there and is nowhere now."""
        files = [path for path in self.scenes.rglob("*") if path.is_file() and not path.is_symlink()]
        left = {path.read_bytes() for path in files if path.stat().st_size < 100}
        return [data.decode() for data in self.own if data not in left]

    def put(self) -> str:
        """Put a file into the deliverable, as Blender does when a scene is saved beside the meshes."""
        name = self.rng.choice(NAMES)
        path, data = self.scenes / "tiny" / name, f"{name} {len(self.own)} of {self.rng.random()}".encode()
        if path.exists() or not (self.scenes / "tiny").is_dir():
            return f"nothing put at {name}"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
        self.own.append(data)
        return f"put {name}"

    def make(self, *arguments: str, quality: str = "fine") -> str:
        found = self.workflow.run("scenes/tiny", *arguments, "--config", f"quality={quality}")
        return f"make {quality} {' '.join(arguments)}: {found.returncode}"

    def cheaper(self) -> str:
        """Refused where a result of more pixels is there."""
        return self.make(quality="coarse")

    def replaced(self) -> str:
        found = self.workflow.run("scenes/tiny", "--config", "quality=coarse", "replace=yes")
        return f"replaced by coarse: {found.returncode}"

    def again(self) -> str:
        return self.make("--forcerun", "publish")

    def edited(self) -> str:
        """The scene file changes, and so the page that is published."""
        path = self.workflow.folder / "config/scenes/tiny.yaml"
        path.write_text(SCENE + f"report: {{credit: number {self.rng.random()}}}\n")
        return "edited; " + self.make()

    def ended(self, sent: signal.Signals, wait: Callable[[subprocess.Popen], None], *arguments: str) -> str:
        command = self.workflow.command("scenes/tiny", *arguments, "--forcerun", "publish", "--config", "quality=fine")
        run = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
        wait(run)
        try:
            os.killpg(run.pid, sent)
        except ProcessLookupError:
            pass
        code = run.wait()
        if sent is signal.SIGKILL:  # its lock stays, as after a power cut
            self.workflow.run("--unlock")
        return f"ended by {sent.name}: {code}"

    def killed(self) -> str:
        return self.ended(signal.SIGKILL, lambda _: time.sleep(self.rng.uniform(0, 12)))

    def interrupted(self) -> str:
        return self.ended(signal.SIGINT, lambda _: time.sleep(self.rng.uniform(0, 12)))

    def killed_in_place(self) -> str:
        """Killed while the new deliverable is filled and put in the place of the old one."""

        def wait(run: subprocess.Popen) -> None:
            late = self.rng.uniform(0, 0.4)
            while run.poll() is None and not (self.scenes / ".tiny.tmp").exists():
                time.sleep(0.002)
            time.sleep(late)

        return self.ended(signal.SIGKILL, wait)

    def twice(self) -> str:
        """Two runs of one scene at once."""
        runs = [
            subprocess.Popen(
                self.workflow.command("scenes/tiny", "--forcerun", "publish", "--config", "quality=fine"),
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
            for _ in range(2)
        ]
        return f"two at once: {[run.wait() for run in runs]}"

    def renamed(self) -> str:
        """The user keeps a deliverable under another name, and makes a new one."""
        if (self.scenes / "tiny").is_dir():
            (self.scenes / "tiny").rename(self.scenes / f"tiny-{len(list(self.scenes.iterdir()))}")
        return "renamed; " + self.make()

    def forgotten(self) -> str:
        """The records of Snakemake, or of the stage, are deleted."""
        folder = self.workflow.folder / self.rng.choice([".snakemake", "results/tiny/publish", "results/tiny/report"])
        shutil.rmtree(folder, ignore_errors=True)
        return f"deleted {folder.name}; " + self.make()

    def verified(self) -> str:
        return f"verify: {self.workflow.run('verify').returncode}"


CHOICES: tuple[Callable[[Room], str], ...] = (
    *(Room.put,) * 4,
    *(Room.killed_in_place,) * 3,
    *(
        Room.cheaper,
        Room.replaced,
        Room.again,
        Room.edited,
        Room.killed,
        Room.interrupted,
        Room.twice,
        Room.renamed,
        Room.forgotten,
    ),
    *(Room.verified,),
)


def trial(template: Workflow, folder: Path, seed: int) -> dict[str, Any]:
    """Run one sequence in a copy of the finished scene; return what was done, and what is wrong, if anything is."""
    shutil.rmtree(folder, ignore_errors=True)
    rng = random.Random(seed)
    room = Room(template.copy(folder), rng)
    done, wrong = [room.put()], []
    for _ in range(COMMANDS):
        done.append(rng.choice(CHOICES)(room))
        wrong += [f"lost after {done[-1]}: {name}" for name in room.lost()]
        if wrong:
            break
    last = room.workflow.run("scenes/tiny", "--config", "quality=fine")
    checked = room.workflow.run("verify", "--config", "quality=fine")
    wrong += [f"lost at the end: {name}" for name in room.lost()]
    if last.returncode or checked.returncode:
        wrong.append(f"made {last.returncode}, verify {checked.returncode}: {(last.stderr + checked.stderr)[-600:]}")
    shutil.rmtree(folder)
    return {"seed": seed, "files": len(room.own), "done": done, "wrong": wrong}


def template_in(folder: Path) -> Workflow:
    """Return the tiny scene, finished, with two qualities that differ in what little is made again."""
    workflow = Workflow(REPOSITORY, folder / "template")
    if not (workflow.folder / "scenes/tiny").is_dir():
        workflow.write("tiny", SCENE)
        for name, settings in QUALITIES.items():
            text = (REPOSITORY / "config/quality/draft.yaml").read_text()
            workflow.write_quality(name, yaml.safe_dump(_merged(yaml.safe_load(text), settings)))
        found = workflow.run("scenes/tiny", "--config", "quality=fine")
        assert found.returncode == 0, found.stderr[-3000:]
    return workflow


def _merged(under: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    return under | {key: (under.get(key) or {}) | value for key, value in over.items()}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--keep", type=Path, default=PLACE, help="where a line for each sequence is added")
    options = parser.parse_args()
    known = {json.loads(line)["seed"] for line in options.keep.read_text().splitlines()} if options.keep.is_file() else set()
    folder = options.folder.resolve()
    template = template_in(folder)
    seeds = [seed for seed in range(options.seed, options.seed + options.count) if seed not in known]
    found = 0
    with ThreadPoolExecutor(options.jobs) as pool:
        for row in pool.map(lambda seed: trial(template, folder / f"run{seed}", seed), seeds):
            with options.keep.open("a") as file:
                file.write(json.dumps(row) + "\n")
            found += bool(row["wrong"])
            print(f"{row['seed']}: {row['wrong'] or 'nothing lost'}", flush=True)
    return found > 0


if __name__ == "__main__":
    sys.exit(main())
