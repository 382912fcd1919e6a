"""Settings of stage `base`, and of the second look that repeats it."""

from __future__ import annotations

from pydantic import Field

from iif_core.fusion.options import CellOptions
from workflow.settings.section import Section


class Base(Section):
    """Fusing the K predictions of all views into one 3D base texture."""

    cell_footprints: float = Field(CellOptions.cell_footprints, gt=0)
    """Edge of a surface cell in median pixel footprints."""


class SecondLook(Section):
    """Predicting and fusing once more, under the light that was found (prior `learned` alone)."""

    enabled: bool = True
    """`false`: the fit starts from the first base texture, which saves a sixth of the CPU time from `prior` to `affines`
    (docs/method/priors.md#a-second-look)."""
