"""Variants of studies as derived scenes (lab/docs/studies.md): which settings a variant has, and what it shares with others.

A derived scene `<scene>--<study>-<variant>-s<seed>` has the settings of the scene's own file, over them its entry in
`lab/config/studies/scenes.yaml`, over these `common` of the study and the settings of the variant, and `prior.seed: <seed>`.
`<scene>--s<seed>` is the same without study and variant and holds what all studies share: photographs, predictions, segments.
Every job reads this, so of the file of a study only what changes settings is read here; lab/studies/files.py checks the rest.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ConfigDict, Field, ValidationError

from iif_core.errors import InputError
from lab.prior import drawn
from workflow.settings.derived import OWN, STUDY, VARIANT, Derived, scene_of
from workflow.settings.explain import needed
from workflow.settings.names import REPOSITORY, did_you_mean, scene_names
from workflow.settings.section import Section
from workflow.settings.yaml_file import read_yaml

FOLDER = Path("lab/config/studies")
SCENES = FOLDER / "scenes.yaml"
SHARED_VARIANT = "shared"
"""Name of the derived scene at whose views all variants of a study are scored."""


def configuration(part: str = "", root: Path = Path(".")) -> Path:
    """Return lab/config/studies, or a part of it: the working folder's where it exists, otherwise the repository's."""
    own = root / FOLDER / part
    return own if own.exists() else REPOSITORY / FOLDER / part


class Variant(Section):
    """The settings of a variant."""

    model_config = ConfigDict(extra="ignore")

    label: str = ""
    """Label in tables and pictures; by default the name of the variant."""
    overrides: dict[str, dict[str, Any]] = {}
    """Settings, section by section, over those of the scene."""
    preset: str | None = Field(None, pattern=r"^[a-z][a-z0-9_]*$")
    """Settings under these, shared by studies: `lab/config/studies/presets/<preset>.yaml`."""

    def layer(self, root: Path) -> dict[str, dict[str, Any]]:
        """Return all that the variant sets over the scene.

        Raises:
            InputError: there is no such preset.
        """
        if self.preset is None:
            return dict(self.overrides)
        file = configuration(f"presets/{self.preset}.yaml", root)
        if not file.is_file():
            known = sorted(path.stem for path in file.parent.glob("*.yaml"))
            hint = did_you_mean(self.preset, known)
            raise InputError(f"{FOLDER}/presets/{self.preset}.yaml: not found.{hint} Known presets: {', '.join(known)}.")
        below = read_yaml(file)
        return {**below, **{section: {**below.get(section, {}), **keys} for section, keys in self.overrides.items()}}


class Design(Section):
    """Variants as runs of a design: each is a string of digits, the level of every factor, which is also its name."""

    model_config = ConfigDict(extra="ignore")

    factors: dict[str, list[Any]] = Field(min_length=1)
    """Setting, or settings joined by ` + `, -> its levels, from cheap to dear."""
    runs: list[str] = Field(min_length=1)
    """In the order of the trajectories; a run that is there twice is one variant."""

    def overrides(self, run: str) -> dict[str, dict[str, Any]]:
        """Return the settings of a run."""
        out: dict[str, dict[str, Any]] = {}
        for (names, levels), digit in zip(self.factors.items(), run, strict=True):
            for dotted in names.split(" + "):
                section, _, key = dotted.partition(".")
                out.setdefault(section, {})[key] = levels[int(digit)]
        return out


class Study(Section):
    """What of one file under lab/config/studies/ changes settings."""

    model_config = ConfigDict(extra="ignore")

    seeds: list[int] = Field([0, 1, 2], min_length=1)
    """Seeds of the prior; everything else keeps the seed of the scene."""
    common: dict[str, dict[str, Any]] = {}
    """Settings of all variants; those of a variant override them."""
    shared: dict[str, dict[str, Any]] = {}
    """`scores: common_scores`: settings, over `common`, of the capture at whose last views all variants are scored. With more
    views than any variant has, these are views that none was fitted to. Default: the capture that all studies share."""
    variants: dict[str, Variant] = {}
    """Name -> variant."""
    grids: list[dict[str, list[Any]]] = []
    """Each maps dotted settings to values; every combination is a variant, named after its values."""
    design: Design | None = None
    """Runs of a design, which are variants too."""


AnyStudy = TypeVar("AnyStudy", bound=Study)


def study_names(root: Path = Path(".")) -> list[str]:
    """Return the name of every study that has a file, sorted."""
    return sorted(path.stem for path in configuration("", root).glob("*.yaml") if path.name != SCENES.name)


def load_study(name: str, root: Path = Path(".")) -> Study:
    """Return the settings of a study, with its grids and its design expanded into variants.

    Raises:
        InputError: names the file, the key, what was found and what is allowed.
    """
    path, file = study_path(name, root)
    return _load_study(path, file, file.stat().st_mtime_ns)


def study_path(name: str, root: Path = Path(".")) -> tuple[Path, Path]:
    """Return the file of a study, as messages have it and where it lies.

    Raises:
        InputError: there is none, or a study cannot be called that.
    """
    path = FOLDER / f"{name}.yaml"
    names = study_names(root)
    if name in OWN:
        raise InputError(f"{path}: a study cannot be called {name}, which stands for {OWN[name]}; rename it")
    if name not in names:
        raise InputError(
            f"{path}: not found.{did_you_mean(name, names)} Known studies: {', '.join(names) or 'none'}; benchmarks"
            " of kernels: hashgrid, base_cost (lab/docs/studies.md)."
        )
    if not re.fullmatch(STUDY, name):
        raise InputError(f"{path}: name of a study {name!r}: use lower-case letters, digits and _, starting with a letter")
    return path, configuration("", root) / path.name


@lru_cache(64)
def _load_study(path: Path, file: Path, _stamp: int) -> Study:
    try:
        study = Study.model_validate(read_yaml(file))
    except ValidationError as error:
        problem = error.errors()[0]
        where = ".".join(map(str, problem["loc"]))
        raise InputError(f"{path}: `{where}`: found {problem.get('input')!r}. {needed(problem)}.") from None
    return expanded(study, path)


def expanded(study: AnyStudy, path: Path, kind: type[Variant] = Variant) -> AnyStudy:
    """Return a study with its grids and its design expanded into variants of a type.

    Raises:
        InputError: a grid or a design that cannot be expanded, or a name that a variant cannot have.
    """
    variants = dict(study.variants)
    for i, grid in enumerate(study.grids):
        for name, variant in _grid(grid, f"{path}: `grids.{i}`", kind).items():
            if name in variants:
                raise InputError(f"{path}: `grids.{i}`: variant {name} is there already; give each its own setting")
            variants[name] = variant
    if study.design:
        variants |= _design(study.design, path, variants, kind)
    if study.shared and SHARED_VARIANT in variants:
        raise InputError(f"{path}: a variant cannot be called {SHARED_VARIANT}, which is the capture of `shared`; rename it")
    for name in variants:
        if not re.fullmatch(VARIANT, name):
            raise InputError(
                f"{path}: `variants`: found the name {name!r}; use letters, digits, _ and -, starting with a letter or digit"
            )
    return study.model_copy(update={"variants": variants})


def _grid(grid: dict[str, list[Any]], where: str, kind: type[Variant]) -> dict[str, Variant]:
    for key, values in grid.items():
        if key.count(".") != 1 or not values:
            raise InputError(f"{where}: found `{key}: {values}`, needed <section>.<key>: [value, ...]")
    out: dict[str, Variant] = {}
    for values in itertools.product(*grid.values()):
        overrides: dict[str, dict[str, Any]] = {}
        for dotted, value in zip(grid, values, strict=True):
            section, _, key = dotted.partition(".")
            overrides.setdefault(section, {})[key] = value
        words = [re.sub(r"[^A-Za-z0-9_]", "_", str(value)) for value in values]
        out["-".join(words)] = kind(label=", ".join(str(value) for value in values), overrides=overrides)
    return out


def _design(design: Design, path: Path, others: dict[str, Variant], kind: type[Variant]) -> dict[str, Variant]:
    for names, levels in design.factors.items():
        if not 1 <= len(levels) <= 10 or any(dotted.count(".") != 1 for dotted in names.split(" + ")):
            raise InputError(
                f"{path}: `design.factors`: found `{names}: {levels}`, needed <section>.<key>: [level, ...] of at most 10 levels;"
                " settings that change together are joined by ` + `"
            )
    out: dict[str, Variant] = {}
    for run in design.runs:
        digits = run if len(run) == len(design.factors) and run.isdecimal() else ""
        if not digits or any(int(d) >= len(levels) for d, levels in zip(digits, design.factors.values(), strict=True)):
            raise InputError(
                f"{path}: `design.runs`: found {run!r}, needed a digit for each of the {len(design.factors)} factors: which of"
                " its levels, counted from 0"
            )
        if run in others:
            raise InputError(f"{path}: `design.runs`: variant {run} is there already; give it another name")
        out[run] = kind(label=run, overrides=design.overrides(run))
    return out


def scene_overrides(root: Path = Path(".")) -> dict[str, dict[str, Any]]:
    """Return scene -> settings that every study uses for it; an entry with a `source` needs no scene of that name."""
    path = configuration("", root) / SCENES.name
    if not path.is_file():
        raise InputError(f"{SCENES}: not found; it lists the scenes of the studies (lab/docs/studies.md)")
    document = read_yaml(path)
    known = scene_names(root)
    for scene, overrides in document.items():
        if overrides is not None and not isinstance(overrides, dict):
            raise InputError(f"{SCENES}: `{scene}`: found {overrides!r}, needed settings, e.g. {{capture: {{views: 24}}}}")
        if scene not in known and "source" not in (overrides or {}):
            hint = did_you_mean(scene, known)
            raise InputError(
                f"{SCENES}: {scene}: no such scene, and no `source` here.{hint} Known scenes: {', '.join(known) or 'none'}."
            )
    return {name: settings for scene, overrides in document.items() for name, settings in _rooms(scene, overrides or {})}


def _rooms(scene: str, overrides: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield an entry of the list of scenes, or an entry `<scene>-<number>` for each of its drawn rooms."""
    source = overrides.get("source") or {}
    if source.get("kind") != "drawn" or "room" in source:
        yield scene, overrides
        return
    for number in range(drawn.COUNT):
        yield f"{scene}-{number}", {**overrides, "source": {**source, "room": number}}


