"""A recovered scene at the views of another capture of the same mesh: its materials, and its pictures."""

from __future__ import annotations

import numpy as np

from iif_core.camera.pinhole import direction_derivatives
from iif_core.camera.response import Response
from iif_core.evaluation.consistency import held_out_gain
from iif_core.light.base_scene import BaseScene
from iif_core.surface.lookup import values_at
from workflow.models.denoise import denoise
from workflow.runtime import device
from workflow.scene.normal_form import CaptureReader, View
from workflow.scene.recovered import Recovered

SAMPLES, MAX_BOUNCES = 8, 6
"""Number of paths a pixel, which a denoiser makes up for, and their length."""
GAIN_STEP = 2
"""The gain of a photograph is found at every second pixel in both directions."""


def fitted_materials(surface: BaseScene, other: CaptureReader, views: list[View]) -> list[dict[str, np.ndarray]]:
    """Return the materials of the surface that some views of another capture see: albedo (H, W, 3), roughness and metallic (H, W)
    of each; 0 where it sees none."""
    points, faces = [], []
    for view in views:
        depth, face_id = other.gbuffer(view)
        points.append(other.points(view, depth)[face_id >= 0])
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


class OtherViews:
    """Renders views of another capture, in sensor values of their photographs.

    Args:
        scene: the recovered scene; curve: the response of its camera.
        other: the capture.
        seed: any integer >= 0; each view adds its own id.
    """

    def __init__(self, scene: Recovered, curve: Response, other: CaptureReader, seed: int):
        self._surface, self._other, self._seed, self._curve = scene.surface, other, seed, curve
        device.mitsuba()
        geometry, material = scene.surface.traceable(scene.light.emits)
        from iif_core.light.transport.scene import Scene

        self._world = Scene(geometry, material, scene.light.emitters(geometry))
        self._exposure = {view.view_id: float(e) for view, e in zip(other.views, other.exposures(), strict=True)}

    def rendered(self, view: View, albedo: np.ndarray, face_id: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return re-rendering, photograph and the pixels that count. An 8-bit photograph gets the exposure with which its
        re-rendering is nearest to it, because those of another capture are not known.

        Args:
            view: of the other capture.
            albedo: (H, W, 3) and face_id: (H, W), what it shows.
        """
        from iif_core.light.transport.render import render
        from iif_core.light.transport.scene import PathOptions

        photo, valid = self._other.photo(view, held_out=True)
        valid, eye = valid & (face_id >= 0), view.world_from_camera[:3, 3]
        paths = PathOptions(SAMPLES, MAX_BOUNCES, self._seed << 32 | view.view_id)
        jitter = direction_derivatives(view.fx, view.fy, view.world_from_camera)
        radiance = render(self._world, eye, view.directions().reshape(-1, 3), paths, jitter)
        radiance = denoise(radiance.reshape(albedo.shape), albedo, self._surface.seen_normals(face_id, eye))
        if self._other.is_hdr:
            exposure = self._exposure[view.view_id]
            return np.clip(exposure * radiance, 0, 1), np.clip(exposure * photo, 0, 1), valid
        some = slice(None, None, GAIN_STEP), slice(None, None, GAIN_STEP)
        gain = held_out_gain(radiance[some], photo[some], valid[some], self._curve)
        return self._curve(np.clip(gain * radiance, 0, 1)), photo, valid
