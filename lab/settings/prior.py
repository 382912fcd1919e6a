"""Settings of priors: the kind that needs ground truth, and the seed of the others, which the product takes from the scene."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from iif_core.priors.options import SamplingOptions
from workflow.settings import prior
from workflow.settings.section import Section


class Seeded(Section):
    seed: int | None = Field(None, ge=0, lt=2**31)
    """Seed of the predictions alone; by default the seed of the scene. Without effect on `kind: files`."""


class SimulatedPrior(prior.PriorBase, Seeded):
    """Ground truth with errors like those of RGB-X. Needs a source with ground truth."""

    kind: Literal["simulated"]
    strength: float = Field(1.0, ge=0, le=4)
    """Strength of the errors: 0 = ground truth; 1 = errors as large as the paper reports for RGB-X."""
    shared: float = Field(1.0, ge=0, le=10)
    """Factor on the errors of albedo that all views of an object share, which no fusion of predictions can remove."""


class Sampled(Seeded):
    tile: int = Field(SamplingOptions.tile, ge=64, le=4096, multiple_of=64)
    """Edge in pixels of the tiles in which larger pictures are sampled; they overlap by a quarter."""
    precision: Literal["auto", "float32", "float16", "bfloat16"] = "auto"
    """Precision of the U-Net; `auto`: float16 on a GPU, float32 on a CPU. The rest of the model is float32."""
    longest_side: int | None = Field(SamplingOptions.longest_side, ge=64, le=8192)
    """Longest side in pixels to which photographs are scaled for the model; by default as its authors recommend."""


class LearnedPrior(prior.LearnedPrior, Seeded):
    """Prior `learned`, seeded."""


class RetinexPrior(prior.RetinexPrior, Seeded):
    """Prior `retinex`, seeded."""


class FilesPrior(prior.FilesPrior, Seeded):
    """Prior `files`, which draws nothing."""


class RgbxPrior(prior.RgbxPrior, Sampled):
    """Prior `rgbx`, seeded, and how it is sampled."""


class MarigoldPrior(prior.MarigoldPrior, Sampled):
    """Prior `marigold`, seeded, and how it is sampled."""
