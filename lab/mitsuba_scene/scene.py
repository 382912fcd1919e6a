"""Loads a scene such that every shape keeps its identity, and lists its shapes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from iif_core.errors import InputError


def children(thing: Any) -> dict[str, Any]:
    """Return the Mitsuba objects directly below an object (BSDFs, textures, emitters) by parameter name."""

    class Callback(mi.TraversalCallback):  # the base class exists only once a variant is chosen
        def __init__(self) -> None:
            super().__init__()
            self.found: dict[str, Any] = {}

        def put(self, name: str, value: Any, flags: Any, cpptype: Any = None) -> None:
            if isinstance(value, mi.Object):
                self.found[name] = value

    callback = Callback()
    thing.traverse(callback)
    return callback.found


def parameter(thing: Any, name: str, default: Any = None) -> Any:
    """Return the value of a numeric parameter as an array, or `default`."""
    parameters = mi.traverse(thing)
    return np.array(parameters[name]) if name in parameters else default


@dataclass(frozen=True)
class Shape:
    """One shape in the world.

    Attributes:
        plugin: Mitsuba's name of its kind, such as `ply`.
        name: unique, for people.
        object: Mitsuba's shape.
        placement: (4, 4) applied after the shape's own transformation (members of a shape group), or None.
    """

    plugin: str
    name: str
    object: Any
    placement: np.ndarray | None = None


@dataclass(frozen=True)
class LoadedScene:
    """The scene that is rendered, its shapes, and notes about parts of the XML that the mesh cannot represent."""

    scene: Any
    shapes: list[Shape]
    notes: list[str]


def load(xml: Path) -> LoadedScene:
    """Load a scene without merging meshes or materials; a shape of a group appears once for each of its instances.

    Raises:
        InputError: Mitsuba cannot load the scene; the message repeats Mitsuba's.
    """
    parser = mi.parser
    config = parser.ParserConfig(mi.variant())
    config.merge_meshes = config.merge_equivalent = False  # every shape stays its own object, as the ids require
    resolver = mi.file_resolver()
    before = [str(resolver[i]) for i in range(len(resolver))]
    resolver.prepend(str(xml.parent.resolve()))
    try:
        with _threads_for_exr():
            state = parser.parse_file(config, str(xml))
            parser.transform_all(config, state)
            entries, notes = _name_shapes(state), _notes(state)
            built = parser.instantiate(config, state)  # empties `state`
            scene = built[0] if isinstance(built, list) else built
            if not isinstance(scene, mi.Scene):
                raise InputError(f"{xml}: holds a {type(scene).__name__}, expected a scene")
            shapes = _shapes(scene, entries)
    except UnicodeDecodeError as error:  # of a message of Mitsuba that repeats bytes of a damaged file
        said = error.object.decode("utf-8", "backslashreplace")
        raise InputError(f"{xml}: Mitsuba cannot load it: {' '.join(said.split())[:1000]}") from None
    except RuntimeError as error:
        raise InputError(f"{xml}: Mitsuba cannot load it: {' '.join(str(error).split())}") from None
    finally:
        resolver.clear()
        for folder in before:
            resolver.append(folder)
    return LoadedScene(scene, shapes, notes)


@contextmanager
def _threads_for_exr() -> Iterator[None]:
    """Give Dr.Jit at least two threads: with one, Mitsuba waits forever for the blocks of an EXR file."""
    count = dr.thread_count()
    dr.set_thread_count(max(count, 2))
    try:
        yield
    finally:
        dr.set_thread_count(count)


def _references(node: Any) -> list[int]:
    values = (node.props[key] for key in node.props.keys())
    return [value.index() for value in values if isinstance(value, mi.Properties.ResolvedReference)]


def _bsdf_name(state: Any, index: int) -> str:
    """Return the id of a BSDF, or of the first nested one that has an id, or the name of its plugin."""
    node = state.nodes[index]
    if node.props.id():
        return node.props.id()
    inner = [i for i in _references(node) if state.nodes[i].type == mi.ObjectType.BSDF]
    nested = _bsdf_name(state, inner[0]) if inner else ""
    return nested or node.props.plugin_name()


@dataclass(frozen=True)
class _Entry:
    plugin: str
    name: str
    members: tuple[tuple[str, str, dict[str, Any]], ...]  # plugin, name and dictionary of each shape of an instance


def _name_shapes(state: Any) -> dict[str, _Entry]:
    """Give every shape node the id '@<index>', by which its object can be found later; return plugin and name by that id."""
    shapes = [i for i, node in enumerate(state.nodes) if node.type == mi.ObjectType.Shape]
    names = {}
    for index in shapes:
        props = state.nodes[index].props
        own = props.id() or (Path(str(props["filename"])).stem if "filename" in props else props.plugin_name())
        bsdf = [i for i in _references(state.nodes[index]) if state.nodes[i].type == mi.ObjectType.BSDF]
        names[index] = f"{_bsdf_name(state, bsdf[0])}/{own}" if bsdf else own
    out = {}
    for index in shapes:
        node = state.nodes[index]
        members = []
        if node.props.plugin_name() == "instance":
            for group in _references(node):
                inside = [i for i in _references(state.nodes[group]) if i in names]
                members += [(state.nodes[i].props.plugin_name(), names[i], _as_dict(state, i)) for i in inside]
        out[f"@{index}"] = _Entry(node.props.plugin_name(), names[index], tuple(members))
    for index in shapes:
        state.nodes[index].props.set_id(f"@{index}")
    return out


def _shapes(scene: Any, entries: dict[str, _Entry]) -> list[Shape]:
    out: list[Shape] = []
    taken: Counter[str] = Counter()

    def add(plugin: str, name: str, thing: Any, placement: np.ndarray | None) -> None:
        taken[name] += 1
        unique = name if taken[name] == 1 else f"{name}#{taken[name]}"
        out.append(Shape(plugin, unique, thing, placement))

    for thing in scene.shapes():
        name = thing.class_name().lower()
        # A `merge` shape has been replaced by its result, which has no node.
        entry = entries.get(thing.id(), _Entry(name, thing.id() or name, ()))
        if entry.plugin != "instance":
            add(entry.plugin, entry.name, thing, None)
            continue
        placement = np.array(mi.traverse(thing)["to_world"].matrix, np.float64).reshape(4, 4)
        for plugin, name, dictionary in entry.members:
            add(plugin, name, mi.load_dict(dictionary), placement)
    return out


def _as_dict(state: Any, index: int) -> dict[str, Any]:
    """Return a parsed node as a dictionary for `mi.load_dict`."""
    props = state.nodes[index].props
    out: dict[str, Any] = {"type": props.plugin_name()}
    for key in props.keys():
        value = props[key]
        out[key] = _as_dict(state, value.index()) if isinstance(value, mi.Properties.ResolvedReference) else value
    return out


def _notes(state: Any) -> list[str]:
    media = beckmann = 0
    for node in state.nodes:
        media += node.type == mi.ObjectType.Medium
        if node.type == mi.ObjectType.BSDF and node.props.plugin_name().startswith("rough"):
            props = node.props
            beckmann += "distribution" not in props or str(props["distribution"]) != "ggx"
    out = []
    if beckmann:
        out.append(f"{beckmann} rough BSDFs have the Beckmann distribution: their alpha is taken for GGX's")
    if media:
        out.append(f"{media} participating media: not rendered, the photographs show surfaces alone")
    return out
