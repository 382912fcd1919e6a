"""Settings of sources with ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from workflow.settings.section import Section


class BuiltinSource(Section):
    """A room that the project makes itself; nothing from outside is needed."""

    kind: Literal["builtin"]
    scene: Literal[
        "kitchen", "matte", "tiny", "tiny-gloss", "tiny-black-metal", "tiny-white", "tiny-lamp",
        "sky", "sun", "blinds", "curtains", "door", "lamps", "gloss", "white", "single", "evening",
    ] = "kitchen"  # fmt: skip
    """Which room (lab/docs/rooms.md): `kitchen` is furnished, `matte` the same without gloss and metal, `tiny` a few
    boxes."""
    quarterings: int = Field(0, ge=0, le=4)
    """How often every face of its mesh is split into four. The room stays the same; a scan is finer, and costs more."""


class DrawnSource(Section):
    """A room that is drawn at random (lab/docs/drawn.md); nothing from outside is needed."""

    kind: Literal["drawn"]
    room: int = Field(0, ge=0)
    """Its number."""


class MitsubaSource(Section):
    """Any Mitsuba 3 scene; the workflow renders photographs, G-buffers and ground truth itself."""

    kind: Literal["mitsuba"]
    path: Path
    """XML file of the scene."""
    unit: Literal["m", "cm", "mm", "km", "ft", "in"] | float = "m"
    """Unit of the scene; a number is metres per unit."""
    max_bounces: int = Field(16, ge=1, le=64)
    """Longest path of the rendered photographs, in bounces."""
    drop_transparent: bool = True
    """Leave transparent (dielectric) surfaces out of the mesh, as a scan does. This is recorded, and pixels behind them are not
    scored."""
