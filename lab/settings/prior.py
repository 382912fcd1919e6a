"""Settings of priors: the kind that needs ground truth, and the seed of the others, which the product takes from the scene."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from iif_core.priors.options import SamplingOptions
from workflow.settings import prior
from workflow.settings.section import Section


class Seeded(Section):
    seed: int | None = Field(None, ge=0, lt=2**31)
    """Seed of the predictions alone; by default the seed of the scene. Without effect on `kind: files`."""


MEASURED_SAMPLES = 16
"""Predictions of which the errors were measured."""


class SimulatedPrior(prior.PriorBase, Seeded):
    """Ground truth with the errors of a prior. Needs a source with ground truth."""

    kind: Literal["simulated"]
    errors: Literal["objects", "fields", "measured"] = "objects"
    """`objects`: as large as those of RGB-X, mostly one affine map for each true object; `fields`: as large, but correlated in
    space and not tied to objects; `measured`: those of prior `learned` in generated rooms, with their correlations."""
    strength: float = Field(1.0, ge=0, le=4)
    """Factor on the errors: 0 = ground truth; 1 = errors as large as the paper reports for RGB-X, or as measured."""
    shared: float = Field(1.0, ge=0, le=10)
    """Factor on the errors of albedo that all views share, which no fusion of predictions can remove. Not of `measured`."""
    good_share: float = Field(0.4, ge=0, le=1)
    """Share of samples that are nearly true but for an affine map, by object (`fields`: by place). Not of `measured`."""
    length: float = Field(0.5, gt=0, le=1000)
    """`fields`: correlation length in metres."""

    @model_validator(mode="after")
    def _as_measured(self) -> SimulatedPrior:
        """Errors that were measured are as they are."""
        if self.errors != "measured":
            return self
        own = type(self).model_fields
        if stated := [name for name in ("shared", "good_share") if getattr(self, name) != own[name].default]:
            raise ValueError(
                f"`errors: measured` has no `{stated[0]}`; remove it, or write `errors: objects` or `errors: fields`"
            )
        if self.samples > MEASURED_SAMPLES:
            raise ValueError(f"`errors: measured` has 1 to {MEASURED_SAMPLES} `samples`, not {self.samples}")
        return self


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
