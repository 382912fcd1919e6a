"""A tiny scene through the real workflow, once a session; other tests work on copies of it."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

TINY = """\
source: {kind: builtin, scene: tiny}
capture: {dynamic_range: hdr, views: 4, width: 48, height: 48, samples: 32}
prior: {kind: simulated, samples: 3, strength: 0.5}
emission: {rows: 2000, samples: 8}
shading: {samples: 8, levels: 6}
affines: {pixels: 8000, iterations: 5}
render: {samples: 8}
report: {views: 2}
"""


class Workflow:
    """A folder with scenes, and Snakemake run in it as a user would."""

    def __init__(self, repository: Path, folder: Path):
        self.repository, self.folder = repository, folder

    def write(self, scene: str, text: str) -> None:
        path = self.folder / "config/scenes" / f"{scene}.yaml"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)

    def command(self, *arguments: str) -> list[str]:
        snakemake = Path(sys.executable).with_name("snakemake")
        return [str(snakemake), "-s", str(self.repository / "Snakefile"), "-d", str(self.folder), "--cores", "2", *arguments]

    def run(self, *arguments: str) -> subprocess.CompletedProcess:
        return subprocess.run(self.command(*arguments), capture_output=True, text=True)

    def copy(self, folder: Path) -> "Workflow":
        """The same state elsewhere (time stamps and Snakemake's records kept)."""
        shutil.copytree(self.folder, folder, symlinks=True)
        return Workflow(self.repository, folder)


@pytest.fixture(scope="session")
def finished(repository, tmp_path_factory) -> Workflow:
    """The tiny scene, run to the end. Do not change it: use `workflow`."""
    workflow = Workflow(repository, tmp_path_factory.mktemp("tiny") / "run")
    workflow.write("tiny", TINY)
    result = workflow.run("scenes/tiny")
    assert result.returncode == 0, result.stderr[-4000:]
    return workflow


@pytest.fixture
def workflow(finished, tmp_path) -> Workflow:
    """A private copy of the finished tiny scene."""
    return finished.copy(tmp_path / "run")
