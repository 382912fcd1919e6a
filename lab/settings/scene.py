"""All settings of a scene of the laboratory."""

from __future__ import annotations

from typing import Any

from pydantic import Field, model_validator

from lab.settings.methods import PUBLISHED
from workflow.settings.prior import predictions
from workflow.settings.scene import SceneSettings
from workflow.settings.section import Section


class Relit(Section):
    """Scores of pictures under new light, made by studies with `scores: relit_scores` (lab/docs/evaluation.md#relighting)."""

    views: int = Field(3, ge=1)
    """Views that are rendered under each light, spread evenly over all."""
    lamps: int = Field(6, ge=0)
    """At most this number of lamps shine alone, the strongest first."""
    spheres: int = Field(3, ge=0)
    """Positions of the glowing sphere on its path."""
    moved: bool = True
    """Whether the strongest lamp is moved."""
    environment: tuple[float, float, float] | None = (1.0, 1.0, 1.0)
    """Uniform radiance from outside, all lamps off; null = none. A room without openings has no such picture."""
    samples: int = Field(64, ge=1)
    """Paths per pixel, of the source and of the recovered room alike."""
    max_bounces: int = Field(8, ge=1, le=64)
    """Longest path, in bounces."""
    denoise: bool = True
    """Denoise the pictures of both."""


class SecondLook(Section):
    """Predicting and fusing once more, under the light that was found (prior `learned` alone)."""

    enabled: bool = True
    """`false`: the fit starts from the first base texture, which saves a sixth of the CPU time from `prior` to `affines`
    (docs/method/priors.md#a-second-look)."""


class LabScene(SceneSettings):
    """The settings of the product, those of scored relighting, and what must hold where another method than ours is chosen."""

    relit: Relit = Relit()
    second_look: SecondLook = SecondLook()

    @model_validator(mode="after")
    def _known_predictions(self) -> LabScene:
        made, used = predictions(self.prior.model_dump()), self.base.predictions
        if used is not None and used > made:
            raise ValueError(
                f"`base: predictions` is {used}, but `prior` makes {made} (`samples`); lower the one or raise the other"
            )
        return self

    @model_validator(mode="after")
    def _enough_pixels(self) -> LabScene:
        asked, needed = self.shading.pixels, super().implied()["shading"]["pixels"]
        if isinstance(asked, int) and (needed == "all" or asked < needed):
            cells = self.affines.of_cells(self.prior.kind)
            why = (
                f"{cells or '`affines: pixels: all`'} reads every pixel"
                if needed == "all"
                else f"the fit reads {needed} (`affines: pixels`)"
            )
            raise ValueError(f"`shading: pixels` is {asked}, but {why}; write `auto`, or at least `{needed}`")
        return self

    def implied(self) -> dict[str, dict[str, Any]]:
        """Return what other settings decide, where no setting of the laboratory does."""
        found = super().implied()
        found["second_look"] = self.second_look.model_dump()
        if self.shading.pixels != "auto":
            found["shading"]["pixels"] = self.shading.pixels
        return found

    @model_validator(mode="after")
    def _published_photographs(self) -> LabScene:
        solver = self.emission.solver
        if solver in PUBLISHED and not isinstance(self.affines.response, str):
            raise ValueError(
                f"`emission: solver: {solver}` takes a family as `affines: response`, and no measured curve; name one, or set"
                " another solver"
            )
        if solver in PUBLISHED and self.capture.dynamic_range == "hdr":
            raise ValueError(
                f"`emission: solver: {solver}` knows the loss of 8-bit photographs alone; set `capture: {{dynamic_range: ldr}}`,"
                " or another solver"
            )
        return self

    @model_validator(mode="after")
    def _forced_components(self) -> LabScene:
        forced = {name: value for name, value in self.components.model_dump().items() if value != "auto"}
        if forced and (self.emission.solver in PUBLISHED or self.shading.method == "published"):
            raise ValueError(f"`components: {', '.join(forced)}`: the published method has no plan; remove it")
        ours = self.affines.model == "objects" and self.affines.solver == "direct"
        for component in ("specular", "metallic"):
            if forced.get(component) == "off" and not ours:
                raise ValueError(f"`components: {component}: off`: needs `affines: {{model: objects, solver: direct}}`")
        if self.materials and not ours:
            raise ValueError("`materials`: materials given by hand need `affines: {model: objects, solver: direct}`; remove them")
        return self
