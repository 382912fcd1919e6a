"""Which module runs a stage in the place of the product's, with given settings (lab/plugins.py); None: the product's own.

Manifests of stages that the product ran have none of the laboratory's settings.
"""

from __future__ import annotations

from typing import Any

PUBLISHED = "lab.published.stages"


def plan(settings: dict[str, Any]) -> str | None:
    """The published method decides about the parts of the model itself."""
    return f"{PUBLISHED}.plan" if emission(settings) or shading(settings) else None


def base(settings: dict[str, Any]) -> str | None:
    """Another solver, loss or variant of ours."""
    own, ours = settings["base"], {"solver": "direct", "variant": "full", "objective": "least_squares", "judge": False}
    return f"{PUBLISHED}.base" if any(own.get(name, value) != value for name, value in ours.items()) else None


def emission(settings: dict[str, Any]) -> str | None:
    """The published descent to emitters."""
    return f"{PUBLISHED}.emission" if settings["emission"].get("solver", "direct") != "direct" else None


def shading(settings: dict[str, Any]) -> str | None:
    """Light of one bounce at every pixel."""
    return f"{PUBLISHED}.shading" if settings["shading"].get("method", "shared_paths") != "shared_paths" else None


def second_look(settings: dict[str, Any]) -> str | None:
    """The fusion of stage base, once more."""
    return f"{PUBLISHED}.second_look" if base(settings) else None


def affines(settings: dict[str, Any]) -> str | None:
    """Another solver, or the materials of an earlier method."""
    if settings["affines"].get("model", "objects") != "objects":
        return "lab.baselines.stage"
    return f"{PUBLISHED}.affines" if settings["affines"].get("solver", "direct") != "direct" else None
