"""The recovered scene as coloured triangle meshes, one part an object or emitter: what every exporter starts from.

Materials live on surface cells; other programs want them on vertices. So large faces are split until their edges are as
short as a budget allows, and every vertex takes the mean of the cells next to it. Faces are turned to the side that the
photographs saw, because other programs cull, light and emit by orientation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from iif_core.errors import InputError

Array = np.ndarray

MIN_AREA = 1e-12  # m^2; smaller faces have no normal
CREASE_COSINE = 0.7660444  # cos 40 degrees: sharper edges get two normals
TWO_SIDED_SHARE = 0.02  # an object with more of its pixels on the far side of faces is a sheet seen from both sides


@dataclass(frozen=True)
class RecoveredScene:
    """What the workflow found, as arrays. Lengths in metres; colours linear; ids int32, -1 = none.

    Attributes:
        vertices, faces: (n, 3) float32, (m, 3) int32.
        object_id: (m,) of each face; object_names: one per object id.
        cells: (c, 3) float32 centres; cell_object: (c,); cell_values: (c, 5) albedo R G B, roughness, metallic.
        object_values: (objects, 5), for surface without cells.
        emitter_id: (m,) of each face, -1 = none; emitter_side: (m,) +1 front, -1 back, 0 both.
        emitter_radiance: (emitters, 3), one row per emitter id.
        environment: (3,) or (H, W, 3) radiance of what the mesh does not cover, as in `iif_core.light.environment`.
        seen_front, seen_back: (m,) pixels that saw each side of a face.
        up: (3,) unit vector.
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


@dataclass(frozen=True)
class Part:
    """One mesh: an object without its emitters, or one emitter of an object. Normals unit, towards the observers."""

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


def build_parts(scene: RecoveredScene, longest_edge: float, max_faces: int) -> list[Part]:
    """Split, orient and colour the surface.

    Args:
        longest_edge: edges are halved until they are no longer than this (metres) ...
        max_faces: ... or until the faces are this many; then all stay equally coarse.

    Returns:
        Parts in order of object and emitter; names are unique. Emitters are black (they reflect nothing in the model).

    Raises:
        InputError: no face with an area.
    """
    vertices = np.asarray(scene.vertices, np.float64)
    faces = np.asarray(scene.faces, np.int64)
    area = 0.5 * np.linalg.norm(_cross(vertices, faces), axis=1)
    kept = np.flatnonzero(area > MIN_AREA)
    if not len(kept):
        raise InputError(f"mesh of {len(faces)} faces: none has an area above {MIN_AREA} m^2; nothing can be exported")
    turned, double_sided = _orientation(scene)
    oriented = np.where(turned[:, None], faces[:, ::-1], faces)[kept]
    vertices, oriented = _weld(vertices, oriented)
    vertices, oriented, parent = subdivide(vertices, oriented, longest_edge, max_faces)
    parent = kept[parent]
    objects, emitters = scene.object_id[parent], scene.emitter_id[parent]
    keys, part_of = np.unique(np.stack([objects, emitters], 1), axis=0, return_inverse=True)
    part_of = part_of.ravel()
    groups = _smooth_groups(vertices, oriented, part_of)
    names, parts = _Names(), []
    for p, (object_id, emitter_id) in enumerate(keys.tolist()):
        own = np.flatnonzero(part_of == p)
        corners = np.stack([oriented[own].ravel(), np.repeat(groups[own], 3)], 1)
        split, local = np.unique(corners, axis=0, return_inverse=True)
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
                bool(sides),
            )
        )
    return parts


def seen_sides(vertices: Array, faces: Array, face_id: Array, eye: Array) -> tuple[Array, Array]:
    """Pixels of one view that see the front and the back of every face: (m,), (m,) int64.

    `face_id` (H, W), -1 = none; `eye` (3,) in metres. Front is the side of the right-hand normal.
    """
    count = np.bincount(face_id[face_id >= 0].ravel(), minlength=len(faces))
    normal = _cross(vertices, faces)
    front = np.einsum("ij,ij->i", normal, np.asarray(eye, np.float64) - vertices[faces[:, 0]]) > 0
    return np.where(front, count, 0), np.where(front, 0, count)


def up_axis(world_from_camera: Array) -> Array:
    """World axis nearest to the mean upward direction of the cameras (V, 4, 4); (3,), z if the cameras cancel out."""
    mean = -np.asarray(world_from_camera, np.float64)[:, :3, 1].sum(0)
    axis = np.zeros(3)
    strongest = int(np.argmax(np.abs(mean)))
    if abs(mean[strongest]) < 1e-6:
        strongest, mean = 2, np.ones(3)
    axis[strongest] = np.sign(mean[strongest])
    return axis


