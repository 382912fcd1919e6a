"""`python -m workflow status` while a run holds the folder, after it was killed, and of a finished scene."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time

import pytest

from workflow.runtime.job_state import state_file

ROOM = "room"


def status(workflow, *arguments):
    command = [sys.executable, "-m", "workflow", "status", *arguments]
    environment = {**os.environ, "PYTHONPATH": str(workflow.repository)}
    said = subprocess.run(command, cwd=workflow.folder, env=environment, capture_output=True, text=True, timeout=60)
    assert said.returncode == 0 and "Traceback" not in said.stderr, said.stderr
    return said.stdout.splitlines()


def scene_line(workflow):
    (line,) = (line for line in status(workflow) if line.startswith("tiny "))
    return line


@pytest.mark.long
def test_status_is_told_while_a_run_holds_the_folder(workflow):
    folder = workflow.folder
    assert scene_line(workflow).split()[1] == "done"
    other = status(workflow, "--quality", "paper")[1]
    assert other.split()[1:3] == ["stale", "capture"] and other.endswith("made at quality draft")
    shutil.rmtree(folder / "scenes")  # from here on it is a scene that lacks its last stages
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
    finally:
        os.killpg(run.pid, signal.SIGKILL)
        run.wait()
    assert scene_line(workflow).split()[1:3] == ["killed", ROOM]
    killed, refused = map(json.loads, status(workflow, "--json", "tiny", "tinny"))
    assert (killed["state"], killed["stage"], killed["log"]) == ("killed", ROOM, f"results/tiny/logs/{ROOM}.log")
    assert killed["remaining_cpu_seconds"] > 0 and killed["cpu_seconds"] > 1 and killed["seconds"] < 600
    assert refused["state"] == "refused" and "Did you mean scenes/tiny?" in refused["reason"]
