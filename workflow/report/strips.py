"""The pictures of one view in the report: result, truth, prediction and checks, row by row."""

from __future__ import annotations

import numpy as np

from workflow.artifacts.store import ids_from_disk, material_maps, prediction_numbers, rgb
from workflow.report import pictures as pic
from workflow.report.page import Picture, Strip, ViewRows
from workflow.report.reported import Reported
from workflow.report.views import photograph_and_rerendering, sensor_values
from workflow.scene import unexplained
from workflow.scene.normal_form import Truth, View
from workflow.scene.recovered import Recovered

WIDTH = 448
"""Longest side of a picture of a map."""
ERROR_RANGE, COVERAGE_RANGE, UNCERTAINTY_RANGE = 0.25, 4.0, 0.2
"""What is shown lightest."""
UNEXPLAINED_RANGE = 1.0
"""Stops at both ends of the colours."""

Maps = dict[str, np.ndarray]


def view_rows(scene: Reported, view: View, emission_exposure: float, score: float | None) -> ViewRows:
    """Return all pictures of a view. `emission_exposure`: of `exposure_of_emission`; `score`: PSNR in dB, None = not scored."""
    file = f"maps/{view.name}.exr"
    sensor, valid = sensor_values(scene, view)
    depth, face_id = scene.capture.gbuffer(view)
    counted = valid & (face_id >= 0)
    rendered, predictions = scene.readers["render"].exr(file), scene.readers["prior"]
    photograph, rerendering = photograph_and_rerendering(scene, view, sensor, WIDTH)
    result = material_maps(rendered) if "albedo.R" in rendered else None
    emission = _linear("emission", rgb(rendered, "emission"), "radiance", exposure=emission_exposure)
    off = pic.difference(rgb(rendered, "ldr"), sensor, counted)
    error = _false("re-rendering error", off, "error", ERROR_RANGE, "sensor value")
    strips = [Strip("result", [rerendering, *(_materials(result) if result else [None] * 3), emission, error])]
    if scene.capture.has_truth:
        strips.append(_truth(scene.capture.truth(view), photograph, result, face_id >= 0, emission_exposure))
        photograph = None  # it is shown once
    channels = predictions.exr(file) if predictions.has(file) else {}
    if prediction_numbers(channels):
        strips.append(_prediction(channels, photograph))
    elif photograph:
        strips.append(Strip("photograph", [photograph]))
    strips.append(Strip("checks", _checks(scene, view, sensor, depth, counted)))
    captions = [f"{score:.1f} dB"] if score is not None else []
    captions += [f"{view.width} x {view.height}", f"exposure {view.exposure:.3g}"]
    if view.split == "test":
        captions.append("held out: not used in the reconstruction")
    return ViewRows(view.name, ", ".join(captions), strips, file)


def exposure_of_emission(recovered: Recovered) -> float:
    """Return the factor at which emitters of median radiance, by area, appear just below white; brighter ones clip."""
    lit = np.flatnonzero(recovered.light.emits)
    peak, area = recovered.light.radiance[lit].max(-1), recovered.surface.areas[lit]
    order = np.argsort(peak, kind="stable")
    half = np.searchsorted(np.cumsum(area[order]), 0.5 * area.sum())
    return 0.8 / max(float(peak[order][min(half, len(lit) - 1)]), 1e-6) if len(lit) else 1.0


def _linear(title: str, image: np.ndarray, unit: str, note: str = "", exposure: float = 1.0) -> Picture:
    """Return the picture of linear colours, shown times `exposure`."""
    return Picture(title, pic.data_uri(pic.linear(image, exposure), longest=WIDTH), note, "srgb", 0.0, exposure, unit)


def _grey(title: str, values: np.ndarray) -> Picture:
    return Picture(title, pic.data_uri(pic.grey(values), longest=WIDTH), "", "grey", 0.0, 1.0, title)


def _false(title: str, image: np.ndarray, scheme: str, high: float, unit: str, note: str = "") -> Picture:
    """Return the picture of a scalar in false colours, from 0 to `high`."""
    return Picture(title, pic.data_uri(image, True, WIDTH), note, scheme, 0.0, high, unit)


