"""The size of rendered sources and the work of the stages of the laboratory, for the cost model (workflow/costs/work.py)."""

from __future__ import annotations

from typing import Any

from lab.settings.capture import paths
from workflow.costs.work import MILLION, SceneSize, base_cells

FACES_OF_ROOM = 60_000
"""Of a room that is made, before its faces are divided."""


def faces_of_room(source: dict[str, Any], faces: float) -> float:
    """Return the faces of a built-in room."""
    return FACES_OF_ROOM * 4.0 ** source["quarterings"]


def faces_of_files(source: dict[str, Any], faces: float) -> float:
    """Return the faces of a scene whose mesh files have `faces`."""
    return faces


def rendered(settings: dict[str, Any], size: SceneSize) -> tuple[str, dict[str, float]]:
    """Count the work of stage capture that renders its photographs."""
    pixels = size.pixels / MILLION
    counts = {"paths": pixels * paths(settings["capture"]), "pixels": pixels, "faces": size.faces / MILLION}
    return settings["source"]["kind"], counts


def relit_truth(settings: dict[str, Any], size: SceneSize) -> tuple[str, dict[str, float]]:
    """Count the work of stage `relit_truth`."""
    return settings["source"]["kind"], _relit_pictures(settings, size)


def relit_scores(settings: dict[str, Any], size: SceneSize) -> tuple[str, dict[str, float]]:
    """Count the work of stage `relit_scores`."""
    return "all", _relit_pictures(settings, size)


def base_scores(settings: dict[str, Any], size: SceneSize) -> tuple[str, dict[str, float]]:
    """Count the work of stage `base_scores`."""
    return "all", {"pixels": size.pixels / MILLION}


def common_scores(settings: dict[str, Any], size: SceneSize) -> tuple[str, dict[str, float]]:
    """Count the work of stage `common_scores`."""
    return "all", {"faces": size.faces / MILLION, "cells": base_cells(settings, size)}


def _relit_pictures(settings: dict[str, Any], size: SceneSize) -> dict[str, float]:
    """Pixels of all pictures under new light, if the room has as many lamps as may shine alone."""
    relit = settings["relit"]
    lights = relit["lamps"] + relit["moved"] + (relit["environment"] is not None) + relit["spheres"]
    pixels = lights * relit["views"] * size.pixels / max(size.views, 1) / MILLION
    return {"paths": pixels * relit["samples"], "pixels": pixels, "faces": size.faces / MILLION}