def subdivide(vertices: Array, faces: Array, longest: float, max_faces: int) -> tuple[Array, Array, Array]:
    """Halve edges until none is longer than `longest` or the faces would be more than `max_faces`.

    Edges are split for all faces that share them, so no cracks appear. The longest go first: each round halves the
    limit.

    Returns:
        vertices (n', 3), faces (m', 3), parent (m',): which face each one came from.
    """
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    parent = np.arange(len(faces))
    if not longest > 0:
        raise InputError(f"subdivision to edges of {longest} m: must be positive")
    limit = np.inf
    while True:
        pairs = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1)
        edges, edge_of = np.unique(pairs, axis=0, return_inverse=True)
        edge_of = edge_of.reshape(-1, 3)
        length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
        limit = max(longest, min(limit, length.max()) / 2)
        marked = length > limit * (1 + 1e-9)
        if not marked.any():
            if limit <= longest:
                return vertices, faces, parent
            continue
        if len(faces) + np.count_nonzero(marked[edge_of]) > max_faces:
            return vertices, faces, parent
        middle = np.full(len(edges), -1, np.int64)
        middle[marked] = len(vertices) + np.arange(np.count_nonzero(marked))
        vertices = np.concatenate([vertices, vertices[edges[marked]].mean(1)])
        faces, source = _split(vertices, faces, middle[edge_of])
        parent = parent[source]


def vertex_normals(vertices: Array, faces: Array) -> Array:
    """(n, 3) unit normals, mean of the faces around a vertex weighted by their angle there; +z where there is none."""
    corner = vertices[faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    total = np.zeros((len(vertices), 3))
    for i in range(3):
        a = _unit(corner[:, (i + 1) % 3] - corner[:, i])
        b = _unit(corner[:, (i + 2) % 3] - corner[:, i])
        angle = np.arccos(np.clip(np.einsum("ij,ij->i", a, b), -1, 1))[:, None]
        for c in range(3):
            total[:, c] += np.bincount(faces[:, i], (normal * angle)[:, c], len(vertices))
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 1e-9, total / np.maximum(length, 1e-300), [0.0, 0.0, 1.0])


# ----------------------------------------------------------------------------------------------------------- internals


class _Names:
    """Object names may repeat; files and glTF nodes should not."""

    def __init__(self) -> None:
        self._used: set[str] = set()

    def unique(self, name: str) -> str:
        candidate, number = name, 1
        while candidate in self._used:
            number += 1
            candidate = f"{name}.{number}"
        self._used.add(candidate)
        return candidate


def _cross(vertices: Array, faces: Array) -> Array:
    a, b, c = (np.asarray(vertices, np.float64)[faces[:, i]] for i in range(3))
    return np.cross(b - a, c - a)


def _unit(v: Array) -> Array:
    return v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-300)


def _weld(vertices: Array, faces: Array) -> tuple[Array, Array]:
    """Vertices at the same place become one; unused ones go."""
    unique, inverse = np.unique(vertices, axis=0, return_inverse=True)
    faces = inverse.ravel()[faces]
    used, local = np.unique(faces, return_inverse=True)
    return unique[used], local.reshape(-1, 3)


def _orientation(scene: RecoveredScene) -> tuple[Array, Array]:
    """Which faces to turn (m,), and whether the object of a face was seen from both sides (m,).

    A face turns when most of its pixels saw its back; one that nobody saw does as most of its connected object does.
    Emitters turn so that they emit to their front, whatever was seen.
    """
    front, back = scene.seen_front.astype(np.int64), scene.seen_back.astype(np.int64)
    group = _components(scene)
    n = int(group.max()) + 1
    group_turned = np.bincount(group, back, n) > np.bincount(group, front, n)
    turned = np.where(front + back > 0, back > front, group_turned[group])
    objects = np.unique(scene.object_id, return_inverse=True)[1]
    minority = np.bincount(objects, np.minimum(front, back))
    total = np.bincount(objects, front + back)
    # Nothing seen: nobody knows which side is out, so both are drawn.
    double = (minority > TWO_SIDED_SHARE * total) | (total == 0)
    emits = scene.emitter_id >= 0
    turned = np.where(emits & (scene.emitter_side != 0), scene.emitter_side < 0, turned)
    return turned, double[objects]


