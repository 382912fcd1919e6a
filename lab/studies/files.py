"""The files of studies, lab/config/studies/*.yaml: everything in them, checked (lab/docs/studies.md)."""

from __future__ import annotations

import itertools
import re
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Literal

from pydantic import ConfigDict, Field, PositiveFloat, ValidationError, field_validator

from iif_core.errors import InputError
from iif_core.evaluation import catalogue
from lab.studies import variants as of_settings
from lab.studies.variants import SCENES
from workflow.registry import STAGES
from workflow.settings.explain import needed
from workflow.settings.names import did_you_mean
from workflow.settings.section import Section
from workflow.settings.yaml_file import read_yaml

MORRIS_LEVELS = 4
"""Levels of each factor of a screening."""
METRICS = tuple(name for name in catalogue.METRICS if name != "psnr_3d")
"""Metrics that a study can show."""
RELIT = ("relit_lamp", "relit_moved", "relit_environment", "relit_sphere")
"""Pictures under new light: a lamp alone, a moved lamp, an environment, a glowing sphere."""
QUANTITIES = (*catalogue.PROTOCOLS_OF, "rgb_held_out", *RELIT)


class Variant(of_settings.Variant):
    """One row of the table."""

    model_config = ConfigDict(extra="forbid")

    row: str = ""
    """`scores: metrics`: row of variants.parquet that is scored; by default `result`."""


class Paper(Section):
    """Numbers that a publication gives for a variant."""

    protocol: catalogue.ProtocolName
    """Protocol under which its numbers were scored."""
    values: dict[str, float]
    """`quantity/metric` -> number."""


class Design(of_settings.Design):
    """Runs of a design."""

    model_config = ConfigDict(extra="forbid")

    trajectories: Literal[0] | Annotated[int, Field(ge=2)] = 0
    """The first runs are this number of trajectories of Morris (lab/docs/studies.md): the page then has the effect of
    each factor."""


class Opposite(Section):
    """The variants that force a component of the plan."""

    forced_in: str = ""
    """Variant that has it; "" where nothing can put it in."""
    forced_out: str = ""
    """Variant without it."""


class Plot(Section):
    """The picture."""

    kind: Literal["bars", "line", "pareto", "history"] = "bars"
    """`bars`: variants; `line`: scores over a setting; `pareto`: over CPU time; `history`: lines, and a curve over the sweeps."""
    x: str = ""
    """`line`, `history`: setting on the horizontal axis, dotted, e.g. `base.predictions`."""
    group: list[str] = []
    """Settings that distinguish lines (or colours)."""
    history: str = "entropy"
    """`history`: column of the history in base.json."""
    log: bool = False
    """Logarithmic horizontal axis."""


class Sheet(Section):
    """The sheet of pictures, results/studies/<study>.grid.png and .pdf."""

    views: int = Field(1, ge=1)
    """Views of each scene, spread evenly."""
    quantities: list[Literal["albedo", "roughness", "metallic", "relit"]] = ["albedo", "roughness", "metallic", "relit"]
    """Rows of each view; `relit` is there in studies of relighting alone: one light of each kind."""
    insets: dict[str, tuple[float, float, float]] = {}
    """Scene -> [x, y, size] of a square that is shown enlarged, as shares of the width and the height."""


