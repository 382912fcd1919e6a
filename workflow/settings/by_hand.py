"""What a person knows better: parts of the model that the plan is not to decide about, and materials of objects."""

from __future__ import annotations

import re
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from workflow.settings.section import ON_OFF, Section

Choice = Annotated[Literal["auto", "on", "off"], ON_OFF]


class Components(Section):
    """Parts of the model that are forced in (`on`) or out (`off`); `auto`: as the scene requires."""

    environment: Choice = "auto"
    """Light from outside the mesh: 42 directions, what is seen apart, or twelve where the mesh is open."""
    specular: Choice = "auto"
    """Specular lobes; without them nothing is metal, and re-renderings end in photographed
    radiance, if the radiance cache is in."""
    metallic: Annotated[Literal["auto", "off"], ON_OFF] = "auto"
    """The fit decides which objects are metals; `off`: every object is a dielectric."""
    radiance_cache: Choice = "auto"
    """Indirect light. `on`: paths end at surface whose radiance was photographed; `off`: paths go on with the base materials."""
    denoiser: Choice = "auto"
    """Denoised re-renderings. They are looked at and compared; nothing is fitted to them."""


class GivenMaterial(Section):
    """What is known of the material of an object. It is not fitted; everything else is fitted with it
    (docs/guide/relighting.md#corrections-by-hand)."""

    roughness: float | None = Field(None, ge=0.02, le=1)
    """Perceptual roughness, the same all over the object; by default fitted."""
    metallic: float | None = Field(None, ge=0, le=1)
    """Metallic, the same all over the object; by default chosen by the fit."""

    @model_validator(mode="before")
    @classmethod
    def _no_albedo(cls, value: Any) -> Any:
        if isinstance(value, dict) and "albedo" in value:
            raise ValueError(
                "albedo cannot be given by hand here, because its level is tied to the level of the light: use"
                " `affines: {scale: {white_patch: {object: ..., albedo: ...}}}`, or paint the object in a relighting"
            )
        return value

    @model_validator(mode="after")
    def _something(self) -> GivenMaterial:
        if self.roughness is None and self.metallic is None:
            raise ValueError("nothing is given; write `roughness`, `metallic` or both")
        return self


def _words(value: Any) -> Any:
    """Keys of a mapping as text: YAML reads the id of an object as a number."""
    return {str(key): entry for key, entry in value.items()} if isinstance(value, dict) else value


TEXT_KEYS = BeforeValidator(_words)
"""For mappings whose keys are names or ids."""
ByObject = Annotated[dict[str, GivenMaterial], TEXT_KEYS]
LONGEST_NAME = 60


def _readable(names: dict[str, str]) -> dict[str, str]:
    for key, name in names.items():
        if not name.isprintable() or name != name.strip() or not 0 < len(name) <= LONGEST_NAME or re.fullmatch(r"[\d/.]+", name):
            raise ValueError(
                f"the name of {key!r}, {name!r:.80}, must have 1 to {LONGEST_NAME} printable characters, no blanks around it,"
                " and be no number"
            )
    return names


Names = Annotated[dict[str, str], TEXT_KEYS, AfterValidator(_readable)]


def by_former_names(named: dict[str, Any], names: dict[str, str]) -> dict[str, Any]:
    """Return a mapping of objects with the keys of `names`, by which the segmentation knows objects, in the place of their name.

    >>> by_former_names({"sofa": 1, "table": 2}, {"24": "sofa", "25": "sofa"})
    {'24': 1, '25': 1, 'table': 2}

    Raises:
        ValueError: an object is there by both names.
    """
    out: dict[str, Any] = {}
    for key, value in named.items():
        for former in [own for own, name in names.items() if name == key] or [key]:
            if former in out:
                raise ValueError(f"{names.get(former, key)!r} and {former!r} are one object (`names`); write one of them")
            out[former] = value
    return out