def file_of_source(scene: str, root: Path = Path(".")) -> Path | None:
    """Return the list of the scenes of studies if it has the `source` of this scene, else None."""
    return configuration("", root) / SCENES.name if "source" in scene_overrides(root).get(scene, {}) else None


def layers(parts: Derived, root: Path = Path(".")) -> list[tuple[str, dict[str, Any]]]:
    """Return (place, settings) of the layers that a derived scene puts over the file of its scene, in order."""
    shared = scene_overrides(root)
    if parts.scene not in shared:
        raise InputError(f"{SCENES}: {parts.scene} is not listed. Known there: {', '.join(shared) or 'none'}.")
    out = [(f"{SCENES}, {parts.scene}", shared[parts.scene])]
    if parts.study:
        study = load_study(parts.study, root)
        if parts.variant == SHARED_VARIANT and study.shared:
            places = ((f"{FOLDER / parts.study}.yaml, `{name}`", getattr(study, name)) for name in ("common", "shared"))
            return [*out, *((place, settings) for place, settings in places if settings)]
        if parts.variant not in study.variants:
            hint = did_you_mean(parts.variant, study.variants)
            raise InputError(
                f"{FOLDER / parts.study}.yaml: no variant {parts.variant}.{hint} Known: {', '.join(study.variants)}."
            )
        if study.common:
            out.append((f"{FOLDER / parts.study}.yaml, `common`", study.common))
        out.append((f"{FOLDER / parts.study}.yaml, variant {parts.variant}", study.variants[parts.variant].layer(root)))
    return [*out, ("seed of the study", {"prior": {"seed": parts.seed}})]


