"""Sections with settings that choose the published method, its optimisers, variants of ours, and baselines, and with what the
product holds constant and studies change."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from iif_core.fitting.problem import FitOptions
from iif_core.fusion.options import CellOptions, FusionOptions
from iif_core.light.emission.options import EmissionOptions
from iif_core.light.options import ShadingOptions
from workflow.settings import affines, base, light
from workflow.settings.section import word_or_count

PUBLISHED = ("published", "published_repaired")
"""Solvers of stage emission that are the published method from the photographs on."""
FREE_CELLS = ("fipt", "iris")
"""Models of stage affines with a free BRDF in every cell."""


class Base(base.Base):
    """Fusing the K predictions of all views into one 3D base texture."""

    solver: Literal["direct", "sgd"] = "direct"
    """`direct`: alternating closed forms on surface cells; `sgd`: the paper's optimiser, to compare with."""
    variant: Literal["full", "uniform", "image_affine", "texel_mean", "object_mean", "raw"] = "full"
    """`full`: affine maps and selection; `uniform`: affine maps without selection; `image_affine`: one affine map per image
    instead of one per object and image; baselines: the means, and `raw` = the first prediction of each view unchanged."""
    objective: Literal["least_squares", "distribution"] = "least_squares"
    """`direct`: `distribution` afterwards minimises the paper's own loss for the selection found."""
    polish: int = Field(25, ge=1, le=1000)
    """`direct`, `objective: distribution`: sweeps on the paper's loss."""
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
    predictions: int | None = Field(CellOptions.predictions, ge=1)
    """Use only the first so many predictions of each view; default: all."""
    cell_edge: float | None = Field(CellOptions.cell_edge, gt=0)
    """Edge of a surface cell in metres; default: `cell_footprints` pixel footprints."""
    border_weight: float = Field(CellOptions.border_weight, gt=0, le=1)
    """Weight of pixels next to another object."""
    footprint_power: float = Field(CellOptions.footprint_power, ge=0, le=4)
    """Weight pixels by (median footprint / own footprint) to this power."""
    sweeps: int = Field(FusionOptions.sweeps, ge=1, le=200)
    """Alternations."""
    ridge: float = Field(FusionOptions.ridge, gt=0)
    """Strength of the ridge of the affine maps towards the identity, per pixel."""
    temperature: float = Field(FusionOptions.temperature, ge=0)
    """Selection temperature of the first sweep, in units of a segment's median error."""
    anneal: float = Field(FusionOptions.anneal, gt=0, lt=1)
    """Factor on the selection temperature per sweep."""
    final_temperature: float = Field(FusionOptions.final_temperature, ge=0)
    """Temperature at which annealing stops; 0 = the single best prediction, more = near-ties are averaged."""
    seams: bool = FusionOptions.seams
    """Close seams between parts of an object that no photograph shows together."""

    @model_validator(mode="after")
    def _known_pairs(self) -> Base:
        if self.solver == "sgd" and self.variant != "full":
            raise ValueError(
                f"`solver: sgd` fits `variant: full` alone, not `{self.variant}`; use `solver: direct` for the others"
            )
        if self.objective == "distribution" and self.variant not in ("full", "image_affine"):
            raise ValueError(f"`objective: distribution` needs a selection; `variant: {self.variant}` makes none")
        return self


class Emission(light.Emission):
    """Which faces of the mesh emit light, and how bright they are."""

    solver: Literal["direct", "published", "published_repaired"] = "direct"
    """`direct`: non-negative least squares; `published`: the paper's method; `published_repaired`: without its errors
    (lab/docs/published.md#emission)."""
    iterations: int | None = Field(None, ge=1)
    """`published`: steps of 8192 pixels each; default: one pass over all pixels."""
    cache_edge: float = Field(EmissionOptions.cache_edge, gt=0)
    """Edge of a radiance-cache voxel in metres."""
    min_observations: int = Field(EmissionOptions.min_observations, ge=1)
    """Pixels that must show a face or a group of faces before it can be an emitter."""


