"""Stage common_scores: scores of the result at views that all variants of a study share, whatever photographs each was made from
(lab/docs/evaluation.md#views-that-variants-share)."""

from __future__ import annotations

import math

import numpy as np

from iif_core.camera.pinhole import direction_derivatives
from iif_core.errors import InputError
from iif_core.evaluation import metrics
from iif_core.evaluation.consistency import held_out_gain
from iif_core.light.base_scene import BaseScene
from iif_core.reflectance.material import PROPERTIES
from iif_core.surface.lookup import values_at
from workflow.models.denoise import denoise
from workflow.runtime import device
from workflow.runtime.job import Job
from workflow.scene.normal_form import CaptureReader, View
from workflow.scene.recovered import Recovered, read_recovered, read_response
from workflow.scoring import scores as scoring

SCORED_VIEWS = 12
"""Views whose materials and emission are scored: the last ones of the shared capture."""
RENDERED_VIEWS, SAMPLES, MAX_BOUNCES = 4, 8, 6
"""At most this number of them, in equal steps, is rendered again, with this number of paths a pixel and a denoiser."""
GAIN_STEP = 2
"""The gain of a photograph is found at every second pixel in both directions."""
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
    rows, render = scoring.ScoreRows(), _Renderer(job, scene, shared)
    for done, (view, maps) in enumerate(zip(views, _maps(scene.surface, shared, views), strict=True)):
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
            image, photo, valid = render.view(view, maps["albedo"], face_id)
            found = metrics.score_map("rgb", image, photo, valid, encoded=not shared.is_hdr, metrics=("l2", "psnr", "ssim"))
            rows.add("result", view.name, "rgb", found)
    job.progress(len(views), len(views), "shared views scored")
    job.writer.table("scores.parquet", rows.table(job.scene, {"result"}), scoring.UNITS)
    job.writer.json("scores.json", {"means": rows.means().get("result", {}), "not_scored": rows.missing})


def _maps(surface: BaseScene, shared: CaptureReader, views: list[View]) -> list[dict[str, np.ndarray]]:
    """Fitted materials of the surface that some views of another capture see, a map for each; 0 where they see none."""
    points, faces = [], []
    for view in views:
        depth, face_id = shared.gbuffer(view)
        points.append(shared.points(view, depth)[face_id >= 0])
        faces.append(face_id)
    seen = np.concatenate([face_id[face_id >= 0] for face_id in faces])
    grid = surface.cell_edge, surface.cell_origin, surface.cell_ijk, surface.cell_object
    values, _ = values_at(np.concatenate(points), surface.object_id[seen], *grid, surface.cell_values, surface.object_values)
    out, first = [], 0
    for face_id in faces:
        image = np.zeros((*face_id.shape, 5), np.float32)
        count = np.count_nonzero(face_id >= 0)
        image[face_id >= 0] = values[first : first + count]
        first += count
        out.append({"albedo": image[..., :3], "roughness": image[..., 3], "metallic": image[..., 4]})
    return out


class _Renderer:
    """Renders shared views of the recovered scene, in sensor values of their photographs."""

    def __init__(self, job: Job, scene: Recovered, shared: CaptureReader):
        self._surface, self._shared, self._seed = scene.surface, shared, job.seed
        self._curve = read_response(job.read("affines"))
        device.mitsuba()
        geometry, material = scene.surface.traceable(scene.light.emits)
        from iif_core.light.transport.scene import Scene

        self._world = Scene(geometry, material, scene.light.emitters(geometry))
        self._exposure = {view.view_id: float(e) for view, e in zip(shared.views, shared.exposures(), strict=True)}

    def view(self, view: View, albedo: np.ndarray, face_id: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return re-rendering, photograph and the pixels that count. An 8-bit photograph gets the exposure with which its
        re-rendering is nearest to it, because those of another capture are not known."""
        from iif_core.light.transport.render import render
        from iif_core.light.transport.scene import PathOptions

        photo, valid = self._shared.photo(view, held_out=True)
        valid = valid & (face_id >= 0)
        paths = PathOptions(SAMPLES, MAX_BOUNCES, ((self._seed << 32) | _SEEDS) << 32 | view.view_id)
        jitter = direction_derivatives(view.fx, view.fy, view.world_from_camera)
        radiance = render(self._world, view.world_from_camera[:3, 3], view.directions().reshape(-1, 3), paths, jitter)
        radiance = denoise(radiance.reshape(albedo.shape), albedo, self._normals(view, face_id))
        if self._shared.is_hdr:
            exposure = self._exposure[view.view_id]
            return np.clip(exposure * radiance, 0, 1), np.clip(exposure * photo, 0, 1), valid
        some = slice(None, None, GAIN_STEP), slice(None, None, GAIN_STEP)
        gain = held_out_gain(radiance[some], photo[some], valid[some], self._curve)
        return self._curve(np.clip(gain * radiance, 0, 1)), photo, valid

    def _normals(self, view: View, face_id: np.ndarray) -> np.ndarray:
        """Normals on the side of the camera, 0 where nothing is seen."""
        surface, eye = self._surface, view.world_from_camera[:3, 3]
        facing = np.sign(np.einsum("ij,ij->i", surface.normals, eye - surface.vertices[surface.faces[:, 0]]))
        return np.where((face_id >= 0)[..., None], (surface.normals * facing[:, None])[face_id], 0).astype(np.float32)
