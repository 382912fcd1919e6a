"""Chained fingerprints: everything that the result of a stage depends on, in sixteen characters.

fingerprint(stage) = sha256(settings that the stage reads, digest of the code that it imports, digest of its raw input files,
fingerprints of all upstream stages). Every rule carries its fingerprint as a parameter, so Snakemake runs again exactly what
changed and everything below it, also after a run that failed half-way. Touching a file or editing a comment changes nothing.
"""

from __future__ import annotations

import ast
import hashlib
import importlib
import json
import sys
from functools import lru_cache
from pathlib import Path
from typing import Any

from iif_core.errors import InputError
from workflow import plugins
from workflow import settings as settings_module
from workflow.artifacts.files import facts_in, sha256_of
from workflow.artifacts.stamps import Stamps
from workflow.intake.names import shown
from workflow.registry import STAGES
from workflow.runtime import input_digests
from workflow.settings import derived
from workflow.settings.names import EXAMPLES
from workflow.settings.relight import recombines

REPOSITORY = Path(__file__).resolve().parents[2]
PACKAGES = ("iif_core", "workflow", *plugins.packages())  # their __init__ compute nothing
# Modules that run stages without computing results: the schema number in the manifest stands for their effect on artefacts.
INFRASTRUCTURE = (
    "workflow.runtime",
    "workflow.registry",
    "workflow.plugins",
    "workflow.costs",
    "workflow.settings",
    "workflow.batch",
    "workflow.artifacts",
    "iif_core.errors",
)
# Stage -> the section of the settings whose `kind` chooses a module at run time.
CHOOSES = {"capture": "source", "prior": "prior", "segmentation": "segmentation"}
_HERE = f"{REPOSITORY}/"
_OWN = tuple(f"{_HERE}{name}/" for name in (*PACKAGES, EXAMPLES))
NEEDED = tuple(stage.name for stage in STAGES.values() if not stage.on_demand)
"""Stages that every scene needs, in order."""


def needed(scene: str, quality: str) -> tuple[str, ...]:
    """Return the stages that a scene needs, in order: those of every scene, and what these read in scenes of its kind of source.

    Raises:
        InputError: the settings of the scene cannot be used.
    """
    document = parsed(resolved(scene, quality))
    read = {up for stage in NEEDED for up in STAGES[stage].reads(document)}
    return tuple(name for name, stage in STAGES.items() if name in read or not stage.on_demand)


def module_file(module: str) -> Path | None:
    """Return the source file of one of our modules; None if there is no such module."""
    path = REPOSITORY.joinpath(*module.split("."))
    if path.with_suffix(".py").is_file():
        return path.with_suffix(".py")
    if (path / "__init__.py").is_file():
        return path / "__init__.py"
    return None


def is_infrastructure(module: str) -> bool:
    return module in PACKAGES or any(module == name or module.startswith(name + ".") for name in INFRASTRUCTURE)


CODE = Path("results/.code-digests.json")
"""What was found of modules: parsing all of them takes longer than some stages."""


@lru_cache(None)
def _code() -> Stamps:
    return Stamps(CODE.absolute(), _found_in, f"{sys.version_info[:3]} {sha256_of(Path(__file__))}")


def _facts(module: str) -> tuple[str, list[str]]:
    """Return the digest of a module's code, and the names within our packages that it imports anywhere in its source."""
    path = module_file(module)
    return _code().of(path) if path else ("", [])


def _found_in(path: Path) -> tuple[str, list[str]]:
    tree = ast.parse(path.read_text(), str(path))
    return _digest_of(tree), sorted(_imported(tree))


def _imported(tree: ast.Module) -> set[str]:
    out: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            out.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):  # no import here is relative
            out.update([node.module or "", *(f"{node.module}.{alias.name}" for alias in node.names)])
    # Whatever the plug-ins of this process are, because what was found is kept for others.
    return {name for name in out if (REPOSITORY / name.split(".")[0]).is_dir()}


