"""What the settings call by name: objects of the segmentation."""

from __future__ import annotations

import json
import re
from functools import lru_cache
from pathlib import Path

from iif_core.errors import InputError
from workflow.artifacts import StageReader
from workflow.registry import upstream_of
from workflow.runtime import fingerprint as fp
from workflow.settings import scene_origin
from workflow.settings.names import did_you_mean


def object_number(key: object, names: list[str], where: str) -> int:
    """Return the id of the object that a key of the settings means: its name, or else its id, alone or as `piece 24`.

    Raises:
        InputError: there is no such object, or several have this name; `where` is the setting, for the message.
    """
    text = str(key)
    found = [i for i, name in enumerate(names) if name == text]
    if len(found) == 1:
        return found[0]
    if len(found) > 1:
        raise InputError(f"{where}: {text!r} is the name of {len(found)} objects; name it by its id, one of {found}")
    number = re.fullmatch(r"(?:(?:piece|object) )?(\d+)", text)
    if number and int(number[1]) < len(names):
        return int(number[1])
    hint = did_you_mean(text, names, "{!r}")
    listed = ", ".join(names[:8]) + (" ..." if len(names) > 8 else "")
    raise InputError(f"{where}: there is no object {text!r}.{hint} Allowed: a name or an id of objects.parquet, such as {listed}")


@lru_cache(None)
def check_overrides(stage: str, scene: str, quality: str) -> None:
    """Check the objects that `materials` names, once the segmentation is known. Every later stage checks them before its work,
    not only stage `affines`, which is the first to use them.

    Raises:
        InputError: as `object_number`.
    """
    wanted = json.loads(fp.resolved(scene, quality))["materials"]
    if not wanted or "segmentation" not in upstream_of(stage):
        return
    reader = finished("segmentation", scene, quality)
    if reader is not None:
        names = object_names(reader)
        for key in wanted:
            object_number(key, names, f"{scene_origin(scene)}: `materials`")


def object_names(segmentation: StageReader, n_objects: int | None = None) -> list[str]:
    """Return the name of every object id, of `n_objects` or of those in the table; `object<id>` where it has none."""
    table = segmentation.table("objects.parquet")
    count = int(table["object_id"].max(initial=-1)) + 1 if n_objects is None else n_objects
    names = [f"object{i}" for i in range(count)]
    for i, name in zip(table["object_id"], table["name"], strict=True):
        names[int(i)] = str(name)
    return names


def finished(stage: str, scene: str, quality: str) -> StageReader | None:
    """Return the reader of a stage if it is finished under these settings and this code; None otherwise."""
    home = fp.home(stage, scene, quality)
    folder = Path("results") / home / stage
    try:
        reader = StageReader(folder, stage, home)
    except InputError:
        return None
    return reader if reader.fingerprint == fp.fingerprint(stage, scene, quality) else None
