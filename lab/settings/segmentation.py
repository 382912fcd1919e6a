"""Settings of segmentations that the product holds constant."""

from __future__ import annotations

from pydantic import Field

from iif_core.objects.options import BorderOptions, PieceOptions, ProposalOptions
from workflow.settings import segmentation
from workflow.settings.section import Section


class Bordered(Section):
    border_erosion: int = Field(BorderOptions.border_erosion, ge=0, le=16)
    """Width in pixels of the border along another object."""


class GivenSegmentation(segmentation.GivenSegmentation, Bordered):
    """Objects that are given."""


class Coloured(Section):
    colour: float = Field(PieceOptions.colour, ge=0)
    """Pieces of the mesh: weight of differences in colour between faces, relative to the angle between them (0 = shape
    alone)."""


class GeometrySegmentation(segmentation.GeometrySegmentation, Bordered, Coloured):
    """Pieces of the mesh, of any size."""

    min_faces: int = Field(PieceOptions.min_faces, ge=1)
    """Pieces of the mesh with fewer faces are merged into a neighbour, unless they have `min_area`."""
    min_area: float = Field(PieceOptions.min_area, ge=0)
    """Area in m^2 from which a piece of the mesh stays as it is, however few faces it has."""


class Sam2(segmentation.Sam2):
    """Cut the photographs into masks with SAM 2, whose masks are chosen otherwise."""

    points_per_side: int = Field(ProposalOptions.points_per_side, ge=1, le=256)
    """Points along each side of the grid at which the model is queried in every photograph."""
    confidence: float = Field(ProposalOptions.confidence, ge=0, le=1)
    """Masks for which the model predicts a smaller intersection over union with the truth are dropped."""
    stability: float = Field(ProposalOptions.stability, ge=0, le=1)
    """Masks that shrink below this share when the threshold on the logits rises from -1 to 1 are dropped."""
    overlap: float = Field(ProposalOptions.overlap, ge=0, le=1)
    """Of masks with a larger intersection over union, only the most confident is kept."""


class MaskSegmentation(segmentation.MaskSegmentation, Bordered, Coloured):
    """Masks of the photographs."""

    sam2: Sam2 | None = None
    """Make the masks instead of reading them."""
