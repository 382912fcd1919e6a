"""Settings of the segmentation: which surface belongs to which object."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from iif_core.objects.options import ConsensusOptions, PieceOptions
from workflow import plugins
from workflow.settings.section import Section


class GivenSegmentation(Section):
    """Object ids that came with the source, of the faces of the mesh or of views. Nothing reads them under another kind."""

    kind: Literal["given"]


class PiecesOfMesh(Section):
    scale: float = Field(PieceOptions.scale, gt=0)
    """Pieces of the mesh: a larger value gives fewer and larger pieces."""


class Sam2(Section):
    """Cut the photographs into masks with SAM 2, whose weights you bring (docs/guide/segmentation.md)."""

    checkpoint: str = "facebook/sam2.1-hiera-large"
    """Folder in the layout of transformers, or the name of a repository in the local cache of Hugging Face. Nothing is
    downloaded."""
    revision: str | None = Field(None, pattern=r"^[0-9a-f]{7,40}$")
    """Expected commit of the checkpoint, or its first digits; required in the cache, compared with a folder that states it."""
    accept_license: bool = False
    """Set to `true` if you have read the licence of the weights and may use them for this."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """`auto`: the GPU if torch finds one."""


class MaskSegmentation(PiecesOfMesh):
    """Masks of the photographs made by any tool, `masks/<view>.png|exr` or `masks/<view>/<n>.png`, clustered across the views by
    view consensus; surface without masks is cut into pieces of the mesh (docs/guide/segmentation.md)."""

    kind: Literal["masks"]
    path: Path | None = None
    """Folder that holds `masks/`; by default the folder of the source."""
    sam2: Sam2 | None = None
    """Make the masks instead of reading them."""
    consensus: float = Field(ConsensusOptions.consensus, gt=0, le=1)
    """Two masks are joined if this share of the views that see both support them as one. A larger value gives finer objects."""

    @model_validator(mode="after")
    def _one_origin(self) -> MaskSegmentation:
        if self.path is not None and self.sam2 is not None:
            raise ValueError("`path` names masks to read, `sam2` makes them; give one of the two")
        return self


class GeometrySegmentation(PiecesOfMesh):
    """Graph-based segmentation of the mesh after Felzenszwalb and Huttenlocher; needs neither ids nor masks."""

    kind: Literal["geometry"] = "geometry"


Segmentation = Annotated[
    plugins.union("segmentation", GivenSegmentation, MaskSegmentation, GeometrySegmentation),
    Field(discriminator="kind"),
]