class Study(of_settings.Study):
    """One file under lab/config/studies/."""

    model_config = ConfigDict(extra="forbid")

    title: str
    """Title of the table and the picture."""
    scenes: list[str] = Field(min_length=1)
    """Names of entries in lab/config/studies/scenes.yaml; `drawn-0:120` stands for drawn-0 to drawn-119."""
    repeats: dict[str, Annotated[list[int], Field(min_length=1)]] = {}
    """Variant -> further seeds, where one of `seeds` does not tell how much a score varies."""
    scores: Literal["base_scores", "metrics", "common_scores", "relit_scores"] = "base_scores"
    """Stage whose scores are collected: of the base texture, of the result and its re-rendering, of the result at views that all
    variants share, or of pictures under new light."""
    costs: list[str] = ["base"]
    """Stages whose times are added; they are made even if the scores do not need them."""
    growth: dict[str, dict[str, PositiveFloat]] = {}
    """What is varied -> variant -> how much of it there is: the page then has the exponents with which `costs` grow."""
    protocols: list[catalogue.ProtocolName] = Field(["raw", "oracle_affine"], min_length=1)
    """Protocols in the printed table and the picture; the Parquet file has all."""
    rows: Literal["variants", "scenes"] = "variants"
    """Rows of the printed tables; with `scenes` each protocol has its own table."""
    opposites: dict[str, Opposite] = {}
    """Component of the plan -> variants that force it: the page then says whether the plan, which `reference` follows, was right
    about it."""
    reference: str = ""
    """Variant with which the printed table compares the others; differences are in brackets."""
    variants: dict[str, Variant] = {}
    """Name -> variant."""
    design: Design | None = None
    """Runs of a design, which are variants too."""
    paper: dict[str, Paper] = {}
    """Variant -> published numbers."""
    show: list[str] = ["albedo/psnr", "albedo/ssim", "albedo/lpips", "roughness/l2", "metallic/l2"]
    """`quantity/metric` in the printed table and the picture; the Parquet file has all."""
    plot: Plot = Plot()
    sheet: Sheet = Sheet()
    """The sheet of pictures."""

    @field_validator("scenes")
    @classmethod
    def _each(cls, scenes: list[str]) -> list[str]:
        return [scene for name in scenes for scene in _range(name)]

    def seeds_of(self, variant: str) -> list[int]:
        """Return the seeds of a variant, those of all variants first."""
        return list(dict.fromkeys([*self.seeds, *self.repeats.get(variant, [])]))


def _range(name: str) -> list[str]:
    """Return the names that a range of numbers stands for, or the one name that is none."""
    found = re.fullmatch(r"(.+-)(\d+):(\d+)", name)
    return [f"{found[1]}{number}" for number in range(int(found[2]), int(found[3]))] if found else [name]


def load_study(name: str, root: Path = Path(".")) -> Study:
    """Return the study, with its grids expanded into variants.

    Raises:
        InputError: names the file, the key, what was found and what is allowed.
    """
    path, file = of_settings.study_path(name, root)
    return _load_study(path, file, root, file.stat().st_mtime_ns)


@lru_cache(64)
def _load_study(path: Path, file: Path, root: Path, _stamp: int) -> Study:
    try:
        study = Study.model_validate(read_yaml(file))
    except ValidationError as error:
        raise InputError(_explain(error, path)) from None
    study = of_settings.expanded(study, path, Variant)
    variants = study.variants
    if study.design and study.design.trajectories:
        _check_trajectories(study.design, path)
    if not variants:
        raise InputError(f"{path}: no variants; add `variants: {{<name>: {{overrides: ...}}}}` or `grids`")
    for name in study.paper:
        if name not in variants:
            raise InputError(f"{path}: `paper.{name}`: no such variant. Allowed here: {', '.join(variants)}.")
    shown = [(f"paper.{name}.values", key) for name, paper in study.paper.items() for key in paper.values]
    for where, key in [*shown, *(("show", key) for key in study.show)]:
        quantity, _, metric = key.partition("/")
        if quantity not in QUANTITIES or metric not in METRICS:
            raise InputError(
                f"{path}: `{where}`: found {key!r}, needed <quantity>/<metric>"
                f" with {', '.join(QUANTITIES)} and {', '.join(METRICS)}"
            )
    varied = sorted({f"{section}.{key}" for v in variants.values() for section, keys in v.overrides.items() for key in keys})
    wanted = [study.plot.x] if study.plot.kind in ("line", "history") else []
    for dotted in [*wanted, *study.plot.group]:
        if dotted not in varied:
            raise InputError(f"{path}: `plot`: no variant sets {dotted or 'x'!r}. Allowed here: {', '.join(varied) or 'none'}.")
    shared = of_settings.scene_overrides(root)
    if study.reference and study.reference not in variants:
        raise InputError(f"{path}: `reference: {study.reference}`: no such variant. Allowed here: {', '.join(variants)}.")
    if study.opposites and not study.reference:
        raise InputError(f"{path}: `opposites` need a `reference`, the variant that leaves them to the plan")
    for component, opposite in study.opposites.items():
        for name in filter(None, (opposite.forced_in, opposite.forced_out)):
            if name not in variants:
                raise InputError(f"{path}: `opposites.{component}`: no variant {name}. Allowed here: {', '.join(variants)}.")
    for name in study.repeats:
        if name not in variants:
            raise InputError(f"{path}: `repeats.{name}`: no such variant. Allowed here: {', '.join(variants)}.")
    for stage in study.costs:
        if stage not in STAGES:
            raise InputError(f"{path}: `costs`: {stage} is no stage. Allowed here: {', '.join(STAGES)}.")
    for what, sizes in study.growth.items():
        for name in sizes:
            if name not in variants:
                raise InputError(f"{path}: `growth.{what}`: no variant {name}. Allowed here: {', '.join(variants)}.")
    for scene in study.scenes:
        if scene not in shared:
            hint = did_you_mean(scene, shared)
            raise InputError(f"{path}: `scenes`: {scene} is not in {SCENES}.{hint} Allowed here: {', '.join(shared)}.")
    return study


