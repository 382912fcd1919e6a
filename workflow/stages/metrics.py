"""metrics: scores of the result and of simple baselines against ground truth and photographs (docs/method/evaluation.md)."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

from iif_core.evaluation import metrics
from iif_core.reflectance.material import PROPERTIES
from workflow.models.lpips import FETCH_VGG
from workflow.runtime.job import Job
from workflow.scene.normal_form import CaptureReader, View
from workflow.scoring.light_error import light_error
from workflow.scoring.no_reference import EVERY_VIEW, truth_free_scores
from workflow.scoring.of_views import PredictionMeans, scores_of_view, summary
from workflow.scoring.rivals import OtherPhotographs
from workflow.scoring.scores import (
    UNITS,
    ScoreRows,
    perceptual_networks,
    scored_views,
)


def run(job: Job) -> None:
    """Score the views; write metrics.parquet (the result), variants.parquet (with the baselines) and summary.json."""
    capture = CaptureReader(job.read("capture"))
    rows = ScoreRows()
    networks = perceptual_networks(with_vgg=job.settings.metrics.lpips_vgg)
    networks_of = {q: networks if q == "albedo" else {"alex": networks["alex"]} for q in (*PROPERTIES, "rgb")}
    if job.settings.metrics.lpips_vgg and capture.has_truth and "vgg" not in networks:
        job.log.warning("metrics.lpips_vgg: %s; the other scores are computed without", FETCH_VGG)
        rows.missing.append({"quantity": "albedo", "metric": "lpips_vgg", "reason": FETCH_VGG})
    views = scored_views(capture, job.settings.metrics.views)
    used = [view for view in views if view.split != "test"]
    others = OtherPhotographs(job, capture)
    means = PredictionMeans(job, views) if capture.has_truth else None
    exposure_of = {view.view_id: float(e) for view, e in zip(capture.views, capture.exposures(), strict=True)}

    def scores_of(view: View) -> list[tuple[str, str, str, list[metrics.Score]]]:
        return list(scores_of_view(job, capture, view, exposure_of[view.view_id], means, others, networks_of))

    with ThreadPoolExecutor(job.threads) as pool:
        # `map` keeps the order of the views, so the tables do not depend on the number of threads.
        for done, scored in enumerate(pool.map(scores_of, views)):
            for entry in scored:
                rows.add(*entry)
            job.progress(done + 1, len(views), "views scored")
    for entry in truth_free_scores(job, capture, used, others.albedo):
        rows.add(*entry)
    if capture.has_truth:
        rows.add("result", EVERY_VIEW, "rgb", light_error(job, capture, used))
    job.writer.table("metrics.parquet", rows.table(job.scene, {"result"}), UNITS)
    job.writer.table("variants.parquet", rows.table(job.scene), UNITS)
    job.writer.json("summary.json", summary(rows, capture, len(views)))
