"""What users get from three small rooms as captured: scores, and how often 95 % intervals hold. Rewrite the gates from finished
runs, and read the difference before committing:

    python -m tests.lab.gates <folder>     # makes the runs that are missing there, then tests/lab/gates.json
"""

import contextlib
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

import lab  # noqa: F401  for the rooms of the laboratory
from iif_core.fitting.intervals import MeasuredErrors
from lab.benchmarks.object_intervals import measured, rooms_of
from workflow.artifacts.manifest import MANIFEST
from workflow.decisions import held
from workflow.registry import STAGES, upstream_of
from workflow.runtime import native
from workflow.runtime.job import run_stage

REPOSITORY = Path(__file__).resolve().parents[2]
PATH = Path(__file__).with_name("gates.json")
ROOMS, SEEDS = ("tiny", "tiny-gloss", "gloss"), (0, 1, 2)
CELLS = 50
"""Objects with fewer surface cells whose truth is known are left out of the coverage."""
SCENE = """\
source: {{kind: builtin, scene: {room}}}
capture: {{realism: as_captured, dynamic_range: ldr, views: 8, width: 96, height: 96, samples: 64, denoise: true}}
seed: {seed}
"""
SCORES = ("albedo/psnr/raw", "albedo/psnr/scaled", "rgb/psnr/raw")


def run(folder: Path, rooms: tuple[str, ...] = ROOMS, seeds: tuple[int, ...] = SEEDS) -> subprocess.CompletedProcess:
    """Photograph rooms and fit them as users do: the default prior, objects from the mesh."""
    names = []
    for room in rooms:
        for seed in seeds:
            path = folder / f"config/scenes/{room}-{seed}.yaml"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(SCENE.format(room=room, seed=seed))
            names.append(path.stem)
    # One process for all stages: as jobs of Snakemake, half of their time would be that of imports.
    command = [sys.executable, "-c", "import sys; from tests.lab import gates; gates.fit(sys.argv[1:])", *names]
    return subprocess.run(command, cwd=folder, env=os.environ | {"PYTHONPATH": str(REPOSITORY)}, capture_output=True, text=True)


def fit(names: list[str]) -> None:
    """Run the stages of scenes up to their scores, in this process and in the working folder; those that are there are left."""
    native.prepare()
    wanted = upstream_of("metrics") | {"metrics"}
    for name in names:
        for stage in (stage for stage in STAGES if stage in wanted and not STAGES[stage].on_demand):
            if not (Path("results") / name / stage / MANIFEST).is_file():
                run_stage(stage, name, "draft", threads=2)


def scores(folder: Path, scene: str) -> dict[str, float]:
    """Means over the photographs, in dB."""
    frame = pq.read_table(folder / f"results/{scene}/metrics/metrics.parquet").to_pandas()
    means = frame.groupby(["quantity", "metric", "protocol"])["value"].mean()
    return {name: round(float(means[tuple(name.split("/"))]), 3) for name in SCORES}


def covered(folder: Path, scene: str) -> list[bool]:
    """Whether the interval of each channel of each object's albedo holds the truth, with the constants that ship."""
    with contextlib.chdir(folder):
        (room,) = rooms_of(list(measured(scene, "draft", CELLS)))
    errors = MeasuredErrors.from_facts(held.measured()["errors"], str(held.FILE))
    low, high = room.albedo(errors).ends(errors.albedo)
    return ((low <= room.truth[:, :3]) & (room.truth[:, :3] <= high)).ravel().tolist()


def take(folder: Path, rooms: tuple[str, ...] = ROOMS, seeds: tuple[int, ...] = SEEDS) -> dict:
    """Scores of each run, and the share of the channels of all objects of all runs that the intervals hold."""
    names = [f"{room}-{seed}" for room in rooms for seed in seeds]
    inside = np.concatenate([covered(folder, name) for name in names])
    return {"scores": {name: scores(folder, name) for name in names}, "held": round(float(inside.mean()), 4)}


if __name__ == "__main__":
    where = Path(sys.argv[1]).resolve()
    done = run(where)
    if done.returncode:
        sys.exit(done.stderr[-3000:])
    PATH.write_text(json.dumps(take(where), indent=1, sort_keys=True) + "\n")
