"""The results that two names stand for, and digests of what is compared; light enough for the Snakefile to import."""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass
from pathlib import Path

from iif_core.errors import InputError
from workflow.artifacts import StageReader
from workflow.artifacts.files import facts_in, sha256_of
from workflow.artifacts.store import MANIFEST
from workflow.artifacts.verify import with_artefacts
from workflow.registry import STAGES
from workflow.runtime import fingerprint as fp
from workflow.settings import derived
from workflow.settings.names import did_you_mean

QUANTITIES = ("albedo", "roughness", "metallic", "emission", "rgb")
"""Folders of somebody's maps."""
NEEDED = ("capture", "segmentation", "base", "affines")
"""Stages without which there is no result to compare; the others are compared where both have them."""


@dataclass(frozen=True)
class Result:
    """One result: its name, and the readers of the stages that it has."""

    name: str
    stages: dict[str, StageReader]

    def __getitem__(self, stage: str) -> StageReader:
        return self.stages[stage]

    @property
    def folders(self) -> list[str]:
        """Folders under results/ in which its stages lie."""
        return sorted({reader.directory.parent.name for reader in self.stages.values()})

    @property
    def quality(self) -> str:
        return str(self["affines"].manifest.get("quality", ""))


def open_result(name: str, quality: str = "draft") -> Result:
    """Return the readers of the finished stages of a result.

    Args:
        name: of a scene or a variant.
        quality: for variants of a study, whose stages may lie in the folder of another.

    Raises:
        InputError: no such result, or one that is not finished as far as it must be.
    """
    known = [one for one in with_artefacts() if Path("results", one).is_dir()]
    folders = [name]
    if derived.derived(name):
        folders += derived.bases(name)
    stages = {}
    for stage in STAGES:
        home = _home(stage, name, folders, quality)
        if home:
            folder = Path("results") / home / stage
            stages[stage] = StageReader(folder, stage, _scene_in(folder) or home)
    missing = [stage for stage in NEEDED if stage not in stages]
    if not stages:
        raise InputError(
            f"results/{name}: nothing there to compare.{did_you_mean(name, known)} What is here:"
            f" {', '.join(known[:20]) or 'nothing'}. `snakemake --cores 2 scenes/{name}` makes a scene"
        )
    if missing:
        raise InputError(
            f"results/{name}: without {', '.join(missing)}, so there is no result to compare yet; make it with"
            f" `snakemake --cores 2 scenes/{name}`"
        )
    return Result(name, stages)


def _scene_in(folder: Path) -> str | None:
    """Return the scene that a manifest names: a result that was copied to keep it under another name can be compared."""
    found = facts_in(folder / MANIFEST).get("scene")
    return found if isinstance(found, str) else None


def _home(stage: str, name: str, folders: list[str], quality: str) -> str:
    """Return the folder under results/ in which a result has a stage; empty if it has none."""
    if (Path("results") / name / stage / MANIFEST).is_file():
        return name
    if len(folders) == 1:
        return ""
    try:
        home = fp.home(stage, name, quality)
    except InputError:
        return ""
    return home if (Path("results") / home / stage / MANIFEST).is_file() else ""


def mark(a: str, b: str, quality: str = "draft") -> str:
    """Return a digest that changes with either result.

    Raises:
        InputError: as `open_result`.
    """
    parts = []
    for name in (a, b):
        result = open_result(name, quality)
        parts += [name, *(sha256_of(reader.directory / MANIFEST) for reader in result.stages.values())]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]


def digest_of_maps(folder: Path, colour: str) -> str:
    """Return a digest of the maps in a folder, which changes when a file does; of an absent folder, too."""
    files = sorted(p for q in ("", *QUANTITIES) for p in (folder / q).glob("*") if p.is_file())
    facts = [f"{path.relative_to(folder)}:{sha256_of(path)}" for path in files]
    return hashlib.sha256("\n".join([os.fspath(folder), colour, *facts]).encode()).hexdigest()[:16]
