"""Plans of relightings, `config/relight/<plan>.yaml`, which any scene can have."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from iif_core.errors import InputError
from workflow.settings.names import configuration, did_you_mean
from workflow.settings.yaml_file import read_yaml

FOLDER = Path("config/relight")
EXAMPLE = "example"
"""Plan of scenes that have none of their own."""
KEYS = ("title", "relight")


def plan_names(root: Path = Path(".")) -> list[str]:
    """Return the name of every plan that has a file, sorted."""
    return sorted(path.stem for path in configuration("relight", root).glob("*.yaml"))


def active_plan(scene: str, root: Path = Path(".")) -> str:
    """Return the plan of a scene whose file has no relightings: the plan with the name of the scene, otherwise the example."""
    return scene if scene in plan_names(root) else EXAMPLE


def plan_layer(plan: str, root: Path = Path(".")) -> tuple[str, dict[str, Any]]:
    """Return (place, settings) of a plan, which replace the relightings of a scene. The entries are checked with the scene.

    Raises:
        InputError: there is no such plan, or its file is no list of relightings.
    """
    names, shown = plan_names(root), FOLDER / f"{plan}.yaml"
    if plan not in names:
        raise InputError(
            f"{shown}: not found.{did_you_mean(plan, names)} Known plans of relightings: {', '.join(names) or 'none'}"
            " (docs/guide/relighting.md)."
        )
    document = read_yaml(configuration("relight", root) / shown.name)
    unknown = [key for key in document if key not in KEYS]
    if unknown:
        hint = did_you_mean(unknown[0], KEYS, "`{}`")
        raise InputError(f"{shown}: `{unknown[0]}`: unknown key.{hint} Allowed here: {', '.join(KEYS)}.")
    listed, title = document.get("relight"), document.get("title", "")
    if not isinstance(listed, list) or not listed:
        found = f"found {listed!r}" if listed else "no relightings"
        raise InputError(f"{shown}: `relight`: {found}; needed is a list of them, as in {FOLDER / 'kitchen.yaml'}")
    if not isinstance(title, str):
        raise InputError(f"{shown}: `title`: found {title!r}, needed text; write it in quotes")
    folder = configuration("relight", root)
    return str(shown), {"relight_title": title, "relight": [_beside(entry, folder) for entry in listed]}


def _beside(entry: Any, folder: Path) -> Any:
    """Return an entry with the paths of its files; those that are not in the working folder are looked for next to the plan. The
    check of the settings handles what is no entry."""
    if not isinstance(entry, dict):
        return entry
    out = dict(entry)
    if isinstance(out.get("environment"), str):
        out["environment"] = _place(out["environment"], folder)
    if isinstance(out.get("insert"), list):
        moved = [
            {**one, "file": _place(one["file"], folder)} if isinstance(one, dict) and "file" in one else one
            for one in out["insert"]
        ]
        out["insert"] = moved
    return out


def _place(name: Any, folder: Path) -> Any:
    if not isinstance(name, str) or name in ("keep", "off") or Path(name).exists() or not (folder / name).is_file():
        return name
    return str(folder / name)
