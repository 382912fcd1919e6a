"""The Slurm profiles on a real Slurm of one node, with or without accounting: tests/slurm/run.sh starts it (`make test-slurm`).

`IIF_SLURM_SCENE=kitchen bash tests/slurm/run.sh -k overhead` measures what a job for a scene costs in addition to its stages,
and keeps the row for lab/notebook/reliability.md. It needs a machine that does nothing else, and takes two drafts of the scene.
"""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.errors import missing

REPOSITORY = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(REPOSITORY / "tests/workflow"))

from conftest import TINY  # noqa: E402
from support import manifests, planned  # noqa: E402

pytestmark = pytest.mark.skipif("IIF_SLURM_STATE" not in os.environ, reason="no Slurm here; `make test-slurm` starts one")
ACCOUNTING = bool(os.environ.get("IIF_SLURM_ACCOUNTING"))
SCENES = "abc"
PROFILES = REPOSITORY / "workflow/profiles"
ROW = REPOSITORY / "lab/notebook/data/reliability_slurm.json"


def command(folder, *arguments):
    """Snakemake in a folder, as the guide says."""
    snakemake = REPOSITORY / ".venv/bin/snakemake"
    return [str(snakemake), "-s", str(REPOSITORY / "Snakefile"), "-d", str(folder), *map(str, arguments)]


def environment():
    return {**os.environ, "PYTHONPATH": os.environ["IIF_SLURM"]}


