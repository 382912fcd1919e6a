"""Studies: tables of variants (settings) x scenes x seeds that the ordinary rules run; docs/studies.md tells how to write one.

A *derived scene* `<scene>--<study>-<variant>-s<seed>` is the scene's own file, with the scene's entry of
`config/studies/scenes.yaml` over it, with the variant's settings over that, and `prior.seed: <seed>`. `<scene>--s<seed>` is the
same without a variant: what all studies share (photographs, predictions, segments) lies there. Imports nothing heavy.
"""

from __future__ import annotations

import difflib
import itertools
import re
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

from pydantic import Field, ValidationError

from iif_core.errors import InputError
from workflow.registry import STAGES
from workflow.settings.names import scene_names
from workflow.settings.section import Section
from workflow.settings.yaml_file import read_yaml

FOLDER = Path("config/studies")
SCENES = FOLDER / "scenes.yaml"
STUDY = r"[a-z][a-z0-9_]*"  # no hyphen: it ends the study's part of a derived scene's name
_VARIANT = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")
_DERIVED = re.compile(
    rf"(?P<scene>[A-Za-z0-9_-]+?)--(?:(?P<study>{STUDY})-(?P<variant>{_VARIANT.pattern})-)?s(?P<seed>0|[1-9]\d{{0,8}})"
)

METRICS = ("l2", "psnr", "ssim", "flip", "lpips", "lpips_vgg", "coverage_50", "coverage_80", "coverage_95", "log_l2", "iou")
METRICS += ("shading_left", "shading_slope", "view_spread")
QUANTITIES = ("albedo", "roughness", "metallic", "emission", "rgb", "rgb_held_out")
Protocol = Literal["raw", "scaled", "oracle_affine"]


class Variant(Section):
    """One row of the table."""

    label: str = ""
    """Words for tables and pictures; default: the variant's name."""
    row: str = ""
    """`scores: metrics`: which row of variants.parquet is scored; default: `result`."""
    overrides: dict[str, dict[str, Any]] = {}
    """Settings, section by section, over those of the scene."""


class Paper(Section):
    """What a publication prints for a variant."""

    protocol: Protocol
    """Protocol that its numbers were scored under."""
    values: dict[str, float]
    """`quantity/metric` -> number."""


class Plot(Section):
    """The picture."""

    kind: Literal["bars", "line", "pareto", "history"] = "bars"
    """`bars`: variants; `line`: scores over a setting; `pareto`: over CPU time; `history`: lines, and a curve over the sweeps."""
    x: str = ""
    """`line`, `history`: setting on the horizontal axis, dotted, e.g. `base.predictions`."""
    group: list[str] = []
    """Settings that tell one line (or colour) from another."""
    history: str = "entropy"
    """`history`: which column of base.json's history."""
    log: bool = False
    """Logarithmic horizontal axis."""


class Study(Section):
    """One file under config/studies/."""

    title: str
    """Above the table and the picture."""
    scenes: list[str] = Field(min_length=1)
    """Names of entries in config/studies/scenes.yaml."""
    seeds: list[int] = Field([0, 1, 2], min_length=1)
    """Seeds of the prior; everything else keeps the scene's seed."""
    scores: Literal["base_scores", "metrics"] = "base_scores"
    """Stage whose scores are collected: of the base texture, or of the result and its re-rendering."""
    costs: list[str] = ["base"]
    """Stages whose times are added up."""
    protocols: list[Protocol] = Field(["raw", "oracle_affine"], min_length=1)
    """Protocols in the printed table and the picture; the Parquet file has all."""
    common: dict[str, dict[str, Any]] = {}
    """Settings of all variants, under their own."""
    reference: str = ""
    """Variant that the printed table compares the others with: the difference stands in brackets."""
    variants: dict[str, Variant] = {}
    """Name -> variant."""
    grids: list[dict[str, list[Any]]] = []
    """Each: dotted setting -> values; every combination is a variant, named after its values."""
    paper: dict[str, Paper] = {}
    """Variant -> published numbers."""
    show: list[str] = ["albedo/psnr", "albedo/ssim", "albedo/lpips", "roughness/l2", "metallic/l2"]
    """`quantity/metric` in the printed table and the picture; the Parquet file has all."""
    plot: Plot = Plot()


