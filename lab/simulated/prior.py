"""Prior `simulated`: ground truth with simulated errors of a single-view model, or measured ones (lab/docs/simulated.md)."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from iif_core.errors import InputError
from lab.simulated.errors import RGBX, shading_proxy, simulate_predictions
from lab.simulated.measured import BANK, draw_predictions
from workflow.scene.normal_form import CaptureReader, View
from workflow.settings.names import data_folder

_NO_TRUTH = (
    "`prior: {kind: simulated}` spoils ground truth, and this capture has none;"
    " use `prior: {kind: files}` or `{kind: retinex}`, or a source with truth (builtin, mitsuba, fipt)"
)


def raw_inputs(document: dict[str, Any]) -> list[Path]:
    """Return the bank where the errors are measured ones, and refuse a folder without `truth/` before any job starts."""
    source = document["source"]
    if source["kind"] == "folder" and not (data_folder(source["path"]) / "truth").is_dir():
        raise InputError(_NO_TRUTH)
    return [BANK] if document["prior"].get("errors") == "measured" else []


def predict(view: View, settings: SimpleNamespace, capture: CaptureReader, seed: int) -> np.ndarray:
    """Simulate K predictions of a view from its ground truth.

    Args:
        view: of the capture.
        settings: section `prior`.
        capture: with ground truth. Its instances are read for `errors: objects` alone.
        seed: of the errors.

    Returns:
        (K, H, W, 5) float32, linear albedo, perceptual roughness, metallic.

    Raises:
        InputError: the capture has no ground truth.
    """
    if not capture.has_truth:
        raise InputError(_NO_TRUTH)
    own, truth = settings.prior, capture.truth(view)
    depth, face_id = capture.gbuffer(view)
    points = None if own.errors == "objects" else np.where((face_id >= 0)[..., None], capture.points(view, depth), np.nan)
    if own.errors == "measured":
        materials = np.concatenate([truth.albedo, truth.roughness[..., None], truth.metallic[..., None]], -1)
        return draw_predictions(materials, points, own.samples, view.view_id, seed, own.strength)
    material = truth.valid & ~(truth.emission > 0).any(-1)
    shading = shading_proxy(truth.radiance, truth.albedo, np.where(material, 0, -1))
    return simulate_predictions(
        truth.albedo,
        truth.roughness,
        truth.metallic,
        _instances(capture, view, face_id) if points is None else None,
        own.samples,
        view.view_id,
        seed,
        own.strength,
        shading,
        replace(RGBX, good_share=own.good_share).with_shared(own.shared),
        points,
        own.length,
    )


def _instances(capture: CaptureReader, view: View, face_id: np.ndarray) -> np.ndarray:
    given = capture.given_instances(view)
    return np.where(face_id >= 0, _instance_of_face(capture)[face_id], -1) if given is None else given


@lru_cache(1)
def _instance_of_face(capture: CaptureReader) -> np.ndarray:
    return capture.faces()["instance_id"].astype(np.int32)
