"""A tiny scene through the real workflow, once a session; other tests work on copies of it."""

import fcntl

import pytest
from support import TINY, Workflow


@pytest.fixture(scope="session")
def finished(repository, tmp_path_factory, worker_id) -> Workflow:
    """The tiny scene, run to the end, once for all processes of pytest-xdist. Do not change it: use `workflow`."""
    base = tmp_path_factory.getbasetemp()
    shared = base if worker_id == "master" else base.parent
    workflow = Workflow(repository, shared / "tiny")
    with (shared / "tiny.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # the other processes wait here until the run is there
        if not (workflow.folder / "scenes/tiny").is_dir():
            workflow.write("tiny", TINY)
            result = workflow.run("scenes/tiny")
            assert result.returncode == 0, result.stderr[-4000:]
    return workflow


@pytest.fixture
def workflow(finished, tmp_path) -> Workflow:
    """A private copy of the finished tiny scene."""
    return finished.copy(tmp_path / "run")
