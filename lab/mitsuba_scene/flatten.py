"""Merges all shapes of a scene into one welded triangle mesh that records the shape and primitive of every face."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from iif_core.errors import InputError
from lab.mitsuba_scene.scene import LoadedScene, Shape, children

Array = np.ndarray

SEGMENTS = 64  # around a sphere, cylinder or disk; chords leave the circle by 0.12 % of the radius
SUPPORTED = ("ply", "obj", "serialized", "cube", "merge", "rectangle", "disk", "sphere", "cylinder", "instance")
MIN_RELATIVE_AREA = 1e-7
"""Twice the area of a face over its longest edge squared; below this a face has no normal in float32."""


@dataclass
class FlatMesh:
    """The merged mesh.

    Attributes:
        vertices: (n, 3) float32 metres, welded.
        faces: (m, 3) int32; the right-hand normal points to Mitsuba's front side.
        uv: (m, 3, 2) float32, texture coordinates of the corners.
        shape: (m,) int32, index into `shapes`.
        primitive: (m,) int32, face of the shape's own mesh; -1 where it was tessellated here.
        emission: (m, 3) float32 radiance of the front side.
        shapes: all shapes of the scene.
        notes: what was left out, as text.
    """

    vertices: Array
    faces: Array
    uv: Array
    shape: Array
    primitive: Array
    emission: Array
    shapes: list[Shape]
    notes: list[str]


def flatten(loaded: LoadedScene) -> FlatMesh:
    """Merge and weld every shape that can become triangles.

    Vertices are welded where all three float32 coordinates are equal. Faces without area are dropped. Of several faces over the
    same three vertices one is kept: a light rather than other surface, else the first. The notes name everything dropped.

    Raises:
        InputError: no face is left.
    """
    parts: list[tuple[Array, Array, Array, Array, Array, Array]] = []
    unsupported: Counter[str] = Counter()
    skipped_lights: Counter[str] = Counter()
    tessellated = 0
    offset = 0
    for index, shape in enumerate(loaded.shapes):
        light = shape.object.emitter()
        surface = _triangles(shape, textured_light=light is not None and _varies(light))
        if surface is None:
            unsupported[shape.plugin] += 1
            continue
        vertices, faces, uv, primitive = surface
        tessellated += shape.plugin in ("disk", "sphere", "cylinder")
        if shape.placement is not None:
            vertices = vertices @ shape.placement[:3, :3].T + shape.placement[:3, 3]
            if np.linalg.det(shape.placement[:3, :3]) < 0:
                faces, uv = faces[:, [0, 2, 1]], uv[:, [0, 2, 1]]
        emission = np.zeros((len(faces), 3), np.float32)
        if light is not None:
            if light.class_name() == "AreaLight":
                emission = _emission(shape, light, uv, primitive)
            else:
                skipped_lights[light.class_name()] += 1
        ids = np.full(len(faces), index, np.int32)
        parts.append((vertices.astype(np.float32), faces.astype(np.int64) + offset, uv, ids, primitive, emission))
        offset += len(vertices)
    if not offset or not any(len(part[1]) for part in parts):
        raise InputError(f"the scene has no surface that can become triangles; supported: {', '.join(SUPPORTED)}")

    columns = [np.concatenate([part[i] for part in parts]) for i in range(6)]
    parts.clear()
    vertices, faces, uv, ids, primitive, emission = columns
    left_out = "shapes left out of the mesh (not triangles); the photographs show them"
    notes = [f"{n} {plugin} {left_out}" for plugin, n in unsupported.items()]
    if tessellated:
        notes.append(f"{tessellated} disks, spheres and cylinders became triangles, {SEGMENTS} around")
    notes += [f"{n} shapes with the light {kind}: no emission truth on the mesh" for kind, n in skipped_lights.items()]

    vertices, faces = _weld(vertices, faces)
    keep, degenerate, repeated = _proper(vertices, faces, emission.any(1))
    if degenerate:
        notes.append(f"{degenerate} faces without area left out")
    if repeated:
        notes.append(f"{repeated} faces over the same three vertices as another face left out")
    if not keep.any():
        raise InputError(f"all {len(keep)} faces of the scene are without area")
    mesh = FlatMesh(vertices, faces[keep], uv[keep], ids[keep], primitive[keep], emission[keep], loaded.shapes, notes)
    return compact(mesh)


def compact(mesh: FlatMesh, keep: Array | None = None) -> FlatMesh:
    """Return the mesh with only the faces `keep` (m,) bool and the vertices that they use, in the same order."""
    chosen = slice(None) if keep is None else keep
    faces = mesh.faces[chosen]
    used = np.zeros(len(mesh.vertices), bool)
    used[faces.ravel()] = True
    new_id = np.cumsum(used) - 1
    return FlatMesh(
        mesh.vertices[used],
        new_id[faces].astype(np.int32),
        mesh.uv[chosen],
        mesh.shape[chosen],
        mesh.primitive[chosen],
        mesh.emission[chosen],
        mesh.shapes,
        mesh.notes,
    )


# --------------------------------------------------------------------------------------------------------- one shape


def _triangles(shape: Shape, textured_light: bool) -> tuple[Array, Array, Array, Array] | None:
    """Return vertices (n, 3) float64, faces (m, 3), corner uv (m, 3, 2) and primitive (m,), or None without triangles."""
    if shape.plugin == "rectangle":
        local, faces, uv = _grid_rectangle(16 if textured_light else 1)
    elif shape.plugin == "disk":
        local, faces, uv = _grid_disk(8 if textured_light else 1)
    elif shape.plugin == "sphere":
        local, faces, uv = _grid_sphere()
    elif shape.plugin == "cylinder":
        local, faces, uv = _grid_cylinder()
    elif hasattr(shape.object, "vertex_positions_buffer") and hasattr(shape.object, "faces_buffer"):
        return _mesh_triangles(shape)
    else:
        return None
    to_world = np.array(mi.traverse(shape.object)["to_world"].matrix, np.float64).reshape(4, 4)
    vertices = local @ to_world[:3, :3].T + to_world[:3, 3]
    if not _faces_front(shape.object, local[faces[0]], vertices[faces[0]]):
        faces, uv = faces[:, [0, 2, 1]], uv[:, [0, 2, 1]]
    return vertices, faces, uv, np.full(len(faces), -1, np.int32)


def _mesh_triangles(shape: Shape) -> tuple[Array, Array, Array, Array]:
    mesh = shape.object
    vertices = np.array(mesh.vertex_positions_buffer(), np.float64).reshape(-1, 3)
    faces = np.array(mesh.faces_buffer()).reshape(-1, 3).astype(np.int64)
    primitive = np.arange(len(faces), dtype=np.int32)
    if mesh.has_vertex_texcoords():
        uv = np.array(mesh.vertex_texcoords_buffer(), np.float32).reshape(-1, 2)[faces]
    else:  # Mitsuba then uses the barycentric position as uv
        uv = np.broadcast_to(np.array([[0, 0], [1, 0], [0, 1]], np.float32), (len(faces), 3, 2)).copy()
    if not np.isfinite(vertices).all():
        wrong = np.count_nonzero(~np.isfinite(vertices).all(1))
        raise InputError(f"shape {shape.name}: {wrong} vertices are not finite; mend the mesh")
    flip = np.full(len(faces), mesh.has_flipped_normals())
    if mesh.emitter() is not None and len(faces):  # a light emits to the side of its shading normal
        si = interaction_at_centres(mesh, primitive)
        corners = vertices[faces]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        flip = (normal * np.array(si.sh_frame.n, np.float64).T).sum(1) < 0
    faces[flip] = faces[flip][:, [0, 2, 1]]
    uv[flip] = uv[flip][:, [0, 2, 1]]
    return vertices, faces, uv, primitive


def interaction_at_centres(mesh: Any, primitive: Array) -> Any:
    """Return Mitsuba's surface interaction at the centres of triangles of one mesh."""
    hit = dr.zeros(mi.PreliminaryIntersection3f, len(primitive))
    hit.t = dr.full(mi.Float, 1, len(primitive))
    hit.prim_index = mi.UInt32(primitive.astype(np.uint32))
    hit.prim_uv = mi.Point2f(1 / 3, 1 / 3)
    hit.shape = mi.ShapePtr(mesh)
    return mesh.compute_surface_interaction(dr.zeros(mi.Ray3f, len(primitive)), hit, mi.RayFlags.All)


