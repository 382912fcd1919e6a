"""Scores without truth: shading left in albedo, and agreement of views (docs/method/evaluation.md#scores-without-truth)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from iif_core.evaluation.consistency import ShadingLeft, ViewSpread
from iif_core.evaluation.metrics import Score
from iif_core.surface.cells import grid_origin, pack_keys, voxel_indices
from workflow.artifacts.store import ids_from_disk, prediction_numbers, rgb
from workflow.runtime.job import Job
from workflow.scene.base_scene import read_lit_scene
from workflow.scene.cached_light import read_diffuse
from workflow.scene.normal_form import CaptureReader, View

EVERY_VIEW = "all"
"""Value of the column `view` for scores over all views together."""
DARK = 0.02
"""Share of the median light below which pixels are left out, because light and albedo are noise there."""


def truth_free_scores(
    job: Job, capture: CaptureReader, views: list[View], photo: np.ndarray
) -> Iterator[tuple[str, str, str, list[Score]]]:
    """Score the albedo of `result`, `base`, `prior_k0` and `photo_as_albedo`, whose values `photo` (cells + 1, 3) are given, and
    the mean of the scores of all predictions (`prior_mean_k`).

    The light is the diffuse light of stage shading (mean of its halves) at interior pixels of surface that neither emits nor lets
    light through, in the `views`, none of which is held out. The surface cells are those of its edge. Yields (variant, view,
    quantity, scores).
    """
    vertices, faces = capture.mesh()
    scene, emitters = read_lit_scene(job)
    mixed = emitters.emits | scene.is_sheer
    edge = float(job.read("shading").json("shading.json")["diffuse"]["cell_edge_m"])
    origin = grid_origin(vertices[faces.ravel()], edge)
    left: dict[str, ShadingLeft] = {}
    spread: dict[str, ViewSpread] = {}
    for view in views:
        light, use, object_id = _light(job, capture, view, mixed)
        if not use.any():
            continue
        points = capture.points(view, capture.gbuffer(view)[0])[use]
        own = object_id[use]
        keys = pack_keys(voxel_indices(points, edge, origin), own % 65535)
        for name, albedo in _albedos(job, view, photo):
            left.setdefault(name, ShadingLeft()).add(albedo[use], light[use], own)
            spread.setdefault(name, ViewSpread()).add(albedo[use], keys)
    rows = {name: _scores(left[name], spread[name]) for name in left}
    each = [scores for name, scores in rows.items() if name.startswith("prior.")]
    for name in ("result", "base", "photo_as_albedo"):
        if name in rows:
            yield name, EVERY_VIEW, "albedo", rows[name]
    if each:
        yield "prior_k0", EVERY_VIEW, "albedo", each[0]
        means = [
            Score(first.metric, first.protocol, None if any(v is None for v in values) else float(np.mean(values)), first.reason)
            for first, values in ((group[0], [score.value for score in group]) for group in zip(*each, strict=True))
        ]
        yield "prior_mean_k", EVERY_VIEW, "albedo", means


def _scores(left: ShadingLeft, spread: ViewSpread) -> list[Score]:
    shading, apart = left.finish(), spread.finish()
    return [
        Score("shading_left", "raw", abs(shading.correlation)),
        Score("shading_slope", "raw", shading.slope),
        Score("view_spread", "raw", apart, "" if apart is not None else "no surface is seen in two views"),
    ]


def _light(job: Job, capture: CaptureReader, view: View, mixed: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Diffuse light (H, W, 3), which pixels count (H, W), and object (H, W)."""
    file = f"maps/{view.name}.exr"
    light, maps = read_diffuse(job, view).mean(0), job.read("segmentation").exr(file)
    face, object_id = capture.gbuffer(view)[1], ids_from_disk(maps["object.id"])
    use = capture.photo(view)[1] & (face >= 0) & (object_id >= 0) & (maps["interior"] > 0.5) & ~mixed[np.maximum(face, 0)]
    brightness = light.mean(-1)
    return light, use & (brightness > DARK * float(np.median(brightness[use])) if use.any() else use), object_id


def _albedos(job: Job, view: View, photo: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    file = f"maps/{view.name}.exr"
    for name, stage in (("result", "affines"), ("base", "base")):
        if job.read(stage).has(file):
            channels = job.read(stage).exr(file)
            yield name, rgb(channels, "albedo")
            if name == "base":
                shown = photo[ids_from_disk(channels["cell.id"])]
                yield "photo_as_albedo", np.where(shown > 0, shown, np.nan)  # what no photograph shows is left out
    if job.read("prior").has(file):
        channels = job.read("prior").exr(file)
        for k in prediction_numbers(channels):
            yield f"prior.{k:03d}", rgb(channels, f"prior.{k:03d}.albedo")
