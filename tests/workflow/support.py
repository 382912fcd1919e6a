"""Helpers of the workflow tests."""

import hashlib
import re
from pathlib import Path


def planned(stderr: str) -> set[str]:
    """Rules that a dry run would execute."""
    return set(re.findall(r"^(?:local)?rule (\w+):", stderr, re.M)) - {"scenes"}


def manifests(folder: Path) -> dict[str, str]:
    """Digest of every stage manifest but publish's, whose timings differ from run to run."""
    return {
        path.parent.name: hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.glob("results/*/*/manifest.json"))
        if path.parent.name not in ("publish", "report")
    }
