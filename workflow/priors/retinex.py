"""Prior `retinex`: photograph / smooth shading, without learned weights (iif_core.retinex). A baseline."""

from __future__ import annotations

from functools import lru_cache
from types import SimpleNamespace

import numpy as np

from iif_core.mesh import face_geometry
from iif_core.retinex import retinex_predictions
from workflow.normal_form import CaptureReader, View

GAMMA = 2.2
"""Stands for the unknown inverse response of an LDR photograph, as in the reference's prior (METHOD 1.3)."""
SATURATED = 0.995


def predict(view: View, settings: SimpleNamespace, capture: CaptureReader, seed: int) -> np.ndarray:
    """K hypotheses of a view, (K, H, W, 5) float32, guided by the mesh's normals and, where given, instances."""
    photo, valid = capture.photo(view)
    if not capture.is_hdr:
        valid = valid & (photo.max(-1) < SATURATED)
        photo = np.clip(photo, 0, 1) ** GAMMA
    _, face_id = capture.gbuffer(view)
    normal_of_face, instance_of_face = _mesh(capture)
    hit = face_id >= 0
    normals = np.where(hit[..., None], normal_of_face[face_id], 0)
    towards = np.sign((normals * capture.directions(view)).sum(-1, keepdims=True))
    instance = capture.given_instances(view)
    if instance is None:
        instance = np.where(hit, instance_of_face[face_id], -1)
    return retinex_predictions(photo, settings.prior.samples, settings.prior.mean_albedo, instance, normals * -towards, valid)


@lru_cache(1)
def _mesh(capture: CaptureReader) -> tuple[np.ndarray, np.ndarray]:
    normals, _ = face_geometry(*capture.mesh())
    return normals, capture.faces()["instance_id"].astype(np.int32)
