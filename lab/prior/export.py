"""Weights as the product reads them: safetensors in half precision, and a recipe with all that is known about them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file, save_file

from iif_core.errors import InputError
from iif_core.priors.features import CHANNELS
from lab.prior import network
from workflow.artifacts.files import sha256_of
from workflow.priors.network import PriorNetwork

LARGEST = 10_000_000
"""Bytes of weights that the repository may hold."""
WEIGHTS, RECIPE = "weights.safetensors", "recipe.json"


def export(trained: Path, target: Path, report: dict[str, Any], licence: str = "MIT") -> dict[str, Any]:
    """Write weights and recipe for the product.

    Args:
        trained: folder that `train` wrote.
        target: folder that is written.
        report: what `evaluate` measured on rooms that were kept back, with the scales as they are; it gives `scale_calibration`
            and `object_errors`.
        licence: of the weights.

    Returns:
        The recipe.

    Raises:
        InputError: weights that are not finite in half precision, too large, or for other inputs; or a report without errors of
            objects.
    """
    arrays = {name: array.half().contiguous() for name, array in load_file(trained / WEIGHTS).items()}
    bad = [name for name, array in arrays.items() if not torch.isfinite(array).all()]
    if bad:
        raise InputError(f"export: {', '.join(bad[:3])} of {trained / WEIGHTS} are not finite in half precision; train again")
    recipe = json.loads((trained / RECIPE).read_text())
    if tuple(recipe["channels"]) != CHANNELS:
        raise InputError(f"export: {trained} was trained on other inputs than the product computes now")
    network.load_weights(PriorNetwork(len(CHANNELS), recipe["widths"], recipe["heads"]), arrays)
    target.mkdir(parents=True, exist_ok=True)
    save_file(arrays, target / WEIGHTS)
    size = (target / WEIGHTS).stat().st_size
    if size > LARGEST:
        raise InputError(f"export: {size} bytes of weights; at most {LARGEST} are allowed, so choose smaller --widths")
    if "object_errors" not in report:
        raise InputError(
            "export: the report has no object_errors, because its rooms lack metal or dielectrics; measure on more rooms"
        )
    # Nearly all errors of metallic are nearly 0, so their 68 % quantile says nothing; the mean ratio is the most likely factor.
    factors = [report["scale_factor"]["albedo"], report["scale_factor"]["roughness"], report["mean_ratio"]["metallic"]]
    recipe |= {
        "scale_calibration": factors,
        "object_errors": report["object_errors"],
        "held_out": report,
        "licence": licence,
        "sha256": sha256_of(target / WEIGHTS),
    }
    (target / RECIPE).write_text(json.dumps(recipe, indent=1) + "\n")
    return recipe
