"""Settings of the segmentation: which surface belongs to which object."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from workflow import plugins
from workflow.settings.section import Section


class SegmentationBase(Section):
    border_erosion: int = Field(1, ge=0, le=16)
    """Width in pixels of the border along another object."""


class GivenSegmentation(SegmentationBase):
    """Object ids that came with the source, of the faces of the mesh or of views. Nothing reads them under another kind."""

    kind: Literal["given"]


class PiecesOfMesh(SegmentationBase):
    scale: float = Field(0.05, gt=0)
    """Pieces of the mesh: a larger value gives fewer and larger pieces."""
    min_faces: int = Field(100, ge=1)
    """Pieces of the mesh with fewer faces are merged into a neighbour, unless they have `min_area`."""
    min_area: float = Field(0.01, ge=0)
    """Area in m^2 from which a piece of the mesh stays as it is, however few faces it has."""
    colour: float = Field(0.1, ge=0)
    """Pieces of the mesh: weight of differences in colour between faces, relative to the angle between them (0 = shape
    alone)."""


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
    points_per_side: int = Field(32, ge=1, le=256)
    """Points along each side of the grid at which the model is queried in every photograph."""
    confidence: float = Field(0.8, ge=0, le=1)
    """Masks for which the model predicts a smaller intersection over union with the truth are dropped."""
    stability: float = Field(0.95, ge=0, le=1)
    """Masks that shrink below this share when the threshold on the logits rises from -1 to 1 are dropped."""
    overlap: float = Field(0.7, ge=0, le=1)
    """Of masks with a larger intersection over union, only the most confident is kept."""


class MaskSegmentation(PiecesOfMesh):
    """Masks of the photographs made by any tool, `masks/<view>.png|exr` or `masks/<view>/<n>.png`, clustered across the views by
    view consensus; surface without masks is cut into pieces of the mesh (docs/guide/segmentation.md)."""

    kind: Literal["masks"]
    path: Path | None = None
    """Folder that holds `masks/`; by default the folder of the source."""
    sam2: Sam2 | None = None
    """Make the masks instead of reading them."""
    min_faces: int = Field(20, ge=1)
    """Pieces of the mesh with fewer faces are merged into a neighbour, unless they have `min_area`."""
    visible: float = Field(0.3, gt=0, le=1)
    """Share of a mask that a view must see for its masks to be compared with it."""
    contained: float = Field(0.8, gt=0, le=1)
    """A view supports a mask if a mask of the view contains more than this share of the visible part."""
    split: float = Field(0.5, gt=0, le=1)
    """A mask that more than this share of the views split is dropped, because it holds several objects. A smaller value gives
    finer objects."""
    consensus: float = Field(0.9, gt=0, le=1)
    """Two masks are joined if this share of the views that see both support them as one. A larger value gives finer objects."""
    min_points: int = Field(4, ge=1)
    """Masks with fewer surface points, which are two pixel footprints apart, are not clustered."""

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
