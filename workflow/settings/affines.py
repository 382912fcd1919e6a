"""Settings of the fit of materials to the photographs: affine maps, camera response, scale."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, ClassVar, Literal

from pydantic import Field, field_validator, model_validator

from iif_core.fitting.problem import FitOptions, SgdOptions
from workflow.settings.section import Section, word_or_count

_DIRECT, _DESCENT = FitOptions(), SgdOptions()
_BASELINES = ("base", "object_mean", "texture_average", "fipt", "iris")
FREE_CELLS = ("fipt", "iris")
"""Models that read every pixel."""
_DIRECT_ALONE = ("iterations", "population", "robust_width")
_DESCENT_ALONE = ("epochs", "batch", "rate")
_OBJECTS_ALONE = (*_DIRECT_ALONE, *_DESCENT_ALONE, "scale", "texture")  # `pixels` too, but it comes with a quality


def textures_cells(texture: str, prior_kind: str) -> bool:
    """Return whether `affines.texture` asks for texture from the photographs, with the prior of a kind."""
    return texture == "photographs" or (texture == "auto" and prior_kind == "retinex")


class ResponseFile(Section):
    """A measured camera response."""

    file: Path
    """CSV or Parquet with columns `x, R, G, B` (exposed radiance from 0 to 1, sensor values), or NPY of shape (3, samples) over
    evenly spaced x."""


class WhitePatch(Section):
    """Surface of known albedo: an object, or a rectangle of pixels in one view."""

    object: str | None = None
    """Name of the object (objects.parquet)."""
    view: str | None = None
    """View that holds the rectangle."""
    box: tuple[int, int, int, int] | None = None
    """Left, top, right, bottom in pixels; right and bottom are excluded."""
    albedo: float = Field(gt=0, le=1)
    """Albedo of the surface: mean over the channels, linear."""

    @model_validator(mode="after")
    def _one_place(self) -> WhitePatch:
        if (self.object is None) == (self.view is None) or (self.view is None) != (self.box is None):
            raise ValueError("a white patch is either `object: NAME` or `view: NAME` with `box: [left, top, right, bottom]`")
        return self


class KnownLamp(Section):
    """An emitter of known radiance."""

    emitter_id: int = Field(ge=0)
    """Number of the emitter (emitters.parquet)."""
    radiance: tuple[float, float, float]
    """R, G, B in the units that the result shall have; their mean is used."""

    @field_validator("radiance")
    @classmethod
    def _shines(cls, value: tuple[float, float, float]) -> tuple[float, float, float]:
        if min(value) < 0 or sum(value) <= 0:
            raise ValueError(f"radiance {list(value)}: no channel below 0, and their sum above 0")
        return value


class KnownScale(Section):
    """What fixes the scale between light and albedo: exactly one of the three."""

    white_patch: WhitePatch | None = None
    """Surface of known albedo."""
    lamp: KnownLamp | None = None
    """Emitter of known radiance."""
    mean_albedo: float | None = Field(None, gt=0, le=1)
    """Mean albedo of the fitted pixels."""

    @model_validator(mode="after")
    def _one_kind(self) -> KnownScale:
        given = [name for name in ("white_patch", "lamp", "mean_albedo") if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"give exactly one of white_patch, lamp, mean_albedo; found {', '.join(given) or 'none'}")
        return self


class Affines(Section):
    """One affine map per object, and the camera response."""

    IDLE: ClassVar = {
        "model": {model: ("model: objects", _OBJECTS_ALONE) for model in _BASELINES},
        "solver": {
            "direct": ("solver: sgd", _DESCENT_ALONE),
            "sgd": ("solver: direct", _DIRECT_ALONE),
            "adam": ("solver: direct", _DIRECT_ALONE),
            "published": ("solver: direct", _DIRECT_ALONE),
        },
    }

    model: Literal["objects", "base", "object_mean", "texture_average", "fipt", "iris"] = "objects"
    """`objects`: one affine map per object. Baselines under the same light (lab/docs/studies.md): `base`: nothing is
    fitted; `object_mean`: mean prediction of each object; `texture_average`: mean photographed colour of each cell as albedo;
    `fipt`, `iris`: a free BRDF in every cell."""
    solver: Literal["direct", "sgd", "adam", "published"] = "direct"
    """With `objects`: `direct`: Gauss-Newton; `sgd`: stochastic gradient descent on the paper's loss; `adam`: Adam on the same
    loss; `published`: the paper's descent to the letter (lab/docs/published.md#materials). With `fipt`, `iris`: `direct`:
    exact for every cell; `adam`: gradient descent on the same loss."""
    response: Literal["auto", "identity", "srgb", "gamma", "ggcm", "spline"] | ResponseFile = "auto"
    """Family of the camera response, or `{file: curve.csv}` for a measured one (CSV or Parquet with columns `x, R, G, B`, or NPY
    of shape (3, samples)). `auto`: identity for HDR; for LDR the simplest of srgb, gamma, ggcm and spline that explains how
    photographs of different exposure show the same surface, and srgb where no surface is shown by several exposures."""
    iterations: int = Field(_DIRECT.iterations, ge=1, le=500)
    """`direct`: largest number of Gauss-Newton steps; the fit ends earlier when a step changes nothing."""
    pixels: Annotated[Literal["all"] | Annotated[int, Field(ge=100)], word_or_count("all", least=100)] = 200000
    """`objects`: pixels in the fit, drawn evenly over the objects, or `all`; with `solver: published` also those along the border
    of another object."""
    population: bool = _DIRECT.population
    """`direct`: the prior of every object is the distribution of the well-determined objects of the scene (empirical Bayes);
    `false`: a fixed, weak prior."""
    robust_width: float = Field(_DIRECT.robust_width, gt=0)
    """`direct`: width of the Cauchy loss of the residual, in sensor units."""
    epochs: int = Field(_DESCENT.epochs, ge=1)
    """`sgd`, `adam`, `published`: passes over the pixels; the step size falls to a fifth after each."""
    batch: int = Field(_DESCENT.batch, ge=1)
    """`sgd`, `adam`, `published`: pixels in one step."""
    rate: float | None = Field(_DESCENT.rate, gt=0)
    """`sgd`, `adam`, `published`: step size; the default is 10, and 0.01 for `adam`."""
    scale: Literal["found", "prior"] | KnownScale = "found"
    """`objects`: what fixes the factor between light and albedo: `found`: the share of indirect light; `prior`: the prior's mean
    albedo (`found` for HDR); or a known quantity: {white_patch: {object: NAME, albedo: 0.9}}, {white_patch: {view:
    NAME, box: [left, top, right, bottom], albedo: 0.9}}, {lamp: {emitter_id: 0, radiance: [5, 5, 4]}}, {mean_albedo: 0.4}."""
    texture: Literal["auto", "base", "photographs"] = "auto"
    """`objects`: albedo of the surface cells. `base`: the base texture under the affine maps; `photographs`: the same, plus the
    detail that the photographs show in each cell, without slow changes across an object; `auto`: `photographs` for
    `prior: {kind: retinex}`, which was made before the light was known, `base` otherwise."""

    @model_validator(mode="after")
    def _known_pairs(self) -> Affines:
        allowed = {"objects": ("direct", "sgd", "adam", "published"), "fipt": ("direct", "adam"), "iris": ("direct", "adam")}
        solvers = allowed.get(self.model, ("direct",))
        if self.solver not in solvers:
            raise ValueError(f"`solver: {self.solver}` does not fit `model: {self.model}`; allowed with it: {', '.join(solvers)}")
        return self
