"""Names of qualities and scenes, where their files lie, and what an unknown name was probably meant to be."""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Iterable
from pathlib import Path

from workflow import plugins

REPOSITORY = Path(__file__).resolve().parents[2]
QUALITIES = ("draft", "standard", "paper")
DEFAULT = "draft"
"""Quality of what is given none."""
SCENE_NAME = r"[A-Za-z0-9][A-Za-z0-9_-]*"
"""What a scene may be called: its name is a folder, a target of Snakemake and part of the names of variants."""
LONG = 200
"""Characters from which nothing similar is looked for."""
MANY = 10_000
"""Files of a folder among which a similar name is looked for."""
EXAMPLES = "examples"
"""Folder of the repository with scenes that anyone can run."""
RESERVED = ("batch", "studies", "weights")
"""Folders of results/ that do not belong to a scene."""


def configuration(part: str, root: Path = Path(".")) -> Path:
    """Return `config/<part>` of the working folder where it exists, otherwise `config/<part>` of the repository.

    A working folder that has a `config/scenes/` uses only the scenes in it. The paths inside a scene file always count from the
    working folder.
    """
    own = root / "config" / part
    return own if own.exists() else REPOSITORY / "config" / part


def data_folder(path: str) -> Path:
    """Return a folder that a scene file names. It counts from the working folder; where there is none, `examples/...` is an
    example that comes with the repository."""
    given, shipped = Path(path), REPOSITORY / path
    example = given.parts[:1] == (EXAMPLES,) and ".." not in given.parts
    return shipped if example and not given.exists() and shipped.is_dir() else given


def quality_names(root: Path = Path(".")) -> list[str]:
    """Return every quality: the named ones, then the points of the front, and those of the working folder."""
    folders = (REPOSITORY / "config/quality", root / "config/quality")
    found = {path.stem for folder in folders for path in folder.glob("*.yaml") if re.fullmatch(SCENE_NAME, path.stem)}
    return [*QUALITIES, *sorted(found - set(QUALITIES))]


def _scene_folders(root: Path) -> list[Path]:
    """Return the folders with scene files: that of the working folder, or those of the repository and of its plug-ins."""
    first = configuration("scenes", root)
    shipped = first.resolve() == REPOSITORY / "config/scenes"
    added = plugins.named("SCENES") if shipped else []
    return [first, *(root / folder if (root / folder).is_dir() else REPOSITORY / folder for folder in added)]


def scene_path(scene: str, root: Path = Path(".")) -> Path:
    """Return where the file of a scene lies, or would lie."""
    paths = [folder / f"{scene}.yaml" for folder in _scene_folders(root)]
    # Not `Path.is_file`, which raises where a name is longer than a file system takes.
    return next((path for path in paths if os.path.isfile(path)), paths[0])


def scene_names(root: Path = Path(".")) -> list[str]:
    """Return the name of every scene that has a file, sorted."""
    return sorted({path.stem for folder in _scene_folders(root) for path in folder.glob("*.yaml")})


def did_you_mean(name: object, known: Iterable[str], form: str = "{}") -> str:
    """Return ` Did you mean X?` for the known name that is most similar to `name`; empty if none is similar.

    >>> did_you_mean("kichen", ["kitchen", "hall"], "scenes/{}")
    ' Did you mean scenes/kitchen?'
    """
    near = difflib.get_close_matches(str(name), list(known), 1) if len(str(name)) < LONG else []
    return f" Did you mean {form.format(near[0])}?" if near else ""


def did_you_mean_path(path: Path) -> str:
    """Return ` Did you mean X?` where the folder of the first missing part of `path` holds a similar name, or the hint for a `~`;
    otherwise empty."""
    if path.parts[:1] and path.parts[0].startswith("~"):
        return " `~` is not expanded here; write the whole path."
    missing = path
    try:
        while not missing.parent.exists():
            missing = missing.parent
        beside = sorted(os.listdir(missing.parent))[:MANY]
    except (OSError, ValueError):
        return ""
    if len(missing.name) >= LONG:
        return ""
    near = difflib.get_close_matches(missing.name, beside, 1)
    if not near:
        return ""
    found = missing.parent / near[0]
    whole = found / path.relative_to(missing)
    return f" Did you mean {whole if whole.exists() else found}?"
