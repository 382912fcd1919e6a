"""What an unknown target or profile was probably meant to be."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from pathlib import Path

from iif_core.errors import InputError
from workflow.registry import STAGES
from workflow.settings import batch_table
from workflow.settings.names import SCENE_NAME, did_you_mean, did_you_mean_path, scene_names

FOLDERS = ("scenes", "plan", "bench", "relight", "score")
"""Folders of targets that are named after one scene."""


def refuse_target(target: str, rules: Iterable[str], root: Path = Path(".")) -> None:
    """Say that nothing makes `target`, which targets there are, and which of them it resembles.

    Args:
        target: a file, a folder, or what was taken for the name of a rule.
        rules: names of the rules, which `--forcerun` and some others take.
        root: the working folder.

    Raises:
        InputError: always.
    """
    scenes = [*scene_names(root), *(line.name for line in batch_table.read_table(root))]
    hint = _meant(target, list(dict.fromkeys(scenes)), list(rules))
    raise InputError(
        f"{target}: no rule makes this.{hint} Targets are scenes/<name>, plan/<name>, bench/<name> and relight/<name> with the"
        " name of one scene (letters, digits, _ and -), relight/<name>/<plan> with a plan of config/relight/, score/<name>,"
        " compare/<a>,<b> with the names of two results, results/<name>/<stage>/manifest.json, `scenes` and `verify`;"
        " docs/reference/commands.md lists them, and `snakemake --list` the rules that `--forcerun` takes."
    )


def refuse_profile(given: str, start: Path, checkout: Path) -> None:
    """Refuse a `--workflow-profile` that is not there, which Snakemake passes over without a word.

    Args:
        given: as written on the command line.
        start: the folder that it was written in.
        checkout: folder of the Snakefile.

    Raises:
        InputError: there is no such profile at any place where Snakemake looks.
    """
    places = (start / given, start / "profiles" / given, checkout / "profiles" / given)
    if given == "none" or any(path.exists() for path in places):
        return
    ours = sorted(path.parent for path in checkout.glob("workflow/profiles/*/*.yaml"))
    named = [os.path.relpath(path, start) if path.is_relative_to(start) else str(path) for path in ours]
    hint = did_you_mean(given, named) or did_you_mean_path(start / given)
    raise InputError(
        f"--workflow-profile {given}: not found; a relative path counts from {start}.{hint} Those of the workflow are"
        f" {', '.join(named)}."
    )


def _meant(target: str, scenes: list[str], rules: list[str]) -> str:
    parts = Path(target).parts or (target,)
    if parts[0] in FOLDERS and len(parts) > 1 and parts[1] in scenes and not re.fullmatch(SCENE_NAME, parts[1]):
        return f" A scene cannot be called {parts[1]!r}: rename config/scenes/{parts[1]}.yaml."
    if target == "status":
        return " Ask `python -m workflow status`, which needs no Snakemake."
    if target in scenes:
        return f" Did you mean scenes/{target}?"
    if parts[0] == "compare":
        other = next((scene for scene in scenes if scene not in parts[1:]), "other")
        return f" It needs the names of two results, such as compare/{parts[-1] if len(parts) > 1 else 'kitchen'},{other}."
    if parts[:2] == ("results", "studies"):
        return " Studies have a Snakefile to themselves."
    if parts[0] == "results" and len(parts) > 2:
        stages = [f"results/{parts[1]}/{stage}/manifest.json" for stage in STAGES if stage != "publish"]
        same = [path for path in stages if Path(path).parts[2] == parts[2]]
        return f" Did you mean {same[0]}?" if same else did_you_mean(target, stages)
    if parts[0] in FOLDERS and len(parts) > 1 and parts[1] in scenes:
        return f" Did you mean {parts[0]}/{parts[1]}?"
    known = [f"{folder}/{scene}" for folder in FOLDERS for scene in scenes]
    nearest = did_you_mean(target, known) if len(parts) > 1 else did_you_mean(target, rules)
    return nearest or did_you_mean(target, [*known, *rules]) or did_you_mean(target, scenes, "scenes/{}")
