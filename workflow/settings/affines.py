"""Settings of the fit of materials to the photographs: affine maps, camera response, scale."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from workflow.settings.section import Section, word_or_count


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

    response: Literal["auto", "identity", "srgb", "gamma", "ggcm", "spline"] | ResponseFile = "auto"
    """Family of the camera response, or `{file: curve.csv}` for a measured one (CSV or Parquet with columns `x, R, G, B`, or NPY
    of shape (3, samples)). `auto`: identity for HDR; for LDR the simplest of srgb, gamma, ggcm and spline that explains how
    photographs of different exposure show the same surface, and srgb where no surface is shown by several exposures."""
    pixels: Annotated[Literal["all"] | Annotated[int, Field(ge=100)], word_or_count("all", least=100)] = 200000
    """Pixels in the fit, drawn evenly over the objects, or `all`."""
    scale: Literal["found", "prior"] | KnownScale = "found"
    """What fixes the factor between light and albedo: `found`: the share of indirect light; `prior`: the prior's mean
    albedo (`found` for HDR); or a known quantity: {white_patch: {object: NAME, albedo: 0.9}}, {white_patch: {view:
    NAME, box: [left, top, right, bottom], albedo: 0.9}}, {lamp: {emitter_id: 0, radiance: [5, 5, 4]}}, {mean_albedo: 0.4}."""

    def textured(self, prior_kind: str) -> bool:
        """Return whether surface cells take the detail that the photographs show in them: with a prior, of a kind, that was made
        before the light was known."""
        return prior_kind == "retinex"

    def of_cells(self, prior_kind: str) -> str:
        """Return what gives surface cells materials of their own, for which every pixel is read, in words; empty if nothing does.

        prior_kind: `kind` of the prior.
        """
        return "texture from the photographs" if self.textured(prior_kind) else ""