def _ids(title: str, image: np.ndarray, note: str = "") -> Picture:
    return Picture(title, pic.data_uri(image, True, WIDTH), note)


def _materials(maps: Maps) -> list[Picture]:
    return [
        _linear("albedo", maps["albedo"], "albedo, linear"),
        _grey("roughness", maps["roughness"]),
        _grey("metallic", maps["metallic"]),
    ]


def _truth(truth: Truth, photograph: Picture, result: Maps | None, hit: np.ndarray, emission_exposure: float) -> Strip:
    maps = {"albedo": truth.albedo, "roughness": truth.roughness, "metallic": truth.metallic}
    emission = _linear("emission", truth.emission, "radiance", "same exposure as the result's", emission_exposure)
    error = None
    if result:
        picture = pic.difference(result["albedo"], truth.albedo, truth.valid & hit & ~(truth.emission > 0).any(-1))
        error = _false("albedo error", picture, "error", ERROR_RANGE, "albedo, linear")
    return Strip("truth", [photograph, *_materials(maps), emission, error])


def _prediction(channels: Maps, photograph: Picture | None) -> Strip:
    """Show the first prediction, and the spread of the predictions."""
    numbers = prediction_numbers(channels)
    first = _materials(material_maps(channels, f"prior.{numbers[0]:03d}."))
    spread = np.std([rgb(channels, f"prior.{k:03d}.albedo") for k in numbers], axis=0).mean(-1)
    shown = pic.scalar(spread, 0, UNCERTAINTY_RANGE)
    apart = _false("disagreement", shown, "value", UNCERTAINTY_RANGE, "albedo", "standard deviation over the predictions")
    return Strip("raw prediction", [photograph, *first, apart])


def _checks(scene: Reported, view: View, sensor: np.ndarray, depth: np.ndarray, counted: np.ndarray) -> list[Picture]:
    """Show alignment, objects, selected prediction, uncertainty, base texture and unexplained light of a view, as far as they
    exist."""
    segmentation, base, affines = (scene.readers[stage] for stage in ("segmentation", "base", "affines"))
    file = f"maps/{view.name}.exr"
    out: list[Picture] = []
    if segmentation.has(file):
        channels = segmentation.exr(file)
        object_id, segment_id = ids_from_disk(channels["object.id"]), ids_from_disk(channels["segment.id"])
        out.append(_ids("alignment", pic.alignment(sensor, object_id, depth)))
        objects = pic.data_uri(pic.overlay(sensor, object_id), longest=WIDTH)
        out.append(Picture("objects", objects, "one colour for each object, over the photograph"))
        table = base.table("selection.parquet")
        if len(table["k"]):
            k = pic.selected_prediction(segment_id, table["segment_id"], table["k"], table["weight_albedo"])
            out.append(_ids("selected prediction", pic.ids(k), "one colour for each number k"))
    if affines.has(file):
        uncertainty = affines.exr(file)["uncertainty"].astype(np.float32)
        note = "claimed standard error; errors that all predictions share are not in it"
        shown = pic.scalar(uncertainty, 0, UNCERTAINTY_RANGE, mask=counted)
        out.append(_false("uncertainty", shown, "value", UNCERTAINTY_RANGE, "albedo", note))
    if base.has(file):
        maps = base.exr(file)
        out.append(_linear("base albedo", rgb(maps, "albedo"), "albedo, linear", "before the fit"))
        shown = pic.scalar(maps["coverage"], 0, COVERAGE_RANGE, mask=counted)
        out.append(_false("coverage", shown, "value", COVERAGE_RANGE, "pixels", "weighted, of the surface cell; 0: filled in"))
    if (render := scene.readers["render"]).has(lacking := unexplained.name_of(view)):
        stops = np.log2(rgb(render.exr(lacking)).astype(np.float32)).mean(-1)
        uri = pic.data_uri(pic.scalar(stops, -UNEXPLAINED_RANGE, UNEXPLAINED_RANGE, mask=counted), True, WIDTH)
        note = "by how much re-renderings are too dark, as far as other photographs agree on it"
        out.append(Picture("unexplained light", uri, note, "value", -UNEXPLAINED_RANGE, UNEXPLAINED_RANGE, "stops"))
    return out
