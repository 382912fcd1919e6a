"""What the settings call by name: objects of the segmentation."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

from iif_core.errors import InputError
from workflow.artifacts import StageReader
from workflow.registry import upstream_of
from workflow.runtime import fingerprint as fp
from workflow.runtime.job import Job
from workflow.settings import scene_origin
from workflow.settings.names import did_you_mean

OUTSIDE = "light from outside"
"""What people read for the light that the environment sends in."""


def object_number(key: object, names: list[str], where: str, new: Iterable[str] = ()) -> int:
    """Return the id of the object that a key of the settings means: its name, or else its id, alone or as `piece 24`; `new`:
    names that people gave, which may be meant.

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
    every = [*dict.fromkeys(new), *names]
    hint = did_you_mean(text, every, "{!r}")
    words = set(text.lower().split())
    every.sort(key=lambda name: not words & set(name.lower().split()))  # for "wall", the walls first
    listed = ", ".join(every[:8]) + (" ..." if len(every) > 8 else "")
    ids = f"an id (0 to {len(names) - 1})" if names else "an id"
    raise InputError(f"{where}: there is no object {text!r}.{hint} Allowed: {ids} or a name of objects.csv, such as {listed}")


@lru_cache(None)
def check_overrides(stage: str, scene: str, quality: str) -> None:
    """Check the objects that `materials` and `names` name, once the segmentation is known. Every later stage checks them before
    its work, not only stage `affines`, which is the first to use them.

    Raises:
        InputError: as `object_number`.
    """
    document = json.loads(fp.resolved(scene, quality))
    wanted, new = document["materials"], document["names"]
    if not (wanted or new) or "segmentation" not in upstream_of(stage):
        return
    reader = finished("segmentation", scene, quality)
    if reader is not None:
        names = object_names(reader)
        for key in wanted:
            object_number(key, names, f"{scene_origin(scene)}: `materials`", new.values())
        renamed(names, new, f"{scene_origin(scene)}: `names`")


def object_names(segmentation: StageReader, n_objects: int | None = None) -> list[str]:
    """Return the name of every object id, of `n_objects` or of those in the table; `object<id>` where it has none."""
    table = segmentation.table("objects.parquet")
    count = int(table["object_id"].max(initial=-1)) + 1 if n_objects is None else n_objects
    names = [f"object{i}" for i in range(count)]
    for i, name in zip(table["object_id"], table["name"], strict=True):
        names[int(i)] = str(name)
    return names


def renamed(names: list[str], wanted: dict[str, str], where: str = "`names`") -> list[str]:
    """Return the names of objects with those of the setting `names` in their place.

    Raises:
        InputError: there is no such object, two keys mean one, or another object has a new name already.
    """
    out, given = list(names), {}
    for key, name in wanted.items():
        number = object_number(key, names, where)
        if number in given:
            raise InputError(f"{where}: {given[number]!r} and {key!r} are the same object; keep one of the two lines")
        out[number], given[number] = name, key
    for number, name in enumerate(out):
        if number not in given and name in wanted.values():
            raise InputError(f"{where}: object {number} is called {name!r} already; choose another name, or rename that too")
    return out


def new_names(job: Job) -> dict[str, str]:
    """Return the setting `names`; nothing in stages that do not read it, so that they do not run again for a name."""
    return vars(job.settings.names) if "names" in job.stage.settings else {}


def shown_names(job: Job, n_objects: int | None = None) -> list[str]:
    """Return the names of all objects as people see them, in stages that read the setting `names`."""
    return renamed(object_names(job.read("segmentation"), n_objects), new_names(job))


def finished(stage: str, scene: str, quality: str) -> StageReader | None:
    """Return the reader of a stage if it is finished under these settings and this code; None otherwise."""
    home = fp.home(stage, scene, quality)
    folder = Path("results") / home / stage
    try:
        reader = StageReader(folder, stage, home)
    except InputError:
        return None
    return reader if reader.fingerprint == fp.fingerprint(stage, scene, quality) else None
