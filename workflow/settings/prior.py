"""Where the K material predictions come from."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from workflow.settings.section import Section


class PriorBase(Section):
    samples: int = Field(8, ge=1, le=256)
    """Predictions a photograph, K."""
    seed: int | None = Field(None, ge=0, lt=2**31)
    """Seed of the predictions alone; default: the scene's."""


class SimulatedPrior(PriorBase):
    """Ground truth, spoilt the way RGB-X fails (needs a source with truth)."""

    kind: Literal["simulated"]
    strength: float = Field(1.0, ge=0, le=4)
    """0 = truth; 1 = the raw errors that the paper reports for RGB-X."""


class FilesPrior(PriorBase):
    """Maps of any model: `predictions/{albedo,roughness,metallic}/<view>_<kkk>.png|exr`."""

    kind: Literal["files"]
    path: Path | None = None
    """Folder that holds `predictions/`; default: the source's folder."""
    albedo_space: Literal["linear", "srgb"] = "linear"
    """Encoding of the albedo files."""
    roughness_is: Literal["perceptual", "alpha"] = "perceptual"
    """`alpha` = r^2 (microfacet)."""


class RetinexPrior(PriorBase):
    """No weights: photograph / light gathered from all photographs, then colour retinex (docs/real-scenes.md). A baseline, not
    a learned prior."""

    kind: Literal["retinex"]
    mean_albedo: float = Field(0.4, gt=0, lt=1)
    """Mean albedo that each hypothesis is scaled to."""


class DiffusionPrior(PriorBase):
    accept_license: bool = False
    """`true` says that you read the licence of the weights and may use them for this."""
    tile: int = Field(1024, ge=64, le=4096, multiple_of=64)
    """Larger pictures are sampled in tiles of this edge (pixels that the model sees), which overlap by a quarter."""
    batch: int | None = Field(None, ge=1)
    """Samples at once; default: 4 on a GPU, on a CPU one a thread."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """`auto`: the GPU if torch sees one."""
    precision: Literal["auto", "float32", "float16", "bfloat16"] = "auto"
    """Of the U-Net; `auto`: float16 on a GPU, float32 on a CPU. The rest is float32."""


class RgbxPrior(DiffusionPrior):
    """RGB-X, a diffusion model whose weights you bring (docs/priors.md). Non-commercial research only."""

    kind: Literal["rgbx"]
    checkpoint: str = "zheng95z/rgb-to-x"
    """Folder in diffusers' layout, or the name of a repository in the local cache of Hugging Face. Nothing is downloaded."""
    revision: str | None = Field("b38b3fd73a14ea62f3953fc54bc4ac67b067bae0", pattern=r"^[0-9a-f]{7,40}$")
    """Commit of the checkpoint that is meant, or its first digits; where a folder tells none, it is not compared."""
    steps: int = Field(50, ge=1, le=1000)
    """Denoising steps."""
    longest_side: int = Field(1024, ge=64, le=8192)
    """Photographs are scaled to this size, in pixels, for the model; the maps are scaled back."""


class MarigoldPrior(DiffusionPrior):
    """Marigold-IID appearance, a diffusion model whose weights you bring (docs/priors.md)."""

    kind: Literal["marigold"]
    checkpoint: str = "prs-eth/marigold-iid-appearance-v1-1"
    """Folder in diffusers' layout, or the name of a repository in the local cache of Hugging Face. Nothing is downloaded."""
    revision: str | None = Field("e7280a0a0fc5a0df0b36050882b3d8b77da22fd9", pattern=r"^[0-9a-f]{7,40}$")
    """Commit of the checkpoint that is meant, or its first digits; where a folder tells none, it is not compared."""
    steps: int | None = Field(None, ge=1, le=1000)
    """Denoising steps; default: what the checkpoint recommends (4)."""
    longest_side: int | None = Field(None, ge=64, le=8192)
    """Photographs are scaled to this size, in pixels, for the model; default: what the checkpoint recommends (768)."""


Prior = Annotated[SimulatedPrior | FilesPrior | RetinexPrior | RgbxPrior | MarigoldPrior, Field(discriminator="kind")]