@lru_cache(None)
def direct_imports(module: str) -> frozenset[str]:
    """Return those of our modules that `module` imports anywhere in its source, also inside functions."""
    found: set[str] = set()
    for name in _facts(module)[1]:
        if name.split(".")[0] in PACKAGES and module_file(name):
            parts = name.split(".")
            found.update(".".join(parts[: i + 1]) for i in range(len(parts)))
    return frozenset(name for name in found if module_file(name))


def import_closure(*modules: str) -> list[str]:
    """Return every module of ours that importing `modules` can reach, without the infrastructure; sorted."""
    todo, seen = list(modules), set()
    while todo:
        module = todo.pop()
        if module in seen or is_infrastructure(module):
            continue
        seen.add(module)
        package = module.rpartition(".")[0]  # importing a module runs its packages' __init__ first
        todo.extend([*direct_imports(module), *([package] if package else [])])
    return sorted(seen)


def modules_of(package: str) -> list[str]:
    """Return the modules of one of our packages, also of the infrastructure."""
    folder = REPOSITORY.joinpath(*package.split("."))
    return sorted(f"{package}.{path.stem}" for path in folder.glob("*.py") if path.stem != "__init__")


def _digest_of(tree: ast.Module) -> str:
    for node in ast.walk(tree):  # docstrings do not change results, and the tree holds no comments
        body = getattr(node, "body", None)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and body:
            first = body[0]
            if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant) and isinstance(first.value.value, str):
                node.body = body[1:]
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest()


@lru_cache(None)
def _roots_digest(roots: tuple[str, ...]) -> str:
    return modules_digest(import_closure(*roots))


def stage_modules(stage: str, settings: dict[str, Any]) -> list[str]:
    """Return the modules on whose code the result of a stage depends, with these settings."""
    return import_closure(*_roots(stage, settings))


def _roots(stage: str, settings: dict[str, Any]) -> tuple[str, ...]:
    chosen = kinds(settings[CHOOSES[stage]]) if stage in CHOOSES else []
    return module_of(stage, settings), *(plugins.implementation(CHOOSES[stage], kind) for kind in chosen)


def module_of(stage: str, settings: dict[str, Any]) -> str:
    """Return the name of the module that runs a stage with these settings: its own, or that of a plug-in."""
    return plugins.replacement(stage, settings) or STAGES[stage].module


def settings_of(stage: str, settings: dict[str, Any]) -> tuple[str, ...]:
    """Return the dotted settings that a stage reads, with these settings."""
    more = plugins.reads(stage) if plugins.replacement(stage, settings) else ()
    return (*STAGES[stage].settings, *(key for key in more if key not in STAGES[stage].settings))


def kinds(section: dict[str, Any]) -> list[str]:
    """Return what a section chooses, and what its members choose where it has any (`prior: {kind: pooled}`)."""
    return [section["kind"], *(member["kind"] for member in section.get("of", ()))]


def code_digest(stage: str, settings: dict[str, Any]) -> str:
    """Return the digest of the code behind a stage, without comments, docstrings and layout."""
    return _roots_digest(_roots(stage, settings))


def modules_digest(modules: list[str]) -> str:
    """Return the digest of the code of some modules."""
    parts = [f"{module}:{_facts(module)[0]}" for module in modules]
    _code().save()
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]


def raw_digest(paths: list[Path]) -> str:
    """Return the digest of the contents of input files."""
    return hashlib.sha256("\n".join(input_digests.digests(paths, _name_of)).encode()).hexdigest()[:16]


def raw_contents(stage: str, document: dict[str, Any]) -> dict[str, str]:
    """Return name -> SHA-256 of the files from outside that a stage reads.

    Raises:
        InputError: as `raw_inputs`.
    """
    paths = raw_inputs(stage, document) if STAGES[stage].reads_raw else []
    return {name: digest for name, _, digest in (line.rpartition(":") for line in input_digests.digests(paths, _name_of))}