def _faces_front(shape: Any, local: Array, corners: Array) -> bool:
    """Return whether the right-hand normal of a triangle, (3, 3) local and in the world, points to Mitsuba's front side."""
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    length = np.linalg.norm(normal)
    reach = np.sqrt(length)
    origin = corners[1] + normal / length * reach
    ray = mi.Ray3f(mi.Point3f(*origin.tolist()), mi.Vector3f(*(-normal / length).tolist()))
    hit = dr.zeros(mi.PreliminaryIntersection3f)
    hit.t, hit.prim_uv, hit.shape = mi.Float(reach), mi.Point2f(*local[1, :2].tolist()), mi.ShapePtr(shape)
    si = shape.compute_surface_interaction(ray, hit, mi.RayFlags.All)
    return float(np.array(si.sh_frame.n).ravel() @ normal) > 0


def _grid_rectangle(n: int) -> tuple[Array, Array, Array]:
    line = np.linspace(0, 1, n + 1)
    u, v = np.meshgrid(line, line, indexing="ij")
    uv = np.column_stack([u.ravel(), v.ravel()])
    faces = _quads(n, n, n + 1)
    local = np.column_stack([2 * uv - 1, np.zeros(len(uv))])
    return local, faces, uv[faces].astype(np.float32)


def _grid_disk(rings: int) -> tuple[Array, Array, Array]:
    turn = np.linspace(0, 1, SEGMENTS + 1)
    radius = np.linspace(0, 1, rings + 1)
    r, t = np.meshgrid(radius, turn, indexing="ij")
    uv = np.column_stack([r.ravel(), t.ravel()])
    local = np.column_stack([uv[:, :1] * _around(t.ravel()), 0 * uv[:, 0]])
    faces = _quads(rings, SEGMENTS, SEGMENTS + 1)
    return local, *_without_poles(local, faces, uv)


