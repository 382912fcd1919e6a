"""metrics: scores of the result, and of what it should be better than, against ground truth and photographs."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import numpy as np

from iif_core import metrics
from workflow.artifacts.store import StageReader, ids_from_disk, rgb
from workflow.job import Job
from workflow.normal_form import CaptureReader, View
from workflow.scores import (
    MATERIALS,
    UNITS,
    ScoreRows,
    material_maps,
    material_truth,
    perceptual_networks,
    prediction_numbers,
)

BASELINES = {
    "prior_k0": "the first prediction of each view, as the prior gave it",
    "prior_mean_k": "mean L2 and PSNR of all predictions of each view (not those of their mean)",
    "object_mean": "one value an object: mean of all predictions of all views",
    "texel_mean": "one value a surface cell: mean of all predictions of all views",
    "base": "the fused base texture, before the fit to the photographs",
    "result": "what is published",
}


MEAN_METRICS = ("l2", "psnr")
"""What `prior_mean_k` has: the others take most of the stage's time when every prediction is scored with them."""


def run(job: Job) -> None:
    """Score every view; write metrics.parquet (the result), variants.parquet (with the baselines) and summary.json."""
    capture = CaptureReader(job.read("capture"))
    rows = ScoreRows()
    networks = perceptual_networks()
    means = _PredictionMeans(job, capture) if capture.has_truth else None
    exposures = capture.exposures()

    def scores_of(index: int) -> list[tuple[str, str, str, list[metrics.Score]]]:
        return list(_view_scores(job, capture, capture.views[index], float(exposures[index]), means, networks))

    with ThreadPoolExecutor(job.threads) as pool:
        # map keeps the order of the views, so the tables do not depend on the number of threads
        for done, scored in enumerate(pool.map(scores_of, range(len(capture.views)))):
            for entry in scored:
                rows.add(*entry)
            job.progress(done + 1, len(capture.views), "views scored")
    job.writer.table("metrics.parquet", rows.table(job.scene, {"result"}), UNITS)
    job.writer.table("variants.parquet", rows.table(job.scene), UNITS)
    job.writer.json("summary.json", _summary(rows, capture))


def _view_scores(
    job: Job,
    capture: CaptureReader,
    view: View,
    exposure: float,
    means: _PredictionMeans | None,
    networks: dict[str, dict[str, np.ndarray]],
) -> Iterator[tuple[str, str, str, list[metrics.Score]]]:
    """(variant, view, quantity, scores) of one view."""
    photo, valid = capture.photo(view)
    _, face_id = capture.gbuffer(view)
    hit = face_id >= 0
    file = f"maps/{view.name}.exr"
    rendered = job.read("render").exr(file)
    sensor = np.clip(exposure * photo, 0, 1) if capture.is_hdr else photo
    yield (
        "result",
        view.name,
        "rgb",
        metrics.score_map("rgb", rgb(rendered, "ldr"), sensor, valid & hit, encoded=not capture.is_hdr, networks=networks),
    )
    if capture.is_hdr:
        yield "result", view.name, "rgb", _log_scores(rgb(rendered), photo, valid & hit)
    if means is None:
        return
    materials = material_truth(capture, job.read("segmentation"), view)
    truth = materials.truth
    if not capture.is_hdr:
        yield "result", view.name, "rgb", _log_scores(rgb(rendered), truth.radiance, valid & hit)
    yield (
        "result",
        view.name,
        "emission",
        metrics.score_map("emission", rgb(rendered, "emission"), truth.emission, materials.masks["emission"]),
    )
    # The learned metrics take longer than the others, so only what is looked at has them: base, result, first prediction.
    learned = partial(materials.scores, networks=networks)
    for variant, stage in (("base", "base"), ("result", "affines")):
        if job.read(stage).has(file):
            maps = material_maps(job.read(stage).exr(file))
            for quantity in MATERIALS:
                yield variant, view.name, quantity, learned(maps, quantity)
    if not job.read("prior").has(file):
        return
    channels = job.read("prior").exr(file)
    each: dict[str, list[list[metrics.Score]]] = {quantity: [] for quantity in MATERIALS}
    for number, k in enumerate(prediction_numbers(channels)):
        maps = material_maps(channels, f"prior.{k:03d}.")
        for quantity in MATERIALS:
            each[quantity].append(materials.scores(maps, quantity, only=MEAN_METRICS))
            if number == 0:
                yield "prior_k0", view.name, quantity, learned(maps, quantity)
    for quantity, lists in each.items():
        if lists:
            yield "prior_mean_k", view.name, quantity, _mean_scores(lists)
    for variant, maps in means.maps(view, materials.object_id):
        for quantity in MATERIALS:
            yield variant, view.name, quantity, materials.scores(maps, quantity)


