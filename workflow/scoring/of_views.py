"""Scores of a view for the result and for simple baselines, and their summary (docs/method/evaluation.md)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from iif_core.evaluation import metrics
from iif_core.evaluation.catalogue import LPIPS_NETWORKS, METRICS_OF, PROTOCOLS_OF
from iif_core.evaluation.lpips import Weights
from iif_core.reflectance.material import PROPERTIES
from workflow.artifacts.store import StageReader, ids_from_disk, material_maps, prediction_numbers, rgb
from workflow.runtime.job import Job
from workflow.scene.base_scene import read_base
from workflow.scene.normal_form import CaptureReader, View
from workflow.scoring.rivals import OtherPhotographs
from workflow.scoring.scores import MaterialTruth, ScoreRows, material_truth

BASELINES = {
    "prior_k0": "the first prediction of each view, as the prior gave it",
    "prior_mean_k": "mean L2 and PSNR of all predictions of each view (not those of their mean)",
    "object_mean": "one value an object: mean of all predictions of all scored views",
    "texel_mean": "one value a surface cell: mean of all predictions of all scored views",
    "photo_mean": "a held-out photograph by the mean of the photographs that were used, without any model of light",
    "photo_nearest": "the same by a blend of the nearest photographs",
    "photo_as_albedo": "the mean radiance of each surface cell, at the level of the base, taken for its albedo",
    "base": "the fused base texture, before the fit to the photographs",
    "corrected": "the re-rendering times the light that the model lacks, as the other photographs show it",
    "result": "what is published",
}
"""Variant -> what it is."""
MEAN_METRICS = ("l2", "psnr")
"""Metrics of `prior_mean_k`; others would take most of the time of the stage, because every prediction is scored."""

LEARNED = dict.fromkeys(("result", "base", "prior_k0"), tuple(LPIPS_NETWORKS))
"""Variant -> learned metrics that its albedo is scored with."""


def scores_of_view(
    job: Job,
    capture: CaptureReader,
    view: View,
    exposure: float,
    means: PredictionMeans | None,
    others: OtherPhotographs,
    networks: Mapping[str, Mapping[str, Weights]],
) -> Iterator[tuple[str, str, str, list[metrics.Score]]]:
    """Yield (variant, view, quantity, scores) of one view."""
    photo, valid = capture.photo(view, held_out=True)
    rgb_of = "rgb_held_out" if view.split == "test" else "rgb"
    _, face_id = capture.gbuffer(view)
    hit = face_id >= 0
    file = f"maps/{view.name}.exr"
    rendered = job.read("render").exr(file)
    sensor = np.clip(exposure * photo, 0, 1) if capture.is_hdr else photo
    target = metrics.Target("rgb", sensor, valid & hit, encoded=not capture.is_hdr, networks=networks["rgb"])
    yield "result", view.name, rgb_of, target.scores(rgb(rendered, "ldr"))
    if (picture := others.corrected(view, rgb(rendered), photo, valid & hit)) is not None:
        yield "corrected", view.name, rgb_of, target.scores(picture)
    if view.split == "test":
        for variant, picture in others.predictions(view, photo, valid & hit):
            yield variant, view.name, rgb_of, target.scores(picture)
    if capture.is_hdr:
        yield "result", view.name, rgb_of, _log_scores(rgb(rendered), photo, valid & hit)
    if means is None:
        return
    materials = material_truth(capture, job.read("segmentation"), view, networks)
    truth = materials.truth
    if not capture.is_hdr:
        yield "result", view.name, rgb_of, _log_scores(rgb(rendered), truth.radiance, valid & hit)
    yield (
        "result",
        view.name,
        "emission",
        metrics.score_map("emission", rgb(rendered, "emission"), truth.emission, materials.masks["emission"]),
    )
    cell_id = None
    for variant, reader in (("base", read_base(job)), ("result", job.read("affines"))):
        if reader.has(file):
            channels = reader.exr(file)
            cell_id = ids_from_disk(channels["cell.id"]) if variant == "base" else cell_id
            for quantity in PROPERTIES:
                yield variant, view.name, quantity, _scores(materials, variant, material_maps(channels), quantity)
    if cell_id is not None:
        maps = {"albedo": others.albedo[cell_id]}
        yield "photo_as_albedo", view.name, "albedo", _scores(materials, "photo_as_albedo", maps, "albedo")
    if not job.read("prior").has(file):
        return
    channels = job.read("prior").exr(file)
    each: dict[str, list[list[metrics.Score]]] = {quantity: [] for quantity in PROPERTIES}
    for number, k in enumerate(prediction_numbers(channels)):
        maps = material_maps(channels, f"prior.{k:03d}.")
        for quantity in PROPERTIES:
            each[quantity].append(materials.scores(maps, quantity, only=MEAN_METRICS))
            if number == 0:
                yield "prior_k0", view.name, quantity, _scores(materials, "prior_k0", maps, quantity)
    for quantity, lists in each.items():
        if lists:
            yield "prior_mean_k", view.name, quantity, _mean_scores(lists)
    for variant, maps in means.maps(materials.object_id, cell_id):
        for quantity in PROPERTIES:
            yield variant, view.name, quantity, _scores(materials, variant, maps, quantity)


def _scores(materials: MaterialTruth, variant: str, maps: dict[str, np.ndarray], quantity: str) -> list[metrics.Score]:
    """Return all scores of the result; of other variants LPIPS, which takes most of the time, only as `LEARNED` says."""
    learned = LEARNED.get(variant, ()) if quantity == "albedo" else ()
    visual = ("raw", "scaled")
    if variant == "result":
        every = [m for m in METRICS_OF[quantity] if m != "lpips_vgg"]
        vgg = materials.scores(maps, quantity, ("lpips_vgg",), visual) if "lpips_vgg" in learned else []
        return materials.scores(maps, quantity, every) + vgg
    only = [m for m in METRICS_OF[quantity] if m not in LPIPS_NETWORKS or m in learned]
    return materials.scores(maps, quantity, only, visual)


def _log_scores(prediction: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> list[metrics.Score]:
    """Return log_l2 of radiance, also up to the gain that LDR photographs leave open."""
    by_protocol = metrics.score_map("emission", prediction, truth, mask, metrics=("log_l2",))
    return [score for score in by_protocol if score.metric == "log_l2"]


def _mean_scores(lists: list[list[metrics.Score]]) -> list[metrics.Score]:
    """Return the mean of each score over the predictions."""
    out = []
    for group in zip(*lists, strict=True):
        numbers = [score.value for score in group if score.value is not None]
        first = group[0]
        value = float(np.mean(numbers)) if numbers else None
        out.append(metrics.Score(first.metric, first.protocol, value, first.reason))
    return out


class PredictionMeans:
    """The two baselines that average predictions over objects and over surface cells, from one pass over the views."""

    def __init__(self, job: Job, views: list[View]):
        base: StageReader = read_base(job)
        n_objects = int(job.read("segmentation").table("objects.parquet")["object_id"].max(initial=-1)) + 1
        sums = {"object_mean": np.zeros((n_objects, 6)), "texel_mean": np.zeros((base.rows("cells.parquet"), 6))}
        for done, view in enumerate(views):
            file = f"maps/{view.name}.exr"
            if not (job.read("prior").has(file) and base.has(file)):
                continue
            channels = job.read("prior").exr(file)
            numbers = prediction_numbers(channels)
            if not numbers:
                continue
            values = sum(_stack(material_maps(channels, f"prior.{k:03d}.")).astype(np.float64) for k in numbers) / len(numbers)
            object_id = ids_from_disk(job.read("segmentation").exr(file)["object.id"])
            cell_id = ids_from_disk(base.exr(file)["cell.id"])
            for name, ids in (("object_mean", object_id), ("texel_mean", cell_id)):
                known = ids >= 0
                touched, rows = np.unique(ids[known], return_inverse=True)
                weights = values[known].T
                for i in range(5):
                    sums[name][touched, i] += np.bincount(rows, weights[i])
                sums[name][touched, 5] += np.bincount(rows)
            job.progress(done + 1, len(views), "views averaged for the baselines")
        # Id -1 reads the last row.
        self.means = {
            name: np.concatenate([table[:, :5] / np.maximum(table[:, 5:], 1), np.zeros((1, 5))]).astype(np.float32)
            for name, table in sums.items()
        }

    def maps(self, object_id: np.ndarray, cell_id: np.ndarray | None) -> Iterator[tuple[str, dict[str, np.ndarray]]]:
        """Yield (variant, maps) of one view; pixels without an id are 0. `cell_id` is None if the base lacks the view."""
        if cell_id is None:
            return
        for name, ids in (("object_mean", object_id), ("texel_mean", cell_id)):
            mean = self.means[name][ids]
            yield name, {"albedo": mean[..., :3], "roughness": mean[..., 3], "metallic": mean[..., 4]}


def _stack(maps: dict[str, np.ndarray]) -> np.ndarray:
    return np.concatenate([maps["albedo"], maps["roughness"][..., None], maps["metallic"][..., None]], -1)


def summary(rows: ScoreRows, capture: CaptureReader, scored: int) -> dict[str, Any]:
    """Return the means over the views for each variant, and the gain of the result over the raw predictions."""
    means = rows.means()

    def gain(quantity: str, protocol: str) -> dict[str, float] | None:
        pair = [means.get(v, {}).get(quantity, {}).get(protocol) for v in ("prior_mean_k", "result")]
        if any(scores is None or "psnr" not in scores for scores in pair):  # there is no ground truth
            return None
        prior, result = pair
        out = {"psnr_db": round(result["psnr"]["mean"] - prior["psnr"]["mean"], 4)}
        if result["l2"]["mean"] > 0:
            out["l2_ratio"] = round(prior["l2"]["mean"] / result["l2"]["mean"], 4)
        return out

    gains = {q: {p: gain(q, p) for p in PROTOCOLS_OF[q]} for q in PROPERTIES}
    return {
        "has_truth": capture.has_truth,
        "views": {"scored": scored, "of": len(capture.views)},
        "variants": {name: BASELINES[name] for name in means if name in BASELINES},
        "means": means,
        "gain_over_raw_predictions": {
            q: {p: g for p, g in by_protocol.items() if g} for q, by_protocol in gains.items() if any(by_protocol.values())
        },
        "not_scored": rows.missing,
    }
