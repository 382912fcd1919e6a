"""Prior `simulated`: ground truth with simulated errors of a single-view diffusion model (lab/docs/simulated.md#simulated)."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from iif_core.errors import InputError
from lab.simulated.errors import RGBX, shading_proxy, simulate_predictions
from workflow.scene.normal_form import CaptureReader, View
from workflow.settings.names import data_folder

_NO_TRUTH = (
    "`prior: {kind: simulated}` spoils ground truth, and this capture has none;"
    " use `prior: {kind: files}` or `{kind: retinex}`, or a source with truth (builtin, mitsuba, fipt)"
)


def raw_inputs(document: dict[str, Any]) -> list[Path]:
    """Return no files, but refuse a folder without `truth/` before any job starts."""
    source = document["source"]
    if source["kind"] == "folder" and not (data_folder(source["path"]) / "truth").is_dir():
        raise InputError(_NO_TRUTH)
    return []


def predict(view: View, settings: SimpleNamespace, capture: CaptureReader, seed: int) -> np.ndarray:
    """Simulate K predictions of a view from its ground truth; the errors are tied to the instances of the capture.

    Args:
        view: of the capture.
        settings: sections `prior` and `source`.
        capture: with ground truth.
        seed: of the errors.

    Returns:
        (K, H, W, 5) float32, linear albedo, perceptual roughness, metallic.

    Raises:
        InputError: the capture has no ground truth.
    """
    if not capture.has_truth:
        raise InputError(_NO_TRUTH)
    truth = capture.truth(view)
    _, face_id = capture.gbuffer(view)
    instance = capture.given_instances(view)
    if instance is None:
        instance = np.where(face_id >= 0, _instance_of_face(capture)[face_id], -1)
    material = truth.valid & ~(truth.emission > 0).any(-1)
    shading = shading_proxy(truth.radiance, truth.albedo, np.where(material, instance.clip(0), -1))
    return simulate_predictions(
        truth.albedo,
        truth.roughness,
        truth.metallic,
        instance,
        settings.prior.samples,
        view.view_id,
        seed,
        settings.prior.strength,
        shading,
        RGBX.with_shared(settings.prior.shared),
    )


@lru_cache(1)
def _instance_of_face(capture: CaptureReader) -> np.ndarray:
    return capture.faces()["instance_id"].astype(np.int32)
