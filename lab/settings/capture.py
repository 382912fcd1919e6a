"""Settings of the photographs that sources with ground truth render."""

from __future__ import annotations

from pydantic import Field

from workflow.settings import source


class Capture(source.Capture):
    """How the photographs encode radiance, how many are taken, and how they are rendered."""

    samples: int = Field(64, ge=1)
    """Paths per pixel for rendered photographs."""
    denoise: bool = False
    """Denoise rendered photographs: fewer samples suffice, at the price of a bias of a few per cent."""
