"""Load the settings of a scene from its files."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from iif_core.errors import InputError
from workflow import plugins
from workflow.settings import batch_table, relight_plans
from workflow.settings import derived as derived_scenes
from workflow.settings.explain import explain
from workflow.settings.names import (
    DEFAULT,
    QUALITIES,
    REPOSITORY,
    RESERVED,
    SCENE_NAME,
    configuration,
    did_you_mean,
    quality_names,
    scene_names,
    scene_path,
)
from workflow.settings.scene import Capture, SceneSettings
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
    """Return the file of a scene; for a derived scene, the file of the scene that it is derived from, or that of the plug-in that
    has the scene's `source`.

    Raises:
        InputError: no such scene (the message suggests the nearest name), or a name that a scene cannot have.
    """
    if scene_path(scene, root).is_file():
        if not re.fullmatch(SCENE_NAME, scene):
            raise InputError(
                f"config/scenes/{scene}.yaml: a scene cannot be called {scene!r}; use letters from a to z, digits,"
                " _ and -, starting with a letter or digit. Rename the file"
            )
        if scene in RESERVED:
            raise InputError(f"config/scenes/{scene}.yaml: results/ uses {scene!r} otherwise; rename the file")
    parts = derived_scenes.derived(scene, root)
    scene = parts.scene if parts else scene
    path = scene_path(scene, root)
    if parts and not path.is_file() and (listed_in := derived_scenes.file_of_source(parts, root)):
        return listed_in
    if not path.is_file():
        files = scene_names(root)
        listed = [line.name for line in batch_table.read_table(root) if line.name not in files]
        others = [name for name in files + listed if name != scene]  # a line of the table may have nothing but this name
        other = path.with_suffix(".yml")
        rename = f" {other.name} is there: rename it to {path.name}." if other.is_file() else ""
        more = f" and {len(listed)} of {batch_table.TABLE}" if listed else ""
        raise InputError(
            f"config/scenes/{scene}.yaml: not found.{rename or did_you_mean(scene, others, 'scenes/{}')}"
            f" Known scenes: {', '.join(files) or 'none'}{more}."
            " Add a file there to add a scene (docs/guide/own-data.md)."
        )
    return path


def scene_origin(scene: str, root: Path = Path(".")) -> str:
    """Return where a scene is described, for messages: its file, or its line of the batch table."""
    line = batch_table.find(scene, root)
    return line.at() if line else str(scene_file(scene, root))


def relight_origin(scene: str, root: Path = Path(".")) -> str:
    """Return where the relightings of a scene are listed, for messages: a plan, or where the scene is described."""
    parts = derived_scenes.derived(scene, root)
    if parts is not None and parts.study == derived_scenes.RELIGHT:
        return str(relight_plans.FOLDER / f"{parts.variant}.yaml")
    try:
        return scene_origin(scene, root)
    except InputError:  # a job can outlive the file that its scene had
        return f"config/scenes/{scene}.yaml"


def load(scene: str, quality: str = "draft", root: Path = Path(".")) -> SceneSettings:
    """Return the settings of `scene` at `quality`.

    Raises:
        InputError: names the file, the key, what was found and what is allowed.
    """
    below, above, line = _layers(scene, quality, root)
    layers = [*below, *above]
    try:
        return SceneSettings.model_validate(_merged(layers))
    except ValidationError as error:
        if line:
            raise InputError(explain(error, batch_table.blame(line, layers))) from None
        for count, (place, _) in enumerate(layers, 1):  # blame the first file that spoils it
            if not place or place.startswith(batch_table.QUALITY):
                continue
            try:
                SceneSettings.model_validate(_merged(layers[:count]))
            except ValidationError as found:
                raise InputError(explain(found, partial(_blamed, place, layers[:count]))) from None
        raise InputError(explain(error, lambda _: f"{scene_file(scene, root)}")) from None


Layers = list[tuple[str, dict[str, Any]]]
"""(place, settings), the lowest first; settings of a place without a name are blamed on nobody."""


def _layers(scene: str, quality: str, root: Path) -> tuple[Layers, Layers, batch_table.Line | None]:
    """Return the layers of the quality, those of the scene over them, and its line of the batch table if it has one."""
    parts = derived_scenes.derived(scene, root)
    of_bench = parts is not None and parts.study == derived_scenes.BENCH
    if parts and of_bench:
        quality = parts.variant
    if parts and not parts.added:
        scene = parts.scene
    # What a study compares must not move with what `draft` is.
    settings = {} if parts and parts.added and quality == DEFAULT else _quality(quality, root)
    line = batch_table.find(scene, root)
    if line:
        above = batch_table.layers(line, root)
    else:
        path = scene_file(scene, root)
        shown = path.relative_to(root) if path.is_relative_to(root) else path
        above = [(str(shown), read_yaml(path))] if path == scene_path(parts.scene if parts else scene, root) else []
    if parts:
        above = [*above, *derived_scenes.layers(parts, root)]
    limits = _merged(above).get("limits")
    if isinstance(limits, dict):
        settings = limited(settings, limits)
    below = [(f"config/quality/{quality}.yaml", settings)]
    return ([*below, ("", derived_scenes.BENCH_HELD_OUT)] if of_bench else below), above, line


def _blamed(place: str, layers: Layers, dotted: str) -> str:
    """Return which of some layers sets a key: the one at `place`, or else a quality below it."""
    for name, layer in reversed(layers):
        node: Any = layer
        for part in dotted.split("."):
            node = node.get(part) if isinstance(node, dict) else None
        if node is not None:
            return name if name.startswith(batch_table.QUALITY) else place
    return place


def _quality(quality: str, root: Path) -> dict[str, Any]:
    """Return the settings of a quality; where its file names another `quality`, those of that one with its own over them."""
    names = quality_names(root)
    if quality not in names:
        hint = did_you_mean(quality, names)
        raise InputError(f"--config quality={quality}: unknown quality.{hint} Allowed: {', '.join(names)}")
    settings = read_yaml(configuration(f"quality/{quality}.yaml", root))
    added = (REPOSITORY / folder / f"{quality}.yaml" for folder in plugins.named("QUALITY"))
    for path in (path for path in added if path.is_file()):
        settings = merge(read_yaml(path), settings)
    if "quality" not in settings:
        return settings
    other, own = settings["quality"], {key: value for key, value in settings.items() if key != "quality"}
    below = read_yaml(configuration(f"quality/{other}.yaml", root)) if other in names else {"quality": None}
    if "quality" in below:
        raise InputError(
            f"config/quality/{quality}.yaml: `quality`: found {other!r}; needed is the name of a file next to it that names no"
            " `quality` itself, such as p01"
        )
    return merge(below, own)


def limited(settings: dict[str, Any], limits: dict[str, Any]) -> dict[str, Any]:
    """Return the settings of a quality with no more than a scene allows; where only one of width and height is limited, they keep
    their ratio.

    Args:
        settings: of a quality.
        limits: of the scene, not checked yet (`workflow.settings.limits`).
    """
    most = {name: value for name, value in limits.items() if isinstance(value, int) and value > 0}
    capture = {
        **{name: Capture.model_fields[name].default for name in ("views", "width", "height")},
        **settings.get("capture", {}),
    }
    out = dict(settings)
    if all(isinstance(capture[name], int) for name in ("views", "width", "height")):
        shares = {name: min(1.0, most[name] / capture[name]) for name in ("width", "height") if name in most}
        both = shares if len(shares) == 2 else dict.fromkeys(("width", "height"), min(shares.values(), default=1.0))
        sizes = {name: max(round(share * capture[name]), 16) for name, share in both.items()}
        out["capture"] = {**capture, **sizes, "views": min(capture["views"], most.get("views", capture["views"]))}
    prior = settings.get("prior", {})
    if isinstance(prior, dict) and isinstance(prior.get("samples"), int):
        out["prior"] = {**prior, "samples": min(prior["samples"], most.get("predictions", prior["samples"]))}
    return out


def overridden(scene: str, quality: str, root: Path = Path(".")) -> list[str]:
    """Return the settings of a quality, dotted, that the scene sets to other values itself, or that its `limits` lower.

    Raises:
        InputError: as `load`.
    """
    _, above, _ = _layers(scene, quality, root)
    own, settings, out = _merged(above), _quality(quality, root), []
    limits = own.get("limits")
    left = limited(settings, limits) if isinstance(limits, dict) else settings
    for section, keys in settings.items():
        for key, value in keys.items() if isinstance(keys, dict) else ():
            found = own.get(section)
            if (found.get(key, left[section][key]) if isinstance(found, dict) else left[section][key]) != value:
                out.append(f"{section}.{key}")
    return out


def photographs(quality: str, root: Path = Path(".")) -> str:
    """Describe how many photographs a quality takes, and at which size.

    Raises:
        InputError: an unknown quality, or one whose file says something else than numbers there.
    """
    file = f"config/quality/{quality}.yaml"
    try:
        found = Capture.model_validate(_quality(quality, root).get("capture", {}))
    except ValidationError as error:
        raise InputError(explain(error, lambda _: file)) from None
    return f"at most {found.views} photographs of {found.width} x {found.height}"


def canonical(quality: str, root: Path = Path(".")) -> str:
    """Return the name under which a quality is run: a point that is all of a named quality has that name."""
    for name in QUALITIES:
        if read_yaml(configuration(f"quality/{name}.yaml", root)) == {"quality": quality}:
            return name
    return quality


def _merged(layers: list[tuple[str, dict[str, Any]]]) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for _, layer in layers:
        out = merge(out, layer)
    return out