def _log_scores(prediction: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> list[metrics.Score]:
    """log_l2 of radiance, also up to the gain that LDR photographs leave open."""
    by_protocol = metrics.score_map("emission", prediction, truth, mask, metrics=("log_l2",))
    return [score for score in by_protocol if score.metric == "log_l2"]


def _mean_scores(lists: list[list[metrics.Score]]) -> list[metrics.Score]:
    """Mean of each score over the predictions."""
    out = []
    for group in zip(*lists, strict=True):
        numbers = [score.value for score in group if score.value is not None]
        first = group[0]
        value = float(np.mean(numbers)) if numbers else None
        out.append(metrics.Score(first.metric, first.protocol, value, first.reason))
    return out


class _PredictionMeans:
    """The two baselines that average predictions in 3D (METHOD 6.1 B1, B2); one pass over the views."""

    def __init__(self, job: Job, capture: CaptureReader):
        self.base: StageReader = job.read("base")
        n_cells = len(self.base.table("cells.parquet")["cell_id"])
        n_objects = int(job.read("segmentation").table("objects.parquet")["object_id"].max(initial=-1)) + 1
        self.sums = {"object_mean": np.zeros((n_objects, 6)), "texel_mean": np.zeros((n_cells, 6))}
        for done, view in enumerate(capture.views):
            file = f"maps/{view.name}.exr"
            if not (job.read("prior").has(file) and self.base.has(file)):
                continue
            channels = job.read("prior").exr(file)
            numbers = prediction_numbers(channels)
            if not numbers:
                continue
            stacked = [_stack(material_maps(channels, f"prior.{k:03d}.")) for k in numbers]
            values = np.mean(stacked, axis=0, dtype=np.float64)
            object_id = ids_from_disk(job.read("segmentation").exr(file)["object.id"])
            cell_id = ids_from_disk(self.base.exr(file)["cell.id"])
            for name, ids in (("object_mean", object_id), ("texel_mean", cell_id)):
                known = ids >= 0
                table, rows = self.sums[name], values[known]
                for i in range(5):
                    table[:, i] += np.bincount(ids[known], rows[:, i], len(table))
                table[:, 5] += np.bincount(ids[known], minlength=len(table))
            job.progress(done + 1, len(capture.views), "views averaged for the baselines")

    def maps(self, view: View, object_id: np.ndarray) -> Iterator[tuple[str, dict[str, np.ndarray]]]:
        """(variant, maps) of one view; pixels without an id are 0."""
        file = f"maps/{view.name}.exr"
        if not self.base.has(file):
            return
        cell_id = ids_from_disk(self.base.exr(file)["cell.id"])
        for name, ids in (("object_mean", object_id), ("texel_mean", cell_id)):
            table = self.sums[name]
            mean = table[:, :5] / np.maximum(table[:, 5:], 1)
            mean = np.concatenate([mean, np.zeros((1, 5))])[ids].astype(np.float32)  # id -1 reads the last row
            yield name, {"albedo": mean[..., :3], "roughness": mean[..., 3], "metallic": mean[..., 4]}


def _stack(maps: dict[str, np.ndarray]) -> np.ndarray:
    return np.concatenate([maps["albedo"], maps["roughness"][..., None], maps["metallic"][..., None]], -1)


def _summary(rows: ScoreRows, capture: CaptureReader) -> dict[str, Any]:
    """Means over the views per variant, and how far the result is ahead of the raw predictions."""
    means = rows.means()

    def gain(quantity: str, protocol: str) -> dict[str, float] | None:
        pair = [means.get(v, {}).get(quantity, {}).get(protocol) for v in ("prior_mean_k", "result")]
        if None in pair:
            return None
        prior, result = pair
        out = {"psnr_db": round(result["psnr"]["mean"] - prior["psnr"]["mean"], 4)}
        if result["l2"]["mean"] > 0:
            out["l2_ratio"] = round(prior["l2"]["mean"] / result["l2"]["mean"], 4)
        return out

    gains = {q: {p: gain(q, p) for p in metrics.PROTOCOLS_OF[q]} for q in MATERIALS}
    return {
        "has_truth": capture.has_truth,
        "variants": {name: BASELINES[name] for name in means if name in BASELINES},
        "means": means,
        "gain_over_raw_predictions": {
            q: {p: g for p, g in by_protocol.items() if g} for q, by_protocol in gains.items() if any(by_protocol.values())
        },
        "not_scored": rows.missing,
    }