def _grid_sphere() -> tuple[Array, Array, Array]:
    turn, polar = np.linspace(0, 1, SEGMENTS + 1), np.linspace(0, 1, SEGMENTS // 2 + 1)
    t, p = np.meshgrid(turn, polar, indexing="ij")
    uv = np.column_stack([t.ravel(), p.ravel()])
    radius = np.where((uv[:, 1] == 0) | (uv[:, 1] == 1), 0, np.sin(np.pi * uv[:, 1]))
    local = np.column_stack([radius[:, None] * _around(t.ravel()), np.cos(np.pi * uv[:, 1])])
    faces = _quads(SEGMENTS, SEGMENTS // 2, SEGMENTS // 2 + 1)
    return local, *_without_poles(local, faces, uv)


def _grid_cylinder() -> tuple[Array, Array, Array]:
    turn = np.linspace(0, 1, SEGMENTS + 1)
    t, z = np.meshgrid(turn, [0.0, 1.0], indexing="ij")
    uv = np.column_stack([t.ravel(), z.ravel()])
    local = np.column_stack([_around(t.ravel()), z.ravel()])
    faces = _quads(SEGMENTS, 1, 2)
    return local, faces, uv[faces].astype(np.float32)


def _around(turn: Array) -> Array:
    """Return points of the unit circle; a full turn gives exactly the same point as none, so that seams can be welded."""
    angle = 2 * np.pi * (turn % 1)
    return np.column_stack([np.cos(angle), np.sin(angle)])


def _quads(rows: int, columns: int, stride: int) -> Array:
    """Return two triangles for each cell of a (rows + 1) x (columns + 1) grid of vertices."""
    i, j = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    a = (i * stride + j).ravel()
    b, c, d = a + stride, a + stride + 1, a + 1
    return np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])


def _without_poles(local: Array, faces: Array, uv: Array) -> tuple[Array, Array]:
    """Return faces and corner uv without the triangles that collapse at a pole."""
    corners = local[faces]
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    whole = edges.min(1) > 1e-9
    return faces[whole], uv[faces[whole]].astype(np.float32)


# ------------------------------------------------------------------------------------------------------------ lights


