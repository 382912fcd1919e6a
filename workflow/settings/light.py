"""Settings of the emitters and of the light that they cast."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from iif_core.light.emission.options import EmissionOptions
from iif_core.light.options import ShadingOptions
from workflow.settings.section import Section, word_or_positive

NOISE_OF_OBJECTS, NOISE_OF_TEXTURES = 0.2, 0.1
"""Noise of the diffuse light where numbers of objects are fitted to it, and where surface cells get materials of their own."""


class Emission(Section):
    """Which faces of the mesh emit light, and how bright they are."""

    rows: int = Field(EmissionOptions.rows, ge=100)
    """Number of pixels whose light transport is traced."""
    samples: int = Field(EmissionOptions.samples, ge=2)
    """Paths per pixel, over two independent halves."""


class Shading(Section):
    """Incident light that is cached for the fits: diffuse, and specular at several roughness levels."""

    samples: int = Field(ShadingOptions.samples, ge=2)
    """Paths per pixel (specular), and paths per surface cell to begin with (diffuse), over both independent halves."""
    levels: int = Field(10, ge=3, le=32)
    """Number of roughness levels."""
    noise: Annotated[Literal["auto"] | Annotated[float, Field(gt=0)], word_or_positive("auto")] = "auto"
    """Relative standard error of diffuse light (median over an object) below which no more paths are added. `auto`: 0.2, or 0.1
    for texture from the photographs, in which the noise of a cell would be seen."""
