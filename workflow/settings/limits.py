"""Upper limits of a scene on what a quality asks for; `workflow.settings.loading.limited` applies them."""

from __future__ import annotations

from pydantic import Field

from workflow.settings.section import Section


class Limits(Section):
    """A quality may ask for less than this, and gets no more. A number that the scene file sets itself instead, such as
    `capture: {views: 60}`, holds for every quality."""

    views: int | None = Field(None, ge=1)
    """Photographs (`capture.views`)."""
    width: int | None = Field(None, ge=16)
    """Pixels (`capture.width`); without a limit of the height, both are reduced together."""
    height: int | None = Field(None, ge=16)
    """Pixels (`capture.height`); without a limit of the width, both are reduced together."""
    predictions: int | None = Field(None, ge=1)
    """Predictions of each photograph (`prior.samples`)."""
