"""What people put into `scenes/<scene>/` survives a new deliverable: it is carried from the old folder into the new one.

Names that a manifest lists are the workflow's own; everything else belongs to the user.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from itertools import count
from pathlib import Path

from iif_core.errors import InputError
from workflow.artifacts import manifest as manifests
from workflow.artifacts.files import facts_in, flush_folder
from workflow.artifacts.manifest import MANIFEST, SCENE_SCHEMA

OF_SNAKEMAKE = ".snakemake_timestamp"
"""What Snakemake leaves in a folder that is an output."""


def carry(old: Path, target: Path) -> list[str]:
    """Move what is the user's from the folder that a deliverable replaces into the deliverable, and return the new names.

    Nothing is replaced: what has the name of a file that is there gets `.own` in its own, `scene.own.glb`, or `scene.own2.glb`.
    Of a folder without a readable manifest the record of the stage, and the new manifest, tell what was the workflow's.
    """
    if not old.is_dir() or not target.is_dir():
        return []
    listed = {MANIFEST, OF_SNAKEMAKE} | (_listed(old) or _recorded(target) | _listed(target))
    moved = []
    for name in _names(old):
        if name in listed:
            continue
        place = _free(target, name)
        place.parent.mkdir(parents=True, exist_ok=True)
        os.rename(old / name, place)
        flush_folder(place.parent)
        moved.append(place.relative_to(target).as_posix())
    return moved


def _listed(folder: Path) -> set[str]:
    try:
        return set(manifests.read(folder / MANIFEST, SCENE_SCHEMA)["files"])
    except (manifests.Broken, InputError, OSError):
        return set()


def _recorded(target: Path) -> set[str]:
    return set(facts_in(Path("results") / target.name / "publish" / "published.json").get("files", {}))


def _free(target: Path, name: str) -> Path:
    """A path below `target` where nothing is: the name, with `.own` in each part of it that something else has taken."""
    *folders, last = Path(name).parts
    place = target
    for folder in folders:
        place = next(path for path in _alternatives(place / folder) if path.is_dir() or not os.path.lexists(path))
    return next(path for path in _alternatives(place / last) if not os.path.lexists(path))


def _alternatives(path: Path) -> Iterator[Path]:
    """`scene.glb`, `scene.own.glb`, `scene.own2.glb` and so on."""
    yield path
    for number in count(1):
        yield path.with_name(f"{path.stem}.own{number if number > 1 else ''}{path.suffix}")


def _names(folder: Path) -> list[str]:
    """Names of the files and links below a folder."""
    below = (Path(root) / name for root, _, names in os.walk(folder) for name in names)
    links = (Path(root) / name for root, folders, _ in os.walk(folder) for name in folders if (Path(root) / name).is_symlink())
    return sorted(path.relative_to(folder).as_posix() for path in (*below, *links))
