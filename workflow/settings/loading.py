"""Load the settings of a scene from its files."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from iif_core.errors import InputError
from workflow.settings import batch_table, study_files
from workflow.settings.explain import explain
from workflow.settings.names import PRESETS, QUALITIES, RESERVED, SCENE_NAME, configuration, did_you_mean, scene_names, scene_path
from workflow.settings.scene import SECTIONS_THAT_CHOOSE, SceneSettings
from workflow.settings.yaml_file import read_yaml


def merge(lower: dict[str, Any], upper: dict[str, Any]) -> dict[str, Any]:
    """Return `upper` merged over `lower`, key by key; a different `kind` replaces the whole section."""
    out = dict(lower)
    for key, value in upper.items():
        below = out.get(key)
        if isinstance(value, dict) and isinstance(below, dict):
            replaced = "kind" in value and "kind" in below and value["kind"] != below["kind"]
            out[key] = value if replaced else merge(below, value)
        else:
            out[key] = value
    return out


def scene_file(scene: str, root: Path = Path(".")) -> Path:
    """Return the file of a scene; for a derived scene of a study, the file of the scene that it is derived from, which is
    `config/studies/scenes.yaml` where that has the scene's `source`.

    Raises:
        InputError: no such scene (the message suggests the nearest name), or a name that a scene cannot have.
    """
    if scene_path(scene, root).is_file():
        if not re.fullmatch(SCENE_NAME, scene):
            raise InputError(
                f"config/scenes/{scene}.yaml: a scene cannot be called {scene!r}; allowed are letters from a to z, digits, _"
                " and -, the first no sign. Rename the file"
            )
        if scene in RESERVED:
            raise InputError(f"config/scenes/{scene}.yaml: results/ uses {scene!r} otherwise; rename the file")
    parts = study_files.derived(scene, root)
    scene = parts.scene if parts else scene
    path = scene_path(scene, root)
    if parts and not path.is_file() and "source" in study_files.scene_overrides(root).get(scene, {}):
        return study_files.scenes_path(root)
    if not path.is_file():
        files = scene_names(root)
        listed = [line.name for line in batch_table.read_table(root) if line.name not in files]
        other = path.with_suffix(".yml")
        rename = f" {other.name} is there: rename it to {path.name}." if other.is_file() else ""
        more = f" and {len(listed)} of {batch_table.TABLE}" if listed else ""
        raise InputError(
            f"config/scenes/{scene}.yaml: not found.{rename or did_you_mean(scene, files + listed, 'scenes/{}')}"
            f" Known scenes: {', '.join(files) or 'none'}{more}."
            " Add a file there to add a scene (docs/guide/own-data.md)."
        )
    return path


def scene_origin(scene: str, root: Path = Path(".")) -> str:
    """Return where a scene is described, for messages: its file, or its line of the batch table."""
    line = batch_table.find(scene, root)
    return line.at() if line else str(scene_file(scene, root))


def load(scene: str, quality: str = "draft", root: Path = Path(".")) -> SceneSettings:
    """Return the settings of `scene` at `quality`.

    Raises:
        InputError: names the file, the key, what was found and what is allowed.
    """
    if quality not in QUALITIES:
        raise InputError(f"--config quality={quality}: unknown quality; allowed: {', '.join(QUALITIES)}")
    preset = read_yaml(configuration(f"quality/{quality}.yaml", root))
    if line := batch_table.find(scene, root):
        layers = _with_preset([(f"config/quality/{quality}.yaml", preset), *batch_table.layers(line, root)], root)
        try:
            return SceneSettings.model_validate(_merged(layers))
        except ValidationError as error:
            raise InputError(explain(error, batch_table.blame(line, layers))) from None
    path = scene_file(scene, root)
    shown = path.relative_to(root) if path.is_relative_to(root) else path
    layers = [("", preset)]
    if path != study_files.scenes_path(root):
        layers.append((str(shown), read_yaml(path)))
    if parts := study_files.derived(scene, root):
        layers += study_files.layers(parts, root)
    layers = _with_preset(layers, root)
    try:
        return SceneSettings.model_validate(_merged(layers))
    except ValidationError:
        for count, (place, _) in enumerate(layers, 1):  # blame the first file that spoils it, but who names a preset for that
            if not place or place.startswith(batch_table.CHOSEN):
                continue
            try:
                SceneSettings.model_validate(_merged(layers[:count]))
            except ValidationError as error:
                raise InputError(explain(error, lambda _, blamed=place: blamed)) from None
        raise


def _with_preset(layers: list[tuple[str, dict[str, Any]]], root: Path) -> list[tuple[str, dict[str, Any]]]:
    """Return the layers with the file of the `preset` that the uppermost of them names, right below that layer."""
    naming = [i for i, (_, layer) in enumerate(layers) if "preset" in layer]
    name = layers[naming[-1]][1]["preset"] if naming else None
    if name not in PRESETS:
        return layers
    file = configuration(f"presets/{name}.yaml", root)
    return [*layers[: naming[-1]], (f"config/presets/{name}.yaml", read_yaml(file)), *layers[naming[-1] :]]


def _merged(layers: list[tuple[str, dict[str, Any]]]) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for _, layer in layers:
        for name, section in SECTIONS_THAT_CHOOSE.items():
            if isinstance(out.get(name), dict) and isinstance(layer.get(name), dict):
                out[name] = section.without_idle(out[name], layer[name])
        out = merge(out, layer)
    return out
