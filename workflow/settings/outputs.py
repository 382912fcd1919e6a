"""What is made of the result: re-rendering, scores, files, page."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from workflow.settings.section import Section


class Render(Section):
    """Re-rendering of the views from the recovered scene."""

    samples: int = Field(16, ge=1)
    """Paths a pixel."""
    max_bounces: int = Field(16, ge=1, le=64)
    """Path length."""
    denoise: bool = True
    """Denoise the re-renderings (they are looked at and compared, nothing is fitted to them)."""


class Metrics(Section):
    """What is compared."""

    views: Literal["all"] = "all"
    """Views that are scored."""
    lpips_vgg: bool = False
    """Score albedo (of the result, the base and the first prediction; as it is and scaled) also with LPIPS on VGG16, as the
    paper does. Needs its weights: `snakemake --cores 1 results/weights/lpips_vgg.npz`. Triples the time of the stage."""


class Export(Section):
    """Files for other programs."""

    max_faces_glb: int = Field(2_000_000, ge=1000)
    """Faces in scene.glb; above, it is refused with a note rather than written for minutes."""


class Report(Section):
    """The page."""

    views: int = Field(6, ge=1)
    """Views shown."""
    credit: str = ""
    """Line under the title (artist, licence)."""
