"""Settings of stage `base`; the defaults of the direct solver are those of `FusionOptions`."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field, model_validator

from iif_core.fusion.options import FusionOptions
from workflow.settings.section import Section

_DEFAULT = FusionOptions()  # the direct solver's
_DIRECT_ALONE = ("sweeps", "ridge", "temperature", "anneal", "final_temperature", "seams", "robust", "objective")
_SGD_ALONE = ("preset", "texture", "iterations", "median_gradient")  # the sizes of the hash grid come with a quality


class Base(Section):
    """Fusing the K predictions of all views into one 3D base texture."""

    IDLE: ClassVar = {"solver": {"direct": ("solver: sgd", _SGD_ALONE), "sgd": ("solver: direct", _DIRECT_ALONE)}}

    solver: Literal["direct", "sgd"] = "direct"
    """`direct`: alternating closed forms on surface cells; `sgd`: the paper's optimiser, to compare with."""
    variant: Literal["full", "uniform", "image_affine", "texel_mean", "object_mean", "raw"] = "full"
    """`full`: affine maps and selection; `uniform`: affine maps without selection; `image_affine`: one affine map per image
    instead of one per object and image; baselines: the means, and `raw` = the first prediction of each view unchanged."""
    predictions: int | None = Field(None, ge=1)
    """Use only the first so many predictions of each view; default: all."""
    cell_edge: float | None = Field(None, gt=0)
    """Edge of a surface cell in metres; default: `cell_footprints` pixel footprints."""
    cell_footprints: float = Field(0.4, gt=0)
    """Cell edge in median pixel footprints."""
    border_weight: float = Field(0.1, gt=0, le=1)
    """Weight of pixels next to another object: real predictions bleed across borders."""
    footprint_power: float = Field(0.0, ge=0, le=4)
    """Weight pixels by (median footprint / own footprint) to this power: prefers near and frontal views of a surface."""
    objective: Literal["least_squares", "distribution"] = _DEFAULT.objective
    """`direct`: `distribution` afterwards minimises the paper's own loss for the selection found."""
    robust: bool = _DEFAULT.robust
    """`direct`: cells take an M-estimate instead of the mean, which resists outliers in few views and costs sharpness."""
    sweeps: int = Field(_DEFAULT.sweeps, ge=1, le=200)
    """`direct`: alternations."""
    polish: int = Field(_DEFAULT.polish, ge=1, le=1000)
    """`direct`, `objective: distribution`: sweeps on the paper's loss."""
    ridge: float = Field(_DEFAULT.ridge, gt=0)
    """`direct`: strength of the ridge of the affine maps towards the identity, per pixel."""
    temperature: float = Field(_DEFAULT.temperature, ge=0)
    """`direct`: selection temperature of the first sweep, in units of a segment's median error."""
    anneal: float = Field(_DEFAULT.anneal, gt=0, lt=1)
    """`direct`: factor on the selection temperature per sweep."""
    final_temperature: float = Field(_DEFAULT.final_temperature, ge=0)
    """`direct`: temperature at which annealing stops; 0 = the single best prediction, more = near-ties are averaged."""
    seams: bool = _DEFAULT.seams
    """`direct`: close seams between parts of an object that no photograph shows together."""
    preset: Literal["safe", "paper"] = "safe"
    """`sgd`: `paper` = the published behaviour; `safe` = with the numerical safeguards of lab/docs/published.md#schedules. Sets
    the defaults of the settings below."""
    texture: Literal["cells", "hashgrid"] | None = None
    """`sgd`: texture model; default: `cells`, `preset: paper` the hash grid."""
    iterations: int | None = Field(None, ge=1)
    """`sgd`: optimiser steps of 65,536 pixels; default: 3000, `preset: paper` 10 passes over the pixels."""
    hash_levels: int | None = Field(None, ge=1, le=32)
    """`sgd`, hash grid: levels; default: 16, `preset: paper` 32."""
    hash_entries: int | None = Field(None, ge=8, le=24)
    """`sgd`, hash grid: log2 of the entries a level; default: 17, `preset: paper` 19."""
    median_gradient: bool | None = None
    """`sgd`: follow the derivative of the median over the predictions; default: no, `preset: paper` yes."""
    judge: bool = False
    """Evaluate the paper's loss of the result, and for `sgd` also the loss of `direct` at the same selection (base.json)."""

    @model_validator(mode="after")
    def _known_pairs(self) -> Base:
        if self.solver == "sgd" and self.variant != "full":
            raise ValueError(
                f"`solver: sgd` fits `variant: full` alone, not `{self.variant}`; use `solver: direct` for the others"
            )
        if self.objective == "distribution" and self.variant not in ("full", "image_affine"):
            raise ValueError(f"`objective: distribution` needs a selection; `variant: {self.variant}` makes none")
        return self


class SecondLook(Section):
    """Predicting and fusing once more, under the light that was found (prior `learned` alone)."""

    enabled: bool = True
    """`false`: the fit starts from the first base texture, which saves a sixth of the CPU time from `prior` to `affines`
    (docs/method/priors.md#a-second-look)."""
