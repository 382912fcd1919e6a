"""Source `photographs`: photographs and nothing else; stage reconstruction finds their cameras and a mesh
(docs/guide/programs.md#photographs-alone)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from iif_core.errors import InputError
from workflow.artifacts.store import StageReader
from workflow.intake.names import same_name
from workflow.runtime.job import Job
from workflow.settings.source import FolderSource
from workflow.sources import folder
from workflow.sources.folder_scene import images, transforms
from workflow.sources.folder_scene.entries import evenly_spread, one_range, without_raws
from workflow.sources.folder_scene.frames import checked_frames, files_below, folder_at
from workflow.sources.folder_scene.inputs import Inputs

CAMERAS, MESH, POINTS = "transforms.json", "mesh.ply", "points.parquet"
"""What stage reconstruction writes: a folder scene, but for the photographs, and the points that they share."""
LEAST = 3
SEEN_POINTS = 2000  # of a photograph that are kept to check the mesh


def raw_inputs(document: dict[str, Any]) -> list[Path]:
    """List the photographs, after checking their headers; none of a scene of another kind.

    Raises:
        InputError: too few, or one that cannot be read.
    """
    source = document["source"]
    if source["kind"] != "photographs":
        return []
    root = folder_at(source, "photographs")
    names = chosen(root, source["most"])
    one_range(root, [root / name for name in names], document["capture"]["dynamic_range"])
    return [root / name for name in names]


def chosen(root: Path, most: int) -> list[str]:
    """Return the names of the photographs that are used, sorted, at most `most`, evenly spread.

    Raises:
        InputError: too few, or one that cannot be read.
    """
    found = files_below(root, images.EXTENSIONS)
    found = [path for path in found if "masks" not in path.relative_to(root).parts[:-1] and not _hidden(path, root)]
    found = without_raws(found)
    if len(found) < LEAST:
        kinds = ", ".join(images.EXTENSIONS)
        raise InputError(f"{root}: {len(found)} photographs ({kinds}); at least {LEAST} are needed, some dozens are better")
    taken = [found[i] for i in evenly_spread(len(found), most)]
    seen: dict[tuple[str, str], Path] = {}
    for path in taken:
        other = seen.setdefault((path.parent.as_posix(), same_name(path.stem)), path)
        if other is not path:
            raise InputError(
                f"{root}: {other.name} and {path.name} in {path.parent.name}/ would both be view {path.stem!r}; of a photograph"
                " that is there in two formats, move one away, or rename it"
            )
    for path in taken:
        images.header(path)
    return [path.relative_to(root).as_posix() for path in taken]


def _hidden(path: Path, root: Path) -> bool:
    """Return whether a name begins with a dot, as those of the files that macOS leaves beside others."""
    return any(part.startswith(".") for part in path.relative_to(root).parts)


def capture(job: Job) -> None:
    """Write the normal form of the photographs, with the cameras and the mesh that were found."""
    folder.capture_photographs(job, _inputs(job.read("reconstruction"), vars(job.settings.source), vars(job.settings.capture)))


def _inputs(made: StageReader, source: dict[str, Any], settings: dict[str, Any]) -> Inputs:
    root = folder_at(source, "photographs")
    own = FolderSource(kind="folder", path=root).model_dump() | source
    path = made.path(CAMERAS)
    document = transforms.load(path)
    entries = transforms.entries_of(path, document)
    table = made.table(POINTS)
    points, view = np.stack([table[c] for c in "xyz"], 1).astype(np.float64), table["view"]
    seen = [points[view == i] for i in range(len(entries))]
    seen = [own_points[:: max(1, len(own_points) // SEEN_POINTS)] for own_points in seen]
    entries = [replace(entry, seen=own_points) for entry, own_points in zip(entries, seen, strict=True)]
    listed = checked_frames(path, document, entries, root, own, settings)
    facts = made.json("reconstruction.json")
    return Inputs(replace(listed, known=True, notes=tuple(facts["notes"])), made.path(MESH))
