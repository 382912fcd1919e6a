"""Prior `learned`: a small network corrects the photograph divided by the light (docs/method/priors.md#learned).

Snakemake imports this module when it plans, so what takes long to import stands in `workflow/priors/correction.py`.
"""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from workflow.models import prior_weights
from workflow.priors import Keep, LightOf

if TYPE_CHECKING:
    from workflow.priors.correction import Correction
    from workflow.scene.normal_form import CaptureReader


def raw_inputs(document: dict[str, Any]) -> list[Path]:
    """Check that the weights are those of the repository, and list them; raises InputError."""
    return prior_weights.checked_files()


def describe(settings: SimpleNamespace) -> dict[str, Any]:
    """Return the facts about the network for model.json."""
    recipe = prior_weights.recipe()
    kept = ("sha256", "widths", "heads", "training", "object_errors")
    return {"prior": "learned", "licence": "MIT", **{name: recipe[name] for name in kept}}


def prepare(
    settings: SimpleNamespace, capture: CaptureReader, seed: int, keep: Keep, threads: int = 1, light: LightOf | None = None
) -> Correction:
    """Read all photographs of a capture, and return what predicts a view; `light` is given in a second look alone."""
    from workflow.priors.correction import Correction

    return Correction(settings, capture, seed, keep, threads, light)
