"""Plug-ins: kinds of sources, priors and segmentations, settings, stages and solvers that are no part of the product.

The environment variable IIF_PLUGINS names modules in packages of this checkout, comma separated; jobs inherit it. Such a module
holds nothing but names, so that it imports nothing, and defines any of

    KINDS    section (`source`, `prior`, `segmentation`) -> kind -> (module that implements it, class of its settings)
    SECTIONS section of the settings (`segmentation.geometry`: of one kind; `scene`: all of them) -> subclass that adds fields,
             each with a default
    STAGES   stage -> function of the dumped settings -> name of the module whose `run(job)` takes the stage's place, or None
    READS    stage -> dotted settings that such a module reads in addition to those in `workflow/registry.py`
    ADDED    stage that is made on demand -> the arguments of its `Stage`
    SIZES    kind of source that is rendered -> function of its settings and of the faces of its mesh files -> faces
    COSTS    such a kind, or an added stage -> function of settings and size -> kind and counts (workflow/costs/work.py)
    TRUTH    kinds of prior that are made of ground truth, whose scenes may therefore read it
    SCENES   folder of the checkout with further scene files
    DERIVED  module that derives further scenes (workflow/settings/derived.py), with `layers`, `bases`, `shared_scene` and
             `file_of_source`
    QUALITY  folder of the checkout with settings that lie under those of the quality of the same name

Classes and functions are written `package.module:name`. The settings of the product read the classes while they are imported
themselves. So a module that holds such classes lies in a package whose `__init__` imports `workflow.settings`; it imports modules
of `workflow.settings` and nothing from the package itself, and the subclass of `scene` has a module to itself.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable
from functools import lru_cache, reduce
from operator import or_
from pathlib import Path
from types import ModuleType
from typing import Any, get_args

from iif_core.errors import InputError

VARIABLE = "IIF_PLUGINS"
_OWN = {"source": "workflow.sources", "prior": "workflow.priors", "segmentation": "workflow.segmentations"}
"""Sections with a `kind` -> package that holds the module of each kind of the product."""


@lru_cache(None)
def modules() -> tuple[ModuleType, ...]:
    """Return the plug-ins of this process.

    Raises:
        InputError: IIF_PLUGINS names a module that is not in this checkout.
    """
    names = [name.strip() for name in os.environ.get(VARIABLE, "").split(",") if name.strip()]
    for name in names:
        path = Path(__file__).resolve().parents[1].joinpath(*name.split("."))
        if not (path.with_suffix(".py").is_file() or (path / "__init__.py").is_file()):
            raise InputError(
                f"{VARIABLE}={os.environ[VARIABLE]}: found no module {name!r} in this checkout; allowed are names of its modules,"
                " comma separated. Correct the name, or unset the variable"
            )
    return tuple(importlib.import_module(name) for name in names)


def packages() -> tuple[str, ...]:
    """Return the top packages of the plug-ins, whose code counts in fingerprints as the product's does."""
    return tuple(dict.fromkeys(module.__name__.split(".")[0] for module in modules()))


def _entries(table: str) -> list[tuple[str, Any]]:
    return [entry for module in modules() for entry in getattr(module, table, {}).items()]


def _load(name: str) -> Any:
    module, _, attribute = name.partition(":")
    return getattr(importlib.import_module(module), attribute)


def function(table: str, name: str) -> Callable[..., Any] | None:
    """Return the function that a plug-in has in a table under a name; None if there is none."""
    found = [value for key, value in _entries(table) if key == name]
    return _load(found[-1]) if found else None


def union(section: str, *own: type) -> Any:
    """Return the union of the classes of settings of a section: the product's, or the subclasses that plug-ins put in their
    place, and those of the kinds that plug-ins add."""
    ours = [extended(f"{section}.{get_args(one.model_fields['kind'].annotation)[0]}", one) for one in own]
    added = [_load(settings) for name, kinds in _entries("KINDS") if name == section for _, settings in kinds.values()]
    return reduce(or_, [*ours, *added])


def implementation(section: str, kind: str) -> str:
    """Return the name of the module that implements a kind of `source`, `prior` or `segmentation`."""
    added = [own[kind][0] for name, own in _entries("KINDS") if name == section and kind in own]
    return added[-1] if added else f"{_OWN[section]}.{kind}"


def extended(section: str, own: type) -> type:
    """Return the class of a section of the settings: the product's, or the subclass that plug-ins put in its place."""
    for found in (_load(name) for key, name in _entries("SECTIONS") if key == section):
        if not issubclass(found, own):
            raise TypeError(f"{found.__name__} takes the place of {own.__name__} and is no subclass of it")
        own = found
    return own


def replacement(stage: str, document: dict[str, Any]) -> str | None:
    """Return the name of the module that takes the place of a stage with these (dumped) settings; None = the stage's own."""
    chosen = [_load(choose)(document) for name, choose in _entries("STAGES") if name == stage]
    return next((module for module in chosen if module), None)


def reads(stage: str) -> tuple[str, ...]:
    """Return the dotted settings that a module in the place of a stage reads in addition to those of the stage."""
    return tuple(key for name, keys in _entries("READS") if name == stage for key in keys)


def made_of_truth() -> set[str]:
    """Return the kinds of prior that are made of ground truth."""
    return {kind for kinds in named("TRUTH") for kind in kinds}


def named(name: str) -> list[str]:
    """Return what plug-ins have under a name that is no table: SCENES or QUALITY, which are folders, TRUTH or DERIVED."""
    return [getattr(module, name) for module in modules() if hasattr(module, name)]


def derived() -> Any:
    """Return the module that derives further scenes from those that there are; None without such a plug-in."""
    return importlib.import_module(named("DERIVED")[-1]) if named("DERIVED") else None


def added_stages() -> dict[str, dict[str, Any]]:
    """Return the stages that plug-ins add: name -> arguments of `workflow.registry.Stage`."""
    return dict(_entries("ADDED"))