class Derived(NamedTuple):
    """A derived scene's name, taken apart; `study` and `variant` are empty for what all studies share."""

    scene: str
    study: str
    variant: str
    seed: int


def study_names(root: Path = Path(".")) -> list[str]:
    """Every study that has a file."""
    return sorted(path.stem for path in (root / FOLDER).glob("*.yaml") if path.name != SCENES.name)


def load_study(name: str, root: Path = Path(".")) -> Study:
    """The study, its grids written out as variants.

    Raises:
        InputError: names file, key, what was found and what is allowed.
    """
    path = FOLDER / f"{name}.yaml"
    names = study_names(root)
    if name not in names:
        near = difflib.get_close_matches(name, names, 1)
        hint = f" Did you mean {near[0]}?" if near else ""
        raise InputError(
            f"{path}: not found.{hint} Known studies: {', '.join(names) or 'none'}; benchmarks"
            " of kernels: hashgrid, base_cost (docs/studies.md)."
        )
    if not re.fullmatch(STUDY, name):
        raise InputError(f"{path}: name of a study {name!r}: allowed are lower-case letters, digits and _, a letter first")
    return _load_study(path, root, (root / path).stat().st_mtime_ns)


@lru_cache(64)
def _load_study(path: Path, root: Path, _stamp: int) -> Study:
    try:
        study = Study.model_validate(read_yaml(root / path))
    except ValidationError as error:
        raise InputError(_explain(error, path)) from None
    variants = dict(study.variants)
    for i, grid in enumerate(study.grids):
        for name, variant in _grid(grid, f"{path}: `grids.{i}`").items():
            if name in variants:
                raise InputError(f"{path}: `grids.{i}`: variant {name} is there already; give each a setting of its own")
            variants[name] = variant
    if not variants:
        raise InputError(f"{path}: no variants; add `variants: {{<name>: {{overrides: ...}}}}` or `grids`")
    for name in variants:
        if not _VARIANT.fullmatch(name):
            raise InputError(
                f"{path}: `variants`: found the name {name!r}; allowed are letters, digits, _ and -, the first no sign"
            )
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
    shared = scene_overrides(root)
    if study.reference and study.reference not in variants:
        raise InputError(f"{path}: `reference: {study.reference}`: no such variant. Allowed here: {', '.join(variants)}.")
    for stage in study.costs:
        if stage not in STAGES:
            raise InputError(f"{path}: `costs`: {stage} is no stage. Allowed here: {', '.join(STAGES)}.")
    for scene in study.scenes:
        if scene not in shared:
            near = difflib.get_close_matches(scene, shared, 1)
            hint = f" Did you mean {near[0]}?" if near else ""
            raise InputError(f"{path}: `scenes`: {scene} is not in {SCENES}.{hint} Allowed here: {', '.join(shared)}.")
    return study.model_copy(update={"variants": variants})


def _grid(grid: dict[str, list[Any]], where: str) -> dict[str, Variant]:
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
        out["-".join(words)] = Variant(label=", ".join(str(value) for value in values), overrides=overrides)
    return out


def scene_overrides(root: Path = Path(".")) -> dict[str, dict[str, Any]]:
    """Scene -> settings that every study uses for it (config/studies/scenes.yaml)."""
    path = root / SCENES
    if not path.is_file():
        raise InputError(f"{SCENES}: not found; it lists the scenes of the studies (docs/studies.md)")
    document = read_yaml(path)
    known = scene_names(root)
    for scene, overrides in document.items():
        if scene not in known:
            near = difflib.get_close_matches(str(scene), known, 1)
            hint = f" Did you mean {near[0]}?" if near else ""
            raise InputError(f"{SCENES}: {scene}: no such scene.{hint} Known scenes: {', '.join(known) or 'none'}.")
        if overrides is not None and not isinstance(overrides, dict):
            raise InputError(f"{SCENES}: `{scene}`: found {overrides!r}, needed settings, e.g. {{capture: {{views: 24}}}}")
    return {scene: overrides or {} for scene, overrides in document.items()}


