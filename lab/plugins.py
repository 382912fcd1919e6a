"""What the laboratory adds to the product, by name (workflow/plugins.py)."""

from __future__ import annotations

KINDS: dict[str, dict[str, tuple[str, str]]] = {}

# ------------------------------------------------------------------------------ the published method and baselines

SECTIONS = {
    "base": "lab.settings.methods:Base",
    "emission": "lab.settings.methods:Emission",
    "shading": "lab.settings.methods:Shading",
    "affines": "lab.settings.methods:Affines",
    "scene": "lab.settings.scene:SceneSettings",
}
STAGES = {stage: f"lab.methods:{stage}" for stage in ("plan", "base", "emission", "shading", "second_look", "affines")}