def _name_of(path: Path) -> str:
    """Return the path; of a file of the program its place in the checkout, so that results do not depend on where that lies."""
    name = str(path)
    return name[len(_HERE) :] if name.startswith(_OWN) else name


def raw_inputs(stage: str, document: dict[str, Any]) -> list[Path]:
    """Return the files from outside that a stage reads.

    Raises:
        InputError: the module of the source, prior or segmentation, which lists the files, found something wrong with them, or
            they cannot be looked at: a name that is too long for the disk, a folder that may not be read.
    """
    try:
        return _raw_inputs(stage, document)
    except OSError as error:
        raise InputError(f"{shown(error.filename)}: {error.strerror}; correct the path, or let your account read it") from None


def _raw_inputs(stage: str, document: dict[str, Any]) -> list[Path]:
    out: list[Path] = []
    if stage in ("relight", "lamp_images"):
        entries = document["relight"] if stage == "relight" else [entry for entry in document["relight"] if recombines(entry)]
        out.extend(settings_module.relight_files(entries))
    if stage in CHOOSES:
        name = plugins.implementation(CHOOSES[stage], document[CHOOSES[stage]]["kind"])
        path = module_file(name)
        # Importing a module may take as long as all of the plan: some load compilers.
        if path is None or "raw_inputs" in path.read_text():
            module = importlib.import_module(name)
            if hasattr(module, "raw_inputs"):
                out.extend(module.raw_inputs(document))
    for name in STAGES[stage].files:
        out.extend(importlib.import_module(name).raw_inputs(document))
    return out


@lru_cache(None)
def resolved(scene: str, quality: str) -> str:
    """Return the settings of a scene as JSON text, which can be cached."""
    return json.dumps(settings_module.dump(settings_module.load(scene, quality)), sort_keys=True)


@lru_cache(4)
def parsed(text: str) -> dict[str, Any]:
    """Return what `resolved` returned as a tree, which all callers share: do not change it. A plan asks for the same scene dozens
    of times in a row."""
    return json.loads(text)


@lru_cache(None)
def fingerprint(stage: str, scene: str, quality: str) -> str:
    """Return sixteen hexadecimal characters that change when, and only when, the result of the stage may change.

    Raises:
        InputError: the settings or the raw files of the scene cannot be used.
    """
    document = parsed(resolved(scene, quality))
    try:
        raw = raw_digest(raw_inputs(stage, document)) if STAGES[stage].reads_raw else ""
    except InputError as error:
        origin = settings_module.relight_origin if stage in ("relight", "lamp_images") else settings_module.scene_origin
        raise InputError(f"{origin(scene)}: {error}") from None
    facts = {
        "stage": stage,
        "settings": settings_module.recorded(document, settings_of(stage, document)),
        "code": code_digest(stage, document),
        "raw": raw,
        "upstream": {up: fingerprint(up, scene, quality) for up in STAGES[stage].reads(document)},
    }
    if STAGES[stage].shared:
        shared = derived.shared_scene(scene)
        facts["shared"] = {up: fingerprint(up, shared, quality) for up in STAGES[stage].shared}
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:16]


@lru_cache(None)
def home(stage: str, scene: str, quality: str) -> str:
    """Return the scene in whose folder the result of a stage lies: variants of a study share equal results."""
    for shared in derived.bases(scene):
        if fingerprint(stage, shared, quality) == fingerprint(stage, scene, quality):
            return shared
    return scene


def missing_stages(scene: str, quality: str) -> list[str]:
    """Return the stages that a run would make, in order: their manifest is not there, or of other settings, inputs or code.

    Raises:
        InputError: the settings or the raw files of the scene cannot be used.
    """
    return [stage for stage in needed(scene, quality) if _made(stage, scene, quality) != fingerprint(stage, scene, quality)]


def _made(stage: str, scene: str, quality: str) -> str:
    """Return the fingerprint under which a stage was made; empty if it was not, or its manifest cannot be read."""
    return str(facts_in(f"results/{home(stage, scene, quality)}/{stage}/manifest.json").get("fingerprint", ""))