def _components(scene: RecoveredScene) -> Array:
    """Label (m,) of connected pieces of each object (faces that share a vertex position)."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    _, weld = np.unique(scene.vertices, axis=0, return_inverse=True)
    corner = weld.ravel()[scene.faces]
    key = np.stack([corner.ravel(), np.repeat(scene.object_id, 3)], 1)
    node = np.unique(key, axis=0, return_inverse=True)[1].ravel()
    m, n = len(scene.faces), int(node.max()) + 1
    face = np.repeat(np.arange(m), 3)
    graph = coo_matrix((np.ones(3 * m, np.int8), (face, m + node)), (m + n, m + n))
    return connected_components(graph, directed=False)[1][:m]


def _split(vertices: Array, faces: Array, middle: Array) -> tuple[Array, Array]:
    """Split faces at the midpoints of their edges (v0v1, v1v2, v2v0), -1 = edge stays: faces and their sources."""
    count = (middle >= 0).sum(1)
    out, source = [faces[count == 0]], [np.flatnonzero(count == 0)]

    def add(rows: Array, *triangles: tuple[Array, Array, Array]) -> None:
        for triangle in triangles:
            out.append(np.stack(triangle, 1))
            source.append(rows)

    def rotated(rows: Array, first: Array) -> tuple[Array, Array]:
        order = (first[:, None] + np.arange(3)) % 3
        return np.take_along_axis(faces[rows], order, 1), np.take_along_axis(middle[rows], order, 1)

    one = np.flatnonzero(count == 1)
    v, e = rotated(one, np.argmax(middle[one] >= 0, 1))
    add(one, (v[:, 0], e[:, 0], v[:, 2]), (e[:, 0], v[:, 1], v[:, 2]))
    two = np.flatnonzero(count == 2)
    v, e = rotated(two, (np.argmin(middle[two], 1) + 1) % 3)  # the edge that stays comes last
    add(two, (e[:, 0], v[:, 1], e[:, 1]))
    down = _distance(vertices, v[:, 0], e[:, 1]) < _distance(vertices, e[:, 0], v[:, 2])
    for chosen, diagonal in ((down, True), (~down, False)):
        a, b, c, d = v[chosen, 0], e[chosen, 0], e[chosen, 1], v[chosen, 2]
        rows = two[chosen]
        add(rows, *(((a, b, c), (a, c, d)) if diagonal else ((a, b, d), (b, c, d))))
    three = np.flatnonzero(count == 3)
    v, e = faces[three], middle[three]
    add(
        three,
        (v[:, 0], e[:, 0], e[:, 2]),
        (e[:, 0], v[:, 1], e[:, 1]),
        (e[:, 2], e[:, 1], v[:, 2]),
        (e[:, 0], e[:, 1], e[:, 2]),
    )
    source_rows = np.concatenate(source)
    order = np.argsort(source_rows, kind="stable")
    return np.concatenate(out)[order], source_rows[order]


def _distance(vertices: Array, a: Array, b: Array) -> Array:
    return np.linalg.norm(vertices[a] - vertices[b], axis=1)


def _smooth_groups(vertices: Array, faces: Array, part_of: Array) -> Array:
    """Label (m,) of faces of one part that are connected by edges less sharp than 40 degrees."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    normal = _unit(_cross(vertices, faces))
    pairs = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1)
    face = np.repeat(np.arange(len(faces)), 3)
    order = np.lexsort((pairs[:, 1], pairs[:, 0]))
    same = (pairs[order][1:] == pairs[order][:-1]).all(1)
    a, b = face[order][:-1][same], face[order][1:][same]
    smooth = (np.einsum("ij,ij->i", normal[a], normal[b]) > CREASE_COSINE) & (part_of[a] == part_of[b])
    graph = coo_matrix((np.ones(np.count_nonzero(smooth), np.int8), (a[smooth], b[smooth])), (len(faces),) * 2)
    return connected_components(graph, directed=False)[1]


def _vertex_values(scene: RecoveredScene, object_id: int, xyz: Array, reach: float) -> Array:
    """(n, 5) material of the vertices of one object.

    Every cell gives its value to its nearest vertex; a vertex without cells takes the nearest cell of the object within
    four edge lengths, else the object's mean.
    """
    from scipy.spatial import cKDTree

    known = 0 <= object_id < len(scene.object_values)
    mean = scene.object_values[object_id] if known else np.float32([0.5, 0.5, 0.5, 0.9, 0.0])
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