def run(folder, profile, *arguments):
    """Snakemake with a profile, to its end; the seconds that it took."""
    start = time.time()
    whole = command(folder, "--workflow-profile", PROFILES / profile, *arguments)
    done = subprocess.run(whole, env=environment(), capture_output=True, text=True)
    return done, time.time() - start


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
    """The same batch without Slurm."""
    folder = batch("local")
    done = subprocess.run(command(folder, "--cores", 2, "scenes"), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    return folder


def jobs():
    """Slurm's jobs of Snakemake: id -> state."""
    lines = subprocess.run(["squeue", "-h", "-o", "%A %T %j"], capture_output=True, text=True, check=True).stdout.splitlines()
    return {line.split()[0]: line.split()[1] for line in lines if not line.endswith("wrap")}


def wait_for(condition, seconds=300):
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        found = condition()
        if found:
            return found
        time.sleep(0.5)
    raise AssertionError("it did not happen in time")


def running():
    return [number for number, state in jobs().items() if state == "RUNNING"]


def keep(**facts):
    row = json.loads(ROW.read_text()) if ROW.is_file() else {}
    ROW.write_text(json.dumps(row | facts, indent=1, sort_keys=True) + "\n")


def test_a_batch_survives_a_cancelled_job_and_a_killed_controller(batch, local):
    """One job for each scene. Every manifest equals the one of the run without Slurm, the run reports what happened to the
    cancelled job, and nothing is left in the queue."""
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
    cancelled = time.time()
    wait_for(lambda: [number for number in running() if number != first])
    state = Path(os.environ["IIF_SLURM_STATE"])
    # A controller that was killed before it saved this believes for half an hour, until the node registers again, that the job ru
    wait_for(lambda: (state / "state/job_state").stat().st_mtime > cancelled + 1)
    os.kill(int((state / "slurmctld.pid").read_text()), signal.SIGKILL)
    time.sleep(5)
    subprocess.run(["slurmctld"], check=True)
    output, _ = process.communicate(timeout=1500)
    assert process.returncode == 0, output[-4000:]
    assert manifests(folder) == manifests(local)
    assert not jobs()
    assert f"Slurm job {first} ended with CANCELLED" in output, output[-4000:]
    key = f"batch, {'with' if ACCOUNTING else 'without'} accounting"
    keep(**{key: {"scenes": len(SCENES), "cancelled": 1, "controller killed": 1, "equal to local": "yes"}})


def test_a_scene_that_failed_goes_on_where_it_stopped(batch):
    """Although its stages were one job, which Snakemake takes for failed as a whole."""
    folder = batch("failed")
    blocked = folder / "results/b/render/maps"
    blocked.parent.mkdir(parents=True)
    blocked.write_text("in the way")
    failed, _ = run(folder, "slurm-scenes", "--retries", "0", "--", "scenes/b")
    last = failed.stderr.strip().splitlines()[-1]
    assert failed.returncode == 1 and not missing(last, "error", "b", "render", "results/b/logs/render.log"), failed.stderr[
        -3000:
    ]
    blocked.unlink()
    again = subprocess.run(command(folder, "--cores", 2, "-n", "scenes/b"), capture_output=True, text=True)
    assert planned(again) == {"render", "metrics", "report", "publish"}


def beside_stages(folder, scene, seconds):
    """Seconds of a run in which no stage was at work, and the seconds in which at least one was."""
    spans = []
    for record in folder.glob(f"results/{scene}/benchmarks/*.parts.json"):
        end = record.stat().st_mtime
        spans.append((end - json.loads(record.read_text())["job"]["seconds"], end))
    busy = until = 0.0
    for start, end in sorted(spans):
        busy += max(0.0, end - max(start, until))
        until = max(until, end)
    return seconds - busy, busy


def test_overhead_of_one_job_for_a_scene(batch):
    """Submitting, waiting, starting Snakemake on the node and noticing the end, against a run of the same scene without Slurm.

    It is measured within each run, as the time in which no stage is at work: what stages take differs from run to run.
    """
    scene, found = os.environ.get("IIF_SLURM_SCENE", "a"), {}
    for kind in ("slurm", "local"):
        folder = batch(f"overhead-{kind}")
        if scene != "a":
            for place in ("config", "data"):
                subprocess.run(["rm", "-rf", folder / place], check=True)
            (folder / "data").symlink_to(REPOSITORY / "data")
        if kind == "slurm":
            done, seconds = run(folder, "slurm-scenes", f"scenes/{scene}")
        else:
            start = time.time()
            done = subprocess.run(command(folder, "--cores", 2, f"scenes/{scene}"), capture_output=True, text=True)
            seconds = time.time() - start
        assert done.returncode == 0, done.stderr[-3000:]
        found[kind] = beside_stages(folder, scene, seconds)
    (beside, _), (usual, work) = found["slurm"], found["local"]
    assert beside < 3 * usual + 15, found  # not a start of Snakemake for each of its stages, as the jobstep executor has
    if scene != "a":
        share = (beside - usual) / work
        row = {"scene": scene, "seconds of its stages": round(work), "seconds beside them": round(beside, 1)}
        keep(overhead=row | {"without Slurm": round(usual, 1), "more than without Slurm": f"{100 * share:.1f} %"})
        assert share < 0.1, found


def test_one_job_for_each_stage(batch, local):
    """The other profile, whose threads are those of its file; the prior as two jobs. With accounting, `sacct` is asked, and a
    report says what was wasted."""
    folder = batch("stages")
    options = ["--set-threads", "capture=2", "prior=1", "prior_part=1", "segmentation=1", "--set-scatter", "prior=2"]
    if ACCOUNTING:
        options += ["--slurm-status-command", "sacct", "--slurm-efficiency-report"]
    (folder / "partitions.yaml").write_text("partitions:\n  main: {max_runtime: 10000, max_threads: 12, max_mem_mb: 10000}\n")
    options += ["--slurm-partition-config", folder / "partitions.yaml"]
    done, _ = run(folder, "slurm", "results/a/prior/manifest.json", *options)
    assert done.returncode == 0, done.stderr[-3000:]
    places = folder.glob("results/a/benchmarks/*.parts.json")
    threads = {path.name.partition(".")[0]: json.loads(path.read_text())["job"]["threads"] for path in places}
    assert threads["capture"] == 2 and threads["prior"] == 1
    for stage in ("capture", "prior"):
        own, other = (root / f"results/a/{stage}/manifest.json" for root in (folder, local))
        assert own.read_bytes() == other.read_bytes()
    if ACCOUNTING:
        (report,) = folder.glob("efficiency_report_*.csv")
        rows = list(csv.DictReader(report.read_text().splitlines()))
        assert {row["RuleName"].split("_wildcards")[0] for row in rows} == {"rule_capture", "rule_prior_part", "rule_prior"}
        assert any(float(row["CPU Efficiency (%)"]) > 0 and float(row["Memory Usage (%)"]) > 0 for row in rows), rows
