"""All settings of a scene of the laboratory."""

from __future__ import annotations

from pydantic import Field

from workflow.settings.scene import SceneSettings
from workflow.settings.section import Section


class Relit(Section):
    """Scores of pictures under new light, made by studies with `scores: relit_scores` (lab/docs/evaluation.md#relighting)."""

    views: int = Field(3, ge=1)
    """Views that are rendered under each light, spread evenly over all."""
    lamps: int = Field(6, ge=0)
    """At most this number of lamps shine alone, the strongest first."""
    spheres: int = Field(3, ge=0)
    """Positions of the glowing sphere on its path."""
    moved: bool = True
    """Whether the strongest lamp is moved."""
    environment: tuple[float, float, float] | None = (1.0, 1.0, 1.0)
    """Uniform radiance from outside, all lamps off; null = none. A room without openings has no such picture."""
    samples: int = Field(64, ge=1)
    """Paths per pixel, of the source and of the recovered room alike."""
    max_bounces: int = Field(8, ge=1, le=64)
    """Longest path, in bounces."""
    denoise: bool = True
    """Denoise the pictures of both."""


class LabScene(SceneSettings):
    """The settings of the product, and those of scored relighting."""

    relit: Relit = Relit()
