"""Prior `pooled`: the predictions of several priors, one behind the other, as K predictions of one photograph."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType, SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np

from workflow import plugins
from workflow.priors import Keep, Predicted, members, predictor, seed_of

if TYPE_CHECKING:
    from pathlib import Path

    from workflow.scene.normal_form import CaptureReader, View


def raw_inputs(document: dict[str, Any]) -> list[Path]:
    """List the files that the members read, and refuse missing ones."""
    found: list[Path] = []
    for member in document["prior"]["of"]:
        module = _module(member["kind"])
        if hasattr(module, "raw_inputs"):
            found.extend(module.raw_inputs({**document, "prior": member}))
    return list(dict.fromkeys(found))


def describe(settings: SimpleNamespace) -> dict[str, Any]:
    """Return the facts about each member that is a learned model, and how the first that knows it says its predictions err."""
    facts = []
    for own in members(settings.prior):
        module = _module(own.kind)
        describes = hasattr(module, "describe")
        facts.append(module.describe(member_settings(settings, own)) if describes else {"prior": own.kind})
    errors = [one["object_errors"] for one in facts if "object_errors" in one]
    return {"prior": "pooled", "of": facts, **({"object_errors": errors[0]} if errors else {})}


def member_settings(settings: SimpleNamespace, member: SimpleNamespace) -> SimpleNamespace:
    """Return the settings of a scene as a member would find them if it were the only prior."""
    return SimpleNamespace(**{**vars(settings), "prior": member})


class Pool:
    """Members that are ready to predict.

    The scales are those of the first member that states any, for the predictions of all: a pixel has one scale.
    """

    def __init__(self, settings: SimpleNamespace, capture: CaptureReader, seed: int, keep: Keep, threads: int = 1):
        self._members = [
            predictor(member_settings(settings, own), capture, seed_of(own, seed), keep, threads)
            for own in members(settings.prior)
        ]
        self.concurrent = all(getattr(one, "concurrent", False) for one in self._members)

    def __call__(self, view: View) -> Predicted:
        """Make the predictions of all members of a view."""
        made = [member(view) for member in self._members]
        scale = next((one.scale for one in made if one.scale is not None), None)
        return Predicted(np.concatenate([one.maps for one in made]), scale)


prepare = Pool


def _module(kind: str) -> ModuleType:
    return import_module(plugins.implementation("prior", kind))