def bases(parts: Derived, root: Path = Path(".")) -> list[str]:
    """Return the derived scenes whose folders may hold results that this one shares, the most general first.

    These are what all studies share, then the variants of the same study up to this one, with the first seed and with its own.
    A variant that differs late, such as a baseline of the material fit, thus finds everything before it in the folder of the
    first variant.
    """
    name = scene_of(parts.study, parts.scene, parts.variant, parts.seed) if parts.study else f"{parts.scene}--s{parts.seed}"
    candidates = [f"{parts.scene}--s0", f"{parts.scene}--s{parts.seed}"]
    if parts.study:
        study = load_study(parts.study, root)
        variants = list(study.variants)
        earlier = variants[: variants.index(parts.variant) + 1] if parts.variant in variants else []
        seeds = [study.seeds[0], parts.seed]
        candidates += [scene_of(parts.study, parts.scene, variant, seed) for variant in earlier for seed in seeds]
    candidates = list(dict.fromkeys(candidates))
    return candidates[: candidates.index(name)] if name in candidates else candidates


def shared_scene(parts: Derived, root: Path = Path(".")) -> str:
    """Return the scene whose photographs all variants and seeds of a derived scene are compared at.

    >>> shared_scene(Derived("kitchen", "aggregation", "full", 2))
    'kitchen--s0'
    """
    shared = parts.study and load_study(parts.study, root).shared
    return scene_of(parts.study, parts.scene, SHARED_VARIANT, 0) if shared else f"{parts.scene}--s0"