class Shading(light.Shading):
    """Incident light that is cached for the fits: diffuse, and specular at several roughness levels."""

    method: Literal["shared_paths", "published"] = "shared_paths"
    """`shared_paths`: all lobes from one set of paths, diffuse light once for every surface cell; `published`: as the paper has
    it, at every pixel 256 paths for diffuse light and 64 to 128 for each of 6 levels, of one bounce, and the denoiser
    (lab/docs/published.md#shading)."""
    pixels: Annotated[Literal["auto", "all"] | Annotated[int, Field(ge=100)], word_or_count("auto", "all", least=100)] = "auto"
    """Pixels of which specular light is traced, drawn evenly over the objects. `auto`: as many as the fit reads
    (`affines.pixels`), or `all` where it reads every pixel. A number must be at least `affines.pixels`."""
    cell_edge: float = Field(ShadingOptions.cell_edge, gt=0)
    """Edge in metres of the surface cells for which diffuse light is cached, once for all views."""
    max_samples: int = Field(ShadingOptions.max_samples, ge=2)
    """Largest number of paths per cell."""


class Affines(affines.Affines):
    """One affine map per object, and the camera response."""

    model: Literal["objects", "base", "object_mean", "texture_average", "fipt", "iris"] = "objects"
    """`objects`: one affine map per object. Baselines under the same light (lab/docs/studies.md): `base`: nothing is
    fitted; `object_mean`: mean prediction of each object; `texture_average`: mean photographed colour of each cell as albedo;
    `fipt`, `iris`: a free BRDF in every cell."""
    solver: Literal["direct", "sgd", "adam", "published"] = "direct"
    """With `objects`: `direct`: Gauss-Newton; `sgd`: stochastic gradient descent on the paper's loss; `adam`: Adam on the same
    loss; `published`: the paper's descent to the letter (lab/docs/published.md#materials). With `fipt`, `iris`: `direct`:
    exact for every cell; `adam`: gradient descent on the same loss."""
    epochs: int = Field(3, ge=1)
    """`sgd`, `adam`, `published`: passes over the pixels; the step size falls to a fifth after each."""
    steps: int | None = Field(None, ge=1)
    """`sgd`, `adam`, `published`: steps over all epochs, with as many passes as they need; default: one pass an epoch."""
    batch: int = Field(32768, ge=1)
    """`sgd`, `adam`, `published`: pixels in one step."""
    rate: float | None = Field(None, gt=0)
    """`sgd`, `adam`, `published`: step size; the default is 10, and 0.01 for `adam`."""
    iterations: int = Field(FitOptions.iterations, ge=1, le=500)
    """`direct`: largest number of Gauss-Newton steps; the fit ends earlier when a step changes nothing."""
    population: bool = FitOptions.population
    """The prior of every object is the distribution of the well-determined objects of the scene (empirical Bayes);
    `false`: a fixed, weak prior."""
    robust_width: float = Field(FitOptions.robust_width, gt=0)
    """Width of the Cauchy loss of the residual, in sensor units."""
    texture: Literal["auto", "base", "photographs"] = "auto"
    """Albedo of the surface cells. `base`: the base texture under the affine maps; `photographs`: the same, plus the
    detail that the photographs show in each cell, without slow changes across an object; `auto`: `photographs` for
    `prior: {kind: retinex}`, `base` otherwise."""

    @model_validator(mode="after")
    def _known_pairs(self) -> Affines:
        allowed = {"objects": ("direct", "sgd", "adam", "published"), "fipt": ("direct", "adam"), "iris": ("direct", "adam")}
        solvers = allowed.get(self.model, ("direct",))
        if self.solver not in solvers:
            raise ValueError(f"`solver: {self.solver}` does not fit `model: {self.model}`; allowed with it: {', '.join(solvers)}")
        return self

    def textured(self, prior_kind: str) -> bool:
        """Return whether surface cells take the detail that the photographs show in them."""
        return super().textured(prior_kind) if self.texture == "auto" else self.texture == "photographs"

    def of_cells(self, prior_kind: str) -> str:
        """Return what gives surface cells materials of their own, in words; empty if nothing does."""
        if self.model in FREE_CELLS:
            return f"`affines: model: {self.model}`"
        return super().of_cells(prior_kind) if self.model == "objects" else ""