def derived(name: str, root: Path = Path(".")) -> Derived | None:
    """Parts of the name of a derived scene; None for a scene with a file of its own, or for any other name."""
    if "--" not in name or (root / "config/scenes" / f"{name}.yaml").is_file():
        return None
    match = _DERIVED.fullmatch(name)
    if not match:
        return None
    return Derived(match["scene"], match["study"] or "", match["variant"] or "", int(match["seed"]))


def layers(parts: Derived, root: Path = Path(".")) -> list[tuple[str, dict[str, Any]]]:
    """(where it stands, settings) that a derived scene puts over the file of its scene, in order."""
    shared = scene_overrides(root)
    if parts.scene not in shared:
        raise InputError(f"{SCENES}: {parts.scene} is not listed. Known there: {', '.join(shared) or 'none'}.")
    out = [(f"{SCENES}, {parts.scene}", shared[parts.scene])]
    if parts.study:
        study = load_study(parts.study, root)
        if parts.variant not in study.variants:
            near = difflib.get_close_matches(parts.variant, study.variants, 1)
            hint = f" Did you mean {near[0]}?" if near else ""
            raise InputError(
                f"{FOLDER / parts.study}.yaml: no variant {parts.variant}.{hint} Known: {', '.join(study.variants)}."
            )
        if study.common:
            out.append((f"{FOLDER / parts.study}.yaml, `common`", study.common))
        out.append((f"{FOLDER / parts.study}.yaml, variant {parts.variant}", study.variants[parts.variant].overrides))
    return [*out, ("seed of the study", {"prior": {"seed": parts.seed}})]


def bases(name: str, root: Path = Path(".")) -> list[str]:
    """Derived scenes whose folders hold what `name` has in common with others, most common first.

    They are what all studies share, then the variants of its own study up to itself, of the first seed and of its own: so
    a variant that differs late (a baseline of the last fit) finds everything before it where the first variant left it.
    """
    parts = derived(name, root)
    if parts is None:
        return []
    candidates = [f"{parts.scene}--s0", f"{parts.scene}--s{parts.seed}"]
    if parts.study:
        study = load_study(parts.study, root)
        variants = list(study.variants)
        earlier = variants[: variants.index(parts.variant) + 1] if parts.variant in variants else []
        seeds = [study.seeds[0], parts.seed]
        candidates += [scene_of(parts.study, parts.scene, variant, seed) for variant in earlier for seed in seeds]
    candidates = list(dict.fromkeys(candidates))
    return candidates[: candidates.index(name)] if name in candidates else candidates


def scene_of(study: str, scene: str, variant: str, seed: int) -> str:
    """Name of the derived scene."""
    return f"{scene}--{study}-{variant}-s{seed}"


def _explain(error: ValidationError, path: Path) -> str:
    lines = []
    for problem in error.errors():
        where, found = problem["loc"], problem.get("input")
        dotted = ".".join(str(part) for part in where)
        if problem["type"] == "extra_forbidden":
            model = {1: Study, 2: Plot}.get(len(where), Paper if where[0] == "paper" else Variant)
            allowed = list(model.model_fields)
            near = difflib.get_close_matches(str(where[-1]), allowed, 1)
            hint = f" Did you mean `{near[0]}`?" if near else ""
            lines.append(f"{path}: `{dotted}`: unknown key.{hint} Allowed here: {', '.join(allowed)}.")
        elif problem["type"] == "missing":
            lines.append(f"{path}: `{dotted}`: missing. Add it; config/studies/aggregation.yaml is a complete example.")
        else:
            shown = found if not isinstance(found, dict) else "a mapping"
            lines.append(f"{path}: `{dotted}`: found {shown!r}. {problem['msg']}.")
    return "\n".join(lines)