def _varies(light: Any) -> bool:
    texture = children(light).get("radiance")
    return texture is not None and texture.is_spatially_varying()


_BARYCENTRIC = np.array([[(i + 1 / 3) / 4, (j + 1 / 3) / 4] for i in range(4) for j in range(4 - i)])
"""Barycentric coordinates of ten points, one in each upright sub-triangle of side 1/4."""


def _emission(shape: Shape, light: Any, uv: Array, primitive: Array) -> Array:
    """Return the radiance (m, 3) of the front sides, averaged over each face where it is textured."""
    if not len(uv):
        return np.zeros((0, 3), np.float32)
    texture = children(light)["radiance"]
    if not texture.is_spatially_varying():
        return np.broadcast_to(texture_at(texture, np.zeros((1, 2), np.float32)), (len(uv), 3)).astype(np.float32)
    total = np.zeros((len(uv), 3))
    for b1, b2 in _BARYCENTRIC:
        total += texture_at(texture, (1 - b1 - b2) * uv[:, 0] + b1 * uv[:, 1] + b2 * uv[:, 2])
    return (total / len(_BARYCENTRIC)).astype(np.float32)


def texture_at(texture: Any, uv: Array) -> Array:
    """Evaluate a Mitsuba texture at uv (n, 2) with its transformation, wrapping and filter: linear RGB (n, 3) float32."""
    si = dr.zeros(mi.SurfaceInteraction3f, len(uv))
    si.uv = mi.Point2f(*(mi.Float(np.ascontiguousarray(uv[:, axis], np.float32)) for axis in range(2)))
    value = np.array(mi.Color3f(texture.eval(si)), np.float32).T
    return np.broadcast_to(value, (len(uv), 3))


# ----------------------------------------------------------------------------------------------------------- welding


def first_of_equal(rows: Array) -> Array:
    """Return, for each row of an (n, 3) array of 4-byte items, the smallest index of a row with the same bits, (n,) int64."""
    words = np.ascontiguousarray(rows).view(np.uint32).astype(np.uint64)
    key = np.zeros(len(words), np.uint64)
    for column, odd in enumerate((0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9)):
        key = (key ^ words[:, column]) * np.uint64(odd)
        key ^= key >> np.uint64(31)
    order = np.argsort(key, kind="stable")
    starts = np.ones(len(order), bool)
    starts[1:] = key[order[1:]] != key[order[:-1]]
    same = (words[order[1:]] == words[order[:-1]]).all(1)
    if not (same | starts[1:]).all():  # where two different rows share a hash, the rows themselves are sorted
        order = np.lexsort(words.T[::-1])
        starts[1:] = (words[order[1:]] != words[order[:-1]]).any(1)
    first = np.empty(len(order), np.int64)
    first[order] = order[starts][np.cumsum(starts) - 1]
    return first


def _weld(vertices: Array, faces: Array) -> tuple[Array, Array]:
    vertices = vertices + np.float32(0)  # -0 becomes +0
    first = first_of_equal(vertices)
    own = first == np.arange(len(first))
    new_id = (np.cumsum(own) - 1)[first]
    return vertices[own], new_id[faces].astype(np.int32)


def _proper(vertices: Array, faces: Array, emissive: Array) -> tuple[Array, int, int]:
    """Return which faces (m,) bool have area and do not repeat the vertices of another, and the counts of both kinds left out."""
    area, longest = np.empty(len(faces)), np.empty(len(faces))
    for start in range(0, len(faces), 1 << 20):
        part = slice(start, start + (1 << 20))
        a, b, c = (vertices[faces[part, i]].astype(np.float64) for i in range(3))
        area[part] = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        longest[part] = np.max([((b - a) ** 2).sum(1), ((c - b) ** 2).sum(1), ((a - c) ** 2).sum(1)], axis=0)
    keep = area > MIN_RELATIVE_AREA * longest
    degenerate = int(np.count_nonzero(~keep))
    order = np.argsort(~emissive, kind="stable")  # lights first
    order = order[keep[order]]
    first = first_of_equal(np.sort(faces[order], axis=1).astype(np.int32))
    twin = first != np.arange(len(first))
    keep[order[twin]] = False
    return keep, degenerate, int(np.count_nonzero(twin))
