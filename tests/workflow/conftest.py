"""A tiny scene through the real workflow, once a session; other tests work on copies of it."""

import fcntl

import pytest
from support import Workflow

TINY = """\
source: {kind: builtin, scene: tiny}
capture: {dynamic_range: hdr, views: 4, width: 48, height: 48, samples: 32}
prior: {kind: simulated, samples: 3, strength: 0.5}
emission: {rows: 2000, samples: 8}
shading: {samples: 8, levels: 6}
affines: {pixels: 8000, iterations: 5}
render: {samples: 8}
report: {views: 2}
room: {lightmap_size: 128, samples: 256}
"""


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
            result = workflow.run("scenes/tiny", "--config", f"events={shared / 'tiny.events.jsonl'}")
            assert result.returncode == 0, result.stderr[-4000:]
    return workflow


@pytest.fixture
def workflow(finished, tmp_path) -> Workflow:
    """A private copy of the finished tiny scene."""
    return finished.copy(tmp_path / "run")
