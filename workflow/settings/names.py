"""Names of scenes and qualities, and which scenes have a file."""

from __future__ import annotations

from pathlib import Path

QUALITIES = ("draft", "standard", "paper")
SCENE_NAME = r"[A-Za-z0-9][A-Za-z0-9_-]*"
"""What a scene may be called: its name is a folder, a target of Snakemake and part of the names of variants."""
RESERVED = ("batch", "studies", "weights")
"""Folders of results/ that are no scene's."""


def scene_names(root: Path = Path(".")) -> list[str]:
    """Every scene that has a file."""
    return sorted(path.stem for path in (root / "config/scenes").glob("*.yaml"))
