"""What people put into `scenes/<scene>/` survives a new deliverable: it is set apart before, and put back after.

Snakemake removes the folder before the job that publishes it, so a hook of the workflow sets apart, and the job puts back, or a
hook where it failed. Names that the manifest lists are the workflow's own.
"""

from __future__ import annotations

import os
from pathlib import Path

from iif_core.errors import InputError
from workflow.artifacts import manifest as manifests
from workflow.artifacts.files import facts_in, flush_folder
from workflow.artifacts.manifest import MANIFEST, SCENE_SCHEMA


def place_of(target: Path) -> Path:
    """Return where files are while the deliverable `target` is made anew."""
    return target.with_name(f".{target.name}.own")


def set_apart(target: Path) -> list[str]:
    """Move what the manifest of a deliverable does not list to its place, and return the names.

    Of a folder without a readable manifest the record of the stage tells what is listed.
    """
    try:
        listed = manifests.read(target / MANIFEST, SCENE_SCHEMA)["files"]
    except (manifests.Broken, InputError, OSError):
        listed = facts_in(Path("results") / target.name / "publish" / "published.json").get("files", {})
    listed = {MANIFEST, *listed}
    found = sorted(name for name in _names(target) if name not in listed)
    for name in found:
        _move(target, place_of(target), name)
    _prune(target)
    return found


def put_back(target: Path) -> list[str]:
    """Move what was set apart back into a deliverable, and return the names.

    What has the name of one of its own files gets `.own` in its name: `scene.own.glb`.
    """
    place = place_of(target)
    found = _names(place)
    for name in found:
        _move(place, target, name, own=os.path.lexists(target / name))
    _prune(place)
    if place.is_dir():
        place.rmdir()
    return found


def _names(folder: Path) -> list[str]:
    """Names of the files and links below a folder."""
    below = (Path(root) / name for root, _, names in os.walk(folder) for name in names)
    links = (Path(root) / name for root, folders, _ in os.walk(folder) for name in folders if (Path(root) / name).is_symlink())
    return sorted(path.relative_to(folder).as_posix() for path in (*below, *links))


def _move(source: Path, target: Path, name: str, own: bool = False) -> None:
    place = target / name
    place = place.with_name(f"{place.stem}.own{place.suffix}") if own else place
    place.parent.mkdir(parents=True, exist_ok=True)
    os.replace(source / name, place)
    flush_folder(place.parent)


def _prune(folder: Path) -> None:
    """Remove empty folders below a folder."""
    for root, folders, _ in os.walk(folder, topdown=False):
        for name in folders:
            below = Path(root) / name
            if not below.is_symlink() and not any(below.iterdir()):
                below.rmdir()
