"""What must hold between the sections of the settings where another method than ours is chosen."""

from __future__ import annotations

from pydantic import model_validator

from lab.settings.methods import PUBLISHED
from workflow.settings import scene


class SceneSettings(scene.SceneSettings):
    """All settings of one scene."""

    @model_validator(mode="after")
    def _published_photographs(self) -> SceneSettings:
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
    def _forced_components(self) -> SceneSettings:
        forced = {name: value for name, value in self.override.components.model_dump().items() if value != "auto"}
        if forced and (self.emission.solver in PUBLISHED or self.shading.method == "published"):
            raise ValueError(f"`override: components: {', '.join(forced)}`: the published method has no plan; remove it")
        ours = self.affines.model == "objects" and self.affines.solver == "direct"
        for component in ("specular", "metallic"):
            if forced.get(component) == "off" and not ours:
                raise ValueError(f"`override: components: {component}: off`: needs `affines: {{model: objects, solver: direct}}`")
        if self.overrides and not ours:
            raise ValueError("`overrides`: materials given by hand need `affines: {model: objects, solver: direct}`; remove them")
        return self
