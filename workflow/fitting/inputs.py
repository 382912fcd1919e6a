"""What all models of stage `affines` read for the pixels of a view."""

from __future__ import annotations

import numpy as np

from iif_core.camera.gains import CameraGains
from iif_core.camera.pixels import pixel_gains
from iif_core.fitting.predictions import PredictionErrors
from workflow.artifacts.store import ids_from_disk
from workflow.runtime.job import Job
from workflow.scene.base_scene import read_base
from workflow.scene.normal_form import CaptureReader, View


def roughness_levels(job: Job) -> np.ndarray:
    """Return the roughness of the cached levels, (J,) float64."""
    return job.read("shading").table("levels.parquet")["roughness"].astype(np.float64)


def cells_of(job: Job, view: View) -> np.ndarray:
    """Return the surface cell of every pixel of a view, (H * W,) int; -1 = none."""
    return ids_from_disk(job.read("base").exr(f"maps/{view.name}.exr")["cell.id"]).ravel()


def exposure_and_balance(
    capture: CaptureReader, gains: CameraGains, view: View, index: np.ndarray
) -> tuple[np.ndarray, np.ndarray | None]:
    """Split the gains of pixels into an exposure and the balance of the channels (Eq. C.8).

    Args:
        capture: photographs; gains: of all views; view: the view; index: (n,) flattened indices of the pixels.

    Returns:
        Exposure (n,), the geometric mean over the channels, and the gains over it (n, 3); None where they are all 1.
    """
    if capture.is_hdr:
        factor = np.ones((len(index), 3))
    else:
        number = next(i for i, other in enumerate(capture.views) if other.view_id == view.view_id)
        factor = pixel_gains(gains, number, view, index)
    if gains.is_plain:
        return factor[:, 0], None
    exposure = np.exp(np.log(factor).mean(1))
    return exposure, factor / exposure[:, None]


def balanced(light: np.ndarray, balance: np.ndarray | None) -> np.ndarray:
    """Return cached light (n, ..., 3) as the white balance and the lens of its view show it, in its own dtype."""
    if balance is None:
        return light
    return light * balance.reshape(len(balance), *[1] * (light.ndim - 2), 3).astype(light.dtype)


def prediction_errors(job: Job) -> PredictionErrors | None:
    """Return how the predictions err, where the prior states it."""
    prior = job.read("prior")
    stated = prior.json("model.json").get("object_errors") if prior.has("model.json") else None
    if stated is None:
        return None
    errors = PredictionErrors.from_facts(stated, str(prior.path("model.json")))
    return errors.of_second_look() if read_base(job).stage == "second_look" else errors
