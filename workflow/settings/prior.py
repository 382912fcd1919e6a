"""Settings of the prior: where the K material predictions of every photograph come from."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, get_args

from pydantic import Field, model_validator

from workflow import plugins
from workflow.settings.section import Section


class PriorBase(Section):
    BY_VIEW: ClassVar[bool] = True
    """Whether a prediction of a view takes no work that would be repeated for each part of the views, so that
    `--set-scatter prior=8` pays."""
    samples: int = Field(8, ge=1, le=256)
    """Predictions per photograph, K."""


class FilesPrior(PriorBase):
    """Maps that any model has made: `predictions/{albedo,roughness,metallic}/<view>_<kkk>.png|exr`."""

    kind: Literal["files"]
    path: Path | None = None
    """Folder that holds `predictions/`; by default the folder of the source."""
    albedo_space: Literal["linear", "srgb"] = "linear"
    """Colour space of the albedo files."""
    roughness_is: Literal["perceptual", "alpha"] = "perceptual"
    """Whether the files hold perceptual roughness r or the microfacet width alpha = r^2."""


class RetinexPrior(PriorBase):
    """A baseline that needs no weights, not a learned prior: photographs divided by the light gathered from all of them, then
    colour retinex (docs/method/priors.md#retinex-baseline)."""

    BY_VIEW: ClassVar[bool] = False  # the light is estimated from all photographs
    kind: Literal["retinex"]


class LearnedPrior(PriorBase):
    """A small network that corrects photographs divided by the light gathered from all of them; its weights are part of the
    repository (docs/method/priors.md#learned)."""

    BY_VIEW: ClassVar[bool] = False
    kind: Literal["learned"] = "learned"
    samples: int = Field(8, ge=1, le=16)
    """Predictions per photograph, K: the 8 hypotheses of the network, and 8 more from the mirrored photograph."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """`auto`: the GPU if torch finds one."""


class DiffusionPrior(PriorBase):
    accept_license: bool = False
    """Set to `true` if you have read the licence of the weights and may use them for this."""
    batch: int | None = Field(None, ge=1)
    """Samples computed together; by default 4 on a GPU, and one per thread on a CPU."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """`auto`: the GPU if torch finds one."""


class RgbxPrior(DiffusionPrior):
    """RGB-X, a diffusion model whose weights you bring (docs/guide/priors.md). Non-commercial research only."""

    kind: Literal["rgbx"]
    checkpoint: str = "zheng95z/rgb-to-x"
    """Folder in the layout of diffusers, or the name of a repository in the local cache of Hugging Face. Nothing is
    downloaded."""
    revision: str | None = Field("b38b3fd73a14ea62f3953fc54bc4ac67b067bae0", pattern=r"^[0-9a-f]{7,40}$")
    """Expected commit of the checkpoint, or its first digits; not compared with a folder that does not state its commit."""
    steps: int = Field(50, ge=1, le=1000)
    """Denoising steps."""


class MarigoldPrior(DiffusionPrior):
    """Marigold-IID appearance, a diffusion model whose weights you bring (docs/guide/priors.md)."""

    kind: Literal["marigold"]
    checkpoint: str = "prs-eth/marigold-iid-appearance-v1-1"
    """Folder in the layout of diffusers, or the name of a repository in the local cache of Hugging Face. Nothing is
    downloaded."""
    revision: str | None = Field("e7280a0a0fc5a0df0b36050882b3d8b77da22fd9", pattern=r"^[0-9a-f]{7,40}$")
    """Expected commit of the checkpoint, or its first digits; not compared with a folder that does not state its commit."""
    steps: int | None = Field(None, ge=1, le=1000)
    """Denoising steps; by default as many as the checkpoint recommends (4)."""


Member = Annotated[
    plugins.union("prior", LearnedPrior, RetinexPrior, FilesPrior, RgbxPrior, MarigoldPrior), Field(discriminator="kind")
]


class PooledPrior(PriorBase):
    """The predictions of several priors together; the fusion chooses among all of them (docs/guide/priors.md#pooled)."""

    BY_VIEW: ClassVar[bool] = False
    kind: Literal["pooled"]
    samples: int = Field(8, ge=1, le=256)
    """Predictions per photograph of each member that does not state its own number; K is the sum over the members."""
    of: list[Member] = Field(min_length=2, max_length=8)
    """The priors, each with the keys of its kind."""

    @model_validator(mode="before")
    @classmethod
    def _samples_of_members(cls, value: Any) -> Any:
        members = value.get("of") if isinstance(value, dict) else None
        if not isinstance(members, list):
            return value
        common = {"samples": value["samples"]} if "samples" in value else {}
        return {**value, "of": [{**common, **one} if isinstance(one, dict) else one for one in members]}


Prior = Annotated[get_args(Member)[0] | plugins.extended("prior.pooled", PooledPrior), Field(discriminator="kind")]


def members(prior: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the priors of a dumped section `prior`: itself, or those that it pools."""
    return prior.get("of", [prior])


def predictions(prior: dict[str, Any]) -> int:
    """Return K, the number of predictions per photograph that a dumped section `prior` makes."""
    return sum(member["samples"] for member in members(prior))


def by_view(kind: str) -> bool:
    """Return whether a kind of prior predicts each view by itself, without work that all views share."""
    return next(one.BY_VIEW for one in get_args(get_args(Prior)[0]) if get_args(one.model_fields["kind"].annotation) == (kind,))
