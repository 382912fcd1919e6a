"""Prior `rgbx`: RGB-X (Zeng et al., SIGGRAPH 2024), a diffusion model that predicts one map per prompt.

The model reads linear pictures and predicts linear albedo, perceptual roughness and metallic (the first channel of a picture
each). The published weights differ from the paper's in metallic (docs/method/priors.md#diffusion).
"""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from iif_core.priors.options import SamplingOptions
from workflow.models.checkpoint import Recipe, check
from workflow.scene.normal_form import CaptureReader, View
from workflow.settings.options import options_of

LONGEST_SIDE = 1024
RECIPE = Recipe(
    kind="rgbx",
    repository="zheng95z/rgb-to-x",
    licence="the Adobe Research License (non-commercial research only)",
    pipeline="StableDiffusionAOVMatEstPipeline",
    targets=lambda index: 1,
    prompts=("Albedo (diffuse basecolor)", "Roughness", "Metallicness"),
    fill_prompts=True,
    condition_first=False,
    # As the model was trained and is used; the checkpoint's own settings are older.
    scheduler=(("rescale_betas_zero_snr", True), ("timestep_spacing", "trailing")),
)


def raw_inputs(document: dict[str, Any]) -> list[Path]:
    """Check the checkpoint and list its files; raises InputError."""
    return list(check(document["prior"], RECIPE).files)


def describe(settings: SimpleNamespace) -> dict[str, Any]:
    """Return the facts about the model for model.json."""
    from workflow.priors.diffusion import describe_model

    return describe_model(RECIPE, settings.prior)


def predict(view: View, settings: SimpleNamespace, capture: CaptureReader, seed: int) -> np.ndarray:
    """Draw K predictions of a view.

    Args:
        view: of the capture.
        settings: section `prior`.
        capture: the normal form.
        seed: of the first sample.

    Returns:
        (K, H, W, 5) float32 in [0, 1], linear albedo, perceptual roughness, metallic; NaN where the model overflowed.
    """
    from workflow.priors.diffusion import predict_maps
    from workflow.scene.photograph import picture_for_model

    prior = settings.prior
    longest = options_of(SamplingOptions, prior).longest_side or LONGEST_SIDE
    maps = predict_maps(RECIPE, prior, picture_for_model(view, capture, linear=True), longest, prior.steps, seed)
    return np.concatenate([maps[:, 0], maps[:, 1, ..., :1], maps[:, 2, ..., :1]], -1)
