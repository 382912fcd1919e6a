"""Settings of segmentations that the product holds constant."""

from __future__ import annotations

from pydantic import Field

from iif_core.objects.options import BorderOptions, PieceOptions
from workflow.settings import segmentation
from workflow.settings.section import Section


class Bordered(Section):
    border_erosion: int = Field(BorderOptions.border_erosion, ge=0, le=16)
    """Width in pixels of the border along another object."""


class GivenSegmentation(segmentation.GivenSegmentation, Bordered):
    """Objects that are given."""


class GeometrySegmentation(segmentation.GeometrySegmentation, Bordered):
    """Pieces of the mesh, of any size."""

    min_faces: int = Field(PieceOptions.min_faces, ge=1)
    """Pieces of the mesh with fewer faces are merged into a neighbour, unless they have `min_area`."""
    min_area: float = Field(PieceOptions.min_area, ge=0)
    """Area in m^2 from which a piece of the mesh stays as it is, however few faces it has."""
