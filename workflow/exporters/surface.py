"""Converts the recovered scene to coloured triangle meshes, one part per object or emitter, which every exporter writes.

Large faces are split, because other programs store colours on vertices; faces are turned towards the photographs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from iif_core.errors import InputError
from iif_core.numerics.arrays import unique_rows
from iif_core.numerics.graph import component_labels
from iif_core.reflectance.material import NEUTRAL
from iif_core.surface.triangles import face_crosses, face_geometry, smooth_groups, subdivide, vertex_normals, weld

Array = np.ndarray

MIN_AREA = 1e-12  # m^2; smaller faces have no normal
CREASE_COSINE = 0.7660444  # cos 40 degrees; sharper edges get two normals
TWO_SIDED_SHARE = 0.02  # an object with more of its pixels on the back of faces is a sheet seen from both sides


@dataclass(frozen=True)
class RecoveredScene:
    """The recovered scene as arrays; lengths in metres, colours linear, ids int32 with -1 = none.

    Attributes:
        vertices, faces: (n, 3) float32, (m, 3) int32.
        object_id: (m,) of each face; object_names: one per object id.
        cells: (c, 3) float32 centres; cell_object: (c,); cell_values: (c, 5) albedo R G B, roughness, metallic.
        object_values: (objects, 5), for surface without cells.
        emitter_id: (m,) of each face, -1 = none; emitter_side: (m,) +1 front, -1 back, 0 both.
        emitter_radiance: (emitters, 3), one row per emitter id.
        environment: (3,) or (H, W, 3) radiance outside of the mesh, as in `iif_core.light.environment`.
        seen_front, seen_back: (m,) numbers of pixels that see each side of a face.
        up: (3,) unit vector.
        transmittance: (objects,) share of the light that passes straight through each; None = none.
    """

    vertices: Array
    faces: Array
    object_id: Array
    object_names: Sequence[str]
    cells: Array
    cell_object: Array
    cell_values: Array
    object_values: Array
    emitter_id: Array
    emitter_side: Array
    emitter_radiance: Array
    environment: Array
    seen_front: Array
    seen_back: Array
    up: Array
    transmittance: Array | None = None


@dataclass(frozen=True)
class Part:
    """One mesh: an object without its emitters, or one emitter of an object. Unit normals point towards the photographs."""

    name: str
    object_id: int
    emitter_id: int
    vertices: Array  # (n, 3) float32
    normals: Array  # (n, 3) float32
    faces: Array  # (m, 3) int32
    albedo: Array  # (n, 3) float32
    roughness: Array  # (n,) float32
    metallic: Array  # (n,) float32
    radiance: Array  # (3,) float32, 0 for what does not emit
    double_sided: bool
    opacity: float = 1.0  # share of the light that does not pass straight through


def build_parts(scene: RecoveredScene, longest_edge: float, max_faces: int) -> list[Part]:
    """Split, orient and colour the surface: parts in order of object and emitter, with unique names; emitters are black.

    Edges longer than `longest_edge` (metres) are halved as long as there are at most `max_faces`; all parts stay equally coarse.

    Raises:
        InputError: no face with an area.
    """
    vertices = np.asarray(scene.vertices, np.float64)
    faces = np.asarray(scene.faces, np.int64)
    kept = np.flatnonzero(face_geometry(vertices, faces)[1] > MIN_AREA)
    if not len(kept):
        raise InputError(f"mesh of {len(faces)} faces: none has an area above {MIN_AREA} m^2; nothing can be exported")
    turned, double_sided = _orientation(scene)
    oriented = np.where(turned[:, None], faces[:, ::-1], faces)[kept]
    vertices, oriented = weld(vertices, oriented)
    vertices, oriented, parent = subdivide(vertices, oriented, longest_edge, max_faces)
    parent = kept[parent]
    objects, emitters = scene.object_id[parent], scene.emitter_id[parent]
    keys, part_of = unique_rows(np.stack([objects, emitters], 1))
    groups = smooth_groups(vertices, oriented, part_of, CREASE_COSINE)
    names, parts = _Names(), []
    for p, (object_id, emitter_id) in enumerate(keys.tolist()):
        own = np.flatnonzero(part_of == p)
        corners = np.stack([oriented[own].ravel(), np.repeat(groups[own], 3)], 1)
        split, local = unique_rows(corners)
        local = local.reshape(-1, 3)
        xyz = vertices[split[:, 0]]
        normals = vertex_normals(xyz, local)
        name = scene.object_names[object_id] if 0 <= object_id < len(scene.object_names) else "unlabelled"
        radiance = np.zeros(3, np.float32)
        sides = double_sided[parent[own]].any()
        if emitter_id >= 0:
            name = f"{name}.emitter{emitter_id}"
            radiance = np.asarray(scene.emitter_radiance[emitter_id], np.float32)
            sides = bool((scene.emitter_side[parent[own]] == 0).any())
            values = np.tile(np.float32([0, 0, 0, 1, 0]), (len(xyz), 1))
        else:
            values = _vertex_values(scene, object_id, xyz, longest_edge)
        values = np.clip(values, 0, 1).astype(np.float32)
        sheer = scene.transmittance is not None and object_id >= 0
        opacity = 1.0 - float(scene.transmittance[object_id]) if sheer else 1.0
        parts.append(
            Part(
                names.unique(name),
                object_id,
                emitter_id,
                xyz.astype(np.float32),
                normals.astype(np.float32),
                local.astype(np.int32),
                values[:, :3],
                values[:, 3],
                values[:, 4],
                radiance,
                bool(sides) or opacity < 1,
                opacity,
            )
        )
    return parts


def seen_sides(vertices: Array, faces: Array, face_id: Array, eye: Array) -> tuple[Array, Array]:
    """Count the pixels of one view that see the front and the back of every face.

    Args:
        vertices, faces: the mesh.
        face_id: (H, W), -1 = none.
        eye: (3,) position of the camera, metres.

    Returns:
        (m,) and (m,) int64 counts of front and back; front is the side of the right-hand normal.
    """
    count = np.bincount(face_id[face_id >= 0].ravel(), minlength=len(faces))
    normal = face_crosses(vertices, faces)
    front = np.einsum("ij,ij->i", normal, np.asarray(eye, np.float64) - vertices[faces[:, 0]]) > 0
    return np.where(front, count, 0), np.where(front, 0, count)


def up_axis(world_from_camera: Array) -> Array:
    """Return the world axis (3,) nearest to the mean upward direction of the cameras (V, 4, 4); z if they cancel out."""
    mean = -np.asarray(world_from_camera, np.float64)[:, :3, 1].sum(0)
    axis = np.zeros(3)
    strongest = int(np.argmax(np.abs(mean)))
    if abs(mean[strongest]) < 1e-6:
        strongest, mean = 2, np.ones(3)
    axis[strongest] = np.sign(mean[strongest])
    return axis


# ----------------------------------------------------------------------------------------------------------- internals


class _Names:
    """Makes names unique, because those of objects may repeat and those of files and glTF nodes should not."""

    def __init__(self) -> None:
        self._used: set[str] = set()

    def unique(self, name: str) -> str:
        candidate, number = name, 1
        while candidate in self._used:
            number += 1
            candidate = f"{name}.{number}"
        self._used.add(candidate)
        return candidate


def _orientation(scene: RecoveredScene) -> tuple[Array, Array]:
    """Return which faces to turn (m,), and whether the object of a face was seen from both sides (m,).

    A face is turned if most of its pixels see its back; a face that no pixel sees follows the majority of its connected piece.
    Emitters are turned such that they emit to their front.
    """
    front, back = scene.seen_front.astype(np.int64), scene.seen_back.astype(np.int64)
    group = _components(scene)
    n = int(group.max()) + 1
    group_turned = np.bincount(group, back, n) > np.bincount(group, front, n)
    turned = np.where(front + back > 0, back > front, group_turned[group])
    objects = np.unique(scene.object_id, return_inverse=True)[1]
    minority = np.bincount(objects, np.minimum(front, back))
    total = np.bincount(objects, front + back)
    # If no pixel sees an object, its orientation is unknown and both sides are drawn.
    double = (minority > TWO_SIDED_SHARE * total) | (total == 0)
    emits = scene.emitter_id >= 0
    turned = np.where(emits & (scene.emitter_side != 0), scene.emitter_side < 0, turned)
    return turned, double[objects]


def _components(scene: RecoveredScene) -> Array:
    """Label the connected pieces of each object, (m,); faces are connected if they share a vertex position."""
    _, weld = unique_rows(scene.vertices)
    corner = weld[scene.faces]
    key = np.stack([corner.ravel(), np.repeat(scene.object_id, 3)], 1)
    node = unique_rows(key)[1]
    m, n = len(scene.faces), int(node.max()) + 1
    face = np.repeat(np.arange(m), 3)
    return component_labels(m + n, face, m + node)[:m]


def _vertex_values(scene: RecoveredScene, object_id: int, xyz: Array, reach: float) -> Array:
    """Return the material (n, 5) of the vertices of one object.

    A vertex takes the mean of the cells to which it is the nearest vertex. Without such cells it takes the nearest cell of the
    object within four edge lengths, else the mean of the object.
    """
    from scipy.spatial import cKDTree

    known = 0 <= object_id < len(scene.object_values)
    mean = scene.object_values[object_id] if known else np.float32(NEUTRAL)
    out = np.tile(np.asarray(mean, np.float64), (len(xyz), 1))
    own = np.flatnonzero(scene.cell_object == object_id)
    if not len(own):
        return out
    centres, values = np.asarray(scene.cells[own], np.float64), scene.cell_values[own]
    _, nearest = cKDTree(xyz).query(centres)
    count = np.bincount(nearest, minlength=len(xyz))
    sums = np.stack([np.bincount(nearest, values[:, i], len(xyz)) for i in range(5)], -1)
    filled = count > 0
    out[filled] = sums[filled] / count[filled, None]
    if not filled.all():
        distance, cell = cKDTree(centres).query(xyz[~filled], distance_upper_bound=4 * reach)
        near = np.isfinite(distance)
        rows = np.flatnonzero(~filled)[near]
        out[rows] = values[cell[near]]
    return out
