"""Options of the sampling of diffusion models, apart from their code, so that reading them loads no torch."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SamplingOptions:
    """How a diffusion model is run.

    Attributes:
        tile: edge in pixels of the tiles in which larger pictures are sampled; they overlap by a quarter.
        precision: of the U-Net: `float32`, `float16`, `bfloat16`, or `auto` = float16 on a GPU, float32 on a CPU. The rest of the
            model is float32.
        longest_side: to which photographs are scaled for the model, in pixels; the maps are scaled back. None = as its authors
            recommend.
    """

    tile: int = 1024
    precision: str = "auto"
    longest_side: int | None = None
