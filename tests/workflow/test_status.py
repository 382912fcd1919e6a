"""`snakemake status` while a run holds the folder, after it was killed, and of a finished scene; events of a whole run."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time

from support import error_of

from tests.errors import missing, named
from workflow.registry import STAGES
from workflow.runtime.fingerprint import NEEDED
from workflow.runtime.job_state import state_file

ROOM = "room"


def lines(workflow, *arguments):
    """Lines of `snakemake status`, without `--cores`, as users type it."""
    command = [word for word in workflow.command("status", *arguments) if word not in ("--cores", "2")]
    said = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert said.returncode == 0 and "Traceback" not in said.stderr, said.stderr
    return said.stdout.splitlines()


def scene_line(workflow):
    (line,) = (line for line in lines(workflow) if line.startswith("tiny "))
    return line


def test_status_is_told_while_a_run_holds_the_folder(workflow):
    folder = workflow.folder
    assert scene_line(workflow).split()[1] == "done"
    other = lines(workflow, "--config", "quality=paper")[1]
    assert other.split()[1:3] == ["stale", "capture"] and other.endswith("made at quality draft")
    shutil.rmtree(folder / "scenes")  # from here on it is a scene that lacks its last stages
    logs = sorted((folder / ".snakemake/log").iterdir())
    state = state_file("tiny", ROOM, folder)
    run = subprocess.Popen(workflow.command("scenes/tiny", "--forcerun", ROOM), stderr=subprocess.DEVNULL, start_new_session=True)
    try:
        deadline = time.monotonic() + 120
        while not state.exists() and time.monotonic() < deadline:
            time.sleep(0.02)
        job = json.loads(state.read_text())["pid"]
        os.kill(job, signal.SIGSTOP)  # so that the stage lasts for as long as it is looked at
        assert any((folder / ".snakemake/locks").iterdir())
        assert scene_line(workflow).split()[1:3] == ["running", ROOM] and " of about " in scene_line(workflow)
        assert len(sorted((folder / ".snakemake/log").iterdir())) == len(logs) + 1  # the log of the run alone
    finally:
        os.killpg(run.pid, signal.SIGKILL)
        run.wait()
    assert scene_line(workflow).split()[1:3] == ["killed", ROOM]
    command = [sys.executable, "-m", "workflow", "status", "--json", "tiny", "tinny"]
    environment = {**os.environ, "PYTHONPATH": str(workflow.repository)}
    said = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    killed, refused = map(json.loads, said.stdout.splitlines())
    assert (killed["state"], killed["stage"], killed["log"]) == ("killed", ROOM, f"results/tiny/logs/{ROOM}.log")
    assert killed["remaining_cpu_seconds"] > 0 and killed["cpu_seconds"] > 1 and killed["seconds"] < 600
    assert refused["state"] == "refused" and not missing(refused["reason"], "scenes/tiny")


def test_status_stands_alone(workflow):
    said = workflow.run("status", "scenes/tiny", "-n")
    named(error_of(said), "status")


def test_events_of_a_whole_run(finished):
    found = [json.loads(line) for line in (finished.folder.parent / "tiny.events.jsonl").read_text().splitlines()]
    for stage in NEEDED:
        of_stage = [event for event in found if event["stage"] == stage]
        mark = json.loads((finished.folder / f"results/tiny/{stage}/manifest.json").read_text())["fingerprint"]
        assert [event["event"] for event in of_stage if event["event"] != "progress"] == ["started", "finished"]
        assert {(event["v"], event["scene"], event["fingerprint"]) for event in of_stage} == {(1, "tiny", mark)}
        assert len({event["pid"] for event in of_stage}) == 1 and of_stage[-1]["cpu_seconds"] > 0
    assert {event["stage"] for event in found if event["event"] == "progress"} >= {"capture", "shading"}
    assert not {event["stage"] for event in found} - set(STAGES)


def test_a_place_for_events_that_cannot_be_is_refused(workflow):
    said = workflow.run("scenes/tiny", "-n", "--config", "events=config/scenes/tiny.yaml")
    named(error_of(said), "--config events=config/scenes/tiny.yaml")
