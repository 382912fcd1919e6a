"""Which surface belongs to which object."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from workflow.settings.section import Section


class SegmentationBase(Section):
    border_erosion: int = Field(1, ge=0, le=16)
    """Pixels next to another object that count as border."""


class GivenSegmentation(SegmentationBase):
    """Ids that the source came with, of the mesh's faces or of views."""

    kind: Literal["given"] = "given"


class PiecesOfMesh(SegmentationBase):
    scale: float = Field(0.05, gt=0)
    """Pieces of the mesh: larger gives fewer, larger pieces."""
    min_faces: int = Field(100, ge=1)
    """Pieces of the mesh: smaller ones are merged into a neighbour."""
    colour: float = Field(0.1, ge=0)
    """Pieces of the mesh: weight of the photographs' mean colour of a face beside the bend of the surface (0 = shape alone)."""


class Sam2(Section):
    """SAM 2, a model whose weights you bring, cuts the photographs into masks (docs/segmentation.md)."""

    checkpoint: str = "facebook/sam2.1-hiera-large"
    """Folder in transformers' layout, or the name of a repository in the local cache of Hugging Face. Nothing is downloaded."""
    revision: str | None = Field(None, pattern=r"^[0-9a-f]{7,40}$")
    """Commit of the checkpoint that is meant, or its first digits; needed in the cache, compared where a folder tells it."""
    accept_license: bool = False
    """`true` says that you read the licence of the weights and may use them for this."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """`auto`: the GPU if torch sees one."""
    points_per_side: int = Field(32, ge=1, le=256)
    """The model is asked at a grid of so many times so many points a photograph."""
    confidence: float = Field(0.8, ge=0, le=1)
    """Masks of which the model expects less overlap over union with the truth are dropped."""
    stability: float = Field(0.95, ge=0, le=1)
    """Masks are dropped that shrink below this share when the threshold goes from -1 to 1 (logits)."""
    overlap: float = Field(0.7, ge=0, le=1)
    """Of masks that overlap more (over union), only the surest stays."""


class MaskSegmentation(PiecesOfMesh):
    """2D masks of any tool, `masks/<view>.png|exr` or `masks/<view>/<n>.png`, clustered across the views by view consensus;
    pieces of the mesh where there are none (docs/segmentation.md)."""

    kind: Literal["masks"]
    path: Path | None = None
    """Folder that holds `masks/`; default: the source's folder."""
    sam2: Sam2 | None = None
    """Make the masks here instead of reading them."""
    min_faces: int = Field(20, ge=1)
    """Pieces of the mesh: smaller ones are merged into a neighbour."""
    visible: float = Field(0.3, gt=0, le=1)
    """Share of a mask that a view must see to have an opinion about it."""
    contained: float = Field(0.8, gt=0, le=1)
    """A view holds a mask together if one of its own masks has more than this share of what it sees of it."""
    split: float = Field(0.5, gt=0, le=1)
    """A mask that more than this share of the views split is dropped: it holds several things. Smaller gives finer objects."""
    consensus: float = Field(0.9, gt=0, le=1)
    """Masks are joined if this share of the views that contain both hold them together. Larger gives finer objects."""
    min_points: int = Field(4, ge=1)
    """Masks of fewer surface points (two pixel footprints apart) are not clustered."""

    @model_validator(mode="after")
    def _one_origin(self) -> MaskSegmentation:
        if self.path is not None and self.sam2 is not None:
            raise ValueError("`path` names masks to read, `sam2` makes them; give one of the two")
        return self


class GeometrySegmentation(PiecesOfMesh):
    """Felzenszwalb on the mesh graph: no ids and no masks are needed."""

    kind: Literal["geometry"]


Segmentation = Annotated[GivenSegmentation | MaskSegmentation | GeometrySegmentation, Field(discriminator="kind")]
