"""What the settings of stage affines ask for: the level of all albedos, and materials that are given by hand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from iif_core.errors import InputError
from iif_core.fitting.gauge import Gauge
from iif_core.fitting.problem import FitProblem
from workflow.fitting.inputs import prediction_errors
from workflow.runtime.job import Job
from workflow.scene.cached_light import has_lobes
from workflow.scene.named import object_number
from workflow.scene.normal_form import CaptureReader
from workflow.settings import scene_origin
from workflow.settings.affines import KnownLamp


@dataclass(frozen=True)
class Places:
    """View id and index into the flattened image of each pixel of the problem, (n,)."""

    view: np.ndarray
    index: np.ndarray


def find_gauge(job: Job, capture: CaptureReader, names: list[str]) -> Callable[[FitProblem, Places], Gauge]:
    """Check `affines.scale` and return a function that makes the gauge once the pixels of the problem are known."""
    scale = job.settings.affines.scale
    if isinstance(scale, str):
        gauge = Gauge(scale)
        if capture.is_hdr or scale == "found":
            stated = prediction_errors(job)
            gauge = Gauge("found", error=_light_error(job))
            gauge = gauge if stated is None else replace(gauge, prior_error=stated.level)
        return lambda problem, places: gauge
    if getattr(scale, "mean_albedo", None) is not None:
        return lambda problem, places: Gauge("mean_albedo", scale.mean_albedo)
    if getattr(scale, "lamp", None) is not None:
        return _lamp_gauge(job, scale.lamp)
    patch = scale.white_patch
    if patch.object is not None:
        number = object_number(patch.object, names, "affines.scale.white_patch.object")
        return lambda problem, places: Gauge("white_patch", patch.albedo, problem.object_id == number)
    known = {view.name: view for view in capture.used}
    if patch.view not in known:
        raise InputError(f"affines.scale.white_patch.view: no view {patch.view!r}; there are {', '.join(sorted(known)[:20])}")
    view, (left, top, right, bottom) = known[patch.view], patch.box
    if not (0 <= left < right <= view.width and 0 <= top < bottom <= view.height):
        raise InputError(
            f"affines.scale.white_patch.box: {list(patch.box)}; [left, top, right, bottom] must lie within the"
            f" {view.width} x {view.height} pixels of view {patch.view}"
        )

    def inside(problem: FitProblem, places: Places) -> Gauge:
        x, y = places.index % view.width, places.index // view.width
        chosen = (places.view == view.view_id) & (x >= left) & (x < right) & (y >= top) & (y < bottom)
        return Gauge("white_patch", patch.albedo, chosen)

    return inside


def _light_error(job: Job) -> float:
    """Return the standard error of the logarithm of the level of the light; infinite if the photographs do not determine it."""
    error = job.read("emission").json("emission.json")["level_error"]
    return float("inf") if error is None else float(error)


def _lamp_gauge(job: Job, lamp: KnownLamp) -> Callable[[FitProblem, Places], Gauge]:
    """Return the gauge of a lamp of known radiance, which must be among the emitters that were kept."""
    table = job.read("emission").table("emitters.parquet")
    row = np.flatnonzero((table["emitter_id"] == lamp.emitter_id) & table["kept"].astype(bool))
    if not len(row):
        kept = table["emitter_id"][table["kept"].astype(bool)].tolist()
        raise InputError(
            f"affines.scale.lamp.emitter_id: no emitter {lamp.emitter_id} was kept; there are {kept} (emission/emitters.parquet)"
        )
    found = float(np.mean([table[f"radiance_{c}"][row[0]] for c in "rgb"]))
    return lambda problem, places: Gauge("lamp", factor=float(np.mean(lamp.radiance)) / max(found, 1e-30))


def given_materials(job: Job, names: list[str]) -> np.ndarray | None:
    """Return roughness and metallic (O, 2) that `materials` gives, NaN = fitted; None if it gives nothing.

    Raises:
        InputError: no object has this name or id, two entries mean the same object, or the model has no specular lobes.
    """
    wanted: dict[str, Any] = vars(job.settings.materials)
    if not wanted:
        return None
    where = f"{scene_origin(job.scene)}: `materials`"
    if not has_lobes(job):
        raise InputError(
            f"{where}: found materials given by hand, but this scene is fitted without specular lobes, so they would change"
            " nothing; set `components: {specular: on}`, or remove them"
        )
    given = np.full((len(names), 2), np.nan)
    for key, entry in wanted.items():
        number = object_number(key, names, where)
        if not np.isnan(given[number]).all():
            raise InputError(f"{where}: {key}: object {names[number]!r} is there twice, by its name and by its id; remove one")
        given[number] = [np.nan if value is None else value for value in (entry.roughness, entry.metallic)]
    return given
