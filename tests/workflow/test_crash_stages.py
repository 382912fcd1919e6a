"""Real stages that are killed, or whose calls to the file system fail, are as they were, or unfinished, and made again alike."""

import json
import subprocess
import sys

import pytest

CHEAP = ("plan", "prior", "segmentation", "unwrap", "report", "publish")
DEAR = ("capture", "base", "emission", "shading", "affines", "render", "metrics", "export", "room")


def trials(workflow, folder, *stages):
    copy = workflow.copy(folder / "run")
    command = [sys.executable, "-m", "tests.workflow.crash_stages", str(copy.folder), "tiny", *stages]
    found = subprocess.run(command, cwd=workflow.repository, capture_output=True, text=True)
    assert found.returncode == 0, found.stdout[-4000:] + found.stderr[-4000:]
    return {row["stage"]: row for row in map(json.loads, found.stdout.splitlines())}


@pytest.mark.long
def test_stages_killed_and_failing_at_some_calls(finished, tmp_path):
    found = trials(finished, tmp_path, "prior=6", "segmentation=6", "publish=8")
    assert sum(row["points"] for row in found.values()) == 20 and not any(row["wrong"] for row in found.values())
    assert all(row["calls"] > 40 for row in found.values())


@pytest.mark.long
def test_stages_killed_and_failing_at_every_call(finished, tmp_path):
    """Every call of those that take less than a second; of the others, some."""
    found = trials(finished, tmp_path, *CHEAP, *(f"{name}=12" for name in DEAR))
    assert not any(row["wrong"] for row in found.values())
    assert all(found[name]["points"] == found[name]["of"] for name in CHEAP)
