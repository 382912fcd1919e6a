"""The work of each stage, counted in what its loops run over: pixels, predictions, paths, faces.

The cost of a job is a sum over these counts, with factors that are fitted to finished jobs (workflow/costs/model.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, NamedTuple, TypeVar

from iif_core.fusion.options import CellOptions
from iif_core.light.emission.options import EmissionOptions
from iif_core.light.options import ShadingOptions
from workflow import plugins
from workflow.settings.options import options_of
from workflow.settings.prior import members, predictions

Options = TypeVar("Options")

MILLION = 1e6
PROBED_VIEWS = 32
"""Photographs that stage plan reads."""


@dataclass(frozen=True)
class SceneSize:
    """What decides the cost of a scene, in addition to its settings.

    Attributes:
        views: photographs.
        pixels: of all of them together, at the size that they are worked on.
        faces: of the mesh.
        source_mb: size of the files that `capture` reads, in MB; 0 where it renders the photographs.
        exact: whether these are counts of a finished capture, or estimates from settings and headers of files.
        photographs: whose cameras are to be found; 0 where they are known.
    """

    views: int
    pixels: float
    faces: float
    source_mb: float = 0.0
    exact: bool = False
    photographs: int = 0


class Work(NamedTuple):
    """The counts of one job, in millions (views: in hundreds), and what kind of job it is: other kinds have other factors."""

    kind: str
    counts: dict[str, float]


def work_of(stage: str, settings: dict[str, Any], size: SceneSize) -> Work:
    """Return the work of a stage.

    Args:
        stage: name of a stage of workflow/registry.py.
        settings: all settings of the scene, as plain values (`workflow.settings.dump`).
        size: of the scene.

    Returns:
        The kind, such as `direct` or the module of a plug-in that takes the place of the stage, and the counts. Every job has
        the count `job` of 1, for what it costs to start, and `a_view`, the pixels of one photograph, which is what stages hold
        that work on one after the other.
    """
    kind, counts = (plugins.function("COSTS", stage) or _STAGES[stage])(settings, size)
    kind = plugins.replacement(stage, settings) or kind  # which nobody has measured
    a_view = size.pixels / max(size.views, 1) / MILLION
    return Work(kind, {"job": 1.0, "a_view": a_view, **{name: float(value) for name, value in counts.items()}})


def _capture(settings: dict[str, Any], size: SceneSize) -> tuple[str, dict[str, float]]:
    of_plugin = plugins.function("COSTS", settings["source"]["kind"])
    if of_plugin:
        return of_plugin(settings, size)
    pixels, faces = size.pixels / MILLION, size.faces / MILLION
    return "photographs", {"pixels": pixels, "faces": faces, "source_mb": size.source_mb, "views": size.views / 100}


def _plan(settings: dict[str, Any], size: SceneSize) -> tuple[str, dict[str, float]]:
    read = min(size.views, PROBED_VIEWS) * size.pixels / max(size.views, 1) / MILLION
    return "probes", {"pixels": read, "faces": size.faces / MILLION}


def _prior(settings: dict[str, Any], size: SceneSize) -> tuple[str, dict[str, float]]:
    pixels = size.pixels / MILLION
    return settings["prior"]["kind"], {"predictions": pixels * predictions(settings["prior"]), "pixels": pixels}


def _segmentation(settings: dict[str, Any], size: SceneSize) -> tuple[str, dict[str, float]]:
    return settings["segmentation"]["kind"], {"pixels": size.pixels / MILLION, "faces": size.faces / MILLION}


def _options(options: type[Options], section: dict[str, Any], **given: Any) -> Options:
    return options_of(options, SimpleNamespace(**section), **given)


def _base(settings: dict[str, Any], size: SceneSize) -> tuple[str, dict[str, float]]:
    base, pixels, faces = settings["base"], size.pixels / MILLION, size.faces / MILLION
    fused = pixels * min(_options(CellOptions, base).predictions or 1 << 30, predictions(settings["prior"]))
    return "direct", {"predictions": fused, "pixels": pixels, "faces": faces, "cells": base_cells(settings, size)}


def base_cells(settings: dict[str, Any], size: SceneSize) -> float:
    """Cells of the base in millions, up to a factor: a view shows as many as it has pixels over the area of a cell, and other
    views show some of them again."""
    return (size.pixels * size.views**-0.5) / settings["base"]["cell_footprints"] ** 2 / MILLION


def _emission(settings: dict[str, Any], size: SceneSize) -> tuple[str, dict[str, float]]:
    emission, faces = settings["emission"], size.faces / MILLION
    rows = min(emission["rows"], size.pixels) / MILLION
    seen = min(_options(EmissionOptions, emission, seed=0).pixels, size.pixels) / MILLION
    return "direct", {
        "rows": rows,
        "paths": rows * emission["samples"],
        "pixels": seen,
        "views": size.views / 100,
        "faces": faces,
    }


def _shading(settings: dict[str, Any], size: SceneSize) -> tuple[str, dict[str, float]]:
    shading, pixels, faces = settings["shading"], size.pixels / MILLION, size.faces / MILLION
    traced = pixels if shading["pixels"] == "all" else min(shading["pixels"] / MILLION, pixels)
    options = _options(ShadingOptions, shading, seed=0)
    cells = 1 / options.cell_edge**2 / MILLION  # a square metre
    return "shared_paths", {
        "specular": traced * shading["samples"],
        "written": traced * shading["levels"],
        "diffuse": cells * shading["samples"],
        "adaptive": cells * min(options.noise**-2, options.max_samples),
        "pixels": pixels,
        "faces": faces,
    }


def _second_look(settings: dict[str, Any], size: SceneSize) -> tuple[str, dict[str, float]]:
    if not settings["second_look"]["enabled"] or all(one["kind"] != "learned" for one in members(settings["prior"])):
        return "none", {}
    kind, counts = _base(settings, size)
    del counts["predictions"]  # they lie on disk, and the network makes all of them whatever K is
    return f"learned_{kind}", counts


def _affines(settings: dict[str, Any], size: SceneSize) -> tuple[str, dict[str, float]]:
    affines, pixels, faces = settings["affines"], size.pixels / MILLION, size.faces / MILLION
    read = pixels if affines["pixels"] == "all" else min(affines["pixels"] / MILLION, pixels)
    kind = "textured" if settings["prior"]["kind"] == "retinex" else "direct"
    return kind, {"read": read, "pixels": pixels, "faces": faces, "cells": base_cells(settings, size)}


def _render(settings: dict[str, Any], size: SceneSize) -> tuple[str, dict[str, float]]:
    pixels = size.pixels / MILLION
    return "all", {"paths": pixels * settings["render"]["samples"], "pixels": pixels, "faces": size.faces / MILLION}


def _lamp_images(settings: dict[str, Any], size: SceneSize) -> tuple[str, dict[str, float]]:
    pixels = sum(_pixels_of(basis["camera"], size) for basis in settings["lamp_images"])
    paths = sum(_pixels_of(basis["camera"], size) * basis["samples"] for basis in settings["lamp_images"])
    return "all", {"paths": paths, "pixels": pixels, "faces": size.faces / MILLION}


def _relight(settings: dict[str, Any], size: SceneSize) -> tuple[str, dict[str, float]]:
    entries = settings["relight"]
    traced = [one for one in entries if one["name"] not in settings["recombined"]]
    paths = sum(_pixels_of(one["camera"], size) * one["samples"] for one in traced)
    pixels = sum(_pixels_of(one["camera"], size) for one in entries)
    return "all", {"paths": paths, "pixels": pixels, "faces": size.faces / MILLION}


def _pixels_of(camera: dict[str, Any], size: SceneSize) -> float:
    """Pixels of all frames of a relighting, in millions."""
    a_view = size.pixels / max(size.views, 1)
    shape = (camera["width"] or a_view**0.5) * (camera["height"] or a_view**0.5)
    return camera["frames"] * shape / MILLION


def _metrics(settings: dict[str, Any], size: SceneSize) -> tuple[str, dict[str, float]]:
    metrics = settings["metrics"]
    share = 1.0 if metrics["views"] == "all" else min(1.0, metrics["views"] / max(size.views, 1))
    scored = share * size.pixels / MILLION
    counts = {"scored": scored, "pixels": size.pixels / MILLION, "faces": size.faces / MILLION}
    return ("vgg" if metrics["lpips_vgg"] else "all"), counts


def _export(settings: dict[str, Any], size: SceneSize) -> tuple[str, dict[str, float]]:
    texels = settings["export"]["texture_size"] ** 2 / MILLION
    return "all", {"faces": size.faces / MILLION, "cells": base_cells(settings, size), "texels": texels}


def _unwrap(settings: dict[str, Any], size: SceneSize) -> tuple[str, dict[str, float]]:
    return "all", {"faces": size.faces / MILLION, "pixels": size.pixels / MILLION}


def _room(settings: dict[str, Any], size: SceneSize) -> tuple[str, dict[str, float]]:
    texels = settings["room"]["lightmap_size"] ** 2 / MILLION
    counts = {"paths": texels * settings["room"]["samples"], "texels": texels, "pixels": size.pixels / MILLION}
    return "all", {**counts, "faces": size.faces / MILLION, "cells": base_cells(settings, size)}


def _report(settings: dict[str, Any], size: SceneSize) -> tuple[str, dict[str, float]]:
    shown = min(settings["report"]["views"], size.views) * size.pixels / max(size.views, 1) / MILLION
    return "all", {"shown": shown, "pixels": size.pixels / MILLION, "faces": size.faces / MILLION}


def _publish(settings: dict[str, Any], size: SceneSize) -> tuple[str, dict[str, float]]:
    return "all", {"pixels": size.pixels / MILLION, "faces": size.faces / MILLION}


def _reconstruction(settings: dict[str, Any], size: SceneSize) -> tuple[str, dict[str, float]]:
    depth = size.photographs * settings["source"].get("detail", 0) ** 2 / MILLION
    # Every photograph is matched with every other one.
    return "photographs", {"photographs": size.photographs / 100, "pairs": (size.photographs / 100) ** 2, "depth": depth}


_STAGES = {
    "reconstruction": _reconstruction,
    "capture": _capture,
    "plan": _plan,
    "prior": _prior,
    "segmentation": _segmentation,
    "base": _base,
    "emission": _emission,
    "shading": _shading,
    "second_look": _second_look,
    "affines": _affines,
    "render": _render,
    "lamp_images": _lamp_images,
    "relight": _relight,
    "metrics": _metrics,
    "unwrap": _unwrap,
    "export": _export,
    "room": _room,
    "report": _report,
    "publish": _publish,
}
