"""From files to the settings of a scene."""

from __future__ import annotations

import difflib
import re
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from iif_core.errors import InputError
from workflow.settings.explain import explain
from workflow.settings.scene import SceneSettings

QUALITIES = ("draft", "standard", "paper")
SCENE_NAME = r"[A-Za-z0-9][A-Za-z0-9_-]*"
"""What a scene may be called: its name is a folder, a target of Snakemake and part of the names of variants."""
RESERVED = ("batch", "studies", "weights")
"""Folders of results/ that are no scene's."""


class _StrictLoader(yaml.SafeLoader):
    """YAML in which a key that stands twice in one mapping is an error, not a silent choice."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = [self.construct_object(key, deep=deep) for key, _ in node.value]
        for key, (key_node, _) in zip(keys, node.value, strict=True):
            if keys.count(key) > 1:
                raise yaml.constructor.ConstructorError(None, None, f"key `{key}` stands twice", key_node.start_mark)
        return super().construct_mapping(node, deep)


def read_yaml(path: Path) -> dict[str, Any]:
    """A file of `key: value` lines; an `InputError` names file and line."""
    try:
        document = yaml.load(path.read_text(encoding="utf-8"), _StrictLoader)
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not UTF-8 text (byte {error.start}); save it as UTF-8") from None
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f", line {mark.line + 1}" if mark else ""
        raise InputError(f"{path}{where}: not valid YAML ({getattr(error, 'problem', error)})") from None
    if document is None:
        return {}
    if not isinstance(document, dict):
        raise InputError(f"{path}: found {type(document).__name__}, expected `key: value` lines; see config/scenes/kitchen.yaml")
    return document


def merge(lower: dict[str, Any], upper: dict[str, Any]) -> dict[str, Any]:
    """`upper` over `lower`, key by key; a different `kind` replaces the whole section."""
    out = dict(lower)
    for key, value in upper.items():
        below = out.get(key)
        if isinstance(value, dict) and isinstance(below, dict):
            replaced = "kind" in value and "kind" in below and value["kind"] != below["kind"]
            out[key] = value if replaced else merge(below, value)
        else:
            out[key] = value
    return out


def scene_names(root: Path = Path(".")) -> list[str]:
    """Every scene that has a file."""
    return sorted(path.stem for path in (root / "config/scenes").glob("*.yaml"))


def scene_file(scene: str, root: Path = Path(".")) -> Path:
    """Path of a scene's file, of a study's derived scene its parent's; an unknown scene is an error with the nearest name."""
    from workflow import batch, studies  # they need this module first

    if (root / "config/scenes" / f"{scene}.yaml").is_file():
        if not re.fullmatch(SCENE_NAME, scene):
            raise InputError(
                f"config/scenes/{scene}.yaml: a scene cannot be called {scene!r}; allowed are letters from a to z, digits, _"
                " and -, the first no sign. Rename the file"
            )
        if scene in RESERVED:
            raise InputError(f"config/scenes/{scene}.yaml: results/ uses {scene!r} otherwise; rename the file")
    parts = studies.derived(scene, root)
    scene = parts.scene if parts else scene
    path = root / "config/scenes" / f"{scene}.yaml"
    if not path.is_file():
        files = scene_names(root)
        listed = [line.name for line in batch.read_table(root) if line.name not in files]
        near = difflib.get_close_matches(scene, files + listed, 1)
        hint = f" Did you mean scenes/{near[0]}?" if near else ""
        more = f" and {len(listed)} of {batch.TABLE}" if listed else ""
        raise InputError(
            f"config/scenes/{scene}.yaml: not found.{hint} Known scenes: {', '.join(files) or 'none'}{more}."
            " Add a file there to add a scene (docs/own-data.md)."
        )
    return path


def scene_origin(scene: str, root: Path = Path(".")) -> str:
    """Where a scene is described, for messages: its file, or its line of the batch table."""
    from workflow import batch

    line = batch.find(scene, root)
    return line.at() if line else str(scene_file(scene, root))


def load(scene: str, quality: str = "draft", root: Path = Path(".")) -> SceneSettings:
    """Settings of `scene` at `quality`; an `InputError` names file, key, what was found and what is allowed."""
    if quality not in QUALITIES:
        raise InputError(f"--config quality={quality}: unknown quality; allowed: {', '.join(QUALITIES)}")
    from workflow import batch, studies

    preset_file = root / "config/quality" / f"{quality}.yaml"
    preset = read_yaml(preset_file) if preset_file.is_file() else {}
    if line := batch.find(scene, root):
        layers = [(f"config/quality/{quality}.yaml", preset), *batch.layers(line, root)]
        try:
            return SceneSettings.model_validate(_merged(layers))
        except ValidationError as error:
            raise InputError(explain(error, batch.blame(line, layers))) from None
    path = scene_file(scene, root)
    shown = path.relative_to(root) if path.is_absolute() else path
    layers = [("", preset), (str(shown), read_yaml(path))]
    if parts := studies.derived(scene, root):
        layers += studies.layers(parts, root)
    try:
        return SceneSettings.model_validate(_merged(layers))
    except ValidationError:
        for count in range(2, len(layers) + 1):  # blame the first layer that spoils it
            try:
                SceneSettings.model_validate(_merged(layers[:count]))
            except ValidationError as error:
                raise InputError(explain(error, lambda _, blamed=layers[count - 1][0]: blamed)) from None
        raise


def _merged(layers: list[tuple[str, dict[str, Any]]]) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for _, layer in layers:
        out = merge(out, layer)
    return out
