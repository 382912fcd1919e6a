"""What an unknown target, profile or name of `--set-scatter` was probably meant to be."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from iif_core.errors import InputError
from workflow.registry import STAGES
from workflow.settings import batch_table
from workflow.settings.names import did_you_mean, did_you_mean_path, scene_names

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
    hint = _meant(target, list(dict.fromkeys(scenes)), list(rules), root)
    raise InputError(
        f"{target}: no rule makes this.{hint} Targets are scenes/<name>, plan/<name>, bench/<name> and relight/<name> with the"
        " name of one scene (letters, digits, _ and -), relight/<name>/<plan> with a plan of config/relight/, score/<name>,"
        " compare/<a>,<b> with the names of two results, results/<name>/<stage>/manifest.json, `scenes`, `status` and `verify`;"
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


def refuse_scatter(given: Mapping[str, int], known: Sequence[str]) -> None:
    """Refuse a name of `--set-scatter` that nothing is scattered by, which Snakemake passes over without a word, and no parts.

    Raises:
        InputError: there is one.
    """
    for name, parts in given.items():
        if parts < 1:
            raise InputError(f"--set-scatter {name}={parts}: needs a number of parts, at least 1.")
        if name not in known:
            hint = did_you_mean(name, known)
            raise InputError(f"--set-scatter {name}: nothing is scattered by this name.{hint} Known: {', '.join(known)}.")


def _meant(target: str, scenes: list[str], rules: list[str], root: Path) -> str:
    parts = Path(target).parts or (target,)
    if parts[0] in FOLDERS and len(parts) > 1 and parts[1] in scenes:
        return f" Did you mean {parts[0]}/{parts[1]}?"
    if parts[0] == "compare":
        other = next((scene for scene in scenes if scene not in parts[1:]), "other")
        return f" It needs the names of two results, such as compare/{parts[-1] if len(parts) > 1 else 'kitchen'},{other}."
    if parts[0] in scenes:
        return f" Did you mean scenes/{parts[0]}?"
    if parts[0] in FOLDERS and len(parts) > 1:
        return did_you_mean(parts[-1], scenes, parts[0] + "/{}") or did_you_mean(parts[1], scenes, parts[0] + "/{}")
    if parts[:2] == ("results", "studies"):
        return " Studies have their own Snakefile, see lab/docs/studies.md."
    if parts[0] == "results" and len(parts) > 2:
        stages = [f"results/{parts[1]}/{stage}/manifest.json" for stage in STAGES if stage != "publish"]
        same = [path for path in stages if Path(path).parts[2] == parts[2]]
        return f" Did you mean {same[0]}?" if same else did_you_mean(target, stages)
    if len(parts) == 1:
        return did_you_mean(target, rules) or did_you_mean(target, scenes, "scenes/{}")
    return did_you_mean(target, [f"scenes/{scene}" for scene in scenes])