def _check_trajectories(design: Design, path: Path) -> None:
    """Refuse runs that are no trajectories: steps of one factor by two of four levels, each factor once."""
    odd = [name for name, levels in design.factors.items() if len(levels) != MORRIS_LEVELS]
    if odd:
        raise InputError(f"{path}: `design.factors`: {', '.join(odd)}: trajectories need {MORRIS_LEVELS} levels of each factor")
    whole = len(design.factors) + 1
    if len(design.runs) < design.trajectories * whole:
        raise InputError(
            f"{path}: `design.trajectories`: found {design.trajectories}, which are {design.trajectories * whole} runs;"
            f" there are {len(design.runs)}. lab/docs/studies.md says what makes them"
        )
    runs = design.runs[: design.trajectories * whole]
    for number in range(0, len(runs) - whole + 1, whole):
        one = runs[number : number + whole]
        moved = [[i for i, (a, b) in enumerate(zip(*pair, strict=True)) if a != b] for pair in itertools.pairwise(one)]
        far = all(
            abs(int(a) - int(b)) in (0, MORRIS_LEVELS // 2) for x, y in itertools.pairwise(one) for a, b in zip(x, y, strict=True)
        )
        if (
            not far
            or sorted(i for step in moved for i in step) != list(range(whole - 1))
            or any(len(step) != 1 for step in moved)
        ):
            raise InputError(
                f"{path}: `design.runs`: those from {one[0]!r} on are no trajectory, in which each step changes one factor by"
                f" two levels and each factor changes once. lab/docs/studies.md says what makes them"
            )


def _explain(error: ValidationError, path: Path) -> str:
    lines = []
    for problem in error.errors():
        where, found = problem["loc"], problem.get("input")
        dotted = ".".join(str(part) for part in where)
        if problem["type"] == "extra_forbidden":
            model = {1: Study, 2: Plot}.get(len(where), Paper if where[0] == "paper" else Variant)
            allowed = list(model.model_fields)
            hint = did_you_mean(where[-1], allowed, "`{}`")
            lines.append(f"{path}: `{dotted}`: unknown key.{hint} Allowed here: {', '.join(allowed)}.")
        elif problem["type"] == "missing":
            lines.append(f"{path}: `{dotted}`: missing. Add it; lab/config/studies/aggregation.yaml is a complete example.")
        else:
            shown = found if not isinstance(found, dict) else "a mapping"
            lines.append(f"{path}: `{dotted}`: found {shown!r}. {needed(problem)}.")
    return "\n".join(lines)
