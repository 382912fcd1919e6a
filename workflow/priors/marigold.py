"""Prior `marigold`: Marigold-IID appearance (Ke et al. 2025), a diffusion model that predicts all maps in one pass.

The model reads display-encoded pictures; meaning and encoding of its outputs are read from the checkpoint's `target_properties`
(docs/method/priors.md#diffusion).
"""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from iif_core.errors import InputError
from iif_core.numerics.color import linear_from_srgb
from iif_core.priors.options import SamplingOptions
from workflow.models.checkpoint import Recipe, check
from workflow.scene.normal_form import CaptureReader, View
from workflow.settings.options import options_of

REPOSITORY = "prs-eth/marigold-iid-appearance-v1-1"
MAPS = {"albedo": 3, "roughness": 1, "metallicity": 1}  # the checkpoint's name of each map, and its channels
SPACES = ("linear", "srgb")
STEPS, LONGEST_SIDE = 4, 768  # as its authors recommend, where the checkpoint states none


def layout(index: dict[str, Any]) -> dict[str, tuple[int, list[int], str]]:
    """Read map -> (latent image, its channels, encoding) from `target_properties` of model_index.json.

    A target is one map, or a stack of up to three maps of one channel each (`sub_target_names`).

    Raises:
        InputError: a map is missing, of an unknown encoding, or known only up to a factor.
    """
    properties = index.get("target_properties") or {}
    out = {}
    for position, target in enumerate(properties.get("target_names") or []):
        facts = properties.get(target) or {}
        parts = facts.get("sub_target_names")
        channels = {name: [i] for i, name in enumerate(parts) if name} if parts else {target: list(range(MAPS.get(target, 3)))}
        for name, chosen in channels.items():
            known = properties.get(name) or facts
            out[name] = position, chosen, known.get("prediction_space"), bool(known.get("up_to_scale"))
    for name, count in MAPS.items():
        if name not in out:
            raise InputError(f"the model predicts {', '.join(out) or 'nothing that it names'}; needed are {', '.join(MAPS)}")
        _, channels, space, up_to_scale = out[name]
        if space not in SPACES or up_to_scale or len(channels) != count:
            raise InputError(
                f"`target_properties.{name}`: prediction_space {space}, up_to_scale {up_to_scale}, {len(channels)} channels;"
                f" needed: {' or '.join(SPACES)}, false, {count}"
            )
    return {name: out[name][:3] for name in MAPS}


def _targets(index: dict[str, Any]) -> int:
    layout(index)
    return len(index["target_properties"]["target_names"])


RECIPE = Recipe(
    kind="marigold",
    repository=REPOSITORY,
    licence="the CreativeML Open RAIL++-M License (with restrictions of use)",
    pipeline="MarigoldIntrinsicsPipeline",
    targets=_targets,
    prompts=("",),
    fill_prompts=False,
    condition_first=True,
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
    index = check(vars(prior), RECIPE).index
    steps = prior.steps or index.get("default_denoising_steps") or STEPS
    longest = options_of(SamplingOptions, prior).longest_side or index.get("default_processing_resolution") or LONGEST_SIDE
    found = predict_maps(RECIPE, prior, picture_for_model(view, capture, linear=False), longest, steps, seed)
    maps = []
    for position, channels, space in layout(index).values():
        values = found[:, position][..., channels]
        maps.append(linear_from_srgb(values) if space == "srgb" else values)
    return np.concatenate(maps, -1)
