"""Chained fingerprints: what a stage's result depends on, in sixteen characters.

fingerprint(stage) = sha256(settings that the stage reads, digest of the code that it imports, digest of the raw input files,
fingerprints of all upstream stages). Every rule carries it as a parameter, so Snakemake reruns exactly what changed and
everything below it, also after a run that failed half-way; touching a file or editing a comment changes nothing.
"""

from __future__ import annotations

import ast
import hashlib
import importlib
import importlib.util
import json
from functools import lru_cache
from pathlib import Path
from typing import Any

from iif_core.errors import InputError
from workflow import settings as settings_module
from workflow import studies
from workflow.artifacts.files import sha256_of, write_json
from workflow.registry import STAGES

REPOSITORY = Path(__file__).resolve().parents[1]
PACKAGES = ("iif_core", "workflow")  # their __init__ hold a docstring and nothing else
# Runners, not results: their effect on artefacts is versioned by the schema number in the manifest.
INFRASTRUCTURE = (
    "workflow.job",
    "workflow.registry",
    "workflow.settings",
    "workflow.studies",
    "workflow.fingerprint",
    "workflow.artifacts",
    "iif_core.native",
    "iif_core.errors",
)
# A setting that chooses a module at run time -> the module's name.
PLUGINS = {
    "capture": (("source", "kind", "workflow.sources.{}"),),
    "prior": (("prior", "kind", "workflow.priors.{}"),),
}
# Files that a stage reads if they are there.
OPTIONAL_FILES = {"base_scores": (Path("results/weights/lpips_vgg.npz"),)}


def module_file(module: str) -> Path | None:
    """Source file of one of our modules, or None if there is no such module."""
    path = REPOSITORY.joinpath(*module.split("."))
    if path.with_suffix(".py").is_file():
        return path.with_suffix(".py")
    if (path / "__init__.py").is_file():
        return path / "__init__.py"
    return None


def is_infrastructure(module: str) -> bool:
    return module in PACKAGES or any(module == name or module.startswith(name + ".") for name in INFRASTRUCTURE)


@lru_cache(None)
def _tree(module: str) -> ast.Module | None:
    path = module_file(module)
    return ast.parse(path.read_text(), str(path)) if path else None


@lru_cache(None)
def direct_imports(module: str) -> frozenset[str]:
    """Our modules that `module` imports anywhere in its source (also inside functions)."""
    tree = _tree(module)
    if tree is None:
        return frozenset()
    path = module_file(module)
    package = module if path and path.name == "__init__.py" else module.rpartition(".")[0]
    found: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = importlib.util.resolve_name("." * node.level + (node.module or ""), package) if node.level else node.module
            names = [base or ""] + [f"{base}.{alias.name}" for alias in node.names]
        else:
            continue
        for name in names:
            if name.split(".")[0] in PACKAGES and module_file(name):
                parts = name.split(".")
                found.update(".".join(parts[: i + 1]) for i in range(len(parts)))
    return frozenset(name for name in found if module_file(name))


def import_closure(*modules: str) -> list[str]:
    """Every module of ours that importing `modules` can reach, without the infrastructure; sorted."""
    todo, seen = list(modules), set()
    while todo:
        module = todo.pop()
        if module in seen or is_infrastructure(module):
            continue
        seen.add(module)
        package = module.rpartition(".")[0]  # importing a module runs its packages' __init__ first
        todo.extend([*direct_imports(module), *([package] if package else [])])
    return sorted(seen)


@lru_cache(None)
def _module_digest(module: str) -> str:
    tree = _tree(module)
    if tree is None:
        return ""
    for node in ast.walk(tree):  # docstrings and comments do not change results
        body = getattr(node, "body", None)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and body:
            first = body[0]
            if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant) and isinstance(first.value.value, str):
                node.body = body[1:]
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest()


def stage_modules(stage: str, settings: dict[str, Any]) -> list[str]:
    """Modules whose code a stage's result depends on, with these settings."""
    roots = [STAGES[stage].module]
    for section, key, pattern in PLUGINS.get(stage, ()):
        roots.append(pattern.format(settings[section][key]))
    return import_closure(*roots)


def code_digest(stage: str, settings: dict[str, Any]) -> str:
    """Digest of the code behind a stage, blind to comments, docstrings and layout."""
    return modules_digest(stage_modules(stage, settings))


def modules_digest(modules: list[str]) -> str:
    """Digest of the code of some modules."""
    parts = [f"{module}:{_module_digest(module)}" for module in modules]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]


_DIGESTS = Path("results/.input-digests.json")


def raw_digest(paths: list[Path]) -> str:
    """Digest of the contents of input files; contents are hashed again only when size or time stamp changed."""
    try:
        cache: dict[str, list[Any]] = json.loads(_DIGESTS.read_text())
    except (OSError, ValueError):
        cache = {}
    changed, parts = False, []
    for path in sorted(paths):
        status = path.stat()
        stamp = [status.st_size, status.st_mtime_ns]
        entry = cache.get(str(path))
        if entry is None or entry[:2] != stamp:
            cache[str(path)] = entry = [*stamp, sha256_of(path)]
            changed = True
        parts.append(f"{path}:{entry[2]}")
    if changed:
        write_json(_DIGESTS, cache)
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]


def raw_inputs(stage: str, document: dict[str, Any]) -> list[Path]:
    """Input files from outside that a stage reads; the source (or prior) module knows them and checks them first."""
    out = [path for path in OPTIONAL_FILES.get(stage, ()) if path.is_file()]
    if stage == "relight":
        out.extend(settings_module.relight_files(document))
    for section, key, pattern in PLUGINS.get(stage, ()):
        module = importlib.import_module(pattern.format(document[section][key]))
        if hasattr(module, "raw_inputs"):
            out.extend(module.raw_inputs(document))
    return out


@lru_cache(None)
def resolved(scene: str, quality: str) -> str:
    """Settings of a scene as JSON text (so that it can be cached)."""
    return json.dumps(settings_module.dump(settings_module.load(scene, quality)), sort_keys=True)


@lru_cache(None)
def fingerprint(stage: str, scene: str, quality: str) -> str:
    """Sixteen hexadecimal characters that change when, and only when, the stage's result may."""
    document = json.loads(resolved(scene, quality))
    try:
        raw = raw_digest(raw_inputs(stage, document)) if STAGES[stage].reads_raw else ""
    except InputError as error:
        raise InputError(f"{settings_module.scene_file(scene)}: {error}") from None
    facts = {
        "stage": stage,
        "settings": settings_module.select(document, STAGES[stage].settings),
        "code": code_digest(stage, document),
        "raw": raw,
        "upstream": {up: fingerprint(up, scene, quality) for up in STAGES[stage].upstream},
    }
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:16]


@lru_cache(None)
def home(stage: str, scene: str, quality: str) -> str:
    """Scene in whose folder the result of a stage lies: a study's variant shares what others would make alike."""
    for shared in studies.bases(scene):
        if fingerprint(stage, shared, quality) == fingerprint(stage, scene, quality):
            return shared
    return scene
