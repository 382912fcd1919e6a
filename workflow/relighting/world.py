"""The room as a relighting wants it: parts moved, painted and put in, and every lamp by itself."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from iif_core.errors import InputError
from iif_core.light.base_scene import BaseScene
from iif_core.light.environment import as_map, resample
from iif_core.light.relighting import axes_of_map, coloured, sphere_mesh
from workflow.artifacts.files import read_exr
from workflow.artifacts.store import rgb
from workflow.intake.documents import reading
from workflow.intake.pictures import exr_size
from workflow.relighting.inserts import light_of, load_insert, placed
from workflow.relighting.inventory import Inventory
from workflow.runtime import device
from workflow.scene.named import object_number
from workflow.scene.recovered import Recovered
from workflow.settings.relight import name_of

if TYPE_CHECKING:
    from iif_core.light.transport.edits import Textures
    from iif_core.light.transport.geometry import Geometry
    from iif_core.light.transport.scene import Material, Scene

Array = np.ndarray
MAP_ROWS = 128
"""Environment files are averaged down to at most this many rows."""
EQUAL_SHARE = 0.5
"""Share of the draws of emitters that all lamps have alike; the rest is by power. A strong lamp may be off in the end."""


@dataclass(frozen=True)
class World:
    """A room in which every lamp is a column; m faces, L lamps.

    Lamps are traced in white, with the mean of their channels: light of one channel never becomes light of another, so any colour
    is a weight. All surface reflects, including the surface of lamps, so that light is linear in what lamps emit.

    Attributes:
        geometry, material: on the device.
        lamp_of_face: (m,) int32 column, -1 = dark; side: (m,) int8 as in `Emitters`.
        columns: names; those of recovered emitters are `emitter <id>`.
        level: (L,) radiance with which each lamp is traced; 1 for the environment.
        found: (L, 3) radiance of each lamp as it was found or given; 1 for the environment.
        environment: (3,) or (H, W, 3) radiance from outside.
        environment_lamp: its column.
    """

    geometry: Geometry
    material: Material
    lamp_of_face: Array
    side: Array
    columns: list[str]
    level: Array
    found: Array
    environment: Array
    environment_lamp: int

    def scene(self, weights: Array | None = None) -> Scene:
        """Return what paths meet: every lamp white, or all of them together with `weights` (L, 3)."""
        from iif_core.light.transport.emitters import Emitters
        from iif_core.light.transport.scene import Scene

        white = self.level[:, None] * (np.ones(3) if weights is None else weights)
        radiance = np.append(white, np.zeros((1, 3)), 0)[self.lamp_of_face].astype(np.float32)
        outside = np.asarray(self.environment, np.float32)
        if weights is not None:
            outside = outside * np.asarray(weights[self.environment_lamp], np.float32)
            return Scene(self.geometry, self.material, Emitters(self.geometry, radiance, self.side, outside))
        draws = _draws(self.geometry.areas, self.lamp_of_face, radiance.mean(1), len(self.level))
        emitters = Emitters(self.geometry, radiance, self.side, outside, sampling_weight=draws)
        return Scene(self.geometry, self.material, emitters)


def _draws(areas: Array, lamp_of_face: Array, radiance: Array, lamps: int) -> Array:
    """How often faces are drawn, (m,): half by power, half the same for every lamp."""
    power = areas * radiance
    total = np.bincount(lamp_of_face[lamp_of_face >= 0], power[lamp_of_face >= 0], lamps)
    if not total.any():
        return np.zeros(len(areas))
    share = np.divide(1.0, total, out=np.zeros(lamps), where=total > 0)
    own = np.where(lamp_of_face >= 0, power * share[lamp_of_face], 0.0) / np.count_nonzero(total)
    return (1 - EQUAL_SHARE) * power / total.sum() + EQUAL_SHARE * own


def build_world(room: Recovered, inventory: Inventory, state: dict[str, Any], up: Array, time: float = 0.0) -> World:
    """Build the world of a relighting.

    Args:
        room: as recovered; inventory: of the room.
        state: what `workflow.settings.relight.lamp_basis` returns for the relighting.
        up: (3,) unit vector.
        time: in [0, 1], for a sphere that moves.
    """
    device.mitsuba()
    from iif_core.light.transport.edits import EditedMaterials
    from iif_core.light.transport.geometry import build_geometry

    surface = painted(room.surface, inventory, state["materials"])
    vertices, faces, shift = _moved(surface, room, inventory, state["lamps"])
    object_id, passes, side = surface.object_id, surface.passes, room.light.side
    place = {lamp.emitter_id: i for i, lamp in enumerate(inventory.lamps)}
    columns = [f"emitter {lamp.emitter_id}" for lamp in inventory.lamps]
    radiance = [room.emitter_radiance[lamp.emitter_id] for lamp in inventory.lamps]
    lamp_of_face = np.array([place.get(int(e), -1) for e in range(-1, int(room.emitter_id.max(initial=-1)) + 1)], np.int32)
    lamp_of_face = lamp_of_face[room.emitter_id + 1]

    def add(corners: Array, light: Array, name: str, both: Array) -> None:
        """Append faces (k, 3, 3) that emit `light` (k, 3), where it is not 0, on both sides or to the front alone (k,)."""
        nonlocal vertices, faces, object_id, passes, side, lamp_of_face, shift
        count = len(corners)
        own = np.arange(3 * count, dtype=np.int32).reshape(-1, 3) + len(vertices)
        vertices = np.concatenate([vertices, corners.reshape(-1, 3).astype(np.float32)])
        faces = np.concatenate([faces, own])
        object_id = np.concatenate([object_id, np.full(count, surface.n_objects, np.int32)])
        passes = np.concatenate([passes, np.zeros(count, np.float32)])
        side = np.concatenate([side, np.where(both, 0, 1).astype(np.int8)])
        shift = None if shift is None else np.concatenate([shift, np.zeros((count, 3), np.float32)])
        column = np.full(count, -1, np.int32)
        for number, one in enumerate(np.unique(light[light.any(1)], axis=0), 1):  # a lamp for each radiance
            column[(light == one).all(1)] = len(columns)
            columns.append(name if number == 1 else f"{name} {number}")
            radiance.append(one)
        lamp_of_face = np.concatenate([lamp_of_face, column])

    if state["sphere"] is not None:
        ball = state["sphere"]
        start = np.asarray(ball["center"], np.float64)
        centre = start if ball["path_to"] is None else start + time * (np.asarray(ball["path_to"]) - start)
        points, own = sphere_mesh(centre, ball["radius"])
        add(points[own], np.tile(np.asarray(ball["radiance"], np.float64), (len(own), 1)), "sphere", np.zeros(len(own), bool))
    textures = _insert_all(state["insert"], up, add)
    columns.append("environment")
    radiance.append(np.ones(3))
    found = np.array(radiance, np.float64).reshape(-1, 3)
    level = found.mean(1)
    geometry = build_geometry(vertices, faces, object_id, passes)
    material: Material = surface.materials()
    if shift is not None or textures is not None:
        material = EditedMaterials(material, len(faces), shift, textures)
    outside = environment_of(state, room, up)
    return World(geometry, material, lamp_of_face, side, columns, level, found, outside, len(columns) - 1)


def painted(surface: BaseScene, inventory: Inventory, materials: dict[str, dict[str, Any]]) -> BaseScene:
    """Return the surface with the materials of a dumped relighting."""
    cells, objects = surface.cell_values.copy(), surface.object_values.copy()
    for key, paint in materials.items():
        number = object_number(key, inventory.names, "relight.materials")
        own = surface.cell_object == number
        cells[own], objects[number] = _repainted(cells[own], paint), _repainted(objects[number], paint)
    return replace(surface, cell_values=cells, object_values=objects)


def _repainted(rows: Array, paint: dict[str, Any]) -> Array:
    """Return materials (..., 5) under other paint."""
    out = rows.copy()
    if paint["albedo"] is not None:
        out[..., :3] = paint["albedo"]
    if paint["tint"] is not None:
        out[..., :3] = np.minimum(out[..., :3] * np.asarray(paint["tint"], np.float32), 1.0)
    for column, name in ((3, "roughness"), (4, "metallic")):
        if paint[name] is not None:
            out[..., column] = paint[name]
    return out


def _moved(
    surface: BaseScene, room: Recovered, inventory: Inventory, moves: dict[str, list[float]]
) -> tuple[Array, Array, Array | None]:
    """Vertices, faces and shift (m, 3) of each face; a lamp that is named by its object takes the object with it."""
    if not moves:
        return surface.vertices, surface.faces, None
    shift = np.zeros((len(surface.faces), 3), np.float32)
    for key, move in moves.items():
        for place in inventory.lamps_called(key, "relight.lamps"):
            lamp = inventory.lamps[place]
            own = room.emitter_id == lamp.emitter_id
            if named := [o for o in lamp.objects if inventory.is_called(o, key)]:
                own = np.isin(surface.object_id, named)
            shift[own] = np.asarray(move, np.float32)
    goes = np.flatnonzero(shift.any(1))
    corners = surface.vertices[surface.faces[goes]] + shift[goes, None]
    faces = surface.faces.copy()
    faces[goes] = np.arange(3 * len(goes), dtype=np.int32).reshape(-1, 3) + len(surface.vertices)
    return np.concatenate([surface.vertices, corners.reshape(-1, 3).astype(np.float32)]), faces, shift


def _insert_all(inserts: list[dict[str, Any]], up: Array, add: Any) -> Textures | None:
    """Put all meshes in and return the textures of their faces."""
    if not inserts:
        return None
    from iif_core.light.transport.edits import Textures, uv_maps

    texels: list[Array] = []
    start, rows = 0, []
    for insert in inserts:
        mesh = load_insert(Path(insert["file"]))
        corners = placed(mesh, insert, up)
        both = mesh.double_sided[mesh.texture] & (insert["radiance"] is None)
        add(corners, light_of(mesh, insert), name_of(insert), both)
        textures, number = mesh.textures, mesh.texture
        if insert["material"] is not None:
            own = insert["material"]
            textures = [np.array([*own["albedo"], own["roughness"], own["metallic"]], np.float32).reshape(1, 1, 5)]
            number = np.zeros(len(corners), np.int64)
        first = []
        for texture in textures:
            first.append(start)
            texels.append(texture.reshape(-1, 5))
            start += len(texels[-1])
        sizes = np.array([texture.shape[:2] for texture in textures])
        # Lookups are made in float32, so that the corners are taken as the device has them.
        rows.append((np.array(first)[number], sizes[number, 1], sizes[number, 0], uv_maps(np.float32(corners), mesh.uv)))
    joined = (np.concatenate(part) for part in zip(*rows, strict=True))
    return Textures(np.concatenate(texels), *joined)


def environment_of(state: dict[str, Any], room: Recovered, up: Array) -> Array:
    """Return the radiance from outside, (3,) or (H, W, 3): what was found, or what replaces it."""
    wanted = state["environment"]
    if wanted == "keep":
        return room.light.environment
    if isinstance(wanted, str):
        return read_environment(Path(wanted), up, state["environment_turn"])
    return np.asarray(wanted, np.float32)


def read_environment(path: Path, up: Array, turn: float) -> Array:
    """(H, W, 3) map in world axes from a latitude-longitude picture: top row = up, to the right = clockwise seen from above."""
    exr_size(path)
    with reading(path, "cannot be read"):
        channels = read_exr(path)
    if not {"R", "G", "B"} <= set(channels):
        raise InputError(f"{path}: found the channels {', '.join(channels)}; an environment needs R, G and B")
    image = as_map(np.maximum(rgb(channels).astype(np.float32), 0))[:, ::-1]  # columns of a map run counter-clockwise
    rows = min(MAP_ROWS, len(image))
    points = 2 * -(-len(image) // rows)
    return resample(image, axes_of_map(up, turn), rows, 2 * rows, points)


def lamp_weights(entry: dict[str, Any], inventory: Inventory, columns: list[str], level: Array, found: Array) -> Array:
    """Return the factors (L, 3) on the white light of each lamp that a dumped relighting asks for.

    Args:
        entry: the relighting; inventory: of the room.
        columns, level, found: of a `World`, or of a basis that was traced in one.
    """
    wanted = found.copy()
    for place, lamp in enumerate(inventory.lamps):
        wanted[columns.index(f"emitter {lamp.emitter_id}")] = entry["emitters"] * found[place]
    for key, change in entry["lamps"].items():
        for place in inventory.lamps_called(key, "relight.lamps"):
            column = columns.index(f"emitter {inventory.lamps[place].emitter_id}")
            wanted[column] = coloured(found[column], change["factor"], change["colour"])
    light = entry["environment"]
    if light == "off" or isinstance(light, float | int):
        wanted[-1] = 0.0 if light == "off" else light
    return np.divide(wanted, level[:, None], out=np.zeros_like(wanted), where=level[:, None] > 0)


AS_FOUND = {"emitters": 1.0, "lamps": {}, "environment": "keep", "sphere": None, "insert": [], "materials": {}}
"""What makes of a dumped relighting the room as it was found, from the same camera."""
