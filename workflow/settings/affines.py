"""Fitting the materials to the photographs: affines, camera response, scale."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field, field_validator, model_validator

from workflow.settings.section import Section


class ResponseFile(Section):
    """A measured camera response."""

    file: Path
    """CSV or Parquet with columns `x, R, G, B` (exposed radiance from 0 to 1, sensor values), or NPY (3, samples) over
    even steps of x."""


class WhitePatch(Section):
    """Surface of known albedo: an object, or a box of pixels in one view."""

    object: str | None = None
    """Its name (objects.parquet)."""
    view: str | None = None
    """View of the box."""
    box: tuple[int, int, int, int] | None = None
    """Left, top, right, bottom in pixels; right and bottom excluded."""
    albedo: float = Field(gt=0, le=1)
    """Its albedo, mean over the channels, linear."""

    @model_validator(mode="after")
    def _one_place(self) -> WhitePatch:
        if (self.object is None) == (self.view is None) or (self.view is None) != (self.box is None):
            raise ValueError("a white patch is either `object: NAME` or `view: NAME` with `box: [left, top, right, bottom]`")
        return self


class KnownLamp(Section):
    """An emitter of known radiance."""

    emitter_id: int = Field(ge=0)
    """Its number (emitters.parquet)."""
    radiance: tuple[float, float, float]
    """R, G, B in the units that the result shall have; the mean counts."""

    @field_validator("radiance")
    @classmethod
    def _shines(cls, value: tuple[float, float, float]) -> tuple[float, float, float]:
        if min(value) < 0 or sum(value) <= 0:
            raise ValueError(f"radiance {list(value)}: no channel below 0, and their sum above 0")
        return value


class KnownScale(Section):
    """What fixes the scale of light and albedo: exactly one."""

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
    """One affine per object and the camera response."""

    model: Literal["objects", "base", "object_mean", "texture_average", "fipt", "iris"] = "objects"
    """`objects`: one affine an object; the others are baselines over the same light: `base` fits nothing, `object_mean`: the
    predictions' mean of each object, `texture_average`: the photographs' mean colour of each surface cell taken as albedo,
    `fipt`, `iris`: a free BRDF in every surface cell (docs/studies.md)."""
    solver: Literal["direct", "sgd", "adam"] = "direct"
    """`objects`: `direct` Gauss-Newton; `sgd`: the paper's optimiser on the paper's loss; `adam`: the same with its safe variant.
    `fipt`, `iris`: `direct` exact per cell; `adam` as published."""
    response: Literal["auto", "identity", "srgb", "gamma", "ggcm", "spline"] | ResponseFile = "auto"
    """Family of the camera response, or `{file: curve.csv}` for a measured one (CSV or Parquet with columns `x, R, G, B`; NPY
    (3, samples)). `auto`: identity for HDR; for LDR the smallest of srgb, gamma, ggcm and spline that explains how
    differently exposed photographs show the same surface, srgb where there are none."""
    iterations: int = Field(60, ge=1, le=500)
    """`direct`: most Gauss-Newton steps; it ends when a step changes nothing."""
    pixels: int = Field(200000, ge=100)
    """Pixels in the fit (drawn evenly over objects)."""
    population: bool = True
    """`direct`: objects lean on what the well-determined ones have in common, as far as those agree; otherwise on `ridge`."""
    ridge: float = Field(0.002, gt=0)
    """`direct` without `population`: pull towards identity, per pixel."""
    robust_width: float = Field(0.1, gt=0)
    """`direct`: Cauchy width of the residual in sensor units."""
    epochs: int = Field(3, ge=1)
    """`sgd`, `adam`: passes over the pixels; the rate falls to a fifth after each."""
    batch: int = Field(32768, ge=1)
    """`sgd`, `adam`: pixels of a step."""
    rate: float | None = Field(None, gt=0)
    """`sgd`, `adam`: step size; default 10 and 0.01."""
    scale: Literal["found", "prior"] | KnownScale = "found"
    """What fixes the factor between light and albedo. `found`: the light as stage emission found it, by how much of it is
    indirect (always so for HDR, unless a known scale is given); `prior`: the prior's mean albedo; or what is known: {white_patch:
    {object: NAME, albedo: 0.9}}, {white_patch: {view: NAME, box: [left, top, right, bottom], albedo: 0.9}}, {lamp: {emitter_id:
    0, radiance: [5, 5, 4]}} or {mean_albedo: 0.4}."""

    texture: Literal["auto", "base", "photographs"] = "auto"
    """`objects`: `base`: the base texture through the affines; `photographs`: with what they show of every cell beyond that, slow
    changes inside an object left out; `auto`: `photographs` for `prior: {kind: retinex}`, which had no light to divide by."""

    @model_validator(mode="after")
    def _known_pairs(self) -> Affines:
        allowed = {"objects": ("direct", "sgd", "adam"), "fipt": ("direct", "adam"), "iris": ("direct", "adam")}
        solvers = allowed.get(self.model, ("direct",))
        if self.solver not in solvers:
            raise ValueError(f"`solver: {self.solver}` does not fit `model: {self.model}`; allowed with it: {', '.join(solvers)}")
        return self
