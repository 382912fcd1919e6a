"""The Slurm profiles on a real Slurm of one node without accounting: `make test-slurm` (tests/slurm/run.sh) starts it."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(REPOSITORY / "tests/workflow"))

from conftest import TINY  # noqa: E402
from support import manifests  # noqa: E402

pytestmark = pytest.mark.skipif("IIF_SLURM_STATE" not in os.environ, reason="no Slurm here; `make test-slurm` starts one")
SCENES = "abc"
PROFILES = REPOSITORY / "workflow/profiles"
ROW = REPOSITORY / "docs/results/data/reliability_slurm.json"


def command(folder, *arguments):
    """Snakemake in a folder, as the guide says."""
    snakemake = REPOSITORY / ".venv/bin/snakemake"
    return [str(snakemake), "-s", str(REPOSITORY / "Snakefile"), "-d", str(folder), *map(str, arguments)]


def environment():
    return {**os.environ, "PYTHONPATH": os.environ["IIF_SLURM"]}


@pytest.fixture(scope="module")
def batch(tmp_path_factory):
    """Make a folder with three scenes, or more such folders."""

    def make(name):
        folder = tmp_path_factory.mktemp(name)
        (folder / "config/scenes").mkdir(parents=True)
        for number, scene in enumerate(SCENES):
            (folder / f"config/scenes/{scene}.yaml").write_text(f"{TINY}seed: {number}\n")
        (folder / "config/batch.tsv").write_text("name\n" + "".join(f"{scene}\n" for scene in SCENES))
        return folder

    return make


@pytest.fixture(scope="module")
def local(batch):
    """The same batch without Slurm, and the seconds that it took."""
    folder, start = batch("local"), time.monotonic()
    done = subprocess.run(command(folder, "--cores", 2, "scenes"), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    return folder, time.monotonic() - start


def jobs():
    """Slurm's jobs: id -> (state, rule or group)."""
    lines = subprocess.run(["squeue", "-h", "-o", "%A %T %k"], capture_output=True, text=True, check=True).stdout.splitlines()
    return {line.split()[0]: line.split()[1:] for line in lines}


def wait_for(condition, seconds=300):
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        found = condition()
        if found:
            return found
        time.sleep(0.5)
    raise AssertionError("it did not happen in time")


def running():
    return [number for number, (state, *_) in jobs().items() if state == "RUNNING"]


def keep(**facts):
    row = json.loads(ROW.read_text()) if ROW.is_file() else {}
    ROW.write_text(json.dumps(row | facts, indent=1, sort_keys=True) + "\n")


def test_a_batch_survives_a_cancelled_job_and_a_killed_controller(batch, local):
    """One job for each scene. Every manifest equals that of the run without Slurm, and nothing is left in the queue."""
    folder = batch("slurm")
    process = subprocess.Popen(
        command(folder, "--workflow-profile", PROFILES / "slurm-scenes", "--jobs", 2, "scenes"),
        env=environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    first = wait_for(running)[0]
    wait_for(lambda: list(folder.glob("results/*/prior/manifest.json")))
    subprocess.run(["scancel", first], check=True)
    wait_for(lambda: [number for number in running() if number != first])
    state = Path(os.environ["IIF_SLURM_STATE"])
    os.kill(int((state / "slurmctld.pid").read_text()), signal.SIGKILL)
    time.sleep(5)
    subprocess.run(["slurmctld"], check=True)
    output, _ = process.communicate(timeout=1500)
    assert process.returncode == 0, output[-4000:]
    assert manifests(folder) == manifests(local[0])
    assert not running()
    assert re.search(rf"{first}.*(?:cancel|fail|CANCELLED)", output, re.I), output[-4000:]
    keep(batch={"scenes": len(SCENES), "cancelled": 1, "controller killed": 1, "equal to local": True})


def test_overhead_of_one_job_for_a_scene(batch, local):
    folder, start = batch("undisturbed"), time.monotonic()
    whole = command(folder, "--workflow-profile", PROFILES / "slurm-scenes", "scenes")
    done = subprocess.run(whole, env=environment(), capture_output=True, text=True)
    seconds = time.monotonic() - start
    assert done.returncode == 0, done.stderr[-3000:]
    assert manifests(folder) == manifests(local[0])
    assert not subprocess.run(["squeue", "-h"], capture_output=True, text=True).stdout.strip()
    keep(overhead={"local seconds": round(local[1], 1), "slurm seconds": round(seconds, 1), "scenes": len(SCENES)})


def test_one_job_for_each_stage(batch, local):
    """The other profile, whose threads are those of its file: as many as the node has."""
    folder = batch("stages")
    threads = ["--set-threads", "capture=2", "prior=1", "segmentation=1"]
    done = subprocess.run(
        command(folder, "--workflow-profile", PROFILES / "slurm", "results/a/prior/manifest.json", *threads),
        env=environment(),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    noted = {path.stem: path.read_text().strip() for path in folder.glob("results/a/benchmarks/*.threads")}
    assert noted["capture"] == "2" and noted["prior"] == "1"
    for stage in ("capture", "prior"):
        own, other = (root / f"results/a/{stage}/manifest.json" for root in (folder, local[0]))
        assert own.read_bytes() == other.read_bytes()
