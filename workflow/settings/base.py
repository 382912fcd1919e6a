"""Settings of stage `base`."""

from __future__ import annotations

from pydantic import Field

from iif_core.fusion.options import CellOptions
from workflow.settings.section import Section


class Base(Section):
    """Fusing the K predictions of all views into one 3D base texture."""

    cell_footprints: float = Field(CellOptions.cell_footprints, gt=0)
    """Edge of a surface cell in median pixel footprints."""
