"""Settings that decide about parts of the model in the place of the plan."""

from __future__ import annotations

from typing import Annotated, Literal

from workflow.settings.section import ON_OFF, Section

Choice = Annotated[Literal["auto", "on", "off"], ON_OFF]


class Components(Section):
    """Parts of the model that are forced in (`on`) or out (`off`); `auto`: as the scene requires."""

    environment: Choice = "auto"
    """Light from outside the mesh, as `emission: {environment: ...}`."""
    specular: Choice = "auto"
    """Specular lobes; without them nothing is metal, and re-renderings end in photographed
    radiance, if the radiance cache is in."""
    metallic: Annotated[Literal["auto", "off"], ON_OFF] = "auto"
    """Metals among the objects, told apart by the fit; `off`: every object is a dielectric."""
    radiance_cache: Choice = "auto"
    """Indirect light from photographed surface, as `shading: {indirect: cache}`; `off` as `path`."""
    denoiser: Choice = "auto"
    """Denoised re-renderings; `off` as `render: {denoise: false}`."""


class Override(Section):
    """What the plan does not decide."""

    components: Components = Components()
    """Component of plan.yaml -> `on`, `off` or `auto`."""
