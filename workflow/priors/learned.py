"""Prior `learned`: a small network corrects the photograph divided by the light (docs/method/priors.md#learned).

The weights are part of the repository (`workflow/models/weights/prior/`). Snakemake imports this module when it plans, so what
takes long to import stands in `workflow/priors/correction.py`.
"""

from __future__ import annotations

import json
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from iif_core.errors import InputError
from workflow.artifacts.files import sha256_of
from workflow.priors import Keep

if TYPE_CHECKING:
    from workflow.priors.correction import Correction
    from workflow.scene.normal_form import CaptureReader

FOLDER = Path(__file__).resolve().parents[1] / "models" / "weights" / "prior"
WEIGHTS, RECIPE = "weights.safetensors", "recipe.json"


def raw_inputs(document: dict[str, Any]) -> list[Path]:
    """Check that the weights are those of the repository, and list them.

    Raises:
        InputError: a file is missing, or was changed.
    """
    recipe = recipe_of_weights()
    weights = FOLDER / WEIGHTS
    cure = f"it belongs to the repository: git checkout {FOLDER.relative_to(FOLDER.parents[3])}"
    if not weights.is_file():
        raise InputError(f"{weights}: missing; {cure}")
    found = sha256_of(weights)
    if found != recipe["sha256"]:
        raise InputError(f"{weights}: sha256 {found[:16]}..., needed {recipe['sha256'][:16]}... ({RECIPE}); {cure}")
    return [FOLDER / RECIPE, weights]


def describe(settings: SimpleNamespace) -> dict[str, Any]:
    """Return the facts about the network for model.json."""
    recipe = recipe_of_weights()
    kept = ("sha256", "widths", "heads", "training", "object_errors")
    return {"prior": "learned", "licence": "MIT", **{name: recipe[name] for name in kept}}


@lru_cache(1)
def recipe_of_weights() -> dict[str, Any]:
    """Read what is known about the weights."""
    path = FOLDER / RECIPE
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: {error}; it belongs to the repository: git checkout {path}") from error


def prepare(settings: SimpleNamespace, capture: CaptureReader, seed: int, keep: Keep, threads: int = 1) -> Correction:
    """Read all photographs of a capture, and return what predicts a view."""
    from workflow.priors.correction import Correction

    return Correction(settings, capture, seed, keep, threads)
