"""Settings of the photographs that sources with ground truth render."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BeforeValidator, Field

from workflow.settings import source
from workflow.settings.section import Section

UNGUIDED_PATHS = 3
"""Factor on the paths of photographs that are denoised without the truth (lab/docs/simulated.md#as-captured)."""


REDUCED = 4
"""How many times as wide as in the capture photographs are when they are taken. At quality draft it is 4 for Red Kitchen, which
has 640 pixels, and 20 for a telephone."""


class Realism(Section):
    """Which effects of real captures a capture with truth has (lab/docs/simulated.md#as-captured). A mapping switches some of
    them off, such as `{noise: false}`."""

    exposure: bool = True
    """Automatic exposure and a white balance of its own for each photograph, which the method is not told."""
    noise: bool = True
    """Shot and read noise of the sensor."""
    blur: bool = True
    """Blur of the lens."""
    jpeg: bool = True
    """JPEG compression."""
    cameras: bool = True
    """Poses and focal length are off, and registered as those of a folder."""
    mesh: bool = True
    """The mesh bulges, has holes and is decimated."""
    unguided: bool = True
    """Three times as many paths, and a denoiser that sees nothing but the picture, whatever `capture.denoise` says."""
    reduced: int = Field(REDUCED, ge=1, le=16)
    """Photographs are so many times as wide when they are taken, and are then reduced. Noise, blur, JPEG and poses are those
    of the large ones."""


IDEAL = Realism(**{name: False for name, field in Realism.model_fields.items() if field.annotation is bool}, reduced=1)


def _of_word(value: Any) -> Any:
    if value == "ideal":
        return None
    if value == "as_captured":
        return Realism()
    if value is None or isinstance(value, dict | Realism):
        return value
    effects = ", ".join(Realism.model_fields)
    raise ValueError(f"Needed: 'ideal', 'as_captured', or a mapping that changes some effects: {effects}")


class Capture(source.Capture):
    """How the photographs encode radiance, how many are taken, and how they are rendered."""

    samples: int = Field(64, ge=1)
    """Paths per pixel for rendered photographs."""
    denoise: bool = False
    """Denoise rendered photographs: fewer samples suffice, at the price of a bias of a few per cent."""
    realism: Annotated[Realism | None, BeforeValidator(_of_word)] = None
    """`ideal` (none); `as_captured`: with the errors that real captures have; or a mapping: as captured, but for the effects that
    it switches off."""


def paths(capture: dict[str, Any]) -> int:
    """Return the paths per pixel of the photographs of a (dumped) capture."""
    samples: int = capture["samples"]
    return UNGUIDED_PATHS * samples if (capture["realism"] or {}).get("unguided") else samples
