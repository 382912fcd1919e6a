"""Prior `rgbx`: RGB-X (Zeng et al., SIGGRAPH 2024), a diffusion model that is asked for one map at a time (METHOD 2.1).

The checkpoint is the user's (docs/priors.md); this module is written from the published facts about it. It sees linear pictures
and answers with linear albedo, perceptual roughness and metallic (the first channel of a picture each). Its authors say that
the published weights differ from the paper's in metallic.
"""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from workflow.models.checkpoint import Recipe, check
from workflow.scene.normal_form import CaptureReader, View

RECIPE = Recipe(
    kind="rgbx",
    repository="zheng95z/rgb-to-x",
    licence="the Adobe Research License (non-commercial research only)",
    pipeline="StableDiffusionAOVMatEstPipeline",
    targets=lambda index: 1,
    prompts=("Albedo (diffuse basecolor)", "Roughness", "Metallicness"),
    fill_prompts=True,
    condition_first=False,
    # How the model was trained and is used; what the checkpoint itself says is older.
    scheduler=(("rescale_betas_zero_snr", True), ("timestep_spacing", "trailing")),
)


def raw_inputs(document: dict[str, Any]) -> list[Path]:
    """The files of the checkpoint, checked; raises InputError."""
    return list(check(document["prior"], RECIPE).files)


def describe(settings: SimpleNamespace) -> dict[str, Any]:
    """What made the predictions, for model.json."""
    from workflow.priors.diffusion import described

    return described(RECIPE, settings.prior)


def predict(view: View, settings: SimpleNamespace, capture: CaptureReader, seed: int) -> np.ndarray:
    """K samples of a view, (K, H, W, 5) float32 in [0, 1]; NaN where the model's numbers overflowed."""
    from workflow.priors.diffusion import predicted
    from workflow.scene.photograph import seen

    prior = settings.prior
    maps = predicted(RECIPE, prior, seen(view, capture, linear=True), prior.longest_side, prior.steps, seed)
    return np.concatenate([maps[:, 0], maps[:, 1, ..., :1], maps[:, 2, ..., :1]], -1)
