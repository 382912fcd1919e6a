"""The prior scattered over jobs: `--set-scatter prior=3`."""

import json
import os
import shutil
import subprocess
import sys

import pytest
from support import manifests, planned

from tests.errors import missing, named

NOTHING = "Nothing to be done"
PRIOR = "results/tiny/prior/manifest.json"


def files(folder):
    return {path.name: path.read_bytes() for path in (folder / "results/tiny/prior").rglob("*") if path.is_file()}


def alone(workflow, *arguments):
    """Stage prior as its rule runs it."""
    command = [sys.executable, "-m", "workflow", "prior", "tiny", *arguments]
    environment = {**os.environ, "PYTHONPATH": str(workflow.repository)}
    return subprocess.run(command, cwd=workflow.folder, capture_output=True, text=True, env=environment)


@pytest.mark.long
def test_parts_make_the_result_of_one_job(workflow):
    """To the byte, with the same fingerprint. A finished prior is not made again because other parts are asked for, or none."""
    folder = workflow.folder
    undisturbed, all_manifests = files(folder), manifests(folder)
    shutil.rmtree(folder / "results/tiny/prior")
    scattered = workflow.run(PRIOR, "--set-scatter", "prior=3")
    assert scattered.returncode == 0, scattered.stderr[-3000:]
    assert planned(scattered) == {"prior", "prior_part"}
    assert len(list((folder / "results/tiny/logs").glob("prior.*-of-3.log"))) == 3
    assert files(folder) == undisturbed and manifests(folder) == all_manifests
    job = json.loads((folder / "results/tiny/benchmarks/prior.parts.json").read_text())["job"]
    assert job["seconds"] > 0 and not list((folder / "results/tiny/benchmarks").glob("prior.*-of-3.parts.json"))
    for options in ((), ("--set-scatter", "prior=2"), ("--set-scatter", "prior=3")):
        assert NOTHING in workflow.run(PRIOR, *options, "-n").stdout


def test_a_part_makes_its_views_alone_and_goes_on_after_a_kill(workflow):
    """By hand, as a debugger would; what parts have left is taken over and not made again."""
    folder, prior = workflow.folder, workflow.folder / "results/tiny/prior"
    undisturbed = files(folder)
    shutil.rmtree(prior)
    views = sorted(name.removesuffix(".exr") for name in undisturbed if name.endswith(".exr"))
    done = alone(workflow, "--part", "1-of-2")
    assert done.returncode == 0, done.stderr
    assert sorted(path.stem for path in (prior / "maps").iterdir()) == views[::2]
    assert not (prior / "manifest.json").exists()
    lost, kept = (prior / f"maps/{view}.exr" for view in views[:3:2])
    before = kept.stat().st_mtime_ns
    lost.write_bytes(b"half a file")  # as a kill leaves it on a disk that tears writes
    again = alone(workflow, "--part", "1/2")
    assert again.returncode == 0 and lost.read_bytes() == undisturbed[lost.name] and kept.stat().st_mtime_ns == before
    whole = alone(workflow)
    assert whole.returncode == 0 and files(folder) == undisturbed and kept.stat().st_mtime_ns == before
    for text in ("0-of-2", "3/2", "x"):
        refused = alone(workflow, "--part", text)
        assert refused.returncode == 1 and refused.stderr.startswith(f"error: --part {text}: ")


@pytest.mark.long
def test_a_prior_that_would_repeat_work_is_not_scattered(workflow):
    path = workflow.folder / "config/scenes/tiny.yaml"
    path.write_text(path.read_text().replace("prior: {kind: simulated, samples: 3, strength: 0.5}", "prior: {kind: retinex}"))
    dry = workflow.run(PRIOR, "--set-scatter", "prior=3", "-n")
    assert planned(dry) == {"prior"}, dry.stderr
    (line,) = [line for line in dry.stderr.splitlines() if "--set-scatter" in line and line.startswith("tiny:")]
    named(line, "--set-scatter prior", "prior retinex")
    grouped = ("--groups", "prior=scene", "--group-components", "scene=1")
    path.write_text(path.read_text().replace("prior: {kind: retinex}", "prior: {kind: simulated, samples: 4}"))
    assert planned(workflow.run(PRIOR, "--set-scatter", "prior=3", "-n")) == {"prior", "prior_part"}
    dry = workflow.run(PRIOR, "--set-scatter", "prior=3", "-n", *grouped)
    assert planned(dry) == {"prior"} and not missing(dry.stderr, "workflow/profiles/slurm")
