"""Sources of the K material predictions of a view: one plug-in module per kind, chosen by `prior: {kind: ...}`.

A plug-in is a module `workflow/priors/<kind>.py`, or one that is named in IIF_PLUGINS (workflow/plugins.py). Where each view is
predicted by itself, it has the function

    predict(view, settings, capture, seed) -> (K, H, W, 5) float32

and where views share work, the function or class

    prepare(settings, capture, seed, keep, threads), whose result is called with a view -> Predicted

and may have `concurrent = True` where several threads may call it at once with equal results.

Predictions are linear albedo R G B, perceptual roughness and metallic in [0, 1], and NaN where there is no value. `settings` are
the sections that stage prior reads (`prior`, `source` and `segmentation.kind`), `capture` is the normal form, `keep` returns
an array that holds the same values on disk, and `threads` may be used before the first view. Two functions are optional:

    raw_inputs(document) -> list[Path]   files from outside that it reads; called while Snakemake plans, refuses missing files
    describe(settings) -> dict           facts about a learned model, written to model.json
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import TYPE_CHECKING

import numpy as np

from workflow import plugins

if TYPE_CHECKING:
    from workflow.scene.normal_form import CaptureReader, View

Keep = Callable[[np.ndarray], np.ndarray]
LightOf = Callable[["View"], np.ndarray]
"""Returns the diffuse light (H, W, 3) of a view that stage shading computed; 0 where there is no surface."""


@dataclass(frozen=True)
class Predicted:
    """Predictions of one view.

    Attributes:
        maps: (K, H, W, 5) float32 linear albedo R G B, perceptual roughness and metallic in [0, 1]; NaN where there is no value.
        scale: (H, W, 3) float32 Laplace scales of the error of albedo, roughness and metallic; None = the prior states none.
    """

    maps: np.ndarray
    scale: np.ndarray | None = None


def members(prior: SimpleNamespace) -> list[SimpleNamespace]:
    """Return the priors of a section `prior`: itself, or those that it pools, which lie there as plain values."""
    return [SimpleNamespace(**own) for own in prior.of] if hasattr(prior, "of") else [prior]


def seed_of(prior: SimpleNamespace, seed: int) -> int:
    """Return the seed of the predictions of a prior: its own, where a plug-in gives it one, or that of the scene."""
    own = getattr(prior, "seed", None)
    return seed if own is None else own


def predictor(
    settings: SimpleNamespace, capture: CaptureReader, seed: int, keep: Keep, threads: int = 1
) -> Callable[[View], Predicted]:
    """Return what predicts a view by the prior that the settings name."""
    module = importlib.import_module(plugins.implementation("prior", settings.prior.kind))
    if hasattr(module, "prepare"):
        return module.prepare(settings, capture, seed, keep, threads)
    return lambda view: Predicted(module.predict(view, settings, capture, seed))
