"""Settings of the emitters and of the light that they cast."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from workflow.settings.section import ON_OFF, Section, word_or_count, word_or_positive

NOISE_OF_OBJECTS, NOISE_OF_TEXTURES = 0.2, 0.1
"""Noise of the diffuse light where numbers of objects are fitted to it, and where surface cells get materials of their own."""


class Emission(Section):
    """Which faces of the mesh emit light, and how bright they are."""

    saturation: float = Field(0.99, gt=0, le=1)
    """Sensor value from which a pixel counts as saturated."""
    min_observations: int = Field(8, ge=1)
    """Pixels that must show a face (or a group of faces) before it can be an emitter."""
    cache_edge: float = Field(0.06, gt=0)
    """Edge of a radiance-cache voxel in metres."""
    max_bounces: int = Field(6, ge=1, le=64)
    """Longest path, in bounces, where the radiance cache holds no value."""
    pixels: int = Field(4_000_000, ge=1000)
    """Pixels of all photographs together that the stage looks at. Where there are more, a random choice of each photograph
    stands for it, and `min_observations` counts pixels of that choice."""
    rows: int = Field(40000, ge=100)
    """Number of pixels whose light transport is traced."""
    samples: int = Field(16, ge=2)
    """Paths per pixel, over two independent halves."""
    prune: float = Field(0.01, ge=0, lt=1)
    """Emitters of objects that give less than this share of the photographed light are dropped, unless it is missed."""
    environment: Annotated[Literal["auto", "on", "off"], ON_OFF] = "auto"
    """Light from outside the mesh: 42 directions, what is seen apart, or twelve where the mesh is open. `auto`: included when
    enough rays leave the mesh and what they meet is not black."""


class Shading(Section):
    """Incident light that is cached for the fits: diffuse, and specular at several roughness levels."""

    pixels: Annotated[Literal["auto", "all"] | Annotated[int, Field(ge=100)], word_or_count("auto", "all", least=100)] = "auto"
    """Pixels of which specular light is traced, drawn evenly over the objects. `auto`: as many as the fit reads
    (`affines.pixels`), or `all` where it reads every pixel, for texture from the photographs. A number must be at least
    `affines.pixels`."""
    samples: int = Field(32, ge=2)
    """Paths per pixel (specular), and paths per surface cell to begin with (diffuse), over both independent halves."""
    levels: int = Field(10, ge=3, le=32)
    """Number of roughness levels."""
    cell_edge: float = Field(0.03, gt=0)
    """Edge in metres of the surface cells for which diffuse light is cached, once for all views."""
    noise: Annotated[Literal["auto"] | Annotated[float, Field(gt=0)], word_or_positive("auto")] = "auto"
    """Relative standard error of diffuse light (median over an object) below which no more paths are added. `auto`: 0.2, or 0.1
    for texture from the photographs, in which the noise of a cell would be seen."""
    max_samples: int = Field(512, ge=2)
    """Largest number of paths per cell."""
    max_bounces: int = Field(6, ge=1, le=64)
    """Longest path, in bounces, where the radiance cache holds no value."""
    indirect: Literal["auto", "cache", "path"] = "auto"
    """Indirect light. `cache`: paths end at surface whose radiance was photographed; `path`: paths go on with the base
    materials; `auto`: `cache` if enough of the surface that secondary rays meet was photographed."""
