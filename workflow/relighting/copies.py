"""The folder relight/: copies of the pictures of relightings, those of a scene and those of plans that any scene can have."""

from __future__ import annotations

import json
from pathlib import Path

from iif_core.errors import InputError
from workflow.artifacts import StageReader, links
from workflow.artifacts.files import copy, flush_folders, inside, make_folder
from workflow.runtime import fingerprint as fp
from workflow.settings import active_plan, plan_names
from workflow.settings.derived import RELIGHT, scene_of

TARGET = Path("relight")


def source(scene: str, plan: str, quality: str) -> str:
    """Return the scene in whose folder the relightings are made: the scene itself, or for a plan the derived one.

    Args:
        scene: name of a scene; plan: of config/relight/, or "" for what the file of the scene lists, or where that lists nothing
            for its active plan; quality: of the settings.

    Raises:
        InputError: there is no such plan, or the scene has a relighting of that name, whose folder the plan would take.
    """
    listed = [entry["name"] for entry in json.loads(fp.resolved(scene, quality))["relight"]]
    if not plan:
        return scene if listed else scene_of(RELIGHT, scene, active_plan(scene), 0)
    if plan in listed and plan in plan_names():
        raise InputError(
            f"relight/{scene}/{plan}: {plan} is a relighting of the scene and a plan, which would share this folder; rename one"
        )
    return scene_of(RELIGHT, scene, plan, 0)


def deliver(scene: str, plan: str, quality: str) -> None:
    """Copy the pictures to relight/<scene>, with those of all plans that are finished, or to relight/<scene>/<plan>.

    The folder of the scene is made anew by Snakemake, so that the folders of plans in it are as well.
    """
    if plan:
        _copy(source(scene, plan, quality), TARGET / scene / plan)
        return
    own = source(scene, "", quality)
    _copy(own, TARGET / scene)
    for name in plan_names():
        derived = scene_of(RELIGHT, scene, name, 0)
        if derived != own and Path(f"results/{derived}/relight/manifest.json").is_file():
            _copy(derived, TARGET / scene / name)


def _copy(scene: str, target: Path) -> None:
    for folder in (target.parent, target):  # of the scene and, for a plan, its own
        if folder != TARGET and folder.is_symlink():
            raise links.refused(folder)
    reader = StageReader(Path("results") / scene / "relight", "relight", scene)
    make_folder(target)
    for name in reader.manifest["files"]:
        copy(reader.path(name), inside(target, name))
    flush_folders(target)
