"""Helpers of the workflow tests."""

import hashlib
import re
import subprocess
from pathlib import Path


def planned(result: subprocess.CompletedProcess) -> set[str]:
    """Rules in the job table of a dry run."""
    table = (result.stdout + result.stderr).partition("Job stats:")[2].partition("total")[0]
    return set(re.findall(r"^(\w+) +\d+ *$", table, re.M)) - {"scenes"}


def manifests(folder: Path) -> dict[str, str]:
    """Digest of every stage manifest but publish's, whose timings differ from run to run."""
    return {
        path.parent.name: hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.glob("results/*/*/manifest.json"))
        if path.parent.name not in ("publish", "report")
    }


def treatment(case: str) -> str:
    """The text that docs/bad-input.md promises for a case."""
    page = Path(__file__).resolve().parents[2] / "docs/bad-input.md"
    for line in page.read_text().splitlines():
        match = re.fullmatch(r"\| (.+?) \| `(.+)` \|", line)
        if match and match[1] == case:
            return match[2]
    raise AssertionError(f"docs/bad-input.md has no row for {case!r}")
