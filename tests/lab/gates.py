"""What users get from three small rooms as captured: scores, and how often 95 % intervals hold. Rewrite the gates from finished
runs, and read the difference before committing:

    python -m tests.lab.gates <folder>     # makes the runs that are missing there, then tests/lab/gates.json
"""

import contextlib
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from iif_core.fitting.intervals import MeasuredErrors
from lab.benchmarks.object_intervals import measured, rooms_of
from workflow.decisions import held

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
    targets = []
    for room in rooms:
        for seed in seeds:
            path = folder / f"config/scenes/{room}-{seed}.yaml"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(SCENE.format(room=room, seed=seed))
            targets.append(f"results/{room}-{seed}/metrics/manifest.json")
    snakemake = Path(sys.executable).with_name("snakemake")
    command = [str(snakemake), "-s", str(REPOSITORY / "lab/Snakefile"), "-d", str(folder), "--cores", "2", *targets]
    return subprocess.run(command, capture_output=True, text=True)


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
