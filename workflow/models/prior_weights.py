"""The weights of prior `learned`, which are part of the repository (`workflow/models/weights/prior/`)."""

from __future__ import annotations

import json
from functools import lru_cache
from pathlib import Path
from typing import Any

from iif_core.errors import InputError
from workflow.artifacts.files import sha256_of

FOLDER = Path(__file__).resolve().parent / "weights" / "prior"
WEIGHTS, RECIPE = "weights.safetensors", "recipe.json"


def checked_files() -> list[Path]:
    """Check that recipe and weights are those of the repository, and list them, the recipe first.

    Raises:
        InputError: a file is missing, or was changed.
    """
    known = recipe()
    weights = FOLDER / WEIGHTS
    cure = f"it belongs to the repository: git checkout {FOLDER.relative_to(FOLDER.parents[3])}"
    if not weights.is_file():
        raise InputError(f"{weights}: missing; {cure}")
    found = sha256_of(weights)
    if found != known["sha256"]:
        raise InputError(f"{weights}: sha256 {found[:16]}..., needed {known['sha256'][:16]}... ({RECIPE}); {cure}")
    return [FOLDER / RECIPE, weights]


@lru_cache(1)
def recipe() -> dict[str, Any]:
    """Read what is known about the weights."""
    path = FOLDER / RECIPE
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: {error}; it belongs to the repository: git checkout {path}") from error
