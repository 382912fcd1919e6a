"""A new deliverable takes the place of the earlier one, of which nothing is lost if the job is killed between.

The earlier folder is set aside under another name, the new one is renamed, and the earlier one is removed. Whoever publishes next
first brings back what a killed job left aside.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from workflow.artifacts import manifest as manifests
from workflow.artifacts.files import flush_folder
from workflow.artifacts.kept import carry
from workflow.artifacts.manifest import MANIFEST, SCENE_SCHEMA
from workflow.artifacts.sound import wrong_files


def set_aside(target: Path) -> Path:
    """Return where the folder that a deliverable replaces is while that is renamed."""
    return target.with_name(f".{target.name}.old")


def bring_back(target: Path) -> None:
    """Rename a deliverable that was set aside to its place, if publishing was killed before the new one was there."""
    old = set_aside(target)
    if not old.is_dir() or target.exists():
        return
    try:
        whole = next(wrong_files(old, manifests.read(old / MANIFEST, SCENE_SCHEMA)), None) is None
    except manifests.Broken:
        return  # what was left when it was being removed
    if whole:
        os.rename(old, target)
        flush_folder(target.parent)


def replace(temporary: Path, target: Path) -> list[str]:
    """Rename a folder into the place of a deliverable; carry over what the user has put there, and return its names.

    At every moment, and after a power cut at any, the old folder or the new one is complete, here or set aside, and whatever is
    the user's is in one of them.
    """
    old = set_aside(target)
    carry(old, target)  # of a job that was killed below
    _discard(old)
    if target.exists():
        os.rename(target, old)
        flush_folder(target.parent)
    os.rename(temporary, target)
    flush_folder(target.parent)
    own = carry(old, target)
    _discard(old)
    return own


def _discard(old: Path) -> None:
    """Remove a folder that was set aside, its manifest first, so that what is left of it is not taken for whole."""
    if old.is_dir():
        (old / MANIFEST).unlink(missing_ok=True)
        flush_folder(old)
    shutil.rmtree(old, ignore_errors=True)
