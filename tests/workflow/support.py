"""Helpers of the workflow tests."""

import hashlib
import re
import shutil
import subprocess
import sys
from pathlib import Path

TINY = """\
source: {kind: builtin, scene: tiny}
capture: {dynamic_range: hdr, views: 4, width: 48, height: 48, samples: 32}
prior: {kind: simulated, samples: 3, strength: 0.5}
segmentation: {kind: given}
emission: {rows: 2000, samples: 8}
shading: {samples: 8, levels: 6}
affines: {pixels: 8000, iterations: 5}
render: {samples: 8}
room: {lightmap_size: 128, samples: 256}
"""


def planned(result: subprocess.CompletedProcess) -> set[str]:
    """Rules in the job table of a dry run."""
    table = (result.stdout + result.stderr).partition("Job stats:")[2].partition("total")[0]
    return set(re.findall(r"^(\w+) +\d+ *$", table, re.M)) - {"scenes"}


def error_of(result: subprocess.CompletedProcess) -> str:
    """The last line of a run that failed, which is its one error, without `error: `."""
    last = result.stderr.strip().splitlines()[-1]
    assert result.returncode == 1 and last.startswith("error: ") and "Traceback" not in result.stderr, result.stderr[-3000:]
    return last.removeprefix("error: ")


def manifests(folder: Path) -> dict[str, str]:
    """Digest of every stage manifest but publish's, whose timings differ from run to run."""
    return {
        path.parent.name: hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.glob("results/*/*/manifest.json"))
        if path.parent.name not in ("publish", "report")
    }


def treatment(case: str) -> str:
    """The text that tests/unit/bad_input.md has for a case."""
    page = Path(__file__).resolve().parents[1] / "unit/bad_input.md"
    for line in page.read_text().splitlines():
        match = re.fullmatch(r"\| (.+?) \| `(.+)` \|", line)
        if match and match[1] == case:
            return match[2]
    raise AssertionError(f"tests/unit/bad_input.md has no row for {case!r}")


class Workflow:
    """A folder with scenes, and Snakemake run in it as a user would."""

    def __init__(self, repository: Path, folder: Path):
        self.repository, self.folder = repository, folder

    def write(self, scene: str, text: str) -> None:
        path = self.folder / "config/scenes" / f"{scene}.yaml"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)

    def write_quality(self, quality: str, text: str) -> None:
        path = self.folder / "config/quality" / f"{quality}.yaml"
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
