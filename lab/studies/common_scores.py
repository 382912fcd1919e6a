"""Stage common_scores: scores of the result at views that all variants of a study share, whatever photographs each was made from
(lab/docs/evaluation.md#views-that-variants-share)."""

from __future__ import annotations

import math

from iif_core.errors import InputError
from iif_core.evaluation import metrics
from iif_core.reflectance.material import PROPERTIES
from workflow.runtime.job import Job
from workflow.scene.normal_form import CaptureReader
from workflow.scene.recovered import read_recovered, read_response
from workflow.scoring import scores as scoring
from workflow.scoring.other_views import OtherViews, fitted_materials

SCORED_VIEWS = 12
"""Views whose materials and emission are scored: the last ones of the shared capture."""
RENDERED_VIEWS = 4
"""At most this number of them, in equal steps, is rendered again."""
METRICS = {"albedo": ("l2", "psnr", "ssim", "flip", "lpips"), "roughness": ("l2", "psnr"), "metallic": ("l2", "psnr")}
"""Metrics of each material; those that take long, under protocol `scaled` alone."""
_SEEDS = 0x636F6D6D  # keeps the random streams of this stage apart from those of others


def run(job: Job) -> None:
    """Write scores.parquet (every view) and scores.json (means, what could not be scored).

    Raises:
        InputError: there is no ground truth, or the shared views are of another mesh.
    """
    shared = CaptureReader(job.read_shared("capture"))
    if not shared.has_truth:
        raise InputError(f"scene {job.scene}: no ground truth to score against; the study needs a source with truth")
    scene = read_recovered(job)
    if len(shared.mesh()[1]) != len(scene.surface.faces):
        raise InputError(
            f"{job.read_shared('capture').directory}: its mesh has {len(shared.mesh()[1])} faces, the mesh of {job.scene} has"
            f" {len(scene.surface.faces)}. Variants that divide the mesh differently cannot share views."
        )
    networks = scoring.perceptual_networks()
    views = shared.views[-SCORED_VIEWS:]
    rendered = {view.name for view in views[:: math.ceil(len(views) / RENDERED_VIEWS)]}
    seed = (job.seed << 32) | _SEEDS
    rows, render = scoring.ScoreRows(), OtherViews(scene, read_response(job.read("affines")), shared, seed)
    for done, (view, maps) in enumerate(zip(views, fitted_materials(scene.surface, shared, views), strict=True)):
        job.progress(done, len(views), "shared views scored")
        truth = scoring.material_truth(shared, job.read_shared("segmentation"), view, {"albedo": {"alex": networks["alex"]}})
        _, face_id = shared.gbuffer(view)
        for quantity in PROPERTIES:
            rows.add("result", view.name, quantity, truth.scores(maps, quantity, METRICS[quantity], ("scaled",)))
        emission = scene.emission_map(face_id, view.world_from_camera[:3, 3])
        rows.add(
            "result",
            view.name,
            "emission",
            metrics.score_map("emission", emission, truth.truth.emission, truth.masks["emission"]),
        )
        if view.name in rendered:
            image, photo, valid = render.rendered(view, maps["albedo"], face_id)
            found = metrics.score_map("rgb", image, photo, valid, encoded=not shared.is_hdr, metrics=("l2", "psnr", "ssim"))
            rows.add("result", view.name, "rgb", found)
    job.progress(len(views), len(views), "shared views scored")
    job.writer.table("scores.parquet", rows.table(job.scene, {"result"}), scoring.UNITS)
    job.writer.json("scores.json", {"means": rows.means().get("result", {}), "not_scored": rows.missing})
